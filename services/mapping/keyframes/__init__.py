"""Keyframes, their landmarks and local maps, and the loops that move them."""
