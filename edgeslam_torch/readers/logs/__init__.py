"""Columns of telemetry tables, and detection of other programs' logs."""
