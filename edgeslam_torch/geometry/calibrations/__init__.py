"""Calibration files of other programs: text formats, keys and lens models."""
