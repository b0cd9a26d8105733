"""Noise of every sensor that the estimation reads: standard deviations with unit and source.

The SDK of a Tello sends velocities in whole dm/s, attitude in whole degrees and range in whole centimetres, ten times a
second. A reading quantised to a step has a standard deviation of the step over the square root of 12.
"""

import math

import numpy as np

# --- velocity ---------------------------------------------------------------------------------------------------------

VELOCITY_SENSOR_M_S = 0.02
"""Of one reading before quantisation; from residuals of recorded flights."""
VELOCITY_M_S = 0.033
"""Of one reading: quantisation to 0.1 m/s, and the sensor."""
VELOCITY_BIAS_M_S = 0.01
"""Of a bias common to neighbouring readings, which decays within `VELOCITY_BIAS_MEMORY_S`; from autocorrelation."""
VELOCITY_BIAS_MEMORY_S = 12.0
VELOCITY_BIAS_WALK_M_S_SQRT_S = 0.015
"""Random walk of the filter's bias, before the battery factor."""
VELOCITY_SCALE_LOG = 0.008
"""Systematic scale error of the drone's velocity, which averaging does not reduce."""
VELOCITY_TRUNCATED_SCALE_LOG = 0.015
"""The same when readings are truncated: the mean remainder depends on an assumed noise."""
PATH_RATIO_LOG = 0.25
"""Of the length of a path by velocities over that by vision: on a slow take-off half of it is quantisation."""

# --- attitude ---------------------------------------------------------------------------------------------------------

ATTITUDE_RAD = math.radians(0.36)
"""Of one reading: 1 deg / sqrt(12) of quantisation, which repeats in hover."""
ATTITUDE_STEP_RAD = math.radians(1.0)
"""Quantisation step of the SDK's attitude: a change by one shows no motion."""
READING_S = 0.1
"""Between two readings. What the drone leans meanwhile is the error of an attitude interpolated between them."""
CONTRADICTS = 3.0
"""Standard deviations of attitude from which on it contradicts the tilt of a pose."""
FIRST_ATTITUDE_RAD = math.radians(1.0)
"""Of the first attitude, per axis: whole degrees, and the drift since power-on."""
ATTITUDE_WALK_RAD_SQRT_S = 0.05
"""Random walk of the angles between readings; set so that rotation errors match their covariance."""
MOUNT_RAD = math.radians(3.0)
"""Of the camera's mount, per axis, until it is estimated from rotations."""
UP_RAD = math.radians(2.0)
"""Of the direction of gravity in one frame: mount, and acceleration taken for gravity."""
LEVEL_RAD = math.radians(1.0)
"""Of roll and pitch under acceleration, the mount left out."""
UP_MEMORY_S = 5.0
"""Correlation time of both."""
HEADING_RAD = math.radians(0.5)
"""Of one heading: quantisation to whole degrees, and the error of the camera mount in a turn."""
HEADING_DRIFT_RAD_S = math.radians(0.02)
"""Of the gyroscope's drift rate: a degree per minute."""
MAP_TURN_RAD = math.radians(5.0)
"""Of headings in the keyframes of a window before their refinement."""
TURN_SHARE = 0.005
"""Of a rotation, relative: scale factor of the gyroscope, error of the focal length."""
TILT_RAD = math.radians(2.0)
"""Of the rotation from map to world, mostly of the camera's mount."""

# --- height -----------------------------------------------------------------------------------------------------------

HEIGHT_M = {"tof": 0.015, "h": 0.06, "baro": 0.15}
"""Of one reading: range sensor (SDK ``tof``), the SDK's ``h`` in steps of 10 cm, barometer."""
HEIGHT_STEP_M = {"tof": 0.01, "h": 0.1, "baro": 0.01}
"""Quantisation of the SDK's heights."""
HEIGHT_MEMORY_S = 3.0
"""Correlation time of errors of SDK height and barometer."""
HEIGHT_SCALE_LOG = 0.02
"""Systematic scale error of heights over a climb of decimetres, along which the map bends by a centimetre."""

# --- IMU, beside the densities of `ImuModel` --------------------------------------------------------------------------

