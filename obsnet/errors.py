"""Everything obsnet raises on purpose.

A message says what was asked, what was found and what to do. The command line prints it as one line and exits with 2;
anything that is not an `ObsnetError` is a defect of ours.
"""


class ObsnetError(Exception):
    """Root of all errors that obsnet raises on purpose."""


class ConfigError(ObsnetError, ValueError):
    """A parameter or a configuration key is wrong."""


class LayoutError(ObsnetError, ValueError):
    """An array does not have the dims, coordinates or variables that a stage takes."""


class StationError(ObsnetError, ValueError):
    """Station metadata is missing, unreadable or of another station."""


class WaveformError(ObsnetError, ValueError):
    """Waveforms are missing, unreadable or cannot serve."""


class AISError(ObsnetError, ValueError):
    """An AIS file cannot be read or holds no position."""


class OutputError(ObsnetError, OSError):
    """An output folder or file cannot be written."""


class SourceError(ObsnetError, ConnectionError):
    """A data centre or a live source does not answer as it should."""


class ModelError(ObsnetError, ValueError):
    """A model file is not one of ours, was altered, or does not fit the data."""


class WorkerDied(ObsnetError, RuntimeError):
    """A process that did part of the work ended before it was done."""


class FilterError(ObsnetError, ArithmeticError):
    """A filter lost all its weight: the data contradict every particle."""
