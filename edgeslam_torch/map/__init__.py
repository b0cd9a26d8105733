"""The map: anchors, keyframes, which anchors a camera should see, and the poses tied to keyframes."""
