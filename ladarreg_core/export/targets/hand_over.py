"""Export of a registered scan to the programs that come next: one folder a target, written atomically."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ladarreg_core.errors import ExportError
from ladarreg_core.export.json import input_document, software_document, write_result
from ladarreg_core.export.registered_scan import RegisteredScan
from ladarreg_core.export.targets.folder import FileJob, write_folder
from ladarreg_core.export.targets.registry import targets_of
from ladarreg_core.export.targets.target import ExportOptions, Target
from ladarreg_core.progress import Report
from ladarreg_core.storage.replacement import EXPORT_FILE


def export_to(
    folder: str | Path,
    handed: RegisteredScan,
    targets: Sequence[str],
    *,
    options: ExportOptions | None = None,
    apart_from: Sequence[str | Path] = (),
    force: bool = False,
    report: Report | None = None,
) -> None:
    """Write targets into a new folder: `export.json`, and a folder for every target.

    Args:
        folder: output folder; missing parents are created.
        handed: the scan and its photographs.
        targets: names of targets, see `targets.registry.TARGETS`.
        options: options of the targets; None: `ExportOptions()`.
        apart_from: open project folders; a folder that is, contains or lies in one of them is not replaced.
        force: replace an earlier export.
        report: receives the progress; may raise `Cancelled`, and nothing is left then.

    Raises:
        OptionError: if a target is unknown.
        ExportError: if a target cannot be written for this scan or these cameras, the folder must not be replaced, or
            something cannot be written.
    """
    write_folder(
        folder,
        lambda: export_files(handed, targets, options=options, report=report),
        inputs=_sources(handed),
        apart_from=apart_from,
        force=force,
        report=report,
    )


def export_files(
    handed: RegisteredScan,
    targets: Sequence[str],
    *,
    options: ExportOptions | None = None,
    report: Report | None = None,
) -> list[FileJob]:
    """Return the names and writers of the files of an export; names contain `/`.

    Raises:
        OptionError: if a target is unknown.
        ExportError: if a target cannot be written for this scan or these cameras.
    """
    chosen, options = targets_of(targets), options or ExportOptions()
    require_shown([one.photo.name for one in handed.refused], chosen)
    refused = {target.name: why for target in chosen if (why := target.refusal(handed, options))}
    if refused:
        raise ExportError("; ".join(f"{name} cannot be written: {why}" for name, why in refused.items()))
    jobs: list[FileJob] = []
    for target in chosen:
        jobs += [(f"{target.name}/{name}", write) for name, write in target.files(handed, options, report)]
    names = [name for name, _ in jobs]
    return [(EXPORT_FILE, lambda path: write_result(path, _document(handed, chosen, options, names))), *jobs]


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
            f"{', '.join(others)} cannot be written: the pose of {', '.join(refused)} was refused, and only a report "
            "may show it; accept another pose, apply one that you know, or write the report alone"
        )


def _document(
    handed: RegisteredScan, targets: Sequence[Target], options: ExportOptions, names: Sequence[str]
) -> dict[str, Any]:
    return {
        "version": 1,
        "kind": "export",
        "targets": [{"name": target.name, "title": target.title, "purpose": target.purpose} for target in targets],
        "files": list(names),
        "frame": handed.frame.as_dict(),
        "frame_is": handed.frame.sentence,
        "photos": [
            {
                "id": one.id,
                "name": one.photo.name,
                "accepted": one.registration.accepted,
                "evidence": one.registration.evidence,
                "mark": one.mark or None,
                "coarse": one.registration.is_coarse,
            }
            for one in (*handed.photos, *handed.refused)
        ],
        "options": {"full": options.full, "crop": options.crop},
        "inputs": [input_document(path) for path in _sources(handed)],
        "software": software_document(),
    }


def _sources(handed: RegisteredScan) -> list[Path]:
    listed = [handed.scan_file, *handed.scan_options.get("more", ())]
    for one in (*handed.photos, *handed.refused):
        listed += [one.file, one.camera_file]
    return list(dict.fromkeys(path for path in listed if path is not None))
