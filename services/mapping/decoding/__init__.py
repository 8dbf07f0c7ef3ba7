"""From anchors to Gaussians, and the optimizer of what decodes them."""
