"""The result of a registration from the images: their pose as every other one, with residuals and diagnostics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ladarreg_core.camera import CameraModel
from ladarreg_core.camera.uncertainty import DEFAULT_CAMERA_PRIOR, CameraPrior
from ladarreg_core.frames import Rigid, look_along
from ladarreg_core.matches import Matches
from ladarreg_core.matching.auto_options import AutoOptions
from ladarreg_core.matching.auto_result import AutoResult
from ladarreg_core.matching.images.kept_channels import Channels
from ladarreg_core.matching.images.support import carries_intensity
from ladarreg_core.matching.modality import register_by_modality
from ladarreg_core.photo import Photo
from ladarreg_core.pose.assumed_camera import with_assumed_camera
from ladarreg_core.pose.estimate import STATED_SIGMA_PX, STATED_SIGMA_RANGE_M
from ladarreg_core.pose.result import describe_pose
from ladarreg_core.results.registration import PoseResult
from ladarreg_core.results.steps import StepLog
from ladarreg_core.scan import Scan

_DISTINCT_SIGMA = 3.0  # standard deviations between focal lengths that the images distinguish
_SHOWN_BY_BLOCKS = 0.37  # of an offset of the principal point; the pose has absorbed the rest of what blocks can show
_SHAPE_ALONE = "The scan has no intensity, so that only its shape was compared with the photo."
_UNKNOWN = np.diag([np.pi**2] * 3 + [100.0**2] * 3)


def pose_from_images(
    scan: Scan,
    photo: Photo,
    steps: StepLog,
    *,
    initial: Rigid | None = None,
    options: AutoOptions | None = None,
    prior: CameraPrior = DEFAULT_CAMERA_PRIOR,
    channels: Channels | None = None,
) -> PoseResult:
    """Find the pose of a photo from the images alone; a refused one is a result, too.

    Args:
        scan: the scan.
        photo: the photograph; each of its cameras is tried.
        steps: receives every step.
        initial: an initial pose, tried first.
        options: thresholds and seed.
        prior: what is known of an assumed camera.
        channels: those that are kept for further registrations.
    """
    found, photo = _register_cameras(scan, photo, steps, initial, options or AutoOptions(), prior, channels)
    with steps.step("result"):
        result = with_shape_alone_said(_described(found, scan, photo), scan)
        if photo.assumed:
            result = with_assumed_camera(result, prior, shown=_SHOWN_BY_BLOCKS)
        steps.pose, steps.matches = result.camera_from_scanner, result.matches
    return result


def _register_cameras(
    scan: Scan,
    photo: Photo,
    steps: StepLog,
    initial: Rigid | None,
    options: AutoOptions,
    prior: CameraPrior,
    channels: Channels | None,
) -> tuple[AutoResult, Photo]:
    """Return the automatic result with the first of a photo's cameras that is accepted, and the photo with it."""
    cameras = (photo.camera, *photo.alternatives)
    tried: list[tuple[AutoResult, Photo]] = []
    for camera in cameras:
        seen = replace(photo, camera=camera, alternatives=tuple(other for other in cameras if other is not camera))
        found = register_by_modality(
            scan, seen, steps, initial=initial, options=options, prior=prior, channels=channels
        )  # fmt: skip
        if found.accepted:
            return _with_camera_named(found, cameras), seen
        tried.append((found, seen))
    return tried[0]


def _with_camera_named(found: AutoResult, cameras: Sequence[CameraModel]) -> AutoResult:
    """Return an accepted result whose reasons say which of the focal lengths that the file admits the images show."""
    focal = [camera.focal_px for camera in cameras if camera.as_pinhole is not None]
    sigma = found.camera_sigmas.get("focal_px")
    if found.camera is None or sigma is None or max(focal) - min(focal) <= _DISTINCT_SIGMA * sigma:
        return found
    near = [value for value in focal if abs(value - found.camera.focal_px) <= _DISTINCT_SIGMA * sigma]
    what = f"that of {near[0]:.1f} px" if near else "none of them"
    admitted = ", ".join(f"{value:.1f}" for value in focal)
    sentence = f"Of the focal lengths that the photo's file admits ({admitted} px), the images support {what}."
    return replace(found, reasons=(*found.reasons, sentence))


def with_shape_alone_said(result: PoseResult, scan: Scan) -> PoseResult:
    """Return a result whose reasons say so if the scan has no intensity that shows anything."""
    if carries_intensity(scan):
        return result
    return replace(result, reasons=(*result.reasons, _SHAPE_ALONE))


def _described(found: AutoResult, scan: Scan, photo: Photo) -> PoseResult:
    """Return an automatic result with the residuals and diagnostics that every pose has."""
    if found.camera_from_scanner is None:
        return replace(no_pose(scan, photo), reasons=found.reasons)
    evidence, blocks = found.evidence, found.blocks
    scatter = blocks.scatter_px if blocks and np.isfinite(blocks.scatter_px) else STATED_SIGMA_PX
    described = describe_pose(
        found.camera_from_scanner,
        blocks.matches if blocks else Matches.none(),
        blocks.inliers if blocks else np.zeros(0, np.bool_),
        found.camera or photo.camera,
        sigma_px=scatter,
        sigma_range_m=STATED_SIGMA_RANGE_M,
        covariance=evidence.covariance if evidence else _UNKNOWN,
    )
    verdict = found.verification
    diagnostics = dict(described.diagnostics)
    if verdict:
        diagnostics["verification"] = {**verdict.as_dict(), "regions": [list(region) for region in verdict.regions]}
    return replace(
        described,
        camera_sigmas=found.camera_sigmas,
        camera_uncertainty=found.camera_uncertainty,
        blocks=blocks.compared if blocks else None,
        accepted=found.accepted,
        evidence="image" if found.accepted else "none",
        reasons=found.reasons,
        diagnostics=diagnostics,
    )


def no_pose(scan: Scan, photo: Photo) -> PoseResult:
    """Return a refused placeholder pose at the scanner, with a covariance that says it is unknown."""
    result = describe_pose(
        Rigid(look_along(scan.mean_direction), np.zeros(3)),
        Matches.none(),
        np.zeros(0, np.bool_),
        photo.camera,
        sigma_px=STATED_SIGMA_PX,
        sigma_range_m=STATED_SIGMA_RANGE_M,
        covariance=_UNKNOWN,
    )
    return replace(result, diagnostics={**result.diagnostics, "no_candidate": True})
