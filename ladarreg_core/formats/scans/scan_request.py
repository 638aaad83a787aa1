"""Options for reading a scan file: what the file itself does not state."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal, get_args

import msgspec
from msgspec import Meta

from ladarreg_core.errors import OptionError
from ladarreg_core.foundations.progress import Report
from ladarreg_core.foundations.validation import is_number, require_choice

IntensitySource = Literal["auto", "luma"]
_ORIGIN = "three coordinates x, y, z in metres"


class FileOptions(msgspec.Struct, frozen=True, kw_only=True):
    """Options that a project saves with each scan's file; what is left at its default is taken from the file.

    Raises:
        OptionError: if a value is not of its type or range.
    """

    origin: Annotated[tuple[float, float, float], Meta(description=_ORIGIN)] | None = None
    """Where the scanner stood, in the coordinates of the file, m."""
    intensity: IntensitySource = "auto"
    """`luma` takes the luminance of the points' colours as the intensity."""
    columns: Annotated[tuple[str, ...], Meta(description="a sequence of names")] = ()
    """Names of the columns of a text file, in order; `-` skips one."""
    topic: Annotated[str, Meta(description="a name")] | None = None
    """Topic of the clouds in a recording."""
    seconds: Annotated[float, Meta(gt=0, description="a positive duration")] | None = None
    """Duration over which the clouds of a recording are accumulated, s."""

    def __post_init__(self) -> None:
        require_choice(self.intensity, get_args(IntensitySource), "intensity")
        if self.origin is not None:
            try:
                origin = tuple(self.origin)
            except TypeError:
                origin = ()
            if len(origin) != 3 or not all(is_number(value) and abs(value) < 1e12 for value in origin):
                raise OptionError(f"origin is {self.origin!r:.80}; it must be {_ORIGIN}", field="origin")
            msgspec.structs.force_setattr(self, "origin", tuple(float(value) for value in origin))
        if isinstance(self.columns, str) or not all(isinstance(name, str) for name in self.columns):
            raise OptionError(f"columns is {self.columns!r:.80}; it must be a sequence of names", field="columns")
        msgspec.structs.force_setattr(self, "columns", tuple(self.columns))
        if self.topic is not None and not isinstance(self.topic, str):
            raise OptionError(f"topic is {self.topic!r:.80}; it must be a name", field="topic")
        if self.seconds is not None and not (is_number(self.seconds) and self.seconds > 0):
            raise OptionError(f"seconds is {self.seconds!r:.80}; it must be a positive duration", field="seconds")


class ScanOptions(FileOptions, frozen=True, kw_only=True):
    """The options of `read_scan`: arguments of commands, fields of the page's form, records of results."""

    scan_index: Annotated[int, Meta(ge=0, lt=2**31, description="a whole number from 0")] = 0
    """Index of the scan, or frame, in files that contain several, from 0."""

    def given(self) -> dict[str, Any]:
        """Return the options that are not at their defaults."""
        return {name: value for name, value in self.as_arguments().items() if value != getattr(_DEFAULTS, name)}

    def as_arguments(self) -> dict[str, Any]:
        """Return all options as arguments of `read_scan`."""
        return {name: getattr(self, name) for name in SCAN_OPTIONS}


class ScanRequest(ScanOptions, frozen=True, kw_only=True):
    """How a scan file is to be read."""

    memory_bytes: int | None = None
    """Memory that the read may use at its peak; None: 1 GB, or 96 times the file's size if that is more."""
    report: Report | None = None
    """Receives the progress."""

    def require_only(self, taken: tuple[str, ...], format_name: str) -> None:
        """Refuse options that a format does not support.

        Args:
            taken: names of the options that it takes.
            format_name: its name for users.

        Raises:
            OptionError: naming the option and those that can be given.
        """
        for name, value in self.given().items():
            if name not in taken:
                usable = f"; it takes {', '.join(f'`{each}`' for each in taken)}" if taken else ""
                alone = ": the file contains one scan" if name == "scan_index" else ""
                raise OptionError(
                    f"`{name}` is {value!r:.80}, which is not supported for {format_name} files{alone}; leave it out"
                    f"{usable}",
                    field=name,
                )


_DEFAULTS = ScanOptions()
SCAN_OPTIONS: tuple[str, ...] = ("scan_index", *FileOptions.__struct_fields__)
"""Names of the options of `read_scan`, in the order in which they are listed."""


def stated_options(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return those options of a record of JSON that it states, as arguments of `read_scan`.

    Raises:
        msgspec.ValidationError: if one is not of its type.
        OptionError: if one is not of its range.
    """
    stated = {name: record[name] for name in SCAN_OPTIONS if name in record}
    found = msgspec.convert(stated, ScanOptions)
    return {name: getattr(found, name) for name in stated}
