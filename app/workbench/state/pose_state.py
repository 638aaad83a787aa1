"""The slices on a photograph's poses: pick errors, and every stage with its verdict."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from ladarreg_core.errors import LadarregError
from ladarreg_core.inspection.figures import figures, parameters
from ladarreg_core.matching.step_labels import step_label
from ladarreg_core.project.results import pose_of
from ladarreg_core.project.staleness import changed_since
from ladarreg_core.results.registration import STAGE_LABELS

from ...argument_names import as_fields
from ...messages import verdict

if TYPE_CHECKING:
    from ladarreg_core.matches import Matches, Pick
    from ladarreg_core.photo import Photo
    from ladarreg_core.project.document import Document, PhotoEntry, PoseEntry
    from ladarreg_core.quality.assessment import Assessment
    from ladarreg_core.quality.verdict import NextStep, Verdict
    from ladarreg_core.results.registration import StageId
    from ladarreg_core.scan import Scan

    from ...session.loader import Loader
    from ...slices.photographs import (
        AssessedStage,
        Judged,
        JudgedLength,
        JudgedPick,
        Numbers,
        Poses,
        SampledLine,
        SolvedStage,
        Stage,
        Summary,
    )
    from ...slices.photographs import NextStep as NextStepShown


log = logging.getLogger(__name__)
_WORST_FIRST = ("poor", "fair", "good")
_MIN_MATCHES = 4
"""The number of matches from which on cautions are computed."""


def judged_slice(loader: Loader, document: Document, entry: PhotoEntry, *, readable: bool, sigmas: float) -> Judged:
    """Return the slice `judged`: errors of the picks under the shown pose, samples of lines, losses and cautions.

    Args:
        loader: the loader.
        document: the document, which has a scan.
        entry: the photograph, whose pixels are only read where it has picks.
        readable: whether it can be read, and has a camera.
        sigmas: the suggested thresholds in robust standard deviations.

    Raises:
        LadarregError: if the scan beside the photograph can no longer be read.
    """
    from ladarreg_core.inspection.picks import suggested_threshold

    scan = loader.scan(document.beside(entry))
    assert scan is not None, "the document has one"
    picks = loader.picks(entry)
    lines = {pick.id: sampled_line(loader, scan, pick.scan.tolist()) for pick in picks if pick.kind == "line"}
    found: Judged = {
        "stage": entry.shown_stage,
        "by_pick": {},
        "thresholds": {"depth": None, "px": None},
        "predicted": {},
        "lines": lines,
        "lengths": _lengths(scan, picks),
        "losses": [],
        "cautions": [],
    }
    if not picks or not readable:
        return found
    try:
        photo = loader.photo(entry)
    except LadarregError:  # it has just gone
        return found
    measured = loader.measured(scan, photo)
    found["losses"] = list(measured.losses(picks))
    found["cautions"] = _cautions(loader, measured.joined([pick for pick in picks if pick.on]), photo, entry)
    found["by_pick"], found["predicted"] = pick_errors(loader, scan, photo, entry)
    judged = [found["by_pick"][pick.id] for pick in picks if pick.on and pick.id in found["by_pick"]]
    agrees = [each["agrees"] is True for each in judged]

    def threshold(errors: Sequence[float | None]) -> float | None:
        return suggested_threshold([math.nan if each is None else each for each in errors], agrees, sigmas=sigmas)

    found["thresholds"]["depth"] = threshold([each["depth_m"] for each in judged])
    found["thresholds"]["px"] = threshold([each["px"] for each in judged])
    return found


def pick_errors(
    loader: Loader, scan: Scan, photo: Photo | None, entry: PhotoEntry
) -> tuple[dict[str, JudgedPick], dict[str, list[Numbers | None]]]:
    """Return `by_pick` and `predicted` of the slice `judged`, without what takes time for other reasons."""
    from ladarreg_core.inspection.picks import pick_residuals

    errors: dict[str, JudgedPick] = {}
    predicted: dict[str, list[Numbers | None]] = {}
    if photo is None or entry.pose is None or not entry.picks:
        return errors, predicted
    try:
        registration = loader.registration(entry.pose)
    except LadarregError:  # its matches are missing, which the verdict of its stage states
        return errors, predicted
    changed = changed_since(entry, loader.solved_on(entry.pose))
    agreeing = loader.agreeing(entry.pose)
    for name, judged in pick_residuals(loader.measured(scan, photo), loader.picks(entry), registration).items():
        known = name not in changed  # what the solver found of a match does not hold for what it has become
        errors[name] = {
            "px": number(judged.px),
            "mm": number(judged.mm),
            "depth_m": number(judged.depth_m),
            "inlier": judged.inlier if known else None,
            "agrees": agreeing.get(name) if known else None,
            "influence": number(judged.influence_px) if known else None,
        }
        predicted[name] = [None if math.isnan(at[0]) else at for at in judged.photo.tolist()]
    return errors, predicted


def _lengths(scan: Scan, picks: Sequence[Pick]) -> dict[str, JudgedLength]:
    """Return the lengths that came with picks beside the scan's own ranges, by pick; of a line, of its worse end."""
    from ladarreg_core.picks.lengths import check_lengths

    check = check_lengths(scan, [replace(pick, on=True) for pick in picks if pick.lengths_m is not None])
    found: dict[str, JudgedLength] = {}
    for one in () if check is None else check.lengths:
        before = found.get(one.pick_id)
        if before is None or abs(before["difference_m"] or 0) < abs(one.difference_m or 0):
            found[one.pick_id] = {
                "length_m": one.length_m, "scan_range_m": one.scan_range_m, "difference_m": one.difference_m,
                "tolerance_m": one.tolerance_m, "state": one.state, "beyond": one.is_beyond,
            }  # fmt: skip
    return found


