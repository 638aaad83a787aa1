"""The files that make up one scan: a descriptor with the raw files that it names, a recording with its JSON."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ladarreg_core.errors import FormatError
from ladarreg_core.formats.packets.ouster_sensor import find_sensor_file
from ladarreg_core.formats.parsing.json_file import read_json_object
from ladarreg_core.formats.scans.descriptor import KINDS, named_files

_DESCRIPTIONS = 50  # looked at in a folder; each is small
_LONGEST_DESCRIPTION = 1 << 20
_CAPTURES = (".pcap", ".pcapng")


@dataclass(frozen=True, slots=True)
class ScanFiles:
    """The files of one scan."""

    opened: Path
    """The one that is given to `read_scan`."""
    measured: tuple[Path, ...]
    """Those that hold what was measured; each belongs to one scan only."""
    described: Path | None = None
    """One that says how these are read; the same one may serve many scans."""

    @property
    def all(self) -> tuple[Path, ...]:
        """All of them."""
        return self.measured if self.described is None else (self.described, *self.measured)


def scan_files(path: Path) -> ScanFiles:
    """Return what belongs together with a file that lies in a folder, whichever of the files it is.

    Files that are named but not there are returned too. A file that belongs to no other makes up a scan alone.
    """
    if (described := _described(path)) is not None:
        return described
    for description in _descriptions(path.parent):
        described = _described(description)
        if described is not None and path in described.measured:
            return described
    if path.suffix.lower() in _CAPTURES:
        try:
            return ScanFiles(path, (path,), find_sensor_file(path))
        except FormatError:
            pass  # the reader says which one is missing
    return ScanFiles(path, (path,))


def _described(path: Path) -> ScanFiles | None:
    """Return the files of a descriptor; None if a file is none."""
    if not _may_describe(path):
        return None
    try:
        fields = read_json_object(path, "a scan descriptor")
    except (FormatError, OSError):
        return None  # of another kind, or it is still being written
    if fields.get("kind") not in KINDS:
        return None
    names = named_files(fields)
    return ScanFiles(path, tuple(path.parent / name for name in names), path) if names else None


def _descriptions(folder: Path) -> list[Path]:
    try:
        return sorted(path for path in folder.iterdir() if _may_describe(path))[:_DESCRIPTIONS]
    except OSError:
        return []


def _may_describe(path: Path) -> bool:
    try:
        return path.suffix.lower() == ".json" and path.is_file() and path.stat().st_size <= _LONGEST_DESCRIPTION
    except OSError:
        return False
