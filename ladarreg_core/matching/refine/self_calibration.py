"""Every verified pose is tested for its camera, and a camera that is only assumed is estimated with the pose.

An assumed camera (`Photo.assumed`) has a prior: focal length, k1 and principal point are fitted together with the pose,
and the prior counts as one more measurement of each; where the regions contradict it, they determine the camera alone,
or the pose is refused. A calibrated camera is never replaced: if the regions contradict it, the pose is refused, and
the camera that would fit is named. Any other camera is kept unless the image requires another one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, Literal, get_args

import numpy as np

from ladarreg_core.camera import Camera
from ladarreg_core.camera.uncertainty import INTRINSICS, CameraPrior
from ladarreg_core.errors import CameraError
from ladarreg_core.foundations.arrays import BoolArray, FloatArray
from ladarreg_core.foundations.parallel import side_by_side
from ladarreg_core.foundations.validation import require_choice
from ladarreg_core.frames import Rigid, rotvec_from_rotation
from ladarreg_core.matching.images.photo_levels import photo_levels, working_camera
from ladarreg_core.matching.images.scan_levels import pair_levels
from ladarreg_core.matching.refine.aligner import Aligner
from ladarreg_core.matching.refine.ecc import NO_CHANGE, CameraAnchor, CameraChange
from ladarreg_core.matching.refine.finished_pose import FinishedPose, k1_of, share_of_images
from ladarreg_core.matching.verify.verification import verify
from ladarreg_core.photo import Photo
from ladarreg_core.surface.perspective import perspective_view

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
_MAX_FALSE_ALARM_WITH_CAMERA = 0.05  # a wall of the same bricks .26, a real capture .004, most 1e-7 and less
_BY_CHANCE = (
    "With the camera estimated as well, as many regions agree by chance, as in a repeated pattern: probability {:.1g}. "
    "Give a camera file."
)
_MAX_LOG_FOCAL_SIGMA = 0.02
_ROUNDS = 4
_SETTLED_LOG_FOCAL, _SETTLED_K1 = 0.003, 0.02
_SETTLED_SHIFT_PX = 0.5
_SAME_VIEW_LOG_FOCAL = 0.04
_SUFFICIENT_FINE_FRACTION = 0.6
_MIN_FINE_FRACTION = 0.5
_CONTRADICTED_SIGMA = 4.0  # of a calibrated camera: deviate of the one that fits, its own uncertainty included
_CONFLICT_SIGMA = 3.0  # of an assumed one: beyond it the prior of that parameter is dropped
_MAX_CENTRE_SIGMA = 2.0  # of a principal point without prior, relative to the prior
_SAME_CHANNELS_PX = (
    0.05  # largest shift of a pixel by a change of the camera after which the photo is not undistorted anew
)
_EXACT = 1e-6  # standard deviation of what is exact, to keep the information finite
_CENTRAL_FRACTION = 0.3
_PROMISING_FRACTION, _MIN_GAIN = 0.5, 0.05  # fractions of the windows at level 1


def check_free_camera(value: object) -> None:
    """Check the option `intrinsics`.

    Raises:
        OptionError: if it is not a `FreeCamera`.
    """
    require_choice(value, get_args(FreeCamera), "the option intrinsics")


def verify_finished(
    aligner: Aligner,
    camera: Camera,
    pose: Rigid,
    *,
    free: int = 0,
    try_camera: bool = False,
    anchor: CameraAnchor | None = None,
) -> FinishedPose:
    """Verify a finished pose, using two threads.

    Args:
        aligner: the pair, with the photo undistorted with the camera.
        camera: the photo's camera.
        pose: `camera_from_scanner`.
        free: number of (log f, k1, centre x, centre y) estimated with it.
        try_camera: whether to try the stated camera, too.
        anchor: what was known of these before, relative to the camera.
    """
    aligner.prepare_to_verify(pose)
    parts: tuple[Callable[[], Any], ...] = (
        lambda: aligner.agreement_at(pose, 0),
        lambda: _camera_fits(aligner, camera, pose, free=_FREE["auto"]) if try_camera else None,
        lambda: aligner.agreement_at(pose, 1),
        lambda: aligner.regions(pose, free=free, anchor=anchor),
    )
    fine, fits, coarse, regions = side_by_side(lambda part: part(), parts)
    verdict = verify(coarse, fine, aligner.gate)
    if free and verdict.accepted and verdict.false_alarm > _MAX_FALSE_ALARM_WITH_CAMERA:
        verdict = replace(verdict, accepted=False, reasons=(_BY_CHANCE.format(verdict.false_alarm),))
    return FinishedPose(aligner, camera, pose, verdict, fine, regions, free, fits)


def may_estimate_camera(photo: Photo, intrinsics: FreeCamera) -> bool:
    """Return whether a photo's intrinsics may be estimated; a thermal image has too little structure for it."""
    return intrinsics != "fixed" and not (intrinsics == "auto" and photo.temperature_k is not None)


