"""Calibrate a camera (`board`), and choose the calibration that a source gets (`camera_choice`)."""
