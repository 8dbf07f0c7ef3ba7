"""Rendered views: what is seen, from where the map is learned, and how well it is known."""
