"""Descriptions of the documents that results consist of: registrations, comparisons, panoramas, exports."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ladarreg_core.camera import CameraModel
from ladarreg_core.errors import FormatError
from ladarreg_core.formats.cameras.camera_file import camera_from_fields, describe_camera
from ladarreg_core.formats.documents.own_results import TRUST_OPTION, checksum_words, edited_fault, was_edited
from ladarreg_core.formats.documents.panorama_info import panorama_lines
from ladarreg_core.formats.documents.pose_file import CAMERAS_FIELD, GUESS_FIELD, POSE_FIELD, WORLD_FIELD, read_pose
from ladarreg_core.formats.documents.registration_file import as_given
from ladarreg_core.formats.documents.stations_info import station_lines
from ladarreg_core.formats.file_info import FileInfo
from ladarreg_core.formats.parsing.json_file import begins_with_brace, parsed_once, read_json_object
from ladarreg_core.formats.parsing.untrusted import one_line, reading, shown_name
from ladarreg_core.frames import Rigid, ThesisParameters, describe_direction, describe_position
from ladarreg_core.results.verdict_words import verdict_words
from ladarreg_core.storage.checksums import CHECKSUM_FIELD
from ladarreg_core.storage.manifest import DOCUMENTS

_MAX_LISTED = 50
_LONGEST = 400
Fields = Mapping[str, Any]


def describe_results(path: Path, *, trust_edited: bool = False) -> FileInfo | None:
    """Describe a registration, comparison, export, panorama or offset JSON; None for any other file.

    Args:
        path: the file.
        trust_edited: describe a file that was changed after it was written; a registration then is a given pose.

    Raises:
        FormatError: if it is such a file, but damaged, or changed after it was written.
    """
    with reading(path) as file, parsed_once():
        if not begins_with_brace(file):
            return None
        try:
            fields = read_json_object(file, "a document")
        except FormatError:
            return None  # whoever reads it says why
        describe = _describer(fields)
        if describe is None:
            return None
        fault = edited_fault(file, fields) if not trust_edited else ""
        if fault:
            raise FormatError(f"{fault}; {TRUST_OPTION}")
        if trust_edited and describe is _registration and was_edited(file, fields):
            fields = as_given(fields)
        try:
            return replace(describe(path, fields), checksum=_checksum(file))
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise FormatError(f"it is damaged ({one_line(error, 60)}); give an unmodified file") from None


def _checksum(file: Path) -> str | None:
    fields = read_json_object(file, "a document")
    own = file.name in DOCUMENTS or CHECKSUM_FIELD in fields
    return checksum_words(file, fields) if own else None


def _describer(fields: Fields) -> Callable[[Path, Fields], FileInfo] | None:
    has_verdict = isinstance(fields.get("accepted"), bool) and isinstance(fields.get("camera"), dict)
    if POSE_FIELD in fields and has_verdict:
        return _registration
    if fields.get("kind") == "export" and isinstance(fields.get("targets"), list):
        return _export
    if "camera_from_scanner_is" in fields and isinstance(fields.get("columns"), list):
        return _comparison
    if fields.get("kind") == "panorama" and isinstance(fields.get("pieces"), list):
        return _panorama
    if fields.get("kind") == "stations" and isinstance(fields.get("stations"), list):
        return _stations
    if fields.get("kind") == "rig" and isinstance(fields.get("pairs"), list):
        return _rig
    if "offset_is" in fields and isinstance(fields.get("offset_m"), list):
        return _offset
    return None


def _registration(path: Path, fields: Fields) -> FileInfo:
    given = fields.get("evidence") == "given"
    refused = not fields["accepted"] and not given
    # Files of earlier versions have the guess of a refused registration under the name of the pose.
    where = GUESS_FIELD if fields.get(POSE_FIELD) is None else POSE_FIELD
    pose = None if fields.get(where) is None else _pose(read_pose(path, field=where))
    if pose is not None and not refused and fields.get(WORLD_FIELD) is not None:
        in_world = read_pose(path, field=WORLD_FIELD)
        pose["in_the_world"] = describe_position(in_world.centre)
        pose["looks"] = describe_direction(in_world.rotation[2])
    camera: CameraModel = camera_from_fields(fields["camera"])
    return FileInfo(
        **_about(path, fields, "registration"),
        verdict=verdict_words(
            fields["accepted"],
            str(fields.get("evidence")),
            fields.get("diagnostics") or {},
            coarse=fields.get("coarse") is True,
        ),
        evidence=one_line(fields.get("evidence"), 20),
        method=one_line(fields.get("method"), 40),
        reasons=_texts(fields.get("reasons")),
        pose={} if refused or pose is None else pose,
        rejected_guess={} if not refused or pose is None else pose,
        sigma={} if refused else _sigma(fields.get("sigma") or {}),
        camera=describe_camera(camera),
        matches=_matches(fields.get("matches") or []),
        notes=_notes(fields, refused=refused, has_guess=pose is not None),
    )


def _notes(fields: Fields, *, refused: bool, has_guess: bool) -> tuple[str, ...]:
    notes = []
    if refused:
        guess = "the rejected guess is no pose: do not use it as one" if has_guess else "no candidate was found"
        notes.append(f"this registration was refused; {guess}")
    if fields.get("open_in_workbench"):
        notes.append(f"to draw matches by hand: {one_line(fields['open_in_workbench'], 2000)}")
    return tuple(notes)


def _export(path: Path, fields: Fields) -> FileInfo:
    photos = [
        f"{one_line(one['name'], 80)} ({one_line(one['id'], 60)}): {one_line(one.get('mark') or one['evidence'], 40)}"
        for one in fields.get("photos") or []
    ]
    targets = ", ".join(one_line(one["name"], 20) for one in fields["targets"])
    files = fields.get("files") or []
    return FileInfo(
        **_about(path, fields, "export"),
        contents=(f"{len(files)} files for {targets}", *photos[:_MAX_LISTED]),
        notes=_texts([fields["frame_is"]] if fields.get("frame_is") else []),
    )


def _comparison(path: Path, fields: Fields) -> FileInfo:
    lines = [
        f"{one_line(one.get('name') or one.get('stage'), 40)}: "
        + ("accepted" if one.get("accepted") is True else "not accepted" if "accepted" in one else "no pose")
        for one in fields["columns"][:_MAX_LISTED]
    ]
    return FileInfo(**_about(path, fields, "comparison"), contents=tuple(lines), notes=_texts(fields.get("cautions")))


def _panorama(path: Path, fields: Fields) -> FileInfo:
    lines = tuple(f"{name}: {one_line(text, _LONGEST)}" for name, text in panorama_lines(fields))
    return FileInfo(**_about(path, fields, "panorama"), contents=lines, notes=_texts(fields.get("notes")))


def _stations(path: Path, fields: Fields) -> FileInfo:
    lines = tuple(f"{name}: {one_line(text, _LONGEST)}" for name, text in station_lines(fields))
    return FileInfo(**_about(path, fields, "stations"), contents=lines)


def _rig(path: Path, fields: Fields) -> FileInfo:
    where = POSE_FIELD if fields["accepted"] else GUESS_FIELD
    lines = [f"{one_line(one['name'], 60)}: {one_line(one['outcome'], 20)}" for one in fields["pairs"]]
    cameras = fields.get(CAMERAS_FIELD)
    if isinstance(cameras, dict):
        lines = [
            f"{one_line(name, 60)}: {'accepted' if one['accepted'] else 'not accepted'}"
            for name, one in cameras.items()
        ] + lines
    return FileInfo(
        **_about(path, fields, "rig"),
        verdict="Accepted: verified by pairs that were held out." if fields["accepted"] else "Not accepted.",
        pose={} if fields.get(where) is None else _pose(read_pose(path, field=where)),
        contents=(*lines, *(one_line(reason, _LONGEST) for reason in fields["reasons"])),
    )


def _offset(path: Path, fields: Fields) -> FileInfo:
    x, y, z = (float(value) for value in fields["offset_m"])
    what = f"add {x:.10g} {y:.10g} {z:.10g} to X Y Z of the models beside it for coordinates in the world"
    return FileInfo(**_about(path, fields, "offset"), contents=(what,))


def _about(path: Path, fields: Fields, name: str) -> dict[str, Any]:
    inputs = [
        f"{one_line(one['name'], 80)} ({int(one['size']):,} bytes, SHA-256 {one_line(one['sha256'], 64)})"
        for one in (fields.get("inputs") or [])[:_MAX_LISTED]
    ]
    software = fields.get("software")
    made_by = None
    if isinstance(software, dict):
        made_by = one_line(f"{software.get('name')} {software.get('version')}", 60)
    return {
        "file": shown_name(path), "bytes": path.stat().st_size, "kind": "results", "format": f"{name} JSON",
        "inputs": tuple(inputs), "made_by": made_by,
    }  # fmt: skip


def _pose(pose: Rigid) -> dict[str, Any]:
    six = ThesisParameters.from_pose(pose)
    angles = (np.degrees(angle) for angle in (six.alpha, six.beta, six.gamma))
    return {"camera": six.describe_position(), "pan_tilt_roll_deg": ", ".join(f"{angle:.2f}" for angle in angles)}


def _sigma(sigma: Fields) -> dict[str, Any]:
    known = {name: float(value) for name, value in sigma.items() if isinstance(value, int | float)}
    found: dict[str, Any] = {}
    if "position_m" in known:
        found["position_mm"] = 1000 * known["position_m"]
    if "angle_rad" in known:
        found["angle_deg"] = float(np.degrees(known["angle_rad"]))
    return found or {"pose": "unknown"}


def _matches(listed: Sequence[Any]) -> str | None:
    inliers = sum(one.get("inlier") is True for one in listed)
    return f"{inliers} of {len(listed)} are inliers" if listed else None


def _texts(found: Any) -> tuple[str, ...]:
    return tuple(one_line(one, _LONGEST) for one in found[:_MAX_LISTED]) if isinstance(found, list) else ()
