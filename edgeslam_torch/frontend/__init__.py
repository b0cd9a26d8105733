"""Stage 1: keypoints, edges, corners and depth of single images."""
