"""Levenberg-Marquardt refinement of poses, anchors, edge depths and junctions."""
