"""Skills: the behaviours of a flight."""
