"""Readers that give frames and telemetry: call `source.open_source`."""
