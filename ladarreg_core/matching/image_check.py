"""Image verification of a pose that was solved from matches: verified, contradicted or undecidable.

A pose that fails verification need not be wrong: the scan may show too little of what the photo shows. It is
contradicted only if the same images verify another placement.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal, TypeVar

import numpy as np
from threadpoolctl import threadpool_limits

from ladarreg_core.formatting import format_length, format_number
from ladarreg_core.frames import Rigid, rotvec_from_rotation
from ladarreg_core.matching.aligner import Aligner
from ladarreg_core.matching.auto import AutoOptions
from ladarreg_core.matching.auto_result import AutoResult
from ladarreg_core.matching.face_registration import is_wide, verify_faces
from ladarreg_core.matching.modality import register_by_modality
from ladarreg_core.matching.pyramid import ChannelSet, harmonics_of, pair_levels, photo_levels, working_camera
from ladarreg_core.matching.support import carries_intensity, is_coarse, is_interpolated
from ladarreg_core.matching.verification import (
    GateOptions,
    Verification,
    gate_for,
)
from ladarreg_core.matching.views import viewing_directions
from ladarreg_core.matching.wrong_poses import verdict_beside_wrong_poses, wrong_poses_decide
from ladarreg_core.photo import Photo
from ladarreg_core.picks.lengths import refused_by_lengths
from ladarreg_core.progress import StepLog
from ladarreg_core.results import PoseResult
from ladarreg_core.scan import Scan
from ladarreg_core.surface.perspective import perspective_view

Outcome = Literal["verified", "contradicted", "undecidable"]
ResultT = TypeVar("ResultT", bound=PoseResult)
_SIGNIFICANT = 22.46  # chi^2 of 6 degrees of freedom, exceeded by chance once in 1000
_SAMPLES = 10_000


@dataclass(frozen=True, slots=True)
class ImageCheck:
    """Outcome of the verification of a pose against the images."""

    outcome: Outcome
    """`verified`, `contradicted` or `undecidable`."""
    sentence: str
    """The outcome with its reason."""
    verification: Verification | None
    """The verdict on the pose itself; None if there is too little structure to compare."""

    def as_dict(self) -> dict[str, Any]:
        """Return the outcome with its statistics, JSON-ready."""
        figures = {} if self.verification is None else self.verification.as_dict()
        regions = () if self.verification is None else self.verification.regions
        return {
            **figures,
            "outcome": self.outcome,
            "sentence": self.sentence,
            "regions": [list(region) for region in regions],
        }


def check_against_images(scan: Scan, photo: Photo, result: PoseResult, steps: StepLog, *, seed: int = 0) -> ImageCheck:
    """Verify a solved pose against the images; if that fails, look for another placement that the images verify.

    Args:
        scan: the scan.
        photo: the photograph; its camera is replaced by that of the result.
        result: the pose with its covariance.
        steps: receives every step.
        seed: random seed.
    """
    photo = replace(photo, camera=result.camera)
    with threadpool_limits(limits=1, user_api="blas"):  # the same answer on any machine
        return _checked(scan, photo, result, steps, seed)


def _checked(scan: Scan, photo: Photo, result: PoseResult, steps: StepLog, seed: int) -> ImageCheck:
    pose = result.camera_from_scanner
    with steps.step("image check") as note:
        verify = verify_faces if is_wide(photo) else _verified_in_view
        found = verify(scan, photo, pose, seed=seed)
        note.update(verified=found is not None and found.accepted)
    if found is None:
        return ImageCheck(
            "undecidable",
            "The images could not confirm it: the scan shows too little texture here to compare with the photograph.",
            None,
        )
    if found.accepted:
        return ImageCheck("verified", " ".join(found.reasons), found)
    options = AutoOptions(seed=seed, intrinsics="fixed", reach="near_start")
    rival = register_by_modality(scan, photo, steps, initial=pose, options=options)
    return _judged(scan, result, found, rival)


def _verified_in_view(scan: Scan, photo: Photo, pose: Rigid, *, seed: int) -> Verification | None:
    """Return the verdict of the images on a given pose; None if there is too little structure to compare."""
    working = working_camera(scan, photo.pinhole)
    direction = viewing_directions(scan, working, initial=pose)[0]
    view = perspective_view(scan, working, view_from_scanner=direction)
    channel_set: ChannelSet = "both" if carries_intensity(scan) else "geometry"
    coarse = is_coarse(scan, photo.pinhole)
    harmonics = harmonics_of(scan, photo.pinhole)
    levels = pair_levels(scan, view, channel_set=channel_set, coarse=coarse, harmonics=harmonics)
    interpolated = is_interpolated(scan, photo.pinhole)
    gate = gate_for(GateOptions(), coarse=coarse, shape_alone=channel_set == "geometry", interpolated=interpolated)
    aligner = Aligner(levels, photo_levels(photo, working, harmonics=harmonics), gate=gate, seed=seed)
    if not aligner.usable:
        return None
    verdict, _, fine = aligner.verify(pose)
    if wrong_poses_decide(verdict, aligner):
        verdict, _ = verdict_beside_wrong_poses(verdict, fine, aligner, pose, tried=1)
    return verdict


def with_image_check(result: ResultT, check: ImageCheck) -> ResultT:
    """Return a result with the verdict that follows from its image verification.

    The verdict on the match statistics is kept under the diagnostics `statistics`, on which a later check builds. What
    was refused for the lengths of its matches stays refused: those concern where the scan stands, which no image shows.
    """
    return refused_by_lengths(_with_outcome(result, check))


def _with_outcome(result: ResultT, check: ImageCheck) -> ResultT:
    before = result.diagnostics.get("statistics") or {
        "accepted": bool(result.accepted),
        "evidence": result.evidence,
        "reasons": list(result.reasons),
    }
    diagnostics = {**result.diagnostics, "statistics": before, "verification": check.as_dict()}
    if check.outcome == "verified":
        assert check.verification is not None, "a pose is verified by what was compared"
        # What the statistics lack is no reason to accept the pose: it is a note, see `statistics_note`.
        more = before["reasons"] if before["accepted"] else ()
        reasons = tuple(dict.fromkeys((*check.verification.reasons, *more)))
        return replace(result, accepted=True, evidence="image", reasons=reasons, diagnostics=diagnostics)
    if check.outcome == "contradicted":
        return replace(result, accepted=False, evidence="none", reasons=(check.sentence,), diagnostics=diagnostics)
    return replace(
        result,
        accepted=before["accepted"],
        evidence=before["evidence"],
        reasons=(*before["reasons"], check.sentence),
        diagnostics=diagnostics,
    )


def statistics_note(result: PoseResult) -> str:
    """Return what the match statistics of a pose accepted on the images lack, as advice; empty if nothing."""
    before = result.diagnostics.get("statistics")
    if not result.accepted or not before or before["accepted"]:
        return ""
    lacking = " ".join(_sentence(reason) for reason in before["reasons"])
    return f"The images settle it; the matches alone would not suffice yet: {_lower(lacking)}"


def _judged(scan: Scan, result: PoseResult, found: Verification, rival: AutoResult) -> ImageCheck:
    failed = f"The images could not confirm it: {_lower(' '.join(found.reasons))}"
    other = rival.camera_from_scanner
    if other is None or rival.verification is None or not rival.verification.accepted:
        return ImageCheck("undecidable", failed, found)
    pose = result.camera_from_scanner
    apart_px = _displacement_px(scan, result, other)
    given = result.evidence == "given"
    covariance = np.zeros((6, 6)) if given else np.asarray(result.covariance)
    if rival.evidence is not None:
        covariance = covariance + rival.evidence.covariance
    apart = np.concatenate([rotvec_from_rotation(other.rotation @ pose.rotation.T), other.centre - pose.centre])
    significant = float(apart @ np.linalg.pinv(covariance, hermitian=True) @ apart) > _SIGNIFICANT
    where = (
        f"{format_number(apart_px)} px in the photo, {format_length(pose.distance_to(other))} and "
        f"{np.degrees(pose.angle_to(other)):.2g} deg away"
    )
    if significant and apart_px > GateOptions().same_pose_px:
        return ImageCheck(
            "contradicted",
            f"The images agree with another placement, {where}: "
            + ("check the given pose" if given else "correct the matches")
            + ", or register automatically.",
            found,
        )
    return ImageCheck(
        "undecidable",
        f"The images could not confirm it as it is: they agree best with a pose {where}. "
        + ("Register" if given else "Draw the matches more exactly, or register")
        + " automatically to use that pose.",
        found,
    )


def _displacement_px(scan: Scan, result: PoseResult, other: Rigid) -> float:
    """Return the median displacement in the photo of what another pose shows; infinite if it shows nothing."""
    stride = max(1, int(np.sqrt(scan.ranges.size / _SAMPLES)))
    points = scan.thinned_points(stride).reshape(-1, 3).astype(np.float64)
    points = points[np.isfinite(points).all(axis=-1)]
    there = result.camera.project(other @ points)
    seen = result.camera.contains(there)
    if not seen.any():
        return float("inf")
    off = np.hypot(*(result.camera.project(result.camera_from_scanner @ points[seen]) - there[seen]).T)
    return float(np.median(np.where(np.isfinite(off), off, np.inf)))


def _lower(text: str) -> str:
    return f"{text[:1].lower()}{text[1:]}"


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}" + ("" if text.endswith((".", "!", "?")) else ".")
