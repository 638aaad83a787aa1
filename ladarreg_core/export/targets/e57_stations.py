"""Scans of several stations in one new E57, each with its pose in the world that they share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from ladarreg_core.errors import ExportError
from ladarreg_core.export.e57.new_file import append_scan, start_tree
from ladarreg_core.export.e57.tree import library, new_e57
from ladarreg_core.export.json import software_document, write_result
from ladarreg_core.export.targets.folder import write_folder
from ladarreg_core.progress import Progress, Report
from ladarreg_core.scan import Scan
from ladarreg_core.storage.replacement import EXPORT_FILE

ScanReader = Callable[[], Scan]
"""Reads a scan: one is in memory at a time."""
_FILE = "e57/stations.e57"


def export_stations(
    folder: str | Path,
    scans: Sequence[ScanReader],
    *,
    mark: str = "",
    inputs: Sequence[str | Path] = (),
    force: bool = False,
    report: Report | None = None,
) -> None:
    """Write `e57/stations.e57` with all scans and their poses, and `export.json`, into a new folder.

    Args:
        folder: output folder.
        scans: readers of the scans, each with its `world_from_scanner`.
        mark: what every file must say of poses that were not verified; empty: they were.
        inputs: files that they are read from; their folder is not replaced.
        force: replace an earlier export and nothing else.
        report: receives the progress; may raise `Cancelled`.

    Raises:
        DependencyError: if pye57 is not installed.
        ExportError: if a scan has no pose, or the folder cannot be written.
    """
    library()
    document = {
        "version": 1, "kind": "export", "software": software_document(), "targets": ["e57"], "files": [_FILE],
        "mark": mark or None,
    }  # fmt: skip
    write_folder(
        folder,
        lambda: [
            (EXPORT_FILE, lambda path: write_result(path, document)),
            (_FILE, lambda path: write_stations_e57(path, scans, mark=mark, report=report)),
        ],
        inputs=inputs, force=force, report=report,
    )  # fmt: skip


def write_stations_e57(
    path: Path, scans: Sequence[ScanReader], *, mark: str = "", report: Report | None = None
) -> None:
    """Write an E57 with all scans and their poses; arguments and errors as of `export_stations`."""
    software = software_document()
    how = f"whose poses were {mark}, written" if mark else "registered to each other by their ranges"
    note = f"stations {how} with {software['name']} {software['version']}"
    with new_e57(path) as file:
        data3d = start_tree(file, note)
        for number, read in enumerate(scans):
            scan = read()
            if scan.world_from_scanner is None:
                raise ExportError(f"{scan.name} has no pose in the world; register the stations again")
            name = scan.name

            def told(count: int, number: int = number, name: str = name) -> None:
                del count
                if report is not None:
                    report(Progress(number, len(scans), f"writing {name}"))

            append_scan(file, data3d, scan, note, told)
