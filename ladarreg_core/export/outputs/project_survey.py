"""A project of the workbench as a survey: its scans, photographs, cameras and known poses; and what it keeps of one."""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ladarreg_core.batches.photos.photo_list import camera_groups, photo_entries
from ladarreg_core.errors import OptionError
from ladarreg_core.export.json import plain
from ladarreg_core.export.registered_scan import photo_id
from ladarreg_core.formats import read_scan
from ladarreg_core.formats.cameras.camera_file import camera_from_fields
from ladarreg_core.frames import Rigid, rotvec_from_rotation
from ladarreg_core.project.document import (
    Adjusted,
    AdjustedCameraEntry,
    AdjustedPhotoEntry,
    AdjustedScanEntry,
    CameraGiven,
    Document,
    PhotoEntry,
    PoseEntry,
    Rows,
)
from ladarreg_core.project.drawn import AdjustedLineEntry, AdjustedTieEntry, LineEntry
from ladarreg_core.project.results import pose_of
from ladarreg_core.project.smoothing_edits import with_smoothings
from ladarreg_core.project.source import Source
from ladarreg_core.project.station_edits import known_place, scans_of, surveyed_pose
from ladarreg_core.project.storage.folder import ProjectFolder
from ladarreg_core.project.stored_arrays import StoredArrays
from ladarreg_core.scan import Scan
from ladarreg_core.survey.adjustment import Adjustment
from ladarreg_core.survey.parts import (
    PosePrior,
    ScanLine,
    SurveyCamera,
    SurveyLine,
    SurveyPhoto,
    SurveyScan,
    SurveyTie,
)
from ladarreg_core.survey.survey import Survey

_HELD = np.diag([1e-5**2] * 3 + [1e-4**2] * 3)
"""Covariance (6, 6) of a pose that is held: .6 thousandths of a degree, .1 mm."""


def survey_of_project(document: Document, folder: ProjectFolder, photos: Collection[str] | None = None) -> Survey:
    """Return a project as a survey; the scan that is shown is the first one, and keeps its place.

    Accepted poses are where the photographs are looked for first; those that are held are known there. Photographs of
    one body, lens, focal length and size, for which the operator gave the same camera data, share a camera; one that is
    held is not estimated. Photographs that were taken out are no part of it.

    Args:
        document: the project.
        folder: where its files are found.
        photos: ids of its photographs that take part; None: all.

    Raises:
        OptionError: if it has no scan, or none of the photographs.
    """
    if document.scan is None:
        raise OptionError("there is no scan; open one")
    chosen = [one for one in document.photos if (photos is None or one.id in photos) and one.part != "out"]
    if not chosen:
        raise OptionError("there is no photograph; open some")
    names: list[str] = []
    for source in scans_of(document):
        names.append(photo_id(source.name, names))
    scans = tuple(
        SurveyScan(
            id=name, source=_survey_source(folder, source), index=source.index,
            options={key: value for key, value in folder.scan_options(source).items() if key != "scan_index"},
            world_from_scanner=surveyed_pose(document.survey, source), fixed=number == 0,
        )
        for number, (name, source) in enumerate(zip(names, scans_of(document), strict=True))
    )  # fmt: skip
    cameras, camera_of = _cameras(chosen, folder)
    names_of_scans = {
        (one.path, one.index): name for one, name in zip(scans_of(document), names, strict=True)
    }  # fmt: skip
    return Survey(
        scans=scans,
        cameras=cameras,
        photos=tuple(
            SurveyPhoto(
                id=one.id, source=folder.source_path(one.source.path), camera=camera_of[one.id],
                initial=(initial := _initial(document, one)),
                prior=PosePrior(pose=initial, covariance=_HELD) if one.part == "held" and initial is not None else None,
            )
            for one in chosen
        ),
        ties=tuple(
            SurveyTie(id=one.id, photos=one.photos, uv=one.uv, sigma_px=one.sigma_px)
            for one in document.ties if set(one.photos) <= set(camera_of)
        ),
        lines=tuple(
            line for one in document.lines
            if (line := _line(one, camera_of, names_of_scans)) is not None
        ),
    )  # fmt: skip


