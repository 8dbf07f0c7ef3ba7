"""Open sessions: their requests, the worker that goes on learning, what was acknowledged."""
