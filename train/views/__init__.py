"""What the network learns from: images with depth, posed images of a run, and what is computed from them."""