def estimate_camera(
    fixed: FinishedPose, photo: Photo, start: Rigid, intrinsics: FreeCamera, prior: CameraPrior
) -> FinishedPose:
    """Return a finished pose whose camera was tested, and estimated where that is allowed.

    Args:
        fixed: the finished pose with the camera as stated.
        photo: the photograph, with that camera.
        start: the candidate pose before the finish.
        intrinsics: the intrinsics that may be estimated.
        prior: what is known of the camera; without use unless it is calibrated or assumed.
    """
    if not may_estimate_camera(photo, intrinsics):
        return fixed
    if intrinsics == "auto" and (photo.assumed or photo.alternatives):
        return _with_assumed_camera(fixed, photo, start, prior)
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
    best = _with_free_camera(fixed, photo, start, pose, change, free=free)
    if photo.calibrated and intrinsics == "auto":
        return _beside_calibration(fixed, best, pose, doubt, prior)
    believed = best is not None and (intrinsics != "auto" or _is_better(best, fixed))
    if best is None or not believed:
        lost = best is None or not best.verification.accepted
        return _inflated(_refused(fixed) if lost and doubt > _REFUSE_SIGMA else fixed, pose)
    return best


def _with_free_camera(
    fixed: FinishedPose, photo: Photo, start: Rigid, pose: Rigid, change: CameraChange, *, free: int
) -> FinishedPose | None:
    """Return the best pose with a camera of which nothing is known before; None if none was found."""
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
    return best


def _beside_calibration(
    fixed: FinishedPose, free: FinishedPose | None, pose: Rigid, doubt: float, prior: CameraPrior
) -> FinishedPose:
    """Return the pose with the calibrated camera, refused if the regions contradict that camera.

    Args:
        fixed: the pose with the camera as calibrated.
        free: the pose with the camera that fits best; None: none was found.
        pose: that of a free camera on the way there.
        doubt: significance of its camera, as a normal deviate.
        prior: of the calibration.
    """
    if free is None or not free.verification.accepted or free.regions is None:
        return _inflated(_refused(fixed) if doubt > _REFUSE_SIGMA else fixed, pose)
    moved = CameraChange.between(fixed.camera, free.camera).values[: free.free]
    known_to = _sigmas_of_change(prior, fixed.camera)[: free.free]
    deviate = free.regions.normal_deviate(moved, variance_factor=free.aligner.common_variance, known_to=known_to)
    if deviate <= _CONTRADICTED_SIGMA:
        return _inflated(fixed, pose)
    apart_m = float(np.linalg.norm(free.camera_from_scanner.centre - fixed.camera_from_scanner.centre))
    sigma_px, sigma_k1 = (free.camera_sigmas.get(name, 0.0) for name in ("focal_px", "k1"))
    sentence = (
        f"The images contradict the calibrated camera ({deviate:.0f} standard deviations): "
        f"{free.verification.fraction:.0%} of the regions agree with a focal length of {free.camera.focal_px:.1f} +- "
        f"{sigma_px:.1f} px instead of {fixed.camera.focal_px:.1f} and k1 {k1_of(free.camera):.3f} +- {sigma_k1:.3f} "
        f"instead of {k1_of(fixed.camera):.3f}, {1000 * apart_m:.0f} mm from here. Check that the calibration belongs "
        "to this photo (zoom, focus, crop, turn), or have focal length and k1 estimated with the pose."
    )
    return _inflated(_refused(fixed, sentence), pose)


def _with_assumed_camera(fixed: FinishedPose, photo: Photo, start: Rigid, prior: CameraPrior) -> FinishedPose:
    """Return a finished pose with the most probable camera, or refused if no camera fits.

    From a pose that is verified, pose and camera settle together. Otherwise the focal length is perhaps far off: both
    are refined at the coarser level first, without prior.
    """
    stated = photo.pinhole
    sigma = np.maximum(_sigmas_of_change(prior, stated), _EXACT)
    best = _settled(fixed, photo, fixed, sigma) if fixed.verification.accepted else None
    doubtful = best is None or (best.verification.fine_fraction or 0) < _SUFFICIENT_FINE_FRACTION
    if best is None or doubtful or not best.verification.accepted or _conflicts(best, stated, sigma).any():
        coarse = _estimate(fixed, photo, start, NO_CHANGE, free=_FREE["auto"], coarsely=True)
        again = None if coarse is None else _settled(coarse, photo, fixed, sigma)
        if again is not None and (best is None or _rank(again) > _rank(best)):
            best = again
    if best is None:
        return fixed if not fixed.verification.accepted else _refused(fixed)
    conflicts = _conflicts(best, stated, sigma)
    if conflicts.any():
        alone = np.where(conflicts, np.inf, sigma)
        freely = _settled(best, photo, fixed, alone)
        if freely is None or not _is_determined(freely, conflicts, sigma):
            return _refused(best)
        best = freely
    return best


