"""The target `stations`: the scans of several places with their poses; all of them also go into one E57."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from ladarreg_core.errors import DependencyError, ExportError
from ladarreg_core.export.e57.new_file import append_scan, start_tree
from ladarreg_core.export.e57.tree import library, new_e57
from ladarreg_core.export.json import software_document, write_result
from ladarreg_core.export.targets.folder import FileJob
from ladarreg_core.export.targets.target import ExportOptions
from ladarreg_core.formats.scans.npz import write_npz_xyz
from ladarreg_core.foundations.progress import Progress, Report
from ladarreg_core.scan import Scan
from ladarreg_core.storage.atomic_write import write_bytes
from ladarreg_core.storage.replacement import STATIONS_FILE

ScanReader = Callable[[], Scan]
"""Reads a scan: one is in memory at a time."""


@dataclass(frozen=True, slots=True, eq=False)
class StationScans:
    """Scans of several places, with their poses in the world that they share."""

    document: Mapping[str, Any]
    """The contents of `stations.json`; its `stations` state the file of each registered scan as `scan`."""
    scans: Mapping[str, ScanReader]
    """The readers of the registered scans, each with its `world_from_scanner`, by the names of their files."""
    mark: str = ""
    """What every file must say of poses that were not verified; empty: they were."""
    inputs: Sequence[Path] = ()
    """The files that they are read from."""
    by: str = "their ranges"
    """What they were registered by, in words."""
    tables: Mapping[str, bytes] = field(default_factory=dict)
    """Further files beside the scans, by name."""


def stations_files(source: StationScans, options: ExportOptions, report: Report | None) -> Sequence[FileJob]:
    """Return `stations.json`, and each registered scan with its pose as NPZ."""
    del options, report

    def writer(read: ScanReader) -> Callable[[Path], None]:
        return lambda path: write_npz_xyz(path, read())

    return [
        (STATIONS_FILE, lambda path: write_result(path, source.document)),
        *((name, writer(read)) for name, read in source.scans.items()),
        *((name, partial(write_bytes, data=data)) for name, data in source.tables.items()),
    ]


def stations_refusal(source: StationScans, options: ExportOptions) -> str | None:
    """Return why stations cannot be written; None if they can: new checksums would hide that poses were changed."""
    del options
    if not source.mark:
        return None
    return f"its poses are {source.mark}, and only a file that says so may hold them; register the stations again"


def stations_e57_refusal() -> str | None:
    """Return why no E57 can be written; None if it can."""
    try:
        library()
    except DependencyError as error:
        return str(error)
    return None


def stations_e57_files(source: StationScans, report: Report | None) -> Sequence[FileJob]:
    """Return one E57 with all registered scans and their poses.

    Its writer raises `ExportError` if a scan has no pose.
    """
    return [("stations.e57", lambda path: _write_e57(path, source, report))]


def _write_e57(path: Path, source: StationScans, report: Report | None) -> None:
    software = software_document()
    how = f"whose poses were {source.mark}, written" if source.mark else f"registered by {source.by}"
    note = f"stations {how} with {software['name']} {software['version']}"
    with new_e57(path) as file:
        data3d = start_tree(file, note)
        for number, read in enumerate(source.scans.values()):
            scan = read()
            if scan.world_from_scanner is None:
                raise ExportError(f"{scan.name} has no pose in the world; register the stations again")
            name = scan.name

            def told(count: int, number: int = number, name: str = name) -> None:
                del count
                if report is not None:
                    report(Progress(number, len(source.scans), f"writing {name}"))

            append_scan(file, data3d, scan, note, told)
