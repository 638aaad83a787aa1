"""Stations in files: the scans of several places are read, and written again with their poses in one world."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ladarreg_core.progress import Progress, Report

if TYPE_CHECKING:
    from ladarreg_core.scan import Scan
    from ladarreg_core.stations.results import StationNetwork

STATIONS_ARE = (
    "world_from_scanner maps points of each scanner (X forward, Y left, Z up, m) to the world of the fixed station: "
    "its own pose where its file states one, else its scanner's frame; covariance is of (w, c): R_true = exp([w]x) R, "
    "c = C_true - C, rad and m, against the fixed station"
)
"""Explanation of the poses, written into `stations.json`."""
_VERSION = 1


@dataclass(frozen=True, slots=True, eq=False)
class StationScan:
    """A scan of a file."""

    scan: Scan
    """The scan; its name is unlike those of the others."""
    path: Path
    """Its file."""
    scan_index: int
    """Its place in that file."""


def read_stations(
    files: Sequence[str | Path], *, memory_bytes: int | None = None, report: Report | None = None
) -> list[StationScan]:
    """Read scans; a file that contains several gives all of them.

    Args:
        files: files of any scan format.
        memory_bytes: as in `read_scan`.
        report: receives the progress; may raise `Cancelled`.

    Raises:
        FormatError: if a file is no scan.
    """
    from ladarreg_core.formats import read_scan
    from ladarreg_core.formats.file_info import scans_in
    from ladarreg_core.formats.registry import recognise

    found: list[StationScan] = []
    for number, name in enumerate(files):
        path = Path(name)
        count = max(1, len(scans_in(path, recognise(path, kinds=("scan",)).name)))
        for index in range(count):
            if report is not None:
                report(Progress(number, len(files), f"reading {path.name}"))
            scan = read_scan(path, scan_index=index, memory_bytes=memory_bytes)
            found.append(StationScan(scan, path, index))
    names: dict[str, int] = {}
    for k, one in enumerate(found):
        stem = one.path.stem if one.scan_index == 0 else f"{one.path.stem}-{one.scan_index + 1}"
        names[stem] = names.get(stem, 0) + 1
        label = stem if names[stem] == 1 else f"{stem}-{names[stem]}"
        found[k] = replace(one, scan=replace(one.scan, name=label))
    return found


def write_stations(
    folder: str | Path,
    network: StationNetwork,
    stations: Sequence[StationScan],
    *,
    force: bool = False,
    report: Report | None = None,
) -> dict[str, Any]:
    """Write `stations.json`, and each registered scan with its pose as NPZ, into a new folder, all at once.

    Args:
        folder: output folder.
        network: the result.
        stations: the scans that it is of, in its order.
        force: replace an earlier folder of stations and nothing else.
        report: receives the progress.

    Returns:
        the document that was written.

    Raises:
        ExportError: if the folder exists and must not be replaced, or cannot be written.
    """
    from ladarreg_core.export.folder import write_folder
    from ladarreg_core.export.json import write_document
    from ladarreg_core.export.replacement import STATIONS_FILE
    from ladarreg_core.formats.npz import write_npz_xyz

    fields = stations_document(network, stations)
    placed = {one.index: one for one in network.stations if one.world_from_scanner is not None}

    def writer(index: int) -> Any:
        scan = replace(stations[index].scan, world_from_scanner=placed[index].world_from_scanner)
        return lambda path: write_npz_xyz(path, scan)

    write_folder(
        folder,
        lambda: [
            (STATIONS_FILE, lambda path: write_document(path, fields)),
            *((fields["stations"][index]["scan"], writer(index)) for index in placed),
        ],
        inputs=sorted({one.path for one in stations}), force=force, report=report,
    )  # fmt: skip
    return fields


def stations_document(network: StationNetwork, stations: Sequence[StationScan]) -> dict[str, Any]:
    """Return the contents of `stations.json`."""
    from ladarreg_core.export.json import input_document, software_document

    own = network.as_fields()
    names: set[str] = set()
    for one, station in zip(own["stations"], stations, strict=True):
        base = one["name"] if one["name"].casefold() not in names else f"{one['name']}-{one['index']}"
        names.add(base.casefold())
        one["scan"] = None if one["world_from_scanner"] is None else f"{base}.npz"
        one |= {"input": {**input_document(station.path), "scan_index": station.scan_index}}
    return {
        "version": _VERSION, "kind": "stations", "software": software_document(), "poses_are": STATIONS_ARE, **own
    }  # fmt: skip


def is_station_folder(folder: str | Path) -> bool:
    """Return whether a folder contains a `stations.json`."""
    from ladarreg_core.export.replacement import STATIONS_FILE

    return (Path(folder) / STATIONS_FILE).is_file()


def station_files(folder: str | Path) -> list[Path]:
    """Return the scans of a folder of stations, those that were registered.

    Raises:
        FormatError: if its document is damaged, or a scan is missing.
    """
    from ladarreg_core.errors import FormatError
    from ladarreg_core.export.replacement import STATIONS_FILE, is_file_name
    from ladarreg_core.formats.json_file import read_json_object
    from ladarreg_core.formats.untrusted import reading

    home = Path(folder)
    with reading(home / STATIONS_FILE) as file:
        fields = read_json_object(file, "stations")
        listed = fields.get("stations")
        if fields.get("kind") != "stations" or not isinstance(listed, list):
            raise FormatError("it does not describe stations; give the folder of `register-scans`")
        names = [one.get("scan") for one in listed if isinstance(one, dict)]
        scans = [name for name in names if name is not None]
        if not scans or not all(isinstance(name, str) and is_file_name(name) for name in scans):
            raise FormatError("it names no scans; register the stations again")
        missing = [name for name in scans if not (home / name).is_file()]
        if missing:
            raise FormatError(f"{missing[0]} is missing beside it; register the stations again")
    return [home / name for name in scans]


def export_station_folder(
    folder: str | Path, out: str | Path, *, force: bool = False, report: Report | None = None
) -> None:
    """Write the scans of a folder of stations with their poses into one E57.

    Args:
        folder: what `write_stations` wrote.
        out: output folder.
        force: replace an earlier export and nothing else.
        report: receives the progress; may raise `Cancelled`.

    Raises:
        FormatError: if the folder is damaged.
        ExportError: if the output cannot be written.
    """
    from functools import partial

    from ladarreg_core.export.targets.e57_stations import export_stations
    from ladarreg_core.formats import read_scan

    files = station_files(folder)
    named = [partial(_named_scan, read_scan, path) for path in files]
    export_stations(out, named, inputs=files, force=force, report=report)


def _named_scan(read: Any, path: Path) -> Scan:
    scan: Scan = read(path)
    return replace(scan, name=path.stem)
