"""The mapping service: keyframes in, a map of neural Gaussians and renderings out."""
