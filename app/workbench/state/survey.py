"""The survey of a project, for pages: what solving everything together said of each photograph and camera."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from statistics import median
from typing import TYPE_CHECKING

import numpy as np

from ladarreg_core.errors import LadarregError
from ladarreg_core.foundations.formatting import format_angle, format_length
from ladarreg_core.project.station_edits import partner_of, scans_of

from ...argument_names import as_fields

if TYPE_CHECKING:
    from ladarreg_core.project.document import (
        Adjusted,
        AdjustedPhotoEntry,
        AdjustedScanEntry,
        Document,
        PhotoEntry,
    )
    from ladarreg_core.project.drawn import ScanLineEntry

    from ...slices.several import DrawnLine, DrawnTie, LineInScan, Survey, SurveyCamera, SurveyPhoto, SurveyScan


def survey_slice(document: Document, is_stale: Callable[[PhotoEntry], bool]) -> Survey | None:
    """Return the slice `survey`; None before everything was solved together.

    Args:
        document: the project.
        is_stale: returns whether the pose of a photograph is out of date.
    """
    adjusted = document.adjusted
    if adjusted is None:
        return None
    photos = [
        _photo(adjusted, entry, stale=is_stale(entry)) for entry in document.photos if entry.id in adjusted.photos
    ]
    changed = {photo["id"] for photo in photos if photo["changed"]}
    later = [
        entry.source.name for entry in document.photos if entry.id not in adjusted.photos and entry.part != "out"
    ]  # fmt: skip
    out = sum(entry.part == "out" for entry in document.photos if entry.id in adjusted.photos)
    return {
        "accepted": sum(photo["accepted"] for photo in photos),
        "photos": photos,
        "cameras": [_camera(adjusted, document, name) for name in adjusted.cameras],
        "scans": [_scan(one) for one in adjusted.scans],
        "chi2_per_dof": adjusted.chi2_per_dof,
        "sigma_px": adjusted.sigma_px,
        "since": _since(
            len(changed), later, out, _drawn_since(adjusted, document), _lines_since(adjusted, document),
            scans_changed={one.source for one in adjusted.scans} != set(scans_of(document)),
        ),
    }  # fmt: skip


def ties_slice(document: Document, entry: PhotoEntry) -> list[list[float]] | None:
    """Return the slice `ties` of a photograph; None without any, or where it has another pose by now."""
    adjusted, pose = document.adjusted, entry.pose
    found = None if adjusted is None else adjusted.photos.get(entry.id)
    if adjusted is None or adjusted.ties is None or found is None or pose is None or pose.name != found.pose:
        return None
    try:
        marks = adjusted.ties.arrays().get(entry.id)
    except LadarregError:  # the file is lost: the poses are not
        return None
    return None if marks is None else np.round(np.asarray(marks, np.float64), 2).tolist()


def drawn_ties_slice(document: Document) -> list[DrawnTie]:
    """Return the slice `drawn_ties`: the ties that were drawn, and what the last adjustment said of each."""
    from ladarreg_core.survey.ties.ties import tracks_of

    said = {} if document.adjusted is None else document.adjusted.drawn
    firsts = tracks_of([tuple(zip(tie.photos, tie.uv, strict=True)) for tie in document.ties])
    return [
        {
            "id": tie.id, "track": document.ties[first].id, "photos": list(tie.photos),
            "uv": [list(uv) for uv in tie.uv], "sigma_px": tie.sigma_px,
            "agrees": said[tie.id].agrees if tie.id in said else None,
            "residual_px": said[tie.id].residual_px if tie.id in said else None,
            "reason": as_fields(said[tie.id].reason) if tie.id in said else "",
        }
        for tie, first in zip(document.ties, firsts, strict=True)
    ]  # fmt: skip


def drawn_lines_slice(document: Document) -> list[DrawnLine]:
    """Return the slice `drawn_lines`: the lines that were drawn, and what the last adjustment said of each as it is."""
    said = {} if document.adjusted is None else document.adjusted.drawn_lines
    known = ("", *(station.id for station in document.stations))
    stations = {
        (source.path, source.index): name for name in known if (source := partner_of(document, name)) is not None
    }
    rows: list[DrawnLine] = []
    for line in document.lines:
        found = said.get(line.id)
        if found is not None and found.line != line:
            found = None
        rows.append({
            "id": line.id, "photos": list(line.photos), "uv": [[list(end) for end in ends] for ends in line.uv],
            "sigma_px": line.sigma_px, "in_scan": None if line.in_scan is None else _in_scan(line.in_scan, stations),
            "agrees": None if found is None else found.agrees,
            "residuals_px": {} if found is None else found.residuals_px,
            "scan_residual": _length(None if found is None else found.scan_residual_m),
            "reason": "" if found is None else as_fields(found.reason),
        })  # fmt: skip
    return rows


def _in_scan(drawn: ScanLineEntry, stations: Mapping[tuple[str, int], str]) -> LineInScan:
    """Return a line as a scan shows it; its station is None where that scan is no longer in the project."""
    source = drawn.source
    return {
        "station": stations.get((source.path, source.index)), "name": source.name,
        "xyz": [list(end) for end in drawn.xyz], "sigma": format_length(drawn.sigma_m),
    }  # fmt: skip


def _length(value: float | None) -> str | None:
    return None if value is None else format_length(value)


def _photo(adjusted: Adjusted, entry: PhotoEntry, *, stale: bool) -> SurveyPhoto:
    found = adjusted.photos[entry.id]
    pose = entry.pose
    same = pose is not None and pose.name == found.pose
    return {
        "id": entry.id,
        "name": entry.source.name,
        "verdict": found.verdict,
        "accepted": found.accepted,
        "reasons": [as_fields(reason) for reason in found.reasons],
        "ties": found.ties,
        "ties_left_out": found.ties_left_out,
        "median_px": found.median_px,
        "partners": list(found.partners),
        "camera": found.camera,
        "sigma_m": found.sigma_m,
        "position": None if found.sigma_m is None else format_length(found.sigma_m),
        "angle": None if found.sigma_rad is None else format_angle(found.sigma_rad),
        "moved": _moved(found),
        "changed": found.accepted and (stale or not same),
    }


def _moved(found: AdjustedPhotoEntry) -> str | None:
    """Return how far the camera moved, where that is more than is known of its place."""
    if found.moved_m is None or found.moved_rad is None or found.sigma_m is None or found.sigma_rad is None:
        return None
    if found.moved_m <= found.sigma_m and found.moved_rad <= found.sigma_rad:
        return None
    return f"{format_length(found.moved_m)}, {format_angle(found.moved_rad)}"


def _camera(adjusted: Adjusted, document: Document, name: str) -> SurveyCamera:
    found = adjusted.cameras[name]
    names = {entry.id: entry.source.name for entry in document.photos}
    held = [
        entry.camera_held is not None for entry in document.photos
        if (one := adjusted.photos.get(entry.id)) and one.camera == name
    ]  # fmt: skip
    taken = [entry.id for entry in document.photos if (one := adjusted.photos.get(entry.id)) and one.camera == name]
    residuals = {one: px for one in taken if (px := adjusted.photos[one].median_px) is not None and one in found.photos}
    worst = max(residuals, key=lambda one: residuals[one], default=None)
    return {
        "id": name,
        "focal_px": found.camera.get("fx"),
        "sigma_px": found.sigmas.get("focal_px"),
        "width": found.camera.get("width"),
        "height": found.camera.get("height"),
        "photos": [names[one] for one in taken],
        "used": len(found.photos),
        "median_px": median(residuals.values()) if residuals else None,
        "worst": None if worst is None else {"id": worst, "name": names[worst], "median_px": residuals[worst]},
        "held": bool(held) and all(held),
    }


def _scan(found: AdjustedScanEntry) -> SurveyScan:
    known = found.sigma_m is not None and found.sigma_rad is not None
    return {
        "name": found.source.name,
        "state": "not connected" if found.world_from_scanner is None else "placed" if known else "fixed",
        "position": None if found.sigma_m is None else format_length(found.sigma_m),
        "angle": None if found.sigma_rad is None else format_angle(found.sigma_rad),
    }


def _drawn_since(adjusted: Adjusted, document: Document) -> int:
    """Return how many ties were drawn between photographs that took part, or removed, since."""
    there = {tie.id for tie in document.ties}
    drawn = [tie for tie in document.ties if tie.id not in adjusted.drawn and set(tie.photos) <= set(adjusted.photos)]
    return len(drawn) + len(set(adjusted.drawn) - there)


def _lines_since(adjusted: Adjusted, document: Document) -> int:
    """Return how many lines were drawn, changed or removed since."""
    now = {line.id: line for line in document.lines}
    drawn = [
        line for line in now.values()
        if line.id not in adjusted.drawn_lines and len(set(line.photos) & set(adjusted.photos)) >= 2
    ]  # fmt: skip
    changed = [name for name, said in adjusted.drawn_lines.items() if now.get(name) != said.line]
    return len(drawn) + len(changed)


def _since(changed: int, later: list[str], out: int, ties: int, lines: int, *, scans_changed: bool) -> str:
    """Return what has changed since, as a sentence; empty: nothing."""
    causes = []
    if scans_changed:
        causes.append("the scans have changed")
    if changed:
        causes.append(f"{changed} photograph{' has' if changed == 1 else 's have'} another pose")
    if later:
        causes.append(f"{len(later)} photograph{' was' if len(later) == 1 else 's were'} added")
    if out:
        causes.append(f"{out} photograph{' was' if out == 1 else 's were'} taken out")
    if ties:
        causes.append(f"{ties} tie{' was' if ties == 1 else 's were'} drawn or removed")
    if lines:
        causes.append(f"{lines} line{' was' if lines == 1 else 's were'} drawn or removed")
    if not causes:
        return ""
    return f"{', '.join(causes)[:1].upper()}{', '.join(causes)[1:]} since: adjust again."
