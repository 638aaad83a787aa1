"""`survey.json`: reads and writes it, and makes one of a folder; a file with faults is refused with all of them."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from ladarreg_core.batches.photos.photo_list import camera_groups, folder_contents, photo_entries
from ladarreg_core.camera import CameraModel
from ladarreg_core.errors import ExportError, FormatError, LadarregError, OptionError
from ladarreg_core.export.registered_scan import photo_id
from ladarreg_core.formats.cameras.camera_file import camera_from_fields
from ladarreg_core.formats.parsing.json_file import read_json_object, write_json
from ladarreg_core.formats.parsing.untrusted import reading, shown_name
from ladarreg_core.formats.scans.scan_request import stated_options
from ladarreg_core.foundations.progress import Progress, Report
from ladarreg_core.foundations.validation import is_number
from ladarreg_core.frames import Rigid
from ladarreg_core.survey.parts import (
    DRAWN_SIGMA_PX,
    SCAN_LINE_SIGMA_M,
    Estimate,
    PosePrior,
    RigMember,
    ScanLine,
    ScanTargets,
    SurveyCamera,
    SurveyLine,
    SurveyParts,
    SurveyPhoto,
    SurveyScan,
    SurveyTie,
    faults_of,
    listed_faults,
)

T = TypeVar("T")
_VERSION = 1
_FIELDS = {
    "scans": {"id", "path", "scan", "options", "world_from_scanner", "fixed", "targets", "radius_m", "sigma_m"},
    "cameras": {"id", "camera", "path", "estimate", "options"},
    "photos": {"id", "path", "camera", "initial", "prior", "matches", "rig"},
    "ties": {"id", "photos", "uv", "sigma_px"},
    "lines": {"id", "photos", "uv", "sigma_px", "scan"},
}
_ESTIMATED = {"focal": "focal_px"}  # what the file calls it
_PHOTO_OPTIONS = ("focal_px", "focal_mm", "sensor_mm", "camera_model")


@dataclass(frozen=True, slots=True)
class _Parts:
    scans: list[SurveyScan]
    cameras: list[SurveyCamera]
    photos: list[SurveyPhoto]
    rigs: Mapping[str, Mapping[str, Rigid | None]]
    ties: list[SurveyTie] = field(default_factory=list)
    lines: list[SurveyLine] = field(default_factory=list)


class _Faults:
    """Collects what is wrong in a file, so that all faults are reported together."""

    def __init__(self) -> None:
        self.found: list[str] = []

    def add(self, where: str, what: str) -> None:
        self.found.append(f"{where}: {what}")

    def taken(self, where: str, make: Callable[[], T], otherwise: T) -> T:
        """Return what a function makes, or note why it does not."""
        try:
            return make()
        except (LadarregError, KeyError, TypeError, ValueError) as error:
            self.add(where, str(error) if isinstance(error, LadarregError) else f"it is damaged ({error!r:.60})")
            return otherwise


def read_survey_parts(path: str | Path) -> SurveyParts:
    """Return the parts of the survey of a file.

    Raises:
        FormatError: if it is no such file, or has faults: all are listed, missing files among them.
    """
    with reading(path) as file:
        fields = read_json_object(file, "a survey")
        if fields.get("version") != _VERSION:
            raise FormatError(
                f"unsupported version {fields.get('version')!r:.20} of a survey ({_VERSION} is supported)"
            )
        faults = _Faults()
        unknown = sorted(set(fields) - {"version", *_FIELDS, "rigs"})
        if unknown:
            faults.add("survey", f"unknown fields {', '.join(unknown)}")
        folder = file.parent
        parts: dict[str, list[Mapping[str, Any]]] = {what: _listed(fields, what, faults) for what in _FIELDS}
        scans = [_scan(one, folder, faults) for one in parts["scans"]]
        cameras = [_camera(one, folder, faults) for one in parts["cameras"]]
        photos = [_photo(one, folder, faults) for one in parts["photos"]]
        none: dict[str, dict[str, Rigid | None]] = {}
        rigs = faults.taken("rigs", lambda: _rigs(fields.get("rigs", [])), none)
        ties = [tie for one in parts["ties"] if (tie := _tie(one, faults)) is not None]
        lines = [line for one in parts["lines"] if (line := _line(one, faults)) is not None]
        parts_read = _Parts(scans, cameras, photos, rigs, ties, lines)
        faults.found += faults_of(parts_read)
    if faults.found:  # here, since errors of reading are shortened
        raise FormatError(f"{shown_name(path)}: {listed_faults('it', faults.found)}")
    return parts_read


def is_survey_file(path: str | Path) -> bool:
    """Return whether a file is a `survey.json`, with or without faults."""
    try:
        with reading(path) as file:
            fields = read_json_object(file, "a survey")
    except LadarregError:
        return False
    return {"scans", "photos"} <= set(fields)


def write_survey(path: str | Path, survey: SurveyParts) -> None:
    """Write a survey into a file, with paths relative to its folder.

    Raises:
        ExportError: if it cannot be written, or a scan or photograph has no file.
    """
    write_json(path, survey_fields(survey, path))


def survey_fields(survey: SurveyParts, path: str | Path) -> dict[str, Any]:
    """Return what the file of a survey states, with paths relative to its folder.

    Raises:
        ExportError: if a scan or photograph has no file.
    """
    home = Path(os.path.abspath(path)).parent

    def relative(source: object, what: str) -> str:
        if not isinstance(source, Path):
            raise ExportError(f"{what} has no file, so the survey cannot be written; save it first")
        return os.path.relpath(os.path.abspath(source), home).replace(os.sep, "/")

    def matrix(pose: Rigid | None) -> list[list[float]] | None:
        return None if pose is None else pose.matrix.tolist()

    return {
        "version": _VERSION,
        "scans": [
            {"id": one.id, "path": relative(one.source, f"the scan {one.id}"), "scan": one.index,
             **({"options": dict(one.options)} if one.options else {}),
             "world_from_scanner": matrix(one.world_from_scanner), "fixed": one.fixed,
             **_targets_fields(one, relative)}
            for one in survey.scans
        ],
        "cameras": [
            {"id": one.id, **_camera_source(one, relative), "estimate": _estimate_words(one.estimate)}
            for one in survey.cameras
        ],
        "photos": [
            {"id": one.id, "path": relative(one.source, f"the photo {one.id}"), "camera": one.camera,
             "initial": matrix(one.initial), "prior": _prior_fields(one.prior),
             "matches": None if one.matches is None else relative(one.matches, "its file of matches"),
             "rig": None if one.rig is None else
             {"id": one.rig.id, "frame": one.rig.frame, "sensor": one.rig.sensor}}
            for one in survey.photos
        ],
        "rigs": [
            {"id": name,
             "sensors": {sensor: {"sensor_from_reference": matrix(pose)} for sensor, pose in sensors.items()}}
            for name, sensors in survey.rigs.items()
        ],
        **({"ties": [
            {"id": one.id, "photos": list(one.photos), "uv": [list(uv) for uv in one.uv], "sigma_px": one.sigma_px}
            for one in survey.ties
        ]} if survey.ties else {}),
        **({"lines": [_line_fields(one) for one in survey.lines]} if survey.lines else {}),
    }  # fmt: skip


def survey_parts_of_folder(folder: str | Path, *, report: Report | None = None) -> SurveyParts:
    """Return the parts of the survey of a folder, see `Survey.from_folder`."""
    contents = folder_contents(folder)
    if not contents.scans or not contents.photos:
        what = "scan" if not contents.scans else "photo"
        raise OptionError(f"{folder} contains no {what}; a survey has scans and photographs")
    if report is not None:
        report(Progress(0, 1, f"reading the headers of {len(contents.photos)} photos"))
    entries = photo_entries(contents.photos)
    unreadable = [f"{entry.path.name}: {entry.fault}" for entry in entries if entry.facts is None]
    if unreadable:
        raise OptionError(listed_faults(f"the folder {folder}", unreadable))
    groups = camera_groups(entries)
    camera_of = {entry.id: group.id for group in groups for entry in group.photos}
    ids: list[str] = []
    for path in contents.scans:
        ids.append(photo_id(path.name, ids))
    return _Parts(
        [SurveyScan(id=name, source=path) for name, path in zip(ids, contents.scans, strict=True)],
        [SurveyCamera(id=group.id) for group in groups],
        [SurveyPhoto(id=entry.id, source=entry.path, camera=camera_of[entry.id]) for entry in entries],
        {},
    )


def _listed(fields: Mapping[str, Any], what: str, faults: _Faults) -> list[Mapping[str, Any]]:
    listed = fields.get(what, [])
    if not isinstance(listed, list) or not all(isinstance(one, dict) for one in listed):
        faults.add(what, "it must be a list of objects")
        return []
    for k, one in enumerate(listed):
        unknown = sorted(set(one) - _FIELDS[what])
        if unknown:
            faults.add(f"{what}[{k}]", f"unknown fields {', '.join(unknown)}")
        if not isinstance(one.get("id"), str):
            faults.add(f"{what}[{k}]", "it has no id")
    return [one for one in listed if isinstance(one.get("id"), str)]


def _path(value: Any, folder: Path, where: str, faults: _Faults) -> Path:
    if not isinstance(value, str) or not value:
        faults.add(where, "it has no path")
        return folder
    path = folder / value
    if not path.is_file():
        faults.add(where, f"file {value!r:.120} not found")
    return path


def _pose(value: Any) -> Rigid | None:
    return None if value is None else Rigid.from_matrix(value)


def _scan(one: Mapping[str, Any], folder: Path, faults: _Faults) -> SurveyScan:
    where = f"scan {one['id']}"
    index, fixed = one.get("scan", 0), one.get("fixed", False)
    if type(index) is not int or index < 0:
        faults.add(where, f"its index is {index!r:.20}; it must be a whole number from 0")
    if not isinstance(fixed, bool):
        faults.add(where, "'fixed' must be true or false")
    none: dict[str, Any] = {}
    options = faults.taken(where, lambda: stated_options(dict(one.get("options") or {})), none)
    return SurveyScan(
        id=one["id"], source=_path(one.get("path"), folder, where, faults), index=index if type(index) is int else 0,
        options=options, world_from_scanner=faults.taken(where, lambda: _pose(one.get("world_from_scanner")), None),
        fixed=fixed is True, targets=_targets(one, folder, where, faults),
    )  # fmt: skip


def _targets(one: Mapping[str, Any], folder: Path, where: str, faults: _Faults) -> ScanTargets | None:
    lengths: dict[str, float] = {}
    for name in ("radius_m", "sigma_m"):
        value = one.get(name)
        if value is None:
            continue
        if not is_number(value) or value <= 0:
            faults.add(where, f"its {name} is {value!r:.20}; it must be a length in metres")
        elif one.get("targets") is None:
            faults.add(where, f"its {name} is that of targets, and it has none; name their file as 'targets'")
        else:
            lengths[name] = float(value)
    if one.get("targets") is None:
        return None
    return ScanTargets(source=_path(one["targets"], folder, f"{where}, targets", faults), **lengths)


def _targets_fields(one: SurveyScan, relative: Callable[[object, str], str]) -> dict[str, Any]:
    if one.targets is None:
        return {}
    stated = {"radius_m": one.targets.radius_m, "sigma_m": one.targets.sigma_m}
    return {"targets": relative(one.targets.source, "its file of targets"), **stated}


def _camera(one: Mapping[str, Any], folder: Path, faults: _Faults) -> SurveyCamera:
    where = f"camera {one['id']}"
    source: Path | CameraModel | None = None
    if one.get("camera") is not None and one.get("path") is not None:
        faults.add(where, "it has both a camera and a path; give one")
    elif one.get("camera") is not None:
        source = faults.taken(where, lambda: camera_from_fields(one["camera"]), None)
    elif one.get("path") is not None:
        source = _path(one["path"], folder, where, faults)
    options = one.get("options") or {}
    if not isinstance(options, dict) or set(options) - set(_PHOTO_OPTIONS):
        faults.add(where, f"its options must be among {', '.join(_PHOTO_OPTIONS)}")
        options = {}
    default: Estimate = "auto"
    estimate = faults.taken(where, lambda: _estimate(one.get("estimate", "auto")), default)
    return SurveyCamera(id=one["id"], source=source, options=options, estimate=estimate)


def _estimate(value: Any) -> Estimate:
    if value == "auto":
        return "auto"
    if value == "none":
        return "none"
    if isinstance(value, list) and all(isinstance(name, str) for name in value):
        return tuple(str(_ESTIMATED.get(name, name)) for name in value)
    raise OptionError(f"its estimate is {value!r:.60}; it must be 'auto', 'none' or a list of names")


def _photo(one: Mapping[str, Any], folder: Path, faults: _Faults) -> SurveyPhoto:
    where = f"photo {one['id']}"
    camera = one.get("camera")
    if not isinstance(camera, str):
        faults.add(where, "it has no camera")
        camera = ""
    matches = one.get("matches")
    return SurveyPhoto(
        id=one["id"], source=_path(one.get("path"), folder, where, faults), camera=camera,
        initial=faults.taken(where, lambda: _pose(one.get("initial")), None),
        prior=faults.taken(where, lambda: _prior(one.get("prior")), None),
        matches=None if matches is None else _path(matches, folder, f"{where}, matches", faults),
        rig=faults.taken(where, lambda: _member(one.get("rig")), None),
    )  # fmt: skip


def _tie(one: Mapping[str, Any], faults: _Faults) -> SurveyTie | None:
    def made() -> SurveyTie:
        photos, uv, sigma_px = one.get("photos"), one.get("uv"), one.get("sigma_px", DRAWN_SIGMA_PX)
        if not isinstance(photos, list) or len(photos) != 2 or not all(isinstance(name, str) for name in photos):
            raise OptionError("its photos must be the ids of two")
        places = np.asarray(uv, np.float64)
        if places.shape != (2, 2):
            raise OptionError("its uv must be two pixels, [[u, v], [u, v]], one in each of its photos")
        if not is_number(sigma_px):
            raise OptionError(f"its sigma_px is {sigma_px!r:.20}; it must be a number of pixels")
        first, second = ((float(u), float(v)) for u, v in places)
        return SurveyTie(id=one["id"], photos=(photos[0], photos[1]), uv=(first, second), sigma_px=float(sigma_px))

    return faults.taken(f"tie {one['id']}", made, None)


def _line(one: Mapping[str, Any], faults: _Faults) -> SurveyLine | None:
    def made() -> SurveyLine:
        photos, sigma_px = one.get("photos"), one.get("sigma_px", DRAWN_SIGMA_PX)
        if not isinstance(photos, list) or not all(isinstance(name, str) for name in photos):
            raise OptionError("its photos must be a list of ids")
        places = np.asarray(one.get("uv"), np.float64)
        if places.shape != (len(photos), 2, 2):
            raise OptionError("its uv must be two pixels for each of its photos, [[[u, v], [u, v]], ...]")
        if not is_number(sigma_px):
            raise OptionError(f"its sigma_px is {sigma_px!r:.20}; it must be a number of pixels")
        uv = tuple(((float(u), float(v)), (float(s), float(t))) for (u, v), (s, t) in places)
        return SurveyLine(
            id=one["id"], photos=tuple(photos), uv=uv, sigma_px=float(sigma_px), in_scan=_scan_line(one.get("scan"))
        )

    return faults.taken(f"line {one['id']}", made, None)


def _scan_line(value: Any) -> ScanLine | None:
    if value is None:
        return None
    if not isinstance(value, dict) or not isinstance(value.get("id"), str) or set(value) - {"id", "xyz", "sigma_m"}:
        raise OptionError("its scan must have an id and xyz, and may have sigma_m")
    xyz, sigma_m = np.asarray(value.get("xyz"), np.float64), value.get("sigma_m", SCAN_LINE_SIGMA_M)
    if xyz.shape != (2, 3):
        raise OptionError("the xyz of its scan must be two places, [[x, y, z], [x, y, z]]")
    if not is_number(sigma_m):
        raise OptionError(f"the sigma_m of its scan is {sigma_m!r:.20}; it must be a length in metres")
    first, second = ((float(x), float(y), float(z)) for x, y, z in xyz)
    return ScanLine(scan=value["id"], xyz=(first, second), sigma_m=float(sigma_m))


def _line_fields(one: SurveyLine) -> dict[str, Any]:
    fields: dict[str, Any] = {
        "id": one.id, "photos": list(one.photos), "uv": [[list(end) for end in ends] for ends in one.uv],
        "sigma_px": one.sigma_px,
    }  # fmt: skip
    scan = one.in_scan
    if scan is not None:
        fields["scan"] = {"id": scan.scan, "xyz": [list(end) for end in scan.xyz], "sigma_m": scan.sigma_m}
    return fields


def _prior(value: Any) -> PosePrior | None:
    if value is None:
        return None
    if "position_m" in value:
        sigma = np.broadcast_to(np.asarray(value["sigma_m"], np.float64), 3)
        if not (np.isfinite(sigma).all() and (sigma > 0).all()):
            raise OptionError("the sigma_m of its prior must be positive")
        covariance = np.diag([np.inf] * 3 + (sigma**2).tolist())
        return PosePrior(pose=Rigid.from_centre(np.eye(3), np.array(value["position_m"], float)), covariance=covariance)
    covariance = np.array(value["covariance"], np.float64)
    if covariance.shape != (6, 6) or not np.isfinite(covariance).all() or np.linalg.eigvalsh(covariance)[0] <= 0:
        raise OptionError("the covariance of its prior must be 6 x 6, symmetric and positive definite")
    return PosePrior(pose=Rigid.from_matrix(value["pose"]), covariance=covariance)


def _member(value: Any) -> RigMember | None:
    if value is None:
        return None
    names = [value[name] for name in ("id", "frame", "sensor")]
    if not all(isinstance(name, str | int) for name in names):
        raise OptionError("its rig must have an id, a frame and a sensor")
    return RigMember(id=str(names[0]), frame=str(names[1]), sensor=str(names[2]))


def _rigs(value: Any) -> dict[str, dict[str, Rigid | None]]:
    if not isinstance(value, list):
        raise OptionError("it must be a list")
    rigs: dict[str, dict[str, Rigid | None]] = {}
    for one in value:
        if one["id"] in rigs:
            raise OptionError(f"two rigs have the id {one['id']!r:.60}")
        sensors = {
            str(name): _pose((fields or {}).get("sensor_from_reference")) for name, fields in one["sensors"].items()
        }
        if not sensors:
            raise OptionError(f"the rig {one['id']!r:.60} has no sensors")
        rigs[one["id"]] = sensors
    return rigs


def _camera_source(one: SurveyCamera, relative: Callable[[object, str], str]) -> dict[str, Any]:
    options = {"options": dict(one.options)} if one.options else {}
    if one.source is None:
        return options
    if isinstance(one.source, Path):
        return {"path": relative(one.source, "its camera"), **options}
    return {"camera": one.source.as_fields(), **options}


def _estimate_words(estimate: Estimate) -> Any:
    if isinstance(estimate, str):
        return estimate
    back = {name: short for short, name in _ESTIMATED.items()}
    return [back.get(name, name) for name in estimate]


def _prior_fields(prior: PosePrior | None) -> dict[str, Any] | None:
    if prior is None:
        return None
    if prior.is_position:
        return {
            "position_m": prior.pose.centre.tolist(),
            "sigma_m": np.sqrt(np.diag(prior.covariance)[3:]).tolist(),
        }
    return {"pose": prior.pose.matrix.tolist(), "covariance": np.asarray(prior.covariance).tolist()}
