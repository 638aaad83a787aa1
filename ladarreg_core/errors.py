"""The errors that a caller can act on: what was found, what is needed, what to do."""


class LadarregError(Exception):
    """Base of every error that is the input's fault and not the program's; its text is one line for an operator."""


class ShapeError(LadarregError):
    """Arrays that disagree with each other or with what they should be."""


class DegenerateGeometryError(LadarregError):
    """Geometry from which the answer cannot be computed: too few, coplanar, collinear or coincident."""


class FormatError(LadarregError):
    """A file that is missing, damaged, hostile or of an unknown kind."""


class CameraError(LadarregError):
    """Camera parameters that are absent or impossible."""


class OptionError(LadarregError):
    """An option with a value that has no meaning."""


class DependencyError(LadarregError):
    """An optional package that this function needs is not installed."""


class DeviceError(LadarregError):
    """A scanner or a pan/tilt unit that does not answer as its protocol says."""


class ExportError(LadarregError):
    """A result that could not be written where it was asked for."""


class NewerVersionError(FormatError):
    """A file that a newer version of the program wrote, and that is left as it is."""


class UnsavedError(ExportError):
    """Work that could not be saved where it belongs; its text says where it is, if anywhere."""


class Cancelled(Exception):  # noqa: N818 - it is no error
    """Raised by a `report` callback to stop the work that reports to it."""
