"""Calibration files of other programs: their text, their keys, their lens models."""
