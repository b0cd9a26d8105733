"""Errors that a user can fix; the command line prints one line and exits with 1."""


class EdgeSlamError(Exception):
    """Base class of errors caused by user input."""


class SourceError(EdgeSlamError):
    """A recording, image, video or live source cannot be read."""


class CalibrationError(EdgeSlamError):
    """A camera calibration is missing, malformed or does not match the images."""


class ConfigError(EdgeSlamError):
    """A configuration file or ``--set`` option names an unknown key or a value out of range."""


class WeightsError(EdgeSlamError):
    """Network weights are missing, damaged or belong to another network."""


class AtlasError(EdgeSlamError):
    """A saved atlas is missing, damaged, of another version or of another camera."""


class OutputError(EdgeSlamError):
    """A result cannot be written."""


class MissingPackageError(EdgeSlamError):
    """A package that only this command needs is not installed; the message names the extra."""
