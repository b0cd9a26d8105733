"""Camera calibration (`board`) and the choice of a calibration for a source (`camera_choice`)."""
