"""The slices of the state for the page, poses aside (docs/workbench.md)."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from functools import cache
from hashlib import blake2b
from typing import TYPE_CHECKING, Any, Literal

from msgspec import Struct, json
from msgspec.structs import replace

from ladarreg_core.camera import describe_in_short
from ladarreg_core.errors import LadarregError
from ladarreg_core.frames import describe_world
from ladarreg_core.matching.step_labels import step_label
from ladarreg_core.project.own_steps import plain_label

from ...argument_names import as_fields
from ...session.loader import Loader
from ...session.session import Session
from .recent import project_id

if TYPE_CHECKING:
    from ladarreg_core.camera import CameraModel
    from ladarreg_core.export.output_frame import FrameName
    from ladarreg_core.project.document import Document, PhotoEntry, PickEntry
    from ladarreg_core.project.history import Author, Entry, History
    from ladarreg_core.project.source import Source
    from ladarreg_core.project.work_steps import Progress as WorkProgress
    from ladarreg_core.scan import Scan as ScanData

    from ...jobs.runner import Job
    from ...session.cache import ListCache
    from ...slices.every import Scan
    from ...slices.photographs import FocalPhotoCamera, Outline, PanoramaCamera, Photo, PhotoCamera, Pick, Progress
    from ...slices.project import FileFormats, HistoryEntry, LostScan, Project, WorldPlace
    from ...slices.project import History as HistoryShown
    from ...slices.project import Job as JobShown

log = logging.getLogger(__name__)
_MAX_HISTORY = 300


def project_slice(session: Session, author: Author, *, alone: bool, start: bool, opened: str) -> Project:
    """Return the slice `project` of a client: the steps that it would undo and redo are its own, if it is not alone.

    With `start`, pages show the start page; `opened` says what was opened.
    """
    undone, redone = session.undoable(author, alone=alone), session.redoable(author, alone=alone)
    return {
        "id": project_id(session.folder.path),
        "start": start,
        "name": session.document.name,
        "folder": session.folder.path.name,
        "saved_at": clock(session.saved_at),
        "unsaved": bool(session.unsaved),
        "unsaved_why": session.unsaved,
        "amiss": " ".join(session.folder.remarks),
        "undo": plain_label(undone) if undone else None,
        "redo": plain_label(redone) if redone else None,
        "opened": opened,
    }


def history_slice(history: History, entries: ListCache[Entry, HistoryEntry]) -> HistoryShown:
    """Return the slice `history` with the newest entries, each made by `history_entry`."""
    return {"at": history.edit.number, "entries": entries.get("history", history.latest_edits(_MAX_HISTORY))}


def history_entry(entry: Entry) -> HistoryEntry:
    """Return an entry of the slice `history`."""
    return {"n": entry.number, "label": entry.label, "author": entry.author, "when": clock(entry.when)}


def scan_slice(loader: Loader, document: Document) -> Scan | None:
    """Return the slice `scan`; with `error` if it can no longer be read, or no view can show it."""
    from ladarreg_core.inspection.panorama import strip_of
    from ladarreg_core.inspection.pictures import display_note, resolution_note

    source = document.scan
    if source is None:
        return None
    try:
        scan, views = loader.scan(document), loader.views(document)
    except LadarregError as error:
        return _missing_scan(source, as_fields(str(error)))
    except Exception as error:  # a faulty scan must not keep clients from joining
        log.exception("the scan cannot be loaded")
        return _missing_scan(source, f"it cannot be read ({type(error).__name__}); open another scan")
    assert scan is not None
    rows, columns = scan.shape
    remarks = [text for text in (resolution_note(scan, views), display_note(scan)) if text]
    strip = strip_of(scan) if len(views) > 1 else None
    return {
        "id": scan_id(source),
        "grid": f"g{_digest(replace(source, smoothings=()))}",
        "name": source.name,
        "files": list(source.names),
        "rows": rows,
        "columns": columns,
        "returns": int(scan.valid.sum()),
        "notes": [as_fields(text) for text in (*scan.notes, *remarks)],
        "world": _world(scan),
        "has_color": scan.color is not None,
        "has_intensity": scan.has_intensity,
        "views": [
            {
                "label": named.label,
                "width": named.camera.width,
                "height": named.camera.height,
                "f": named.camera.fx,
                "cx": named.camera.cx,
                "cy": named.camera.cy,
                "rotation": named.view_from_scanner.rotation.reshape(-1).tolist(),
            }
            for named in views
        ],
        "strip": None if strip is None else {"low": strip.low_rad, "high": strip.high_rad},
    }


def scan_id(source: Source) -> str:
    """Return the id of a scan, which changes with its ranges."""
    return f"s{_digest(source)}"


def _missing_scan(source: Source, error: str) -> LostScan:
    return {
        "id": "missing", "name": source.name, "files": list(source.names), "error": error, "views": [], "notes": [],
    }  # fmt: skip


def _world(scan: ScanData) -> WorldPlace | None:
    if scan.world_from_scanner is None:
        return None
    said = describe_world(scan.world_from_scanner)
    return {"position": said["position"], "heading": said["heading"], "tilt": said["tilt"]}


def _digest(*parts: Struct) -> str:
    """Return a digest that is the same after a restart, so that pages keep their images."""
    return blake2b(json.encode(parts), digest_size=8).hexdigest()


def photo_revision(entry: PhotoEntry) -> str:
    """Return what changes with a photograph's picture or its camera."""
    return _digest(entry.source, entry.camera)


