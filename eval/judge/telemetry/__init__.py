"""Telemetry made from ground truth, right and faulty, and the scale that a run states while flying."""
