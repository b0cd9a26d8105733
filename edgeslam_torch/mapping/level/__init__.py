"""Where up is in a map, by straight edges and by an accelerometer."""