def _line(entry: LineEntry, photos: Collection[str], scans: Mapping[tuple[str, int], str]) -> SurveyLine | None:
    """Return a line in the photographs that take part; None: it is in too few of them to say anything.

    Args:
        entry: the line.
        photos: ids of the photographs that take part.
        scans: ids of the scans by path and index: they stay where they are when their ranges are smoothed.
    """
    shown = [(photo, uv) for photo, uv in zip(entry.photos, entry.uv, strict=True) if photo in photos]
    drawn = entry.in_scan
    scan = None if drawn is None else scans.get((drawn.source.path, drawn.source.index))
    in_scan = None if drawn is None or scan is None else ScanLine(scan=scan, xyz=drawn.xyz, sigma_m=drawn.sigma_m)
    if len(shown) < (2 if in_scan is None else 1):
        return None
    return SurveyLine(
        id=entry.id, photos=tuple(photo for photo, _ in shown), uv=tuple(uv for _, uv in shown),
        sigma_px=entry.sigma_px, in_scan=in_scan,
    )  # fmt: skip


def _survey_source(folder: ProjectFolder, source: Source) -> Path | Scan:
    """Return the file of a scan; the scan itself where its ranges were smoothed, which the file does not know."""
    path = folder.source_path(source.path)
    if not source.smoothings:
        return path
    return with_smoothings(read_scan(path, **folder.scan_options(source)), source)


def adjusted_entry(document: Document, adjustment: Adjustment, poses: Mapping[str, PoseEntry]) -> Adjusted:
    """Return what a project keeps of an adjustment, beside the poses of its photographs.

    Args:
        document: the project before it.
        adjustment: the solution of `survey_of_project`.
        poses: the entries of the poses that it gave or that were held, by the ids of the photographs.
    """
    scans, lines = scans_of(document), {one.id: one for one in document.lines}
    return Adjusted(
        scans=tuple(
            AdjustedScanEntry(
                source=source,
                world_from_scanner=None if one.world_from_scanner is None else _rows(one.world_from_scanner),
                sigma_m=None if one.fixed or not one.accepted else float(np.sqrt(np.trace(one.covariance[3:, 3:]))),
                sigma_rad=None if one.fixed or not one.accepted else float(np.sqrt(np.trace(one.covariance[:3, :3]))),
            )
            for source, one in zip(scans, adjustment.scans.values(), strict=True)
        ),
        photos={
            name: AdjustedPhotoEntry(
                verdict=one.verdict, accepted=one.accepted,
                reasons=tuple(with_names(reason, document) for reason in one.reasons), ties=one.ties,
                ties_left_out=one.ties_left_out, median_px=_finite(one.median_px), partners=tuple(one.partners),
                camera=one.camera_id, sigma_m=_finite(one.sigma_position_m) if one.accepted else None,
                sigma_rad=_finite(one.sigma_angle_rad) if one.accepted else None,
                pose=poses[name].name if name in poses else "",
                **_movement(document, document.photo(name), poses.get(name)),
            )
            for name, one in adjustment.photos.items()
        },
        cameras={
            name: AdjustedCameraEntry(camera=plain(one.camera.as_fields()), sigmas=one.sigmas, photos=one.photos)
            for name, one in adjustment.cameras.items()
        },
        chi2_per_dof=_finite(adjustment.chi2_per_dof),
        ties=_ties(adjustment),
        drawn={
            one.id: AdjustedTieEntry(
                agrees=one.agrees, residual_px=_finite(one.residual_px), reason=with_names(one.reason, document)
            )
            for one in adjustment.ties
        },
        drawn_lines={
            one.id: AdjustedLineEntry(
                line=lines[one.id], agrees=one.agrees, reason=with_names(one.reason, document),
                residuals_px={
                    photo: px for photo, px in zip(one.photos, one.residuals_px, strict=True) if np.isfinite(px)
                },
                scan_residual_m=_finite(one.scan_residual_m),
            )
            for one in adjustment.lines
        },
        sigma_px=_finite(adjustment.sigma_px) if any(one.ties for one in adjustment.photos.values()) else None,
    )  # fmt: skip


