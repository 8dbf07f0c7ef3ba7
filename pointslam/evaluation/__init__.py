"""Scores of a run: trajectory errors, image scores, the blocks of metrics.json, a report."""
