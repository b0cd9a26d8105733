"""What the columns of telemetry tables are, and which logs are of other programs."""