def with_names(text: str, document: Document) -> str:
    """Return what a survey says of photographs, with the names of their files in place of their ids."""
    names = {one.id: one.source.name for one in document.photos}
    return re.sub(r"\bp\d+\b", lambda found: names.get(found[0], found[0]), text)


def _ties(adjustment: Adjustment) -> StoredArrays | None:
    marks = {name: one.tie_marks for name, one in adjustment.photos.items() if len(one.tie_marks)}
    return StoredArrays.of(marks) if marks else None


def _movement(document: Document, before: PhotoEntry | None, pose: PoseEntry | None) -> dict[str, Any]:
    """Return how far an adjustment moved the camera of a photograph, as fields of its entry."""
    former = None if before is None else before.pose
    if before is None or former is None or not former.accepted or pose is None:
        return {}
    was, now, place = pose_of(former), pose_of(pose), known_place(document, before.station)
    return {
        "former_centre": None if place is None else tuple((place @ was.centre).tolist()),
        "moved_m": float(np.linalg.norm(now.centre - was.centre)),
        "moved_rad": float(np.linalg.norm(rotvec_from_rotation(now.rotation @ was.rotation.T))),
    }


def _rows(pose: Rigid) -> Rows:
    return tuple(tuple(float(value) for value in row) for row in pose.matrix)


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _initial(document: Document, photo: PhotoEntry) -> Rigid | None:
    """Return the accepted `camera_from_world` of a photograph, which may be beside the scan of any station."""
    pose = photo.pose
    if pose is None or not pose.accepted:
        return None
    world = surveyed_pose(document.survey, document.beside(photo).scan)
    if world is None and pose.world_from_scanner is not None:
        world = Rigid.from_matrix(pose.world_from_scanner)
    found = pose_of(pose)
    return found if world is None else found @ world.inverse


def _cameras(photos: Collection[PhotoEntry], folder: ProjectFolder) -> tuple[tuple[SurveyCamera, ...], dict[str, str]]:
    """Return the cameras, and the id of each photograph's."""
    given: dict[tuple[CameraGiven, str | None, str], list[PhotoEntry]] = {}
    for one in photos:
        held = json.dumps(one.camera_held, sort_keys=True)
        given.setdefault((one.camera, one.source.temperature_unit, held), []).append(one)
    cameras: list[SurveyCamera] = []
    camera_of: dict[str, str] = {}
    for (camera, unit, _), members in given.items():
        kept = members[0].camera_held
        if kept is not None:
            name = f"camera-{len(cameras) + 1}"
            stated_unit = {} if unit is None else {"temperature_unit": unit}
            cameras.append(SurveyCamera(id=name, source=camera_from_fields(kept), options=stated_unit, estimate="none"))
            camera_of |= {one.id: name for one in members}
            continue
        paths = {folder.source_path(one.source.path): one.id for one in members}
        options = {
            "camera_name": camera.name, "focal_px": camera.focal_px, "focal_mm": camera.focal_mm,
            "sensor_mm": camera.sensor_mm, "camera_model": camera.model, "temperature_unit": unit,
        }  # fmt: skip
        stated = {name: value for name, value in options.items() if value is not None}
        file = None if camera.file is None else Path(folder.source_path(camera.file.path))
        entries = photo_entries(paths)
        known = {"camera": file, **stated} if file is not None else stated
        groups = [[one.path for one in group.photos] for group in camera_groups(entries, known)]
        groups += [[one.path] for one in entries if one.facts is None]
        for group in groups:
            name = f"camera-{len(cameras) + 1}"
            cameras.append(SurveyCamera(id=name, source=file, options=stated))
            camera_of |= {paths[path]: name for path in group}
        for one in members:  # the same file twice has one entry
            camera_of.setdefault(one.id, f"camera-{len(cameras)}")
    return tuple(cameras), camera_of
