"""A photograph's answers as the page is told them: judged picks, and every stage with its verdict."""

from __future__ import annotations

import logging
import math
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from ladarreg_core.errors import LadarregError
from ladarreg_core.inspection.figures import figures, parameters
from ladarreg_core.project.results import pose_of

from ..jobs.solve import STAGE_NAMES
from ..messages import verdict

if TYPE_CHECKING:
    from ladarreg_core.matches import Matches
    from ladarreg_core.photo import Photo
    from ladarreg_core.project.document import PhotoEntry, PoseEntry
    from ladarreg_core.quality.assessment import Assessment
    from ladarreg_core.scan import Scan

    from ..session.loader import Workroom


log = logging.getLogger(__name__)
_LEAST_TO_WARN = 4


def judged_slice(room: Workroom, scan: Scan, photo: Photo | None, entry: PhotoEntry) -> dict[str, Any]:
    """Return what the shown pose says of the picks, and what the scan measures under drawn lines."""
    from ladarreg_core.inspection.picks import pick_residuals

    picks = room.picks(entry)
    lines = {pick.id: line_shown(room, scan, pick.scan.tolist()) for pick in picks if pick.kind == "line"}
    found: dict[str, Any] = {
        "stage": entry.shown_stage,
        "by_pick": {},
        "predicted": {},
        "lines": lines,
        "losses": [],
        "cautions": [],
    }
    if photo is None:
        return found
    measured = room.measured(scan, photo)
    found["losses"] = list(measured.losses(picks))
    found["cautions"] = _cautions(room, measured.joined([pick for pick in picks if pick.on]), photo, entry)
    if entry.pose is None or not picks:
        return found
    try:
        answer = room.answer(entry.pose)
    except LadarregError:  # its matches are missing, which its stage says in its verdict
        return found
    for name, judged in pick_residuals(measured, picks, answer).items():
        found["by_pick"][name] = {
            "px": number(judged.px),
            "mm": number(judged.mm),
            "depth_m": number(judged.depth_m),
            "inlier": judged.inlier,
            "influence": number(judged.influence_px),
        }
        found["predicted"][name] = [None if math.isnan(at[0]) else at for at in judged.photo.tolist()]
    return found


def _cautions(room: Workroom, matches: Matches, photo: Photo, entry: PhotoEntry) -> list[str]:
    """Return what is to be feared of the thesis's methods on these matches, before anybody solves by them."""
    from ladarreg_core.quality.stereo_limits import stereo_cautions

    if len(matches) < _LEAST_TO_WARN:
        return []
    pose = entry.pose
    try:
        known = pose_of(pose) if pose is not None and pose.accepted else None
        return list(stereo_cautions(matches, photo.camera, pose=known))
    except LadarregError as error:
        log.debug("nothing can be foreseen: %s", error)
        return []


def line_shown(room: Workroom, scan: Scan, ends: Any) -> dict[str, Any]:
    """Return a line's samples and which of them have a range."""
    from ladarreg_core.inspection.picks import sample_line

    key = ("line", id(scan), tuple(tuple(ray) for ray in ends))
    line = room.kept("line", key, lambda: sample_line(scan, ends))
    samples = [[ray, known] for ray, known in zip(line.rays.tolist(), line.known, strict=True)]
    return {"scan_samples": samples, "sampled": line.sampled, "used": line.used}


def poses_slice(room: Workroom, entry: PhotoEntry) -> dict[str, Any]:
    """Return every stage's answer, with what there is to say of it where that was looked into."""
    return {"shown": entry.shown_stage, "stages": [_stage(room, pose) for pose in entry.poses]}


def _stage(room: Workroom, pose: PoseEntry) -> dict[str, Any]:
    try:
        answer = room.answer(pose)
    except LadarregError as error:
        return {"stage": pose.stage, "label": STAGE_NAMES[pose.stage], "accepted": False, "verdict": str(error)}
    return {
        "stage": pose.stage,
        "label": STAGE_NAMES[pose.stage],
        "method": pose.method,
        "accepted": pose.accepted,
        "evidence": pose.evidence,
        "verdict": verdict(answer),
        "reasons": list(pose.reasons),
        "note": pose.note,
        "parameters": [asdict(parameter) for parameter in parameters(answer)],
        "matches": len(answer.matches),
        **{name: number(value) for name, value in asdict(figures(answer)).items()},
        "cost": number(answer.chi2_per_dof),
        "centre": answer.camera_from_scanner.centre.tolist(),
        "focal_px": answer.camera.focal_px,
        "camera_sigmas": dict(answer.camera_sigmas),
        "seconds": pose.seconds,
        "regions": [list(region) for region in pose.diagnostics.get("verification", {}).get("regions", [])],
        "steps": [{"name": step.name, "seconds": step.seconds} for step in pose.steps],
        **_to_say(room.assessed(pose)),
    }


def _to_say(assessment: Assessment | None) -> dict[str, Any]:
    if assessment is None:
        return {}
    return {
        "findings": [
            {"what": f.name, "level": f.level, "sentence": f.sentence, "what_to_do": f.what_to_do}
            for f in assessment.findings or ()
        ],
        "uncertainty": assessment.uncertainty.summary() if assessment.uncertainty else "",
        "check": assessment.match_to_check,
        "check_pick": _match_to_check(assessment),
        "advice": [
            {"uv": place.uv.tolist(), "ray": place.ray.tolist(), "sentence": place.summary()}
            for place in assessment.advice or ()
        ],
        "absent": dict(assessment.absent),
    }


def _match_to_check(assessment: Assessment) -> str | None:
    if not assessment.match_to_check or assessment.influence is None:
        return None
    return assessment.influence.pick_ids[assessment.influence.most_influential]


def number(value: float) -> float | None:
    """Return a number as JSON knows it."""
    return value if math.isfinite(value) else None