def _cautions(loader: Loader, matches: Matches, photo: Photo, entry: PhotoEntry) -> list[str]:
    """Return the limits of the thesis's methods on these matches, before they are solved."""
    from ladarreg_core.quality.stereo_limits import stereo_cautions

    if len(matches) < _MIN_MATCHES:
        return []
    pose = entry.pose
    try:
        known = pose_of(pose) if pose is not None and pose.accepted else None
        return list(stereo_cautions(matches, photo.camera, pose=known))
    except LadarregError as error:
        log.debug("no cautions can be computed: %s", error)
        return []


def sampled_line(loader: Loader, scan: Scan, ends: Any) -> SampledLine:
    """Return the sample points of a line on the scan, and which of them have a range."""
    from ladarreg_core.inspection.picks import sample_line

    key = ("line", id(scan), tuple(tuple(ray) for ray in ends))
    line = loader.cached("line", key, lambda: sample_line(scan, ends))
    samples = list(zip(line.rays.tolist(), line.known, strict=True))
    return {"scan_samples": samples, "sampled": line.sampled, "used": line.used}


def poses_slice(entry: PhotoEntry, stage_of: Callable[[PoseEntry], Stage]) -> Poses:
    """Return the slice `poses`: every stage as `stage_of` describes it."""
    return {"shown": entry.shown_stage, "stages": [stage_of(pose) for pose in entry.poses]}


def stage_state(loader: Loader, pose: PoseEntry, *, stale: str, stages: Sequence[StageId]) -> Stage:
    """Return a stage with its verdict and, once computed, its assessment.

    Args:
        loader: reads the stored registration.
        pose: the stage.
        stale: why it is out of date; empty: it is not.
        stages: all stages that the photograph has a pose of.
    """
    from ladarreg_core.matching.image_check import statistics_note
    from ladarreg_core.matching.images.views import would_clouds_help
    from ladarreg_core.quality.verdict import verdict_of

    try:
        registration = loader.registration(pose)
    except LadarregError as error:
        return {
            "stage": pose.stage,
            "label": STAGE_LABELS[pose.stage],
            "accepted": False,
            "verdict": as_fields(str(error)),
            "stale": stale,
            "summary": _missing_summary(as_fields(str(error))),
        }
    verification = pose.diagnostics.get("verification", {})
    wants_frames = would_clouds_help(pose.reasons)
    assessment = loader.known_assessment(pose)
    summary = verdict_of(
        registration, stage=pose.stage, stale=stale, stages=stages, wants_frames=wants_frames, assessment=assessment
    )
    agreement = figures(registration)
    found: SolvedStage = {
        "stage": pose.stage,
        "label": STAGE_LABELS[pose.stage],
        "method": pose.method,
        "accepted": pose.accepted,
        "evidence": pose.evidence,
        "verdict": verdict(registration),
        "reasons": [as_fields(reason) for reason in pose.reasons],
        "wants_frames": wants_frames,
        "stale": stale,
        "summary": _summary(summary),
        "note": " ".join(filter(None, [pose.note, statistics_note(registration)])),
        "parameters": [
            {"name": one.name, "unit": one.unit, "value": one.value, "sigma": one.sigma}
            for one in parameters(registration)
        ],
        "matches": agreement.matches,
        "inliers": agreement.inliers,
        "median_px": number(agreement.median_px),
        "rms_px": number(agreement.rms_px),
        "rms_depth_m": number(agreement.rms_depth_m),
        "cost": number(registration.chi2_per_dof),
        "centre": registration.camera_from_scanner.centre.tolist(),
        "in_world": registration.in_world if registration.is_determined else None,
        "focal_px": registration.camera.focal_px,
        "camera_sigmas": dict(registration.camera_sigmas),
        "seconds": pose.seconds,
        "regions": [list(region) for region in verification.get("regions", [])],
        "steps": [{"name": step.name, "label": step_label(step.name), "seconds": step.seconds} for step in pose.steps],
        **_assessment_fields(assessment),
    }
    if "outcome" in verification:
        found["image"] = {"outcome": verification["outcome"], "sentence": verification["sentence"]}
    return found


def _missing_summary(problem: str) -> Summary:
    """Return the summary of a pose whose matches are missing."""
    from ladarreg_core.quality.verdict import NextStep, Verdict

    line = f"{problem[:1].upper()}{problem[1:]}."
    return _summary(Verdict("not_accepted", line, "", "", "", NextStep("Solve again.", "solve")))


def _summary(found: Verdict) -> Summary:
    from ladarreg_core.quality.verdict import LIGHT_WORDS

    return {
        "light": found.light,
        "line": found.line,
        "position": found.position,
        "pixels": found.pixels,
        "matches": found.matches,
        "next_step": _next_step(found.next_step),
        "other": None if found.other is None else _next_step(found.other),
        "words": LIGHT_WORDS[found.light],
    }


def _next_step(found: NextStep) -> NextStepShown:
    return {"sentence": found.sentence, "action": found.action, "stage": found.stage}


def _assessment_fields(assessment: Assessment | None) -> AssessedStage:
    if assessment is None:
        return {}
    return {
        "findings": [
            {"what": f.name, "level": f.level, "sentence": f.sentence, "what_to_do": f.what_to_do}
            for f in sorted(assessment.findings or (), key=lambda f: _WORST_FIRST.index(f.level))
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
    """Return a finite number; None, JSON's null, for any other."""
    return value if math.isfinite(value) else None
