"""Direct alignment: Gauss-Newton on the correlation of blocks of channels (block-wise ECC).

Each block of the scan's view is compared with the photo by normalised correlation alone, so a block may be brighter
or fainter there; a block that does not agree, or wants to move elsewhere, loses its weight. The focal length and the
lens may be free with the pose: the photo is then compared as it is, through the change of the camera.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from ladarreg_core.arrays import FloatArray
from ladarreg_core.camera import Camera
from ladarreg_core.features.channels import channel_products
from ladarreg_core.frames import Rigid, rotation_from_rotvec
from ladarreg_core.matching.blocks import BlockComparison, Target, compare_blocks
from ladarreg_core.matching.sampling import ViewPoints
from ladarreg_core.matching.zbuffer import Occluder

_MAX_MOTION_PX = 4.0
_STILL_PX = 0.02
_REFRESH_VISIBILITY = 3
_MAX_LOG_FOCAL, _MAX_K1 = math.log(1.6), 0.5


@dataclass(frozen=True, slots=True)
class CameraChange:
    """A change of (log f, k1), in the ideal picture."""

    log_focal: float = 0.0
    """Of fx and fy alike."""
    k1: float = 0.0
    """Added to the lens's."""

    def after(self, step: FloatArray) -> CameraChange:
        """Return the change after a step (K,) of (log f, k1), within what a camera can be."""
        if not len(step):
            return self
        log_focal, k1 = (*map(float, step), 0.0)[:2]
        return CameraChange(_clipped(self.log_focal + log_focal, _MAX_LOG_FOCAL), _clipped(self.k1 + k1, _MAX_K1))

    def applied_to(self, camera: Camera) -> Camera:
        """Return a camera with the change; a lens keeps its other terms, and an ideal one gets four."""
        factor = math.exp(self.log_focal)
        first, *others = camera.distortion or (0.0,) * 4
        return replace(camera, fx=camera.fx * factor, fy=camera.fy * factor, distortion=(first + self.k1, *others))


NO_CHANGE = CameraChange()
"""No change."""


def _clipped(value: float, most: float) -> float:
    return min(max(value, -most), most)


@dataclass(frozen=True, slots=True)
class RefineOptions:
    """One climb."""

    tau_px: float
    """A block whose own step is this long counts a quarter."""
    iterations: int
    """Gauss-Newton steps at the most."""
    free: int = 0
    """How many of (log f, k1) are free with the pose."""
    damping: float = 0.0
    """Added to their diagonal entries."""


@dataclass(frozen=True, slots=True, eq=False)
class RefineResult:
    """Where a climb ended."""

    camera_from_scanner: Rigid
    """The pose."""
    change: CameraChange
    """What is different in the camera."""
    iterations: int
    """Steps made."""
    correlation: float
    """Mean block correlation at the last step but one."""
    blocks: int
    """Blocks that took part."""
    motion_px: float
    """Median motion of the last step."""


def refine_pose(
    points: ViewPoints,
    target: Target,
    occluder: Occluder,
    start: Rigid,
    options: RefineOptions,
    *,
    change: CameraChange = NO_CHANGE,
) -> RefineResult | None:
    """Climb from a start pose to the best agreement of blocks.

    Args:
        points: the scan's points of a level.
        target: the photo at that level, with its ideal camera.
        occluder: the scan's surface.
        start: `camera_from_scanner`.
        options: how far.
        change: how the camera differs from the target's at the start.

    Returns:
        the end, or None where too little of the scan is visible in the photo.
    """
    pose = start
    buffer = occluder.depth_buffer(pose)
    result = None
    for iteration in range(options.iterations):
        if iteration and iteration % _REFRESH_VISIBILITY == 0:
            buffer = occluder.depth_buffer(pose)
        seen_by = target.seen_by(change.applied_to(target.camera)) if options.free or change != NO_CHANGE else target
        step = _gauss_newton_step(points, seen_by, occluder, buffer, pose, options)
        if step is None:
            return result
        delta, motion, correlation, blocks = step
        turn = rotation_from_rotvec(delta[:3])
        pose = Rigid(turn @ pose.rotation, turn @ pose.translation + delta[3:6])
        change = change.after(delta[6:])
        result = RefineResult(pose, change, iteration + 1, correlation, blocks, motion)
        if motion < _STILL_PX:
            break
    return result


