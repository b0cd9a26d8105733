"""Depth near the drone: network depth scaled to the map, and map points in front of it."""
