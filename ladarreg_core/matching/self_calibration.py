"""Self-calibration: focal length and k1 estimated with the pose if the image contradicts the stated camera."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np

from ladarreg_core.camera import Camera
from ladarreg_core.errors import CameraError
from ladarreg_core.frames import Rigid, rotvec_from_rotation
from ladarreg_core.matching.agreement import Agreement
from ladarreg_core.matching.aligner import Aligner
from ladarreg_core.matching.covariance import RegionEvidence
from ladarreg_core.matching.ecc import NO_CHANGE, CameraChange
from ladarreg_core.matching.pyramid import pair_levels, photo_levels, working_camera
from ladarreg_core.matching.verification import Verification, verify
from ladarreg_core.photo import Photo
from ladarreg_core.side_by_side import side_by_side
from ladarreg_core.surface.perspective import perspective_view
from ladarreg_core.validation import require_choice

FreeCamera = Literal["auto", "fixed", "focal", "focal_k1"]
"""Intrinsics estimated with the pose: automatic; none; the focal length; the focal length and k1."""

_FREE: Mapping[FreeCamera, int] = {"auto": 2, "fixed": 0, "focal": 1, "focal_k1": 2}
_SUSPECT_SIGMA = 3.0
_FITS_SIGMA, _FITS_SHIFT = 2.0, 0.01  # a few steps show whether a whole finish changes the camera
_KEEP_SIGMA = 3.0
_REFUSE_SIGMA = 5.0
_WRONG_CAMERA = (
    "The image contradicts the stated focal length or lens distortion, and no values that fit were found; "
    "give a camera file."
)
_MAX_LOG_FOCAL_SIGMA = 0.02
_ROUNDS = 4
_SETTLED_LOG_FOCAL, _SETTLED_K1 = 0.003, 0.02
_SAME_VIEW_LOG_FOCAL = 0.04
_SUFFICIENT_FINE_FRACTION = 0.6
_MIN_FINE_FRACTION = 0.5
_MIN_SHIFT_CALIBRATED = 0.025  # relative to the distance from the principal point
_CENTRAL_FRACTION = 0.3
_PROMISING_FRACTION, _MIN_GAIN = 0.5, 0.05  # fractions of the windows at level 1


def check_free_camera(value: object) -> None:
    """Check the option `intrinsics`.

    Raises:
        OptionError: if it is not a `FreeCamera`.
    """
    require_choice(value, get_args(FreeCamera), "the option intrinsics")


@dataclass(frozen=True, slots=True, eq=False)
class FinishedPose:
    """A finished pose with its camera, verified on the photo undistorted with that camera."""

    aligner: Aligner
    """The aligner of that camera."""
    camera: Camera
    """The photo's own camera, as stated or estimated."""
    camera_from_scanner: Rigid
    """The pose."""
    verification: Verification
    """The verdict."""
    fine: Agreement
    """Agreement at level 0."""
    regions: RegionEvidence | None
    """Covariance of pose and intrinsics."""
    free: int = 0
    """Number of (log f, k1) estimated."""
    camera_fits: bool | None = None
    """Whether a few further steps with a free camera confirm the stated one; None: not tried."""

    @property
    def camera_sigmas(self) -> dict[str, float]:
        """Standard deviations of the estimated intrinsics, by name."""
        if not self.free or self.regions is None:
            return {}
        sigma = np.sqrt(np.diag(self.regions.covariance)[6 : 6 + self.free])
        scaled = sigma * np.array([self.camera.focal_px, 1.0])[: self.free]
        return dict(zip(("focal_px", "k1"), scaled.tolist(), strict=False))

    def summary(self, given: Camera) -> tuple[str, ...]:
        """Return a sentence for each estimated intrinsic, with its stated value."""
        sentences = []
        for name, sigma in self.camera_sigmas.items():
            if name == "k1":
                sentences.append(
                    f"Lens distortion k1 was estimated: {_k1(self.camera):.3f} +- {sigma:.3f} instead of "
                    f"{_k1(given):.3f}."
                )
            else:
                sentences.append(
                    f"The focal length was estimated: {self.camera.focal_px:.1f} +- {sigma:.1f} px instead of "
                    f"{given.focal_px:.1f} px."
                )
        return tuple(sentences)


