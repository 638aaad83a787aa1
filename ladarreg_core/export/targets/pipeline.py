"""The one export: targets from a registered scan or from stations, written into a folder atomically or into a zip."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ladarreg_core.errors import ExportError
from ladarreg_core.export.json import input_document, software_document, write_result
from ladarreg_core.export.registered_scan import RegisteredScan, RegisteredSurvey
from ladarreg_core.export.targets.folder import MAX_CELLS_TOGETHER, FileJob, write_folder
from ladarreg_core.export.targets.measurements import MeasurementList
from ladarreg_core.export.targets.registry import targets_of
from ladarreg_core.export.targets.stations import StationScans
from ladarreg_core.export.targets.target import ExportOptions, Target
from ladarreg_core.foundations.progress import Report
from ladarreg_core.storage.replacement import EXPORT_FILE

Photographed = RegisteredScan | RegisteredSurvey
Source = Photographed | StationScans | MeasurementList
"""What targets are written from."""


def export_to(
    folder: str | Path,
    handed: Source | Sequence[Source],
    targets: Sequence[str],
    *,
    options: ExportOptions | None = None,
    apart_from: Sequence[str | Path] = (),
    force: bool = False,
    report: Report | None = None,
) -> None:
    """Write targets into a new folder: `export.json`, and a folder for every target.

    The results of one photograph alone, or `stations` alone, are written as `register` and `register-scans` write them.

    Args:
        folder: output folder; missing parents are created.
        handed: the scan and its photographs, or those of a survey, or stations, or several of them.
        targets: names of targets, see `targets.registry.TARGETS`.
        options: options of the targets; None: `ExportOptions()`.
        apart_from: open project folders; a folder that is, contains or lies in one of them is not replaced.
        force: replace an earlier export.
        report: receives the progress; may raise `Cancelled`, and nothing is left then.

    Raises:
        OptionError: if a target is unknown.
        ExportError: if a target cannot be written from what is given, the folder must not be replaced, or something
            cannot be written.
    """
    sources = _listed(handed)
    scans = [scan for one in photographed(sources) for scan in one.scans]
    small = sum(one.scan.ranges.size for one in scans) <= MAX_CELLS_TOGETHER
    write_folder(
        folder,
        lambda: export_files(sources, targets, options=options, report=report),
        inputs=_inputs(sources),
        apart_from=apart_from,
        force=force,
        together=small and all(target.together for target in targets_of(targets)),
        report=report,
    )


def export_files(
    handed: Source | Sequence[Source],
    targets: Sequence[str],
    *,
    options: ExportOptions | None = None,
    report: Report | None = None,
) -> list[FileJob]:
    """Return the names and writers of the files of an export; the arguments are those of `export_to`.

    Raises:
        OptionError: if a target is unknown.
        ExportError: if a target cannot be written from what is given.
    """
    sources, chosen, options = _listed(handed), targets_of(targets), options or ExportOptions()
    for source in photographed(sources):
        require_shown([one.photo.name for one in source.refused], chosen)
    refused = {target.name: why for target in chosen if (why := refusal(target, sources, options))}
    if refused:
        raise ExportError("; ".join(f"{name} cannot be written: {why}" for name, why in refused.items()))
    files = {target: _files(target, sources, options, report) for target in chosen}
    if len(chosen) == 1 and chosen[0].stands_alone:
        alone = files[chosen[0]]
        if not any("/" in name for name, _ in alone):
            return alone
    jobs = [(f"{target.name}/{name}", write) for target, listed in files.items() for name, write in listed]
    names = [name for name, _ in jobs]
    return [(EXPORT_FILE, lambda path: write_result(path, _document(sources, chosen, options, names))), *jobs]


def photographed(sources: Sequence[Source]) -> list[Photographed]:
    """Return those of the sources that are scans with photographs."""
    return [one for one in sources if isinstance(one, Photographed)]


def refusal(target: Target, sources: Sequence[Source], options: ExportOptions) -> str | None:
    """Return why a target cannot be written from any of the sources; None if it can."""
    reasons = [target.refusal(one, options) for _, one in _read_by(target, sources)]
    if any(why is None for why in reasons):
        return None
    return "; ".join(why for why in reasons if why) or f"it needs {target.needs}, and there is none"


def require_shown(refused: Sequence[str], targets: Sequence[Target]) -> None:
    """Refuse targets that would show a pose that was refused.

    Args:
        refused: names of the photographs whose pose was refused.
        targets: the targets.

    Raises:
        ExportError: if there are such photographs, and a target may not show them.
    """
    others = [target.name for target in targets if not target.shows_refused]
    if refused and others:
        raise ExportError(
            f"{', '.join(others)} cannot be written: the pose of {', '.join(refused)} was refused, and only its "
            "results and a report may show it; accept another pose, apply one that you know, or write the report alone"
        )


def _files(target: Target, sources: Sequence[Source], options: ExportOptions, report: Report | None) -> list[FileJob]:
    return [
        (f"{folder}{name}", write)
        for folder, one in _read_by(target, sources)
        if target.refusal(one, options) is None
        for name, write in target.files(one, options, report)
    ]


def _read_by(target: Target, sources: Sequence[Source]) -> list[tuple[str, Source]]:
    """Return the sources that a target is written from, each with the folder of its files, ending in `/`, if any."""
    found: list[tuple[str, Source]] = []
    for one in sources:
        if isinstance(one, target.reads):
            found.append(("", one))
        elif isinstance(one, RegisteredSurvey) and RegisteredScan in target.reads:
            written = [scan for scan in one.scans if scan.photos or scan.refused or target.without_photos]
            found += [(f"{scan.id}/", scan) for scan in written]
    return found


def _document(
    sources: Sequence[Source], targets: Sequence[Target], options: ExportOptions, names: Sequence[str]
) -> dict[str, Any]:
    handed = next(iter(photographed(sources)), None)
    stations = next((one for one in sources if isinstance(one, StationScans)), None)
    placed = {} if handed is None else {"frame": handed.frame.as_dict(), "frame_is": handed.frame.sentence}
    return {
        "version": 1,
        "kind": "export",
        "targets": [{"name": target.name, "title": target.title, "purpose": target.purpose} for target in targets],
        "files": list(names),
        **placed,
        "photos": [] if handed is None else [
            {
                "id": one.id,
                "name": one.photo.name,
                "accepted": one.registration.accepted,
                "evidence": one.registration.evidence,
                "mark": one.mark or None,
                "coarse": one.registration.is_coarse,
                **({} if len(handed.scans) == 1 else {"scan": scan.id}),
            }
            for scan in handed.scans
            for one in (*scan.photos, *scan.refused)
        ],
        **({} if stations is None else {"stations": {"scans": list(stations.scans), "mark": stations.mark or None}}),
        "options": {"full": options.full, "crop": options.crop},
        "inputs": [input_document(path) for path in _inputs(sources)],
        "software": software_document(),
    }  # fmt: skip


def _listed(handed: Source | Sequence[Source]) -> Sequence[Source]:
    return [handed] if isinstance(handed, Source) else list(handed)


def _inputs(sources: Sequence[Source]) -> list[Path]:
    listed: list[Path | None] = []
    for source in sources:
        if isinstance(source, StationScans | MeasurementList):
            listed += source.inputs
            continue
        for scan in source.scans:
            listed += [scan.scan_file, *scan.scan_options.get("more", ())]
            for one in (*scan.photos, *scan.refused):
                listed += [one.file, one.camera_file]
    return list(dict.fromkeys(path for path in listed if path is not None))