def _settled(begin: FinishedPose, photo: Photo, fixed: FinishedPose, sigma: FloatArray) -> FinishedPose | None:
    """Return pose and camera refined together from a finished pose, with the prior; None if they diverge.

    Args:
        begin: where to begin.
        photo: the photograph, with the stated camera.
        fixed: the pose with that camera, whose regions say how much blocks count beside the prior.
        sigma: (4,) of (log f, k1, centre x, centre y) about the stated camera.
    """
    regions = fixed.regions if fixed.regions is not None else begin.regions
    if regions is None:
        return None
    aligner, pose, camera = begin.aligner, begin.camera_from_scanner, begin.camera
    stated, free = photo.pinhole, len(sigma)

    def anchor() -> CameraAnchor:
        mean = CameraChange.between(camera, stated).values
        return regions.anchor(mean, sigma, variance_factor=aligner.common_variance)

    try:
        for _ in range(_ROUNDS):
            pose, change = aligner.finish_with_free_camera(pose, free=free, anchor=anchor())
            before, camera = camera, change.applied_to(camera)
            shift_px = _largest_shift_px(before, camera)
            if shift_px > _SAME_CHANNELS_PX:
                aligner = _aligner_for(aligner, photo, camera)
            if shift_px < _SETTLED_SHIFT_PX:
                break
        found = verify_finished(aligner, camera, pose, free=free, anchor=anchor())
    except (CameraError, _NothingToCompareError):
        return None
    names = zip(INTRINSICS, sigma * _to_px(stated), strict=True)
    return replace(found, prior={name: float(value) for name, value in names if np.isfinite(value)})


def _conflicts(found: FinishedPose, stated: Camera, sigma: FloatArray) -> BoolArray:
    """Return which of (log f, k1, centre x, centre y) the regions alone put elsewhere than the prior admits, (4,)."""
    if found.regions is None:
        return np.zeros(len(sigma), np.bool_)
    covariance = found.regions.joint_covariance(found.aligner.common_variance)
    after = np.sqrt(np.diag(covariance)[6:])
    moved = CameraChange.between(stated, found.camera).values
    conflicts = []
    for off, own, known in zip(moved, after, sigma, strict=True):
        share, alone = share_of_images(float(own), float(known))
        conflicts.append(np.isfinite(known) and abs(off / share) > _CONFLICT_SIGMA * np.hypot(known, alone))
    return np.array(conflicts, np.bool_)


def _is_determined(found: FinishedPose, freed: BoolArray, sigma: FloatArray) -> bool:
    """Return whether the parameters without prior are known well enough."""
    if found.regions is None or not found.verification.accepted:
        return False
    after = np.sqrt(np.diag(found.regions.joint_covariance(found.aligner.common_variance))[6:])
    most = np.array([_MAX_LOG_FOCAL_SIGMA, sigma[1], *(_MAX_CENTRE_SIGMA * sigma[2:])])
    return bool((after <= most)[freed].all())


def _sigmas_of_change(prior: CameraPrior, camera: Camera) -> FloatArray:
    """Return the prior's standard deviations (4,) of (log f, k1, centre x, centre y)."""
    centre = prior.centre_of_width * camera.width
    return np.array([prior.focal, prior.k1, centre / camera.fx, centre / camera.fy])


def _to_px(camera: Camera) -> FloatArray:
    """Return what turns (log f, k1, centre x, centre y) into `INTRINSICS`, (4,)."""
    return np.array([camera.focal_px, 1.0, camera.fx, camera.fy])


def _largest_shift_px(before: Camera, after: Camera) -> float:
    """Return the largest displacement of a pixel of the image between two cameras, px."""
    u, v = np.meshgrid(np.linspace(0, before.width - 1, 5), np.linspace(0, before.height - 1, 5))
    uv = np.stack([u, v], axis=-1).reshape(-1, 2)
    shift = np.linalg.norm(after.project(before.unproject(uv)) - uv, axis=1)
    return float(np.nanmax(shift)) if np.isfinite(shift).any() else np.inf


def _refused(fixed: FinishedPose, sentence: str = _WRONG_CAMERA) -> FinishedPose:
    """Return the pose as refused, since its camera is wrong."""
    verification = fixed.verification
    sentences = verification.reasons if not verification.accepted else ()
    reasons = (*sentences, sentence)
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


def _is_better(found: FinishedPose, stated: FinishedPose) -> bool:
    """Return whether other intrinsics are significant and the image agrees no less with them."""
    if not found.verification.accepted or found.regions is None:
        return False
    if np.sqrt(found.regions.covariance[6, 6]) > _MAX_LOG_FOCAL_SIGMA:
        return False
    if not stated.verification.accepted and (found.verification.fine_fraction or 0.0) < _MIN_FINE_FRACTION:
        return False  # with more free parameters more regions agree by chance
    before, after = stated.camera, found.camera
    moved = np.array([np.log(after.focal_px / before.focal_px), k1_of(after) - k1_of(before)])[: found.free]
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


def _estimate(
    fixed: FinishedPose, photo: Photo, start: Rigid, change: CameraChange, *, free: int, coarsely: bool
) -> FinishedPose | None:
    """Refine pose and camera, undistorting the photo anew in each round, until both settle; None if they diverge.

    The change of the lens is modelled in the undistorted image, which is exact only for a vanishing change: hence the
    rounds.
    """
    aligner, pose, camera = fixed.aligner, start, change.applied_to(fixed.camera)
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
