"""Stage 3: keyframes, triangulated anchors, edge points and the fused edge map."""
