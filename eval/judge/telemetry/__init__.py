"""Telemetry simulated from ground truth, correct and faulty, and scoring of the live scale."""
