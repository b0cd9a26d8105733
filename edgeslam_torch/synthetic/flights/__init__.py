"""Simulated flights through the rooms: the path, telemetry, what a cheap camera adds, the folder on disk."""
