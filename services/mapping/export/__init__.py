"""The map as files that other programs read."""
