"""Telemetry and vision together: extended Kalman filter, metric scale, gravity (stage 2)."""