def photo_slice(loader: Loader, document: Document, entry: PhotoEntry) -> Photo:
    """Return an entry of the slice `photos`; without a camera if its focal length is unknown."""
    from ladarreg_core.quality.verdict import LIGHT_WORDS, light_of, position_of

    found: Photo = {
        "id": entry.id, "name": entry.source.name, "camera": None, "notes": [], "state": "empty",
        "rev": photo_revision(entry), "part": entry.part, "station": entry.station,
        "width": 0, "height": 0, "thermal": False,
    }  # fmt: skip
    try:
        header = loader.header(entry)
        camera = header.camera
        if camera is None:
            found["camera_error"] = as_fields(header.camera_error)
        else:
            found["camera"] = _camera(camera, calibrated=header.calibrated)
    except LadarregError as error:
        return {**found, "error": as_fields(str(error))}
    except Exception as error:  # a faulty photograph must not keep clients from joining
        log.exception("the photograph %s cannot be loaded", entry.id)
        problem = f"it cannot be read ({type(error).__name__}); remove it, or open it again"
        return {**found, "error": problem}
    if entry.stated_pose is not None:
        found["stated_pose"] = [list(row) for row in entry.stated_pose]
    found["width"], found["height"], found["thermal"] = header.width, header.height, header.is_thermal
    found["notes"] = [as_fields(text) for text in header.notes]
    pose = entry.pose
    if pose is not None:
        found["stale"] = loader.stale(document, entry, pose)
        found["light"] = light_of(accepted=pose.accepted, evidence=pose.evidence, stale=found["stale"])
        found["light_words"] = LIGHT_WORDS[found["light"]]
        if pose.accepted:
            found["position"] = position_of(pose.covariance)
        if found["stale"]:
            found["state"] = "stale"
        else:
            found["state"] = "accepted" if pose.accepted else "refused" if pose.evidence == "none" else "solved"
    return found


def _camera(camera: CameraModel, *, calibrated: bool) -> FocalPhotoCamera | PanoramaCamera:
    fields = camera.as_fields()
    found: PhotoCamera = {
        "model": camera.model,
        "width": camera.width,
        "height": camera.height,
        "distortion": list(fields.get("distortion", ())),
        "calibrated": calibrated,
        "said": describe_in_short(camera) + (", calibrated" if calibrated else ""),
        "short": "panorama" if camera.model == "equirectangular" else f"f {camera.focal_px:.0f}",
    }
    if "fx" in fields:
        return {**found, "fx": fields["fx"], "fy": fields["fy"], "cx": fields["cx"], "cy": fields["cy"]}
    return {**found, "window": fields.get("window")}


def progress_slice(
    loader: Loader, document: Document, entry: PhotoEntry | None, *, exported: Mapping[str, FrameName]
) -> Progress:
    """Return the slice `progress` of a photograph, or of a project without one.

    The shown pose was `exported` to these targets.
    """
    from ladarreg_core.project.work_steps import progress_of

    if entry is None:
        return _progress(progress_of(document, None), {})
    stale = "" if entry.pose is None else loader.stale(document, entry, entry.pose)
    try:
        missing = loader.header(entry).camera is None
    except Exception:  # the slice `photos` states it
        missing = False
    found = progress_of(document, entry, missing_camera=missing, stale=stale, exported=bool(exported))
    return _progress(found, exported)


