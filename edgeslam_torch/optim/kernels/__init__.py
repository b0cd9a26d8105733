"""The arithmetic of the solver: normal equations of anchors, edges and junctions, and their elimination."""