GRAVITY_M_S2 = 9.81
"""Between 9.78 and 9.83 on the ground; the scale inherits the difference."""
IMU_BIAS_SIGMA = np.repeat([0.1, 0.3], 3)
"""Of the biases at power-on [rad/s, m/s^2]: the larger one of cheap sensors, 30 mg."""
IMU_SCALE_LOG = 0.01
"""Error of the scale by the accelerometer's gain and axes, which averaging does not reduce: a percent beside the laser
tracker of a real flight; data sheets allow 3 % (MPU-6050)."""
IMU_YOUNG_LOG, IMU_YOUNG_S = 0.2, 2.0
"""Error of the scale by a map that bends in its first seconds, and the time after which it falls with the square of the
time, as displacements by accelerations grow. On a real drone's starts the scale is off by 20 % in the first second, 13
to 20 % in the next, 6 % after 2.5 s; readings and residuals explain half of it."""
IMU_AXES_RAD = 0.01
"""Error of gravity's direction by the accelerometer's axes, likewise: 0.4 degrees on that flight; data sheets allow
axes that are 0.3 (ADIS16448) to 1 degree (MPU-6050) from square."""
KNOWN_MOUNT_RAD, KNOWN_LEVER_M, KNOWN_OFFSET_S = 1e-3, 2e-3, 2e-4
"""Of calibrated values."""
UNKNOWN_MOUNT_RAD, UNKNOWN_LEVER_M, UNKNOWN_OFFSET_S = 0.1, 0.1, 0.02
"""Of values that the model leaves out, once rotations have been compared: a camera and an IMU on one small drone."""

# --- clocks -----------------------------------------------------------------------------------------------------------

CLOCK_S = 0.005
"""Of an estimated video delay, beside its statistical error."""
DELAY_S = 0.3
"""Of an unknown video delay; a Tello's is 0.3 to 0.8 s."""

# --- vision -----------------------------------------------------------------------------------------------------------

SUBMAP_SCALE_LOG = 0.3
"""Of the scale of a submap on predicted depths relative to the map before it: the network sees another scene."""
VISUAL_DRIFT = 0.01
"""Drift of the map from frame to frame, as a share of the distance travelled."""
VISUAL_DRIFT_TURN = 0.003
"""The same as a share of the angle turned."""
VISUAL_JITTER_M, VISUAL_JITTER_RAD = 0.002, 0.001
"""Least noise of a tracked pose."""
TRACKED_M, TRACKED_RAD = 0.03, math.radians(0.8)
"""Of a tracked pose beside the filter's prediction: what ten readings a second do not show of a jerk."""
MAP_DRIFT_M, MAP_DRIFT_MEMORY_S = (0.03, 0.002), 4.0
"""Of the map's local distortion, default first, of which the residuals choose: the error of a position against those
seconds before, and its correlation time."""
MAP_PIVOT_M = 0.02
"""Of the point about which the map takes a rotation to be, per axis: where depths are off, a part of each rotation is
taken for a translation, the same whenever the rotation recurs. It decides where a camera turns and hardly moves."""
MAP_WANDER_LOG = (0.03, 0.09, 0.27, 0.81)
"""Change of the log of the map's scale per e-fold of its age, default first, of which the residuals choose: 2 to 14 %
in the first seconds, later 1 to 2 %; with few features the scale may triple."""
VISUAL_MEMORY_S = 0.5
"""Correlation time of the errors of visual poses: those of a real drone's flight grow with the root of time up to about
a second, the time between keyframes, and hardly beyond."""
DEPTH_SCALE_LOG = 0.1
"""Scale error of the depth network common to all keyframes of a scene; the estimated part is added to it."""

# --- motion -----------------------------------------------------------------------------------------------------------

IMPLAUSIBLE_ACCELERATION_M_S2 = 10.0
"""Per axis, 1 g: a prior that is weak against images; hands and drones have 0.2 to 1.7."""
FAST_M_S = 1e3
"""Of an unmeasured velocity, inside a gap of an IMU's readings."""
POSITION_FLOOR_M_SQRT_S = 1e-3
"""Minimum process noise of the filter, which keeps the covariance positive definite."""
