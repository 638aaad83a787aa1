"""What a model is made of: results on one scan, or of a survey with several, read again."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ladarreg_core.batch.folder import is_batch_folder
from ladarreg_core.batch.photo_summary import read_photos_result
from ladarreg_core.errors import ExportError, OptionError
from ladarreg_core.export.output_frame import FrameName, OutputFrame
from ladarreg_core.export.registered_scan import RegisteredPhoto, RegisteredScan, photo_id
from ladarreg_core.frames import Rigid
from ladarreg_core.outputs.saved_results import SavedResult, is_saved_result, read_saved_result, registered_scan
from ladarreg_core.progress import Report, part_of

_SAME = 1e-6


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
    frame: FrameName | None = None,
    option: str = "`folders`",
    report: Report | None = None,
) -> ModelSources:
    """Read results with their scans and photographs; only what was accepted is used.

    Args:
        results: folders of results, of a run with many photographs, or of an adjusted survey.
        folders: where inputs are looked for, too.
        scan_options: arguments of `read_scan` for results that do not record them.
        temperature_unit: as of `registered_scan`.
        trust_edited: read results that were changed after they were written; they then count as given.
        frame: of the files; None: `scanner` of one scan, `world` of several.
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
    groups: dict[tuple[Any, ...], list[SavedResult]] = {}
    for one in used:
        key = one.inputs[0].get("sha256"), tuple(sorted((k, str(v)) for k, v in one.scan_options.items()))
        groups.setdefault(key, []).append(one)
    several = len(groups) > 1
    if several and frame == "scanner":
        raise OptionError(
            f"the results are on {len(groups)} scans, which have no common scanner's frame; write in the world"
        )
    scans: list[RegisteredScan] = []
    taken: list[str] = []
    for n, group in enumerate(groups.values()):
        found = registered_scan(
            group, folders=folders, scan_options=scan_options, temperature_unit=temperature_unit, option=option,
            report=part_of(report, n / len(groups), (n + 1) / len(groups)),
        )  # fmt: skip
        scans.append(_placed(found, group, several=several, frame=frame, first=scans, taken=taken))
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


def _placed(
    found: RegisteredScan, group: Sequence[SavedResult], *, several: bool, frame: FrameName | None,
    first: Sequence[RegisteredScan], taken: list[str],
) -> RegisteredScan:  # fmt: skip
    """Return a scan with its pose in the world, in the frame of the files, its photographs with unique ids."""
    scan = found.scan
    if several or scan.world_from_scanner is None:
        scan = replace(scan, world_from_scanner=_world_of(group) or scan.world_from_scanner)
    if several and scan.world_from_scanner is None:
        raise OptionError(
            f"the results are on different scans, and where {found.scan.name} stands in the world is not known; give "
            "the folder of an adjusted survey, or the results of each scan by itself"
        )
    name: FrameName = frame or ("world" if several else "scanner")
    placed = OutputFrame.of(scan, name)
    if first:  # what is subtracted is the same for all
        placed = replace(placed, offset_m=first[0].frame.offset_m)
    photos: list[RegisteredPhoto] = []
    for one in found.photos:
        unique = photo_id(one.id, taken)
        taken.append(unique)
        registration = replace(one.registration, world_from_scanner=scan.world_from_scanner)
        photos.append(replace(one, id=unique, registration=registration))
    return replace(found, scan=scan, photos=photos, frame=placed, refused=())


def _world_of(group: Sequence[SavedResult]) -> Rigid | None:
    """Return the scanner's pose in the world as results state it; None: they do not.

    Raises:
        OptionError: if they state different ones.
    """
    stated = [one.registration.world_from_scanner for one in group]
    known = [one for one in stated if one is not None]
    if not known:
        return None
    if any(np.abs(one.matrix - known[0].matrix).max() > _SAME for one in known[1:]):
        raise OptionError(
            f"{group[0].file.parent} and others state different poses of one scanner, as of different adjustments; "
            "give the results of one"
        )
    return known[0]
