"""Views along a path of cameras: where they go, what is written, who waits for it."""
