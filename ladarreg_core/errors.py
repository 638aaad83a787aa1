"""Exceptions that a caller can act on; each text says what was found, what is needed and what to do.

Where a text names an argument it stands in backquotes, as `origin` or `force=True`: programs may replace it by what
their users know it as.
"""


class LadarregError(Exception):
    """Base of all errors caused by the input and not by the program; the text is one line for an operator.

    Args:
        *args: the text.
        field: name of the argument or option that is wrong, where it is one: front ends show the error beside it.
    """

    def __init__(self, *args: object, field: str = "") -> None:
        super().__init__(*args)
        self.field = field


class ShapeError(LadarregError):
    """Arrays of a wrong shape or type, or that do not match each other."""


class DegenerateGeometryError(LadarregError):
    """Geometry that does not determine the result: too few points, or coplanar, collinear or coincident ones."""


class FormatError(LadarregError):
    """A file that is missing, damaged, hostile or of an unknown format."""


class CameraError(LadarregError):
    """Camera parameters that are missing or impossible."""


class OptionError(LadarregError):
    """An option or argument with an invalid value."""


class DependencyError(LadarregError):
    """An optional package that is required here but not installed."""


class DeviceError(LadarregError):
    """A scanner or pan/tilt unit that does not respond as its protocol specifies."""


class DeviceGlitchError(DeviceError):
    """A device answered wrongly or not in time; the same may be asked again, and may then succeed."""


class ExportError(LadarregError):
    """A result that could not be written to its destination."""


class DiskFullError(ExportError):
    """A result that could not be written since there is no space left; it can be, once there is."""


class UnderspecifiedError(FormatError):
    """A file that is intact but does not say all that reading it needs; the text names the option that does."""


class NewerVersionError(FormatError):
    """A file written by a newer version of the program; it is left unchanged."""


class UnsavedError(ExportError):
    """Work that could not be saved to its project; the text says where it was saved instead, if anywhere."""


class Cancelled(Exception):  # noqa: N818 - it is no error
    """Raised by a `report` callback to stop the work that reports to it."""
