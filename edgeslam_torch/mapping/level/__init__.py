"""The vertical of a map, from straight edges and from an accelerometer."""
