"""Seeded textured indoor worlds with exact depth, poses and telemetry."""
