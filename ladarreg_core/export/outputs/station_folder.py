"""Stations in files: the scans of several places are read, and written again with their poses in one world."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ladarreg_core.foundations.progress import Progress, Report

if TYPE_CHECKING:
    from ladarreg_core.export.targets.stations import StationScans
    from ladarreg_core.frames import Rigid
    from ladarreg_core.registration.stations.results import StationNetwork
    from ladarreg_core.scan import Scan

STATIONS_ARE = (
    "world_from_scanner maps points of each scanner (X forward, Y left, Z up, m) to the world of the fixed station: "
    "its own pose where its file states one, else its scanner's frame; covariance is of (w, c): R_true = exp([w]x) R, "
    "c = C_true - C, rad and m, against the fixed station"
)
"""Explanation of the poses, written into `stations.json`."""
_SAME_M, _SAME_RAD = 1e-4, 1e-6


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

    found: list[StationScan] = []
    for number, name in enumerate(files):
        path = Path(name)
        for index in range(count_scans(path)):
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


def count_scans(path: Path) -> int:
    """Return how many scans a file contains.

    Raises:
        FormatError: if it is no scan.
    """
    from ladarreg_core.formats.file_info import scans_in
    from ladarreg_core.formats.registry import recognise

    return max(1, len(scans_in(path, recognise(path, kinds=("scan",)).name)))


def write_stations(
    folder: str | Path,
    network: StationNetwork,
    stations: Sequence[StationScan],
    *,
    tables: Mapping[str, bytes] | None = None,
    force: bool = False,
    report: Report | None = None,
) -> dict[str, Any]:
    """Write `stations.json`, and each registered scan with its pose as NPZ, into a new folder, all at once.

    Args:
        folder: output folder.
        network: the result.
        stations: the scans that it is of, in its order.
        tables: further files, by name.
        force: replace an earlier folder of stations and nothing else.
        report: receives the progress.

    Returns:
        the document that was written.

    Raises:
        ExportError: if the folder exists and must not be replaced, or cannot be written.
    """
    from functools import partial

    from ladarreg_core.export.targets.pipeline import export_to
    from ladarreg_core.export.targets.stations import StationScans

    fields = stations_document(network.as_fields(), [(one.path, one.scan_index) for one in stations])
    scans = {
        fields["stations"][one.index]["scan"]: partial(
            replace, stations[one.index].scan, world_from_scanner=one.world_from_scanner
        )
        for one in network.stations
        if one.world_from_scanner is not None
    }
    source = StationScans(fields, scans, inputs=sorted({one.path for one in stations}), tables=tables or {})
    export_to(folder, source, ["stations"], force=force, report=report)
    return fields


def stations_document(fields: Mapping[str, Any], inputs: Sequence[tuple[Path, int]]) -> dict[str, Any]:
    """Return the contents of `stations.json`, where each registered scan has the name of its file, `scan`.

    Args:
        fields: `StationNetwork.as_fields`; what these state otherwise counts, such as `poses_are`.
        inputs: the file of each scan, and its place in it.
    """
    from ladarreg_core.export.json import input_document, software_document
    from ladarreg_core.formats.documents.stations_info import VERSION

    names: set[str] = set()
    stations = []
    for one, (path, scan_index) in zip(fields["stations"], inputs, strict=True):
        base = one["name"] if one["name"].casefold() not in names else f"{one['name']}-{one['index']}"
        names.add(base.casefold())
        scan = None if one["world_from_scanner"] is None else f"{base}.npz"
        stations.append({**one, "scan": scan, "input": {**input_document(path), "scan_index": scan_index}})
    return {
        "version": VERSION, "kind": "stations", "software": software_document(), "poses_are": STATIONS_ARE, **fields,
        "stations": stations,
    }  # fmt: skip


def is_station_folder(folder: str | Path) -> bool:
    """Return whether a folder contains a `stations.json`."""
    from ladarreg_core.storage.replacement import STATIONS_FILE

    return (Path(folder) / STATIONS_FILE).is_file()


def station_files(folder: str | Path, *, trust_edited: bool = False) -> dict[Path, Rigid]:
    """Return the scans of a folder of stations that were registered, each with its stated `world_from_scanner`.

    Args:
        folder: the folder.
        trust_edited: take a document that was changed after it was written.

    Raises:
        FormatError: if its document is damaged, changed or of another version, or a scan is missing.
    """
    from ladarreg_core.errors import FormatError
    from ladarreg_core.formats.documents.own_results import read_own_result
    from ladarreg_core.formats.documents.stations_info import stated_poses
    from ladarreg_core.formats.parsing.untrusted import reading
    from ladarreg_core.storage.replacement import STATIONS_FILE, is_file_name

    home = Path(folder)
    with reading(home / STATIONS_FILE) as file:
        poses = stated_poses(read_own_result(file, "stations", trust_edited=trust_edited))
        if not all(is_file_name(name) for name in poses):
            raise FormatError("it names scans outside its folder; register the stations again")
        missing = [name for name in poses if not (home / name).is_file()]
        if missing:
            raise FormatError(f"{missing[0]} is missing beside it; register the stations again")
    return {home / name: pose for name, pose in poses.items()}


def read_station_folder(folder: str | Path, *, trust_edited: bool = False) -> StationScans:
    """Return the stations of a folder, to be exported; each scan is read when it is written.

    Args:
        folder: what `write_stations` wrote.
        trust_edited: take the poses that the folder states even if it was changed after it was written; the export then
            says that they were given.

    Raises:
        FormatError: if the folder is damaged, or was changed.
    """
    from functools import partial

    from ladarreg_core.errors import FormatError
    from ladarreg_core.export.targets.stations import StationScans
    from ladarreg_core.formats import read_scan
    from ladarreg_core.formats.documents.own_results import TRUST_OPTION
    from ladarreg_core.formats.parsing.json_file import read_json_object
    from ladarreg_core.results.verdict_words import GIVEN_MARK
    from ladarreg_core.storage.replacement import STATIONS_FILE

    files = station_files(folder, trust_edited=trust_edited)
    changed = _changed_file(Path(folder), list(files))
    if changed and not trust_edited:
        raise FormatError(f"{changed}; {TRUST_OPTION}")
    scans = {
        path.relative_to(folder).as_posix(): partial(_named_scan, read_scan, path, pose, trusted=bool(changed))
        for path, pose in files.items()
    }
    document = read_json_object(Path(folder) / STATIONS_FILE, "stations")
    by = "survey targets" if document.get("targets") else "their ranges"
    return StationScans(document, scans, GIVEN_MARK if changed else "", list(files), by)


def _changed_file(folder: Path, scans: Sequence[Path]) -> str:
    """Return which file of a folder of stations was changed after it was written, and how; empty: none."""
    from ladarreg_core.errors import FormatError
    from ladarreg_core.formats.documents.own_results import edited_fault
    from ladarreg_core.formats.parsing.json_file import read_json_object
    from ladarreg_core.storage.manifest import read_manifest
    from ladarreg_core.storage.replacement import STATIONS_FILE

    try:
        listed = read_manifest(folder) or {}
        fault = edited_fault(folder / STATIONS_FILE, read_json_object(folder / STATIONS_FILE, "stations"))
    except FormatError as error:
        return f"{folder}: {error}"
    if fault:
        return f"{folder / STATIONS_FILE}: {fault}"
    for path in scans:
        if path.name in listed and (fault := listed[path.name].fault(folder)):
            return f"{path} {fault}"
    return ""


def _named_scan(read: Any, path: Path, stated: Rigid, *, trusted: bool = False) -> Scan:
    from ladarreg_core.errors import FormatError
    from ladarreg_core.storage.replacement import STATIONS_FILE

    scan: Scan = read(path)
    own = scan.world_from_scanner
    if trusted:
        return replace(scan, name=path.stem, world_from_scanner=stated)
    if own is None or own.distance_to(stated) > _SAME_M or own.angle_to(stated) > _SAME_RAD:
        raise FormatError(
            f"{path}: {STATIONS_FILE} states another pose for it than the file itself; register the stations again"
        )
    return replace(scan, name=path.stem)
