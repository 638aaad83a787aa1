"""One camera from the photographs that it took: their estimates of it are pooled, and those that disagree named.

Every photograph that was registered with an assumed camera has a joint covariance of its pose and its intrinsics, which
contains the prior of the camera. In the pool that prior counts once: each estimate adds the information of its images
alone. With x_k, C_k the estimates, x_0, P_0 the prior,

    Lambda = P_0^-1 + sum (C_k^-1 - P_k^-1),   Lambda x = P_0^-1 x_0 + sum (C_k^-1 x_k - P_k^-1 x_0k).

An estimate is compared with the pool of the others before it counts: as few as one photograph of another lens, or one
registered wrongly, would move the camera of all. Errors of the scan and of the lens beyond this model are common to all
photographs, whose estimates are therefore correlated: the covariance of the pool of n is enlarged by 1 + rho (n - 1).

Source: the normal equations of one camera and many poses, which are independent given the camera; the poses eliminated.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ladarreg_core.camera import Camera
from ladarreg_core.camera.uncertainty import INTRINSICS, CameraUncertainty, pose_jacobian
from ladarreg_core.foundations.arrays import FloatArray, read_only
from ladarreg_core.results.registration import Registration

_DISAGREES = 23.5  # chi squared with 4 degrees of freedom, exceeded once in 10,000
_MIN_POOLED = 2
_CORRELATION = 0.08  # of estimates on one scan: pools of 12 were off by 1.4 of their sigmas without it, of 6 by 1.0
_COUNT = len(INTRINSICS)
_TURNS = {1: ((1, 0), (0, 1)), 3: ((-1, 0), (0, -1)), 6: ((0, -1), (1, 0)), 8: ((0, 1), (-1, 0))}
"""What EXIF's orientations do to an offset (u, v) of the stored pixels; the mirrored ones are of no camera."""


@dataclass(frozen=True, slots=True, eq=False)
class CameraEstimate:
    """What one photograph says of its camera: `INTRINSICS`, the principal point from the middle of the stored pixels.

    So all photographs of a camera agree however it was held.
    """

    photo: str
    """Id of the photograph."""
    values: FloatArray
    """(4,) estimated: px, 1, px, px."""
    information: FloatArray
    """(4, 4) of the images alone: the inverse of the covariance less that of the prior."""
    weighted: FloatArray
    """(4,) the information times the values that the images alone would give."""
    stated: FloatArray
    """(4,) values before the registration."""
    prior: FloatArray
    """(4,) their standard deviations before; infinite where there was none."""

    def as_fields(self) -> dict[str, Any]:
        """Return the fields as JSON-ready values."""
        return {
            "photo": self.photo,
            **{name: getattr(self, name).tolist() for name in ("values", "information", "weighted", "stated")},
            "prior": [None if np.isinf(sigma) else sigma for sigma in self.prior.tolist()],
        }

    @staticmethod
    def from_fields(fields: Mapping[str, Any]) -> CameraEstimate:
        """Return what `as_fields` wrote.

        Raises:
            ShapeError: if the arrays have other shapes.
            KeyError: if a field is missing.
        """
        prior = [np.inf if sigma is None else sigma for sigma in fields["prior"]]
        vectors = {name: _vector(fields[name], name) for name in ("values", "weighted", "stated")}
        information = read_only(fields["information"], np.float64, (_COUNT, _COUNT), "the information")
        return CameraEstimate(str(fields["photo"]), information=information, prior=_vector(prior, "prior"), **vectors)


