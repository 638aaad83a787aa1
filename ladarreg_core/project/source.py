"""References of a document to files, with what was replaced in the ranges of a scan."""

from __future__ import annotations

from pathlib import PurePath
from typing import Any, Literal

import msgspec

from ladarreg_core.formats.scans.scan_request import FileOptions


class SmoothingEntry(msgspec.Struct, frozen=True, kw_only=True):
    """Ranges of a scan that were replaced by what an accepted registration says of them."""

    id: str
    """Name of all ranges of the scan after it."""
    photo: str
    """Id of the photograph that was registered."""
    name: str
    """Its file name."""
    pose: str
    """Name of the arrays of its pose."""
    cells: tuple[tuple[int, int, float], ...]
    """Row, column and new range, m, of each."""


class Source(FileOptions, frozen=True, kw_only=True):
    """Reference to an opened file."""

    path: str
    """Absolute path, or relative to the project folder for files inside it."""
    name: str
    """File name for display."""
    size: int
    """File size, bytes."""
    index: int = 0
    """Index of the scan in a file with several."""
    temperature_unit: Literal["K", "C", "none"] | None = None
    """Unit of a thermal image's pixels, if it was given."""
    more: tuple[str, ...] = ()
    """Further clouds of a scan's standpoint, which are accumulated with this file; paths as `path`."""
    more_names: tuple[str, ...] = ()
    """Their names for display, in the same order; empty: the names of the files."""
    smoothings: tuple[SmoothingEntry, ...] = ()
    """What was replaced in the ranges of a scan, in the order in which it was."""

    @property
    def ranges(self) -> str:
        """Name of a scan's ranges: another one after each smoothing; empty: they are as measured."""
        return self.smoothings[-1].id if self.smoothings else ""

    @property
    def names(self) -> tuple[str, ...]:
        """The names of all files for display, that of `path` first."""
        known = self.more_names if len(self.more_names) == len(self.more) else map(file_name, self.more)
        return (self.name, *known)

    @property
    def paths(self) -> tuple[str, ...]:
        """All files, `path` first."""
        return (self.path, *self.more)

    @property
    def scan_options(self) -> dict[str, Any]:
        """The arguments of `read_scan` for this file, except `more`: see `ProjectFolder.scan_options`."""
        return {"scan_index": self.index, **{name: getattr(self, name) for name in FileOptions.__struct_fields__}}


def file_name(path: str) -> str:
    """Return the name of a file by its path in a `Source`."""
    return PurePath(path).name