def verify_finished(
    aligner: Aligner, camera: Camera, pose: Rigid, *, free: int = 0, try_camera: bool = False
) -> FinishedPose:
    """Verify a finished pose, using two threads.

    Args:
        aligner: the pair, with the photo undistorted with the camera.
        camera: the photo's camera.
        pose: `camera_from_scanner`.
        free: number of (log f, k1) estimated with it.
        try_camera: whether to try the stated camera, too.
    """
    aligner.prepare_to_verify(pose)
    parts: tuple[Callable[[], Any], ...] = (
        lambda: aligner.agreement_at(pose, 0),
        lambda: _camera_fits(aligner, camera, pose, free=_FREE["auto"]) if try_camera else None,
        lambda: aligner.agreement_at(pose, 1),
        lambda: aligner.regions(pose, free=free),
    )
    fine, fits, coarse, regions = side_by_side(lambda part: part(), parts)
    return FinishedPose(aligner, camera, pose, verify(coarse, fine, aligner.gate), fine, regions, free, fits)


def may_estimate_camera(photo: Photo, intrinsics: FreeCamera) -> bool:
    """Return whether a photo's intrinsics may be estimated; a thermal image has too little structure for it."""
    return intrinsics != "fixed" and not (intrinsics == "auto" and photo.temperature_k is not None)


def estimate_camera(fixed: FinishedPose, photo: Photo, start: Rigid, intrinsics: FreeCamera) -> FinishedPose:
    """Return a finished pose with estimated intrinsics, if the image requires them.

    A significance test over the regions decides first whether the stated camera is in doubt. The estimate is kept if it
    is significant and the image agrees no less with it.

    Args:
        fixed: the finished pose with the camera as stated.
        photo: the photograph, with that camera.
        start: the candidate pose before the finish.
        intrinsics: the intrinsics that may be estimated.
    """
    if not may_estimate_camera(photo, intrinsics):
        return fixed
    free = _FREE[intrinsics]
    if intrinsics == "auto":
        fits = fixed.camera_fits
        if fits is None:
            fits = _camera_fits(fixed.aligner, fixed.camera, fixed.camera_from_scanner, free=free)
        if fits:
            return fixed
    pose, change = fixed.aligner.finish_with_free_camera(fixed.camera_from_scanner, free=free)
    doubt = _camera_deviate(fixed.aligner, pose, change)
    if intrinsics == "auto" and doubt <= _SUSPECT_SIGMA:
        return fixed
    best: FinishedPose | None = None
    # Near the true pose the finish determines the camera; otherwise pose and camera are refined at the coarser level.
    starts = [(start, NO_CHANGE, True)]
    if fixed.verification.accepted:
        starts.insert(0, (pose, change, False))
    for begin, begin_change, coarsely in starts:
        found = _estimate(fixed, photo, begin, begin_change, free=free, coarsely=coarsely)
        if found is not None and (best is None or _rank(found) > _rank(best)):
            best = found
        if best is not None and (best.verification.fine_fraction or 0) >= _SUFFICIENT_FINE_FRACTION:
            break
    believed = best is not None and (intrinsics != "auto" or _is_better(best, fixed, calibrated=photo.calibrated))
    if best is None or not believed:
        lost = best is None or not best.verification.accepted
        return _inflated(_refused(fixed) if lost and doubt > _REFUSE_SIGMA else fixed, pose)
    return best


def _refused(fixed: FinishedPose) -> FinishedPose:
    """Return the pose as refused, since its camera is wrong and no other was found."""
    verification = fixed.verification
    sentences = verification.reasons if not verification.accepted else ()
    reasons = (*sentences, _WRONG_CAMERA)
    return replace(fixed, verification=replace(verification, accepted=False, reasons=reasons))


def _inflated(fixed: FinishedPose, other: Rigid) -> FinishedPose:
    """Return the pose with its covariance enlarged by the shift to the pose of the free camera."""
    if fixed.regions is None:
        return fixed
    pose = fixed.camera_from_scanner
    turn = rotvec_from_rotation(other.rotation @ pose.rotation.T)
    moved = np.concatenate([turn, other.centre - pose.centre])
    return replace(fixed, regions=fixed.regions.inflated_by(moved))


def _camera_deviate(aligner: Aligner, pose: Rigid, change: CameraChange) -> float:
    """Return the significance of a change of the camera, as a normal deviate; 0 if it cannot be computed."""
    moved = np.array([change.log_focal, change.k1])[: _FREE["auto"]]
    evidence = aligner.regions(pose, free=len(moved), change=change)
    if evidence is None:
        return 0.0
    return evidence.normal_deviate(moved, variance_factor=aligner.common_variance)


def _camera_fits(aligner: Aligner, camera: Camera, finished: Rigid, *, free: int) -> bool:
    """Return whether a preliminary free camera confirms the stated one: its change is small and not significant."""
    pose, change = aligner.preview_free_camera(finished, free=free)
    shift = _largest_shift(camera, change.applied_to(camera))
    return shift <= _FITS_SHIFT and _camera_deviate(aligner, pose, change) <= _FITS_SIGMA


