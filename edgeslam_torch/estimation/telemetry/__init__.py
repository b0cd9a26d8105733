"""Telemetry and visual poses of the flight so far, the video's delay, the map's attitude, and their agreement."""
