"""IMUs beside a recording: readings and models in the formats of data sets and calibration programs."""
