"""Depth near the drone: the network's in the map's metres, and points of the map before it."""
