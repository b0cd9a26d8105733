"""What can go wrong that a user can mend; the command line prints the message in one line and exits 1."""


class EdgeSlamError(Exception):
    """Base of every error that a user's input can cause."""


class SourceError(EdgeSlamError):
    """A recording, image, video or live source cannot be read."""


class CalibrationError(EdgeSlamError):
    """A camera calibration is missing, malformed or does not fit the images."""


class ConfigError(EdgeSlamError):
    """A configuration file or ``--set`` option names an unknown key or a value out of range."""


class WeightsError(EdgeSlamError):
    """Network weights are missing, damaged or of another network."""


class OutputError(EdgeSlamError):
    """A result cannot be written."""
