"""The map: anchors, keyframes, projection of anchors, and frame poses relative to keyframes."""
