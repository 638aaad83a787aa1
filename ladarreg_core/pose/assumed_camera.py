"""Poses with a camera that was not calibrated: what is assumed of it becomes part of the uncertainty.

The focal length, k1 and the principal point have a prior about their stated values (`CameraPrior`). The robust
estimator fits them with the pose, each prior as one more measurement; for the other estimators, which keep the camera
as stated, the errors of the camera are propagated into the pose:

    p_true - p = G (theta_true - theta) + noise,   G = -H_pp^-1 H_pt

with the distribution of theta_true after the matches were seen. Its mean counts as an error as well.

Source: Schmidt, Application of state-space methods to navigation problems (1966), for the latter.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from ladarreg_core.camera import Camera, require_pinhole
from ladarreg_core.camera.uncertainty import INTRINSICS, CameraPrior, CameraUncertainty
from ladarreg_core.foundations.arrays import BoolArray, FloatArray
from ladarreg_core.frames import Rigid
from ladarreg_core.matches import Matches
from ladarreg_core.pose.estimators.covariance import pose_covariance
from ladarreg_core.pose.estimators.intrinsics import Anchor, Descent, IntrinsicsFit, Noise, estimate_intrinsics
from ladarreg_core.pose.estimators.unknown_intrinsics import intrinsic
from ladarreg_core.results.registration import PoseResult

MAX_PRIOR_SIGMAS = 3.0
"""Offset of the principal point beyond which the photograph was probably cropped, in standard deviations."""
_DETERMINED = 2.0  # most standard deviation of a cropped photograph's principal point, relative to the prior
_MIN_MATCHES = 4


def fit_assumed_camera(
    matches: Matches,
    stated: Camera,
    start: IntrinsicsFit | tuple[Camera, Rigid],
    prior: CameraPrior,
    *,
    sigma_px: float,
    sigma_range_m: float,
    gate_chi2: float,
    noise: Noise | None,
) -> tuple[IntrinsicsFit, CameraUncertainty] | None:
    """Fit the pose together with the camera; None if nothing of the camera is uncertain.

    Where the matches contradict the prior on the principal point, as for a cropped photograph, they determine it alone.

    Args:
        matches: M matches, which may contain outliers.
        stated: the camera as stated, the mean of the prior.
        start: intrinsics that were estimated without prior, and remain so; or a camera and a pose.
        prior: the prior.
        sigma_px: pixel noise, px.
        sigma_range_m: range noise, m.
        gate_chi2: largest cost s of an inlier.
        noise: estimator of the noise if it is not stated.
    """
    sigmas = prior.sigmas(stated)
    free = start.names if isinstance(start, IntrinsicsFit) else ()
    camera, pose = (start.camera, start.pose) if isinstance(start, IntrinsicsFit) else start
    if not set(sigmas) - set(free):
        return None
    how: dict[str, Any] = {
        "sigma_px": sigma_px, "sigma_range_m": sigma_range_m, "gate_chi2": gate_chi2, "noise": noise,
    }  # fmt: skip
    fit = estimate_intrinsics(matches, camera, pose, "fixed", anchor=Anchor.of(stated, sigmas, free), **how)
    off, off_sigma = _off_by_matches(fit, stated, sigmas, free)
    freed: tuple[str, ...] = ()
    if is_beyond_prior(off, off_sigma, sigmas):
        freely = Anchor.of(stated, sigmas, (*free, "cx", "cy"))
        again = estimate_intrinsics(matches, fit.camera, fit.pose, "fixed", anchor=freely, **how)
        if all(again.sigmas[name] <= _DETERMINED * sigmas[name] for name in off):
            fit = again
            off = {name: intrinsic(fit.camera, name) - intrinsic(stated, name) for name in off}
            off_sigma = {name: fit.sigmas[name] for name in off}
            freed = tuple(off)
    left = {name: sigma for name, sigma in sigmas.items() if name not in free}
    return fit, _uncertainty(fit.names, fit.covariance, stated, left, off, off_sigma, freed)


def is_beyond_prior(off: Mapping[str, float], off_sigma: Mapping[str, float], sigmas: Mapping[str, float]) -> bool:
    """Return whether an offset of the principal point is larger than the prior and its own uncertainty admit."""
    return any(abs(off[name]) > MAX_PRIOR_SIGMAS * np.hypot(sigmas[name], off_sigma[name]) for name in off)


def _off_by_matches(
    fit: IntrinsicsFit, stated: Camera, sigmas: dict[str, float], free: tuple[str, ...]
) -> tuple[dict[str, float], dict[str, float]]:
    """Return the offset of the principal point that the matches alone show, without the prior, and its sigma."""
    off: dict[str, float] = {}
    off_sigma: dict[str, float] = {}
    for name in ("cx", "cy"):
        if name not in sigmas or name in free:
            continue
        before, after = sigmas[name] ** 2, fit.sigmas[name] ** 2
        share = 1 - after / before  # of the estimate that comes from the matches
        if share > 1e-6:
            off[name] = (intrinsic(fit.camera, name) - intrinsic(stated, name)) / share
            off_sigma[name] = float(np.sqrt(after / share))
    return off, off_sigma


def with_assumed_camera(result: PoseResult, prior: CameraPrior, *, shown: float = 1.0) -> PoseResult:
    """Return a result with the errors of its camera, as assumed, propagated into its covariance.

    Args:
        result: a pose by any method, with its covariance for an exact camera.
        prior: what is assumed of the camera; intrinsics that were estimated with the pose are no longer assumed.
        shown: share of the effect of a wrong camera that the residuals show.
    """
    camera = result.camera.as_pinhole
    if camera is None:
        return result
    free = tuple(name for name in INTRINSICS if name in result.camera_sigmas)
    sigmas = {k: v for k, v in prior.sigmas(camera).items() if k not in free}
    if not sigmas or result.camera_uncertainty is not None or np.count_nonzero(result.inliers) < _MIN_MATCHES:
        return result
    if not result.is_determined:
        return result
    try:
        return _with_errors_of_camera(result, sigmas, free, shown)
    except np.linalg.LinAlgError:
        return result  # its covariance is singular: the matches do not determine it


def _with_errors_of_camera(
    result: PoseResult, sigmas: dict[str, float], free: tuple[str, ...], shown: float
) -> PoseResult:
    H, g = _information(result, result.inliers, sigmas, free)
    fitted = 6 + len(free)  # the pose and what was estimated with it; then what is assumed
    inverse = pose_covariance(H[:fitted, :fitted])
    own, scale = _enlarged(inverse, result.covariance)
    information = shown**2 * (H[fitted:, fitted:] - H[fitted:, :fitted] @ inverse @ H[:fitted, fitted:]) / scale
    gradient = shown * (g[fitted:] - H[fitted:, :fitted] @ inverse @ g[:fitted]) / scale
    focal_px = result.camera.focal_px
    before = np.diag([(sigma / focal_px if name == "focal_px" else sigma) ** -2 for name, sigma in sigmas.items()])
    P = np.linalg.inv(information + before)
    gain = -inverse @ H[:fitted, fitted:]
    covariance = np.block([[own + gain @ P @ gain.T, gain @ P], [P @ gain.T, P]])
    moved = np.concatenate([gain @ P @ gradient, P @ gradient])  # to the most probable camera, which is not adopted
    covariance += np.outer(moved, moved)
    if "focal_px" in (*free, *sigmas):  # from log f
        covariance[6] *= focal_px
        covariance[:, 6] *= focal_px
    names = list(sigmas)
    off: dict[str, float] = {}
    off_sigma: dict[str, float] = {}
    for name in ("cx", "cy"):
        if name in names:
            others = [k for k, other in enumerate(names) if other != name]
            k = names.index(name)
            nuisance = (information + before)[np.ix_(others, others)]
            by_others = np.linalg.solve(nuisance, information[others, k])
            alone = float(information[k, k] - information[k, others] @ by_others)
            if alone > 0:
                off[name] = float(gradient[k] - gradient[others] @ by_others) / alone
                off_sigma[name] = float(1 / np.sqrt(alone))
    uncertainty = _uncertainty((*free, *names), covariance, _pinhole(result), sigmas, off, off_sigma)
    return replace(result, covariance=uncertainty.covariance[:6, :6], camera_uncertainty=uncertainty)


def _pinhole(result: PoseResult) -> Camera:
    return require_pinhole(result.camera, "An assumed camera")


def _enlarged(inverse: FloatArray, covariance: FloatArray) -> tuple[FloatArray, float]:
    """Return the covariance (6 + F, 6 + F) of independent matches changed to that of the result, and its mean factor.

    Errors that neighbouring matches share make the covariance of the pose (6, 6) larger than that of independent ones.
    """
    unit = np.sqrt(np.maximum(np.diag(inverse)[:6], 1e-300))
    square = np.outer(unit, unit)
    whiten = np.linalg.inv(np.linalg.cholesky(inverse[:6, :6] / square))
    scale = max(1.0, float(np.trace(whiten @ (covariance / square) @ whiten.T)) / 6)
    change = np.sqrt(scale) * np.eye(len(inverse))
    change[:6, :6] = unit[:, None] * (np.linalg.cholesky(covariance / square) @ whiten) / unit
    return np.asarray(change @ inverse @ change.T), scale


def _information(
    result: PoseResult, members: BoolArray, sigmas: dict[str, float], free: tuple[str, ...]
) -> tuple[FloatArray, FloatArray]:
    """Return the information of the inliers on the pose, the free and the assumed intrinsics, and the gradient."""
    anchor = Anchor.of(_pinhole(result), sigmas, free)
    descent = Descent.start(
        result.matches, _pinhole(result), result.camera_from_scanner, 0,
        sigma_px=result.sigma_px, sigma_range_m=result.sigma_range_m,
        anchor=replace(anchor, information=np.zeros(len(anchor.free))),
    )  # fmt: skip
    H, g, _, _ = descent.normal_equations(members[None].astype(np.float64))
    return H, g


def _uncertainty(
    names: tuple[str, ...],
    covariance: FloatArray,
    stated: Camera,
    prior: dict[str, float],
    off: dict[str, float],
    off_sigma: dict[str, float],
    freed: tuple[str, ...] = (),
) -> CameraUncertainty:
    values = {name: stated.focal_px if name == "focal_px" else intrinsic(stated, name) for name in names}
    return CameraUncertainty(names, (covariance + covariance.T) / 2, values, prior, freed, off, off_sigma)
