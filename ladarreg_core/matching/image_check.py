"""Image verification of a pose that was solved from matches: verified, contradicted or undecidable.

The pose is refined against the images. Where they verify the refined one, it is compared with the pose that was solved:
within three of its standard deviations, they confirm it, and the refined pose is the better one to propose; farther
away, they contradict it. Where they verify none, the pose need not be wrong: the scan may show too little of what the
photo shows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal, TypeVar

import numpy as np
from threadpoolctl import threadpool_limits

from ladarreg_core.camera.uncertainty import DEFAULT_CAMERA_PRIOR, CameraPrior
from ladarreg_core.foundations.arrays import BoolArray
from ladarreg_core.foundations.formatting import format_length, format_number
from ladarreg_core.frames import Rigid, rotvec_from_rotation
from ladarreg_core.matches import across_lines, count_picks
from ladarreg_core.matching.auto import compared_pair
from ladarreg_core.matching.auto_options import AutoOptions
from ladarreg_core.matching.face_registration import FaceViews
from ladarreg_core.matching.from_images import pose_from_images
from ladarreg_core.matching.images.kept_channels import Channels
from ladarreg_core.matching.images.scan_levels import ChannelSet
from ladarreg_core.matching.images.support import carries_intensity, is_interpolated
from ladarreg_core.matching.images.views import viewing_directions
from ladarreg_core.matching.refine.aligner import Aligner
from ladarreg_core.matching.verify.verification import (
    GateOptions,
    Verification,
    gate_for,
)
from ladarreg_core.matching.wrong_poses import verdict_beside_wrong_poses, wrong_poses_decide
from ladarreg_core.photo import Photo
from ladarreg_core.picks.lengths import refused_by_lengths
from ladarreg_core.pose.result import describe_pose, inliers_at
from ladarreg_core.results.registration import PoseResult
from ladarreg_core.results.steps import StepLog
from ladarreg_core.scan import Scan

Outcome = Literal["verified", "contradicted", "undecidable"]
Proposal = Literal["refined", "drawn", "images"]
"""Which pose to propose of matches: that of the images where they confirm the matches, that of the matches as they were
drawn, or that of the images even where they contradict the matches."""
ResultT = TypeVar("ResultT", bound=PoseResult)
_THREE_SIGMAS = 20.06  # chi^2 of 6 degrees of freedom, exceeded as rarely as 3 sigma by one number
_SAMPLES = 10_000
_MEDIAN_OF_RAYLEIGH = 1.1774
_MAX_NOISE_BESIDE = 2.5
_GATE_CHI2 = 9.21  # of a match that agrees with a pose, as `PoseOptions.gate_chi2`


@dataclass(frozen=True, slots=True)
class ImageCheck:
    """Outcome of the verification of a pose against the images."""

    outcome: Outcome
    """`verified`, `contradicted` or `undecidable`."""
    sentence: str
    """The outcome with its reason."""
    verification: Verification | None
    """The verdict on the pose itself; None if there is too little structure to compare."""
    placement: PoseResult | None = None
    """The pose that the images verify, found from the one that was checked; None if they verify none."""

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


def check_against_images(
    scan: Scan,
    photo: Photo,
    result: PoseResult,
    steps: StepLog,
    *,
    seed: int = 0,
    prior: CameraPrior = DEFAULT_CAMERA_PRIOR,
    channels: Channels | None = None,
) -> ImageCheck:
    """Verify a solved pose against the images, and refine it against them.

    Args:
        scan: the scan.
        photo: the photograph; the pose itself is verified with the camera of the result.
        result: the pose with its covariance.
        steps: receives every step.
        seed: random seed.
        prior: what is known of an assumed camera.
        channels: those that are kept for further registrations.
    """
    pose, seen = result.camera_from_scanner, replace(photo, camera=result.camera)
    with threadpool_limits(limits=1, user_api="blas"):  # the same answer on any machine
        with steps.step("image check") as note:
            found = _verified(scan, seen, pose, seed=seed)
            note.update(verified=found is not None and found.accepted)
        if found is None:
            return ImageCheck(
                "undecidable",
                "The images could not confirm it: the scan shows too little texture here to compare with the "
                "photograph.",
                None,
            )
        if result.evidence == "given" and found.accepted:
            return ImageCheck("verified", " ".join(found.reasons), found)
        free = photo.assumed and result.evidence != "given"
        options = AutoOptions(seed=seed, intrinsics="auto" if free else "fixed", reach="near_start")
        placement = pose_from_images(
            scan, photo if free else seen, steps, initial=pose, options=options, prior=prior, channels=channels
        )
    return _judged(scan, result, found, placement)


def _verified(scan: Scan, photo: Photo, pose: Rigid, *, seed: int) -> Verification | None:
    """Return the verdict of the images on a given pose; None if there is too little structure to compare."""
    pair = compared_pair(scan, photo)
    channel_set: ChannelSet = "both" if carries_intensity(scan) else "geometry"
    if isinstance(pair, FaceViews):
        joint = pair.joint_aligner(pose, AutoOptions(seed=seed, channel_set=channel_set))
        return None if joint is None else joint.verify(pose)
    view = pair.view(viewing_directions(scan, pair.working, initial=pose)[0], channel_set)
    interpolated = is_interpolated(scan, photo.pinhole)
    gate = gate_for(GateOptions(), coarse=pair.coarse, shape_alone=channel_set == "geometry", interpolated=interpolated)
    aligner = Aligner(view, pair.photo, gate=gate, seed=seed)
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
    before = result.diagnostics.get("statistics") or _statistics_of(result)
    diagnostics = {**result.diagnostics, "statistics": before, "verification": check.as_dict()}
    if check.outcome == "verified":
        # What the statistics lack is no reason to accept the pose: it is a note, see `statistics_note`.
        more = before["reasons"] if before["accepted"] else ()
        reasons = tuple(dict.fromkeys((check.sentence, *more)))
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


def _statistics_of(result: PoseResult) -> dict[str, Any]:
    """Return what the matches alone say of a pose."""
    return {"accepted": bool(result.accepted), "evidence": result.evidence, "reasons": list(result.reasons)}


def statistics_note(result: PoseResult) -> str:
    """Return what the match statistics of a pose accepted on the images lack, as advice; empty if nothing."""
    before = result.diagnostics.get("statistics")
    if not result.accepted or not before or before["accepted"]:
        return ""
    lacking = " ".join(_sentence(reason) for reason in before["reasons"])
    return f"The images settle it; the matches alone would not suffice yet: {_lower(lacking)}"


def refined_pose(result: PoseResult, check: ImageCheck) -> PoseResult | None:
    """Return the pose that the images verify, with the drawn matches beside it; None if they verify none.

    The pose as drawn, with what the matches alone say of it, stands under the diagnostics `drawn`.
    """
    found = check.placement
    if found is None:
        return None
    pose, matches, agree = found.camera_from_scanner, result.matches, _agreeing(found, result)
    sigma = {"sigma_px": _noise_beside(found, result), "sigma_range_m": result.sigma_range_m}
    described = describe_pose(pose, matches, agree, found.camera, **sigma, covariance=found.covariance)
    count, total = count_picks(matches, agree)
    statistics = result.diagnostics.get("statistics") or _statistics_of(result)
    drawn = {
        **statistics,
        "camera_from_scanner": result.camera_from_scanner.matrix.tolist(),
        "sigma_position_m": result.sigma_position_m,
        "sigma_angle_rad": result.sigma_angle_rad,
        "outcome": check.outcome,
    }
    kept = {name: result.diagnostics[name] for name in ("lengths",) if name in result.diagnostics}
    refined = replace(
        described,
        world_from_scanner=result.world_from_scanner,
        camera_sigmas=found.camera_sigmas,
        camera_uncertainty=found.camera_uncertainty,
        blocks=found.blocks,
        accepted=True,
        evidence="image",
        reasons=(*found.reasons, f"{count} of {total} drawn matches agree with it"),
        diagnostics={
            **described.diagnostics, **kept, "verification": found.diagnostics["verification"], "drawn": drawn
        },
    )  # fmt: skip
    return refused_by_lengths(refined)


def _agreeing(found: PoseResult, result: PoseResult) -> BoolArray:
    """Return which matches (M,) of a result agree with the pose that the images verify."""
    sigma = {"sigma_px": _noise_beside(found, result), "sigma_range_m": result.sigma_range_m}
    return inliers_at(found.camera_from_scanner, result.matches, found.camera, **sigma, gate_chi2=_GATE_CHI2)


def _noise_beside(found: PoseResult, result: PoseResult) -> float:
    """Return the noise of drawn matches beside a pose that was not fitted to them, px.

    It is larger than that beside their own pose, which follows the errors of few lines, but only within reason.
    """
    matches = result.matches
    if not len(matches):
        return result.sigma_px
    off = found.camera.difference(matches.uv, found.camera.project(found.camera_from_scanner @ matches.points))
    lengths = np.hypot(*across_lines(matches, off).T)
    scatter = float(np.median(np.where(np.isfinite(lengths), lengths, np.inf))) / _MEDIAN_OF_RAYLEIGH
    return float(np.clip(scatter, result.sigma_px, _MAX_NOISE_BESIDE * result.sigma_px))


def _judged(scan: Scan, result: PoseResult, found: Verification, placement: PoseResult) -> ImageCheck:
    if not placement.accepted:
        if found.accepted:
            return ImageCheck("verified", " ".join(found.reasons), found)
        return ImageCheck("undecidable", f"The images could not confirm it: {_lower(' '.join(found.reasons))}", found)
    pose, other = result.camera_from_scanner, placement.camera_from_scanner
    apart_px = _displacement_px(scan, result, placement)
    where = (
        f"{format_number(apart_px)} px in the photo, {format_length(pose.distance_to(other))} and "
        f"{np.degrees(pose.angle_to(other)):.2g} deg away"
    )
    far = _is_far(result, placement)
    if result.evidence == "given":
        return _judged_as_given(found, placement, where, contradicted=far and apart_px > GateOptions().same_pose_px)
    own, _ = count_picks(result.matches, result.inliers)
    agree, _ = count_picks(result.matches, result.inliers & _agreeing(placement, result))
    if not far and 2 * agree < own:  # as where another principal point makes up for another pose
        sentence = (
            f"The images verify another placement, {where}, with which {agree} of the {own} matches agree that support "
            "this pose: use that placement, or correct the matches."
        )
        return ImageCheck("contradicted", sentence, found, placement)
    if far:
        sentence = (
            f"The images verify another placement, {where}, which is more than three standard deviations: use that "
            "pose, or correct the matches."
        )
        return ImageCheck("contradicted", sentence, found, placement)
    near = f"The images verify a pose {where}, within its uncertainty."
    if found.accepted:
        return ImageCheck("verified", " ".join([*found.reasons, near]), found, placement)
    statistics = result.diagnostics.get("statistics") or _statistics_of(result)
    # what its matches do not support may be as uncertain as anything: that another pose lies within it confirms nothing
    outcome: Outcome = "verified" if statistics["accepted"] else "undecidable"
    return ImageCheck(outcome, near, found, placement)


def _judged_as_given(found: Verification, placement: PoseResult, where: str, *, contradicted: bool) -> ImageCheck:
    if contradicted:
        sentence = f"The images agree with another placement, {where}: check the given pose, or register automatically."
        return ImageCheck("contradicted", sentence, found, placement)
    sentence = (
        f"The images could not confirm it as it is: they agree best with a pose {where}. Register automatically to use "
        "that pose."
    )
    return ImageCheck("undecidable", sentence, found, placement)


def _is_far(result: PoseResult, placement: PoseResult) -> bool:
    """Return whether two poses differ by more than three standard deviations.

    Those are the own ones of the pose that was solved; what is not known of the other one is no contradiction.
    """
    covariance = np.asarray(placement.covariance)
    if np.isfinite(result.covariance).all():
        covariance = covariance + result.covariance
    pose, other = result.camera_from_scanner, placement.camera_from_scanner
    apart = np.concatenate([rotvec_from_rotation(other.rotation @ pose.rotation.T), other.centre - pose.centre])
    return float(apart @ np.linalg.pinv(covariance, hermitian=True) @ apart) > _THREE_SIGMAS


def _displacement_px(scan: Scan, result: PoseResult, other: PoseResult) -> float:
    """Return the median displacement in the photo of what another pose shows; infinite if it shows nothing."""
    stride = max(1, int(np.sqrt(scan.ranges.size / _SAMPLES)))
    points = scan.thinned_points(stride).reshape(-1, 3).astype(np.float64)
    points = points[np.isfinite(points).all(axis=-1)]
    there = other.camera.project(other.camera_from_scanner @ points)
    seen = other.camera.contains(there)
    if not seen.any():
        return float("inf")
    off = np.hypot(*(result.camera.project(result.camera_from_scanner @ points[seen]) - there[seen]).T)
    return float(np.median(np.where(np.isfinite(off), off, np.inf)))


def _lower(text: str) -> str:
    return f"{text[:1].lower()}{text[1:]}"


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}" + ("" if text.endswith((".", "!", "?")) else ".")