@dataclass(frozen=True, slots=True, eq=False)
class PooledCamera:
    """A camera pooled over photographs."""

    values: FloatArray
    """(4,) as in `CameraEstimate`."""
    covariance: FloatArray
    """(4, 4) of the values, true minus pooled."""
    photos: tuple[str, ...]
    """Ids of the photographs whose estimates it is of."""
    disagreeing: tuple[str, ...]
    """Ids of those whose estimates contradict it and do not count."""

    @property
    def sigmas(self) -> dict[str, float]:
        """Standard deviations by the names of `INTRINSICS`."""
        return dict(zip(INTRINSICS, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    def camera(self, width: int, height: int, orientation: int) -> Camera:
        """Return the camera of upright pixels.

        Args:
            width: of the upright photograph, px.
            height: likewise.
            orientation: EXIF's, by which its pixels were turned upright.
        """
        focal, k1, cx, cy = turn_of(orientation) @ self.values
        return Camera(width, height, focal, focal, cx + (width - 1) / 2, cy + (height - 1) / 2, (k1, 0.0, 0.0, 0.0))

    def covariance_of(self, orientation: int) -> FloatArray:
        """Return the covariance (4, 4) of `INTRINSICS` of upright pixels."""
        turn = turn_of(orientation)
        return np.asarray(turn @ self.covariance @ turn.T)


def may_be_turned(orientation: int) -> bool:
    """Return whether a camera can be pooled over photographs of an EXIF orientation: whether it is not mirrored."""
    return orientation in _TURNS


def turn_of(orientation: int) -> FloatArray:
    """Return (4, 4): the intrinsics of upright pixels, from their middle, of those of the stored ones."""
    turn = np.eye(_COUNT)
    turn[2:, 2:] = _TURNS[orientation]
    return turn


def camera_estimate(photo: str, result: Registration, orientation: int) -> CameraEstimate | None:
    """Return what an accepted registration says of an assumed camera; None: it says nothing that can be pooled.

    Args:
        photo: id of the photograph.
        result: its registration, whose camera was estimated with the pose.
        orientation: EXIF's, by which its pixels were turned upright.
    """
    joint, camera = result.camera_uncertainty, result.camera.as_pinhole
    if not result.accepted or joint is None or joint.names != INTRINSICS or camera is None:
        return None
    turn = turn_of(orientation).T  # orthogonal: back to the pixels as stored
    middle = np.array([0, 0, (camera.width - 1) / 2, (camera.height - 1) / 2])
    k1 = camera.distortion[0] if camera.distortion else 0.0
    values = np.array([camera.focal_px, k1, camera.cx, camera.cy]) - middle
    stated = np.array([joint.stated[name] for name in INTRINSICS]) - middle
    prior = np.array([joint.prior.get(name, np.inf) for name in INTRINSICS])
    whole = np.linalg.inv(joint.covariance[6:, 6:])
    by_images, known = np.linalg.eigh(whole - np.diag(prior**-2.0))
    information = (known * np.maximum(by_images, 0)) @ known.T  # what the prior alone says is no information
    alone = whole @ values - prior**-2.0 * stated
    return CameraEstimate(
        photo, turn @ values, turn @ information @ turn.T, turn @ alone, turn @ stated, prior[_order(orientation)]
    )


def pool(estimates: Sequence[CameraEstimate]) -> PooledCamera | None:
    """Return the camera that estimates agree on; None: fewer than two agree, or more disagree than agree.

    The estimate that contradicts the pool of the others most is left out, as long as one contradicts it. The order of
    the estimates makes no difference beyond rounding.
    """
    used = list(estimates)
    while len(used) >= _MIN_POOLED:
        apart = [_chi_squared(one, [other for other in used if other is not one]) for one in used]
        worst = int(np.argmax(apart))
        if apart[worst] <= _DISAGREES:
            break
        used.pop(worst)
    if len(used) < _MIN_POOLED or 2 * len(used) <= len(estimates):
        return None
    values, covariance = _pooled(used)
    names = tuple(one.photo for one in used)
    others = tuple(one.photo for one in estimates if one.photo not in names)
    return PooledCamera(read_only(values, np.float64, (_COUNT,), ""), covariance, names, others)


def with_pooled_camera(result: Registration, pooled: PooledCamera, orientation: int) -> Registration:
    """Return a registration with a pooled camera, whose covariance contains that of the camera.

    The pose depends on the camera by G = -(J_p^T W J_p)^-1 J_p^T W J_c, with the derivatives of the matches' pixels by
    pose and camera and their information W; G C G^T is added to the covariance at the camera itself.

    Args:
        result: a registration for which the camera was taken as it is.
        pooled: the camera.
        orientation: EXIF's, by which the photograph's pixels were turned upright.
    """
    camera = result.camera.as_pinhole
    assert camera is not None, "only pinholes are pooled"
    of_camera = pooled.covariance_of(orientation)
    sigmas = dict(zip(INTRINSICS, np.sqrt(np.diag(of_camera)).tolist(), strict=True))
    by_camera = pose_by_camera(result, camera)
    if by_camera is None:
        return replace(result, camera_sigmas=sigmas)
    joint = np.zeros((6 + _COUNT, 6 + _COUNT))
    joint[:6, :6] = result.covariance + by_camera @ of_camera @ by_camera.T
    joint[:6, 6:] = by_camera @ of_camera
    joint[6:, :6], joint[6:, 6:] = joint[:6, 6:].T, of_camera
    values = (camera.focal_px, camera.distortion[0], camera.cx, camera.cy)
    stated = dict(zip(INTRINSICS, values, strict=True))
    uncertainty = CameraUncertainty(INTRINSICS, joint, stated, sigmas)
    return replace(
        result, covariance=read_only(joint[:6, :6], np.float64, (6, 6), ""), camera_sigmas=sigmas,
        camera_uncertainty=uncertainty,
    )  # fmt: skip


def pose_by_camera(result: Registration, camera: Camera) -> FloatArray | None:
    """Return the derivative (6, 4) of a pose by the intrinsics; None: its matches do not determine it."""
    used = np.asarray(result.inliers)
    if used.sum() < _COUNT:
        return None
    points = result.matches.points[used]
    _, by_pose = pose_jacobian(result.camera_from_scanner, points, camera)
    p = result.camera_from_scanner @ points
    by_camera = camera.intrinsics_jacobian(p[:, :2] / p[:, 2:])
    by_camera[..., 0] /= camera.focal_px
    weights = np.repeat(np.eye(2)[None], len(points), axis=0)
    if result.blocks is not None:
        of_block = dict(zip(result.blocks.ids, result.blocks.information, strict=True))
        ids = [name for name, inlier in zip(result.matches.pick_ids, used, strict=True) if inlier]
        weights = np.array([of_block.get(name, np.zeros((2, 2))) for name in ids], np.float64)
    known = np.isfinite(by_pose).all(axis=(1, 2)) & np.isfinite(by_camera).all(axis=(1, 2))
    normal = np.einsum("nia,nij,njb->ab", by_pose[known], weights[known], by_pose[known])
    mixed = np.einsum("nia,nij,njb->ab", by_pose[known], weights[known], by_camera[known])
    try:
        return np.asarray(-np.linalg.solve(normal, mixed))
    except np.linalg.LinAlgError:
        return None


def _pooled(estimates: Sequence[CameraEstimate]) -> tuple[FloatArray, FloatArray]:
    """Return the values (4,) and their covariance (4, 4), with the prior of the estimate that had the widest one."""
    first = max(estimates, key=lambda one: (float(one.prior[0]), one.photo))
    of_prior = first.prior**-2.0
    information = np.diag(of_prior) + sum(one.information for one in estimates)
    covariance = np.linalg.inv(information)
    values = covariance @ (of_prior * first.stated + sum(one.weighted for one in estimates))
    return np.asarray(values), np.asarray(covariance * (1 + _CORRELATION * (len(estimates) - 1)))


def _chi_squared(one: CameraEstimate, others: Sequence[CameraEstimate]) -> float:
    """Return how much an estimate contradicts the pool of others, as chi squared with 4 degrees of freedom."""
    values, covariance = _pooled(others)
    scale = np.sqrt(np.diag(covariance))  # pixels and k1 differ by orders of magnitude
    H = one.information * np.outer(scale, scale)
    covariance = covariance / np.outer(scale, scale)
    misfit = scale * (one.weighted - one.information @ values)
    return float(misfit @ np.linalg.pinv(H + H @ covariance @ H, hermitian=True) @ misfit)


def _order(orientation: int) -> list[int]:
    """Return where the standard deviations of the stored pixels stand among those of the upright ones."""
    return [0, 1, 3, 2] if orientation in (6, 8) else [0, 1, 2, 3]


def _vector(values: Any, name: str) -> FloatArray:
    return read_only(values, np.float64, (_COUNT,), f"the {name}")