def _rank(found: FinishedPose) -> tuple[bool, float]:
    return found.verification.accepted, found.verification.fine_fraction or 0.0


def _is_better(found: FinishedPose, stated: FinishedPose, *, calibrated: bool) -> bool:
    """Return whether other intrinsics are significant and the image agrees no less with them.

    A small change may be due to distortions of the scan, so a calibrated camera is overruled by a large change only.
    """
    if calibrated and _largest_shift(stated.camera, found.camera) < _MIN_SHIFT_CALIBRATED:
        return False
    if not found.verification.accepted or found.regions is None:
        return False
    if np.sqrt(found.regions.covariance[6, 6]) > _MAX_LOG_FOCAL_SIGMA:
        return False
    if not stated.verification.accepted and (found.verification.fine_fraction or 0.0) < _MIN_FINE_FRACTION:
        return False  # with more free parameters more regions agree by chance
    before, after = stated.camera, found.camera
    moved = np.array([np.log(after.focal_px / before.focal_px), _k1(after) - _k1(before)])[: found.free]
    if found.regions.normal_deviate(moved, variance_factor=found.aligner.common_variance) < _KEEP_SIGMA:
        return False
    return (found.verification.fine_fraction or 0.0) >= (stated.verification.fine_fraction or 0.0)


def _largest_shift(before: Camera, after: Camera) -> float:
    """Return the largest pixel displacement between two cameras, relative to the distance from the principal point."""
    u, v = np.meshgrid(np.linspace(0, before.width - 1, 9), np.linspace(0, before.height - 1, 9))
    uv = np.stack([u, v], axis=-1).reshape(-1, 2)
    away = np.linalg.norm(uv - (before.cx, before.cy), axis=1)
    shift = np.linalg.norm(after.project(before.unproject(uv)) - uv, axis=1)
    ratio = shift / np.maximum(away, 1.0)
    known = np.isfinite(ratio) & (away > _CENTRAL_FRACTION * away.max())
    return float(ratio[known].max()) if known.any() else np.inf


def _k1(camera: Camera) -> float:
    return camera.distortion[0] if camera.distortion else 0.0


def _estimate(
    fixed: FinishedPose, photo: Photo, start: Rigid, change: CameraChange, *, free: int, coarsely: bool
) -> FinishedPose | None:
    """Refine pose and camera, undistorting the photo anew in each round, until both settle; None if they diverge.

    The change of the lens is modelled in the undistorted image, which is exact only for a vanishing change: hence the
    rounds.
    """
    aligner, pose, camera = fixed.aligner, start, change.applied_to(photo.pinhole)
    agreeing = fixed.verification.fraction
    try:
        if change != NO_CHANGE:
            aligner = _aligner_for(aligner, photo, camera)
        for _ in range(_ROUNDS if coarsely else 0):
            pose, change = aligner.refine_with_free_camera(pose, free=free)
            camera = change.applied_to(camera)
            aligner = _aligner_for(aligner, photo, camera)
            before, agreeing = agreeing, verify(aligner.agreement_at(pose, 1), None, aligner.gate).fraction
            if agreeing < _PROMISING_FRACTION and agreeing < before + _MIN_GAIN:
                return None
            if _is_settled(change):
                break
        for _ in range(_ROUNDS):
            pose, change = aligner.finish_with_free_camera(pose, free=free)
            camera = change.applied_to(camera)
            aligner = _aligner_for(aligner, photo, camera)
            if _is_settled(change):
                break
        return verify_finished(aligner, camera, pose, free=free)
    except (CameraError, _NothingToCompareError):
        return None


class _NothingToCompareError(Exception):
    """The scan has too little to compare at the camera's focal length."""


def _is_settled(change: CameraChange) -> bool:
    return abs(change.log_focal) < _SETTLED_LOG_FOCAL and abs(change.k1) < _SETTLED_K1


def _aligner_for(aligner: Aligner, photo: Photo, camera: Camera) -> Aligner:
    """Return the aligner of another camera: the photo undistorted with it, the view at its focal length."""
    scan, view = aligner.scan.view.scan, aligner.scan.view
    working = working_camera(scan, camera)
    levels = aligner.scan
    if abs(np.log(working.focal_px / view.camera.focal_px)) > _SAME_VIEW_LOG_FOCAL:
        rendered = perspective_view(scan, working, view_from_scanner=view.view_from_scanner)
        levels = pair_levels(
            scan, rendered, channel_set=levels.channel_set, coarse=levels.coarse, harmonics=levels.harmonics
        )
    side = photo_levels(replace(photo, camera=camera), working, harmonics=levels.harmonics)
    seen = Aligner(levels, side, gate=aligner.gate, seed=aligner.seed)
    if not seen.usable:
        raise _NothingToCompareError
    return seen
