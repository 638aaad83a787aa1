"""What a caller may say about a scan file that the file itself does not."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Literal, get_args

from ladarreg_core.errors import OptionError
from ladarreg_core.foundations.validation import is_number, require_choice
from ladarreg_core.progress import Report

IntensitySource = Literal["auto", "luma"]
_OF_FILES = ("scan_index", "origin", "intensity", "columns", "topic", "seconds")


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanRequest:
    """How a scan file is to be read; what is left at its default is taken from the file.

    Raises:
        OptionError: if a value is not of its type or range.
    """

    scan_index: int = 0
    """Index of the scan, or frame, in files that contain several, from 0."""
    origin: tuple[float, float, float] | None = None
    """Where the scanner stood, in the coordinates of the file, m."""
    intensity: IntensitySource = "auto"
    """`luma` takes the luminance of the points' colours as the intensity."""
    columns: Sequence[str] = ()
    """Names of the columns of a text file, in order; `-` skips one."""
    topic: str | None = None
    """Topic of the clouds in a recording."""
    seconds: float | None = None
    """Duration over which the clouds of a recording are accumulated."""
    memory_bytes: int | None = None
    """Memory that the read may use at its peak; None: 1 GB, or 96 times the file's size if that is more."""
    report: Report | None = None
    """Receives the progress."""

    def __post_init__(self) -> None:
        require_choice(self.intensity, get_args(IntensitySource), "intensity")
        if self.origin is not None:
            try:
                origin = tuple(self.origin)
            except TypeError:
                origin = ()
            if len(origin) != 3 or not all(is_number(value) and abs(value) < 1e12 for value in origin):
                raise OptionError(f"origin is {self.origin!r:.80}; it must be three coordinates x, y, z in metres")
            object.__setattr__(self, "origin", tuple(float(value) for value in origin))
        if isinstance(self.columns, str) or not all(isinstance(name, str) for name in self.columns):
            raise OptionError(f"columns is {self.columns!r:.80}; it must be a sequence of names")
        object.__setattr__(self, "columns", tuple(self.columns))
        if self.topic is not None and not isinstance(self.topic, str):
            raise OptionError(f"topic is {self.topic!r:.80}; it must be a name")
        if self.seconds is not None and not (is_number(self.seconds) and self.seconds > 0):
            raise OptionError(f"seconds is {self.seconds!r:.80}; it must be a positive duration")

    def given(self) -> Mapping[str, Any]:
        """Return the options that were given, without those that only concern memory and progress."""
        return {
            field.name: getattr(self, field.name)
            for field in fields(self)
            if field.name in _OF_FILES and getattr(self, field.name) != field.default
        }

    def require_only(self, taken: tuple[str, ...], format_name: str) -> None:
        """Refuse options that a format has no use for.

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
                    f"`{name}` is {value!r:.80}, which a {format_name} file has no use for{alone}; leave it out{usable}"
                )
