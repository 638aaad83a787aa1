"""What a model is made of: results on one scan, or of a survey with several, read again."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ladarreg_core.batches.photos.folder import is_batch_folder
from ladarreg_core.batches.photos.photo_summary import read_photos_result
from ladarreg_core.errors import ExportError, OptionError
from ladarreg_core.export.output_frame import FrameName
from ladarreg_core.export.outputs.placed_scans import placed_scans
from ladarreg_core.export.outputs.saved_results import (
    SavedResult,
    is_saved_result,
    read_saved_result,
    registered_results,
)
from ladarreg_core.export.registered_scan import RegisteredScan, RegisteredSurvey
from ladarreg_core.foundations.progress import Report


@dataclass(frozen=True, slots=True, eq=False)
class ModelSources:
    """Scans with the photographs that were accepted on them, and what is left out."""

    scans: tuple[RegisteredScan, ...]
    """Each with its own photographs, whose ids are unique among all; poses are relative to its scanner."""
    left_out: tuple[tuple[str, str], ...]
    """Names of photographs that are not used, with the reason."""


def read_model_sources(
    results: Sequence[Path],
    *,
    folders: Sequence[Path] = (),
    scan_options: Mapping[str, Any] | None = None,
    temperature_unit: str | None = None,
    trust_edited: bool = False,
    frame: FrameName = "scanner",
    option: str = "`inputs`",
    report: Report | None = None,
) -> ModelSources:
    """Read results with their scans and photographs; only what was accepted is used.

    Args:
        results: folders of results, of a run with many photographs, or of an adjusted survey.
        folders: where inputs are looked for, too.
        scan_options: arguments of `read_scan` for results that do not record them.
        temperature_unit: as of `registered_results`.
        trust_edited: read results that were changed after they were written; they then count as given.
        frame: of the files; several scans are written in the world.
        option: how to give a folder, for messages.
        report: receives the progress.

    Raises:
        OptionError: if a folder is no result, or there are several scans without poses in one world.
        ExportError: if no photograph was accepted, or an input is not found.
        LadarregError: if an input cannot be read.
    """
    folders_of, left_out = _photo_folders(results, trust_edited=trust_edited)
    used: list[SavedResult] = []
    for folder in folders_of:
        one = read_saved_result(folder, trust_edited=trust_edited)
        if one.registration.accepted:
            used.append(one)
        else:
            left_out.append((one.photo_name, one.registration.mark or "not accepted"))
    if not used:
        named = "; ".join(f"{name}: {why}" for name, why in left_out)
        raise ExportError(
            f"no photo was accepted, so there is no model to make ({named or 'there is none'}); register one first"
        )
    found = registered_results(
        used, placed=placed_scans(results, trust_edited=trust_edited), folders=folders, scan_options=scan_options,
        temperature_unit=temperature_unit, frame=frame, option=option, report=report,
    )  # fmt: skip
    scans = found.scans if isinstance(found, RegisteredSurvey) else (found,)
    return ModelSources(tuple(scans), tuple(left_out))


def _photo_folders(results: Sequence[Path], *, trust_edited: bool) -> tuple[list[Path], list[tuple[str, str]]]:
    """Return the folders of results of photographs, and the photographs of runs that were not accepted."""
    found: list[Path] = []
    left_out: list[tuple[str, str]] = []
    for path in results:
        if is_batch_folder(path):
            run = read_photos_result(path, trust_edited=trust_edited)
            for name, fields in run.photos.items():
                if fields.get("accepted") is True:
                    found.append(run.photo_folder(name))
                else:
                    left_out.append((name, str(fields.get("verdict") or "not accepted")))
        elif is_saved_result(path):
            found.append(path)
        else:
            what = "has no registration.json, and is no folder of many photos" if path.is_dir() else "is not a folder"
            raise OptionError(f"{path} {what}; give folders of results, or of an adjusted survey")
    return list(dict.fromkeys(found)), left_out
