"""Training views: images with depth, posed images of a run, and quantities computed from them."""
