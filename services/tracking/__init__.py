"""Tracking service: RGB-D frames in, camera poses and keyframes out."""
