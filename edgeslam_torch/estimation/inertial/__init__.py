"""An IMU beside visual poses: increments between moments, and the alignment of both."""
