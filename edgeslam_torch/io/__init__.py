"""Readers that give frames and telemetry, writers that take records."""