def _progress(found: WorkProgress, exported: Mapping[str, FrameName]) -> Progress:
    return {
        "steps": [
            {"name": step.name, "done": step.done, "status": step.status, "missing": step.missing}
            for step in found.steps
        ],
        "needed": found.needed,
        "next_action": found.next_action,
        "exported": dict(exported),
    }


def outline_slice(loader: Loader, document: Document, entry: PhotoEntry) -> Outline | None:
    """Return the slice `outline` of a photograph; None without a pose, or for a scan that one view shows."""
    from ladarreg_core.frames import Rigid
    from ladarreg_core.inspection.panorama import photo_outline

    try:
        beside = document.beside(entry)
        scan = loader.scan(beside)
        if scan is None or len(loader.views(beside)) < 2:
            return None
        if entry.pose is not None and entry.pose.evidence != "none":  # a rejected guess may lie anywhere
            registration = loader.registration(entry.pose)
            camera, pose = registration.camera, registration.camera_from_scanner
        elif entry.stated_pose is not None:
            stated = loader.header(entry).camera
            if stated is None:
                return None
            camera, pose = stated, Rigid.from_matrix(entry.stated_pose)
        else:
            return None
        rays = photo_outline(scan, camera, pose)
    except LadarregError:
        return None
    return {
        "rays": [[round(float(value), 4) for value in ray] for ray in rays],  # a fiftieth of a pixel of the strip
        "registered": entry.pose is not None and entry.pose.accepted,
    }


def pick_entry(pick: PickEntry) -> Pick:
    """Return an entry of the slice `picks`."""
    found: Pick = {
        "id": pick.id,
        "number": pick.number,
        "kind": pick.kind,
        "scan": [list(ray) for ray in pick.scan],
        "photo": [list(uv) for uv in pick.photo],
        "on": pick.on,
        "weight": pick.weight,
        "origin": pick.origin,
    }
    if pick.name:
        found["name"] = pick.name
    return found


def job_slice(job: Job | None, waiting: Sequence[Job] = ()) -> JobShown | None:
    """Return the slice `job`: the present job, or the last one, and those that wait for it."""
    if job is None:
        return None
    return {
        "id": job.id,
        "kind": job.kind,
        "label": job.label,
        "photo": job.photo,
        "author": job.author.name,
        "state": job.state,
        "done": job.done,
        "total": job.total,
        "said": job.message,
        "seconds": round(job.seconds, 1),
        "can": list(job.can) if job.runs else [],
        "speed": job.speed,
        "steps": [
            {
                "name": step.name,
                "label": step_label(step.name),
                "seconds": round(step.seconds, 3),
                "said": describe_detail(step.detail),
            }
            for step in list(job.steps)
        ],
        "waiting": [
            {"id": each.id, "label": each.label, "photo": each.photo, "author": each.author.name} for each in waiting
        ],
    }


def describe_detail(detail: Any) -> str:
    """Return the figures of a step in one line."""
    parts = []
    for name, value in dict(detail).items():
        if isinstance(value, str):
            parts.append(value if name in ("said", "none", "start", "source") else f"{name.replace('_', ' ')} {value}")
        elif isinstance(value, bool):
            parts.append(name.replace("_", " ") if value else f"not {name.replace('_', ' ')}")
        elif isinstance(value, int):
            parts.append(f"{name.replace('_', ' ')} {value}")
        elif isinstance(value, float):
            parts.append(f"{name.replace('_', ' ')} {value:.3g}")
    return ", ".join(parts[:5])


@cache
def formats_slice() -> list[FileFormats]:
    """Return the slice `formats`: what the workbench opens, by kind."""
    from ladarreg_core.formats import FORMATS

    found: list[FileFormats] = []
    kinds: tuple[tuple[Literal["scan", "photo", "camera", "matches"], str], ...] = (
        ("scan", "Scan"), ("photo", "Photograph"), ("camera", "Camera"), ("matches", "Matches"),
    )  # fmt: skip
    for kind, label in kinds:
        formats = [each for each in FORMATS if each.kind == kind]
        names = [name for each in formats for name in (each.examples or (each.name,))]
        extensions = dict.fromkeys(extension for each in formats for extension in each.extensions)
        found.append({"kind": kind, "label": label, "names": names, "extensions": list(extensions)})
    return found


def clock(when: str) -> str:
    """Return the time of day of an ISO time."""
    return when[11:19] if len(when) >= 19 else when