def _gauss_newton_step(
    points: ViewPoints, target: Target, occluder: Occluder, buffer: FloatArray, pose: Rigid, options: RefineOptions
) -> tuple[FloatArray, float, float, int] | None:
    seen = compare_blocks(points, target, occluder, buffer, pose)
    if seen is None:
        return None
    blocks, count, rho, Bu, Bv = seen.blocks, seen.count, seen.rho, seen.by_u, seen.by_v
    of = blocks.of_point

    # What follows are the sums of products of the centred gradient, projected off B, without ever forming it.
    m_uu, m_uv, m_vv = (channel_products(*pair) for pair in ((Bu, Bu), (Bu, Bv), (Bv, Bv)))
    Ju, Jv = _jacobian(seen.points_camera, target.camera, options.free)
    along_b = blocks.sum(seen.b_u[:, None] * Ju + seen.b_v[:, None] * Jv)
    along_a = blocks.sum(seen.a_u[:, None] * Ju + seen.a_v[:, None] * Jv)

    weight = _weights(seen, options.tau_px)
    # What a block shares with the photo is rho of it, and only that part curves: the rest of B's gradient is noise,
    # and counting it would shorten every step by rho.
    curvature = weight * rho
    w = curvature.take(of)[:, None]
    cross = (w * m_uv[:, None] * Ju).T @ Jv
    H = (w * m_uu[:, None] * Ju).T @ Ju + (w * m_vv[:, None] * Jv).T @ Jv + cross + cross.T
    # The centring of the gradient, at each block's mean Jacobian: it only steers the step, not where it ends.
    mean_u, mean_v = blocks.sum(Ju) / count[:, None], blocks.sum(Jv) / count[:, None]
    sum_u, sum_v = blocks.sum(Bu), blocks.sum(Bv)
    channel_sums = sum_u[:, :, None] * mean_u[:, None] + sum_v[:, :, None] * mean_v[:, None]
    channel_sums *= np.sqrt(curvature / count)[:, None, None]
    channel_sums = channel_sums.reshape(-1, Ju.shape[1])
    H -= channel_sums.T @ channel_sums
    H -= (curvature[:, None] * along_b).T @ along_b
    g = (weight[:, None] * (along_a - rho[:, None] * along_b)).sum(axis=0)
    H, g = H.astype(np.float64), g.astype(np.float64)
    H[range(6, len(H)), range(6, len(H))] += options.damping
    # what is projected off may leave a diagonal of rounding alone, on either side of zero
    scale = np.sqrt(np.maximum(np.diag(H), 0)) + 1e-12
    try:
        delta = np.linalg.solve(H / np.outer(scale, scale) + 1e-6 * np.eye(len(H)), g / scale) / scale
    except np.linalg.LinAlgError:
        return None
    motion = float(np.median(np.hypot(Ju @ delta, Jv @ delta)))
    if motion > _MAX_MOTION_PX:
        delta *= _MAX_MOTION_PX / motion
    return delta, motion, float(np.average(rho)), len(blocks)


def block_systems(seen: BlockComparison, camera: Camera, options: RefineOptions) -> tuple[FloatArray, FloatArray]:
    """Return what each block contributes to a Gauss-Newton step.

    Args:
        seen: the b blocks at a pose.
        camera: the level's camera there.
        options: as of the climb that ended at the pose.

    Returns:
        H (b, 6 + K, 6 + K) and g (b, 6 + K), by (w, t) of X' = exp([w]x) X + t and (log f, k1); H of the block's own
        mean motion, which is all that regions are compared by.
    """
    blocks = seen.blocks
    Ju, Jv = _jacobian(seen.points_camera, camera, options.free)
    weight = _weights(seen, options.tau_px)
    along_b = blocks.sum(seen.b_u[:, None] * Ju + seen.b_v[:, None] * Jv)
    along_a = blocks.sum(seen.a_u[:, None] * Ju + seen.a_v[:, None] * Jv)
    g = weight[:, None] * (along_a - seen.rho[:, None] * along_b)
    curvature = (weight * seen.rho).astype(np.float64)
    uu, uv, vv, _, _ = (value.astype(np.float64) for value in seen.normal_equations())
    mean_u, mean_v = ((blocks.sum(J) / seen.count[:, None]).astype(np.float64) for J in (Ju, Jv))
    outer_uv = mean_u[:, :, None] * mean_v[:, None]
    H = uu[:, None, None] * (mean_u[:, :, None] * mean_u[:, None]) + vv[:, None, None] * (
        mean_v[:, :, None] * mean_v[:, None]
    )
    H += uv[:, None, None] * (outer_uv + np.swapaxes(outer_uv, 1, 2))
    return np.asarray(curvature[:, None, None] * H), np.asarray(g, np.float64)


def _weights(seen: BlockComparison, tau_px: float) -> FloatArray:
    return np.asarray(seen.rho**2 / (1 + (_block_steps(seen) / tau_px) ** 2) ** 2)


def _block_steps(seen: BlockComparison) -> FloatArray:
    """Return how far each block (B,) would move by its own Lucas-Kanade step, level pixels."""
    uu, uv, vv, right_u, right_v = seen.normal_equations()
    # A straight edge says nothing of its own direction: the damping keeps that from becoming a long step.
    det = uu * vv - uv * uv + 1e-3 * (uu + vv) ** 2 + 1e-12
    return np.hypot((vv * right_u - uv * right_v) / det, (uu * right_v - uv * right_u) / det)


def _jacobian(points_camera: FloatArray, camera: Camera, free: int) -> tuple[FloatArray, FloatArray]:
    """Return du / d (w, t, log f, k1) and dv, each (n, 6 + free) float32, for X' = exp([w]x) X + t."""
    x, y, z = points_camera[:, 0], points_camera[:, 1], points_camera[:, 2]
    a, b, inverse, zero = x / z, y / z, 1 / z, np.zeros_like(z)
    Ja = np.stack([-a * b, 1 + a * a, -b, inverse, zero, -a * inverse], axis=-1)
    Jb = np.stack([-1 - b * b, a * b, a, zero, inverse, -b * inverse], axis=-1)
    if camera.distortion:
        k1 = np.float32(camera.distortion[0])
        radial = 1 + k1 * (a * a + b * b)
        aa, ab, bb = (value[:, None] for value in (radial + 2 * k1 * a * a, 2 * k1 * a * b, radial + 2 * k1 * b * b))
        Ja, Jb = aa * Ja + ab * Jb, ab * Ja + bb * Jb
    else:
        radial = np.ones_like(a)
    s = a * a + b * b
    Ja = np.concatenate([Ja, np.stack([a * radial, a * s], axis=-1)[:, :free]], axis=-1)
    Jb = np.concatenate([Jb, np.stack([b * radial, b * s], axis=-1)[:, :free]], axis=-1)
    return Ja * np.float32(camera.fx), Jb * np.float32(camera.fy)
