"""Direct alignment: Gauss-Newton on the correlation of blocks of channels (block-wise ECC).

Each block of the scan's view is compared with the photo by normalised correlation alone, so a block may be brighter
or fainter there; a block that does not agree, or wants to move elsewhere, loses its weight.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ladarreg_core.arrays import FloatArray
from ladarreg_core.camera import Camera
from ladarreg_core.frames import Rigid, rotation_from_rotvec
from ladarreg_core.matching.compared import BlockComparison, Target, compare_blocks
from ladarreg_core.matching.occlusion import Occluder
from ladarreg_core.matching.points import ViewPoints

_MOST_MOTION_PX = 4.0
_STILL_PX = 0.02
_REFRESH_VISIBILITY = 3


@dataclass(frozen=True, slots=True)
class ClimbOptions:
    """One climb."""

    tau_px: float
    """A block whose own step is this long counts a quarter."""
    iterations: int
    """Gauss-Newton steps at the most."""


@dataclass(frozen=True, slots=True, eq=False)
class ClimbResult:
    """Where a climb ended."""

    camera_from_scanner: Rigid
    """The pose."""
    iterations: int
    """Steps made."""
    correlation: float
    """Mean block correlation at the last step but one."""
    blocks: int
    """Blocks that took part."""
    motion_px: float
    """Median motion of the last step."""


def climb(
    points: ViewPoints, target: Target, occluder: Occluder, start: Rigid, options: ClimbOptions
) -> ClimbResult | None:
    """Climb from a start pose to the best agreement of blocks.

    Returns:
        the end, or None where too little of the scan is visible in the photo.
    """
    pose = start
    buffer = occluder.depth_buffer(pose)
    result = None
    for iteration in range(options.iterations):
        if iteration and iteration % _REFRESH_VISIBILITY == 0:
            buffer = occluder.depth_buffer(pose)
        step = _gauss_newton_step(points, target, occluder, buffer, pose, options.tau_px)
        if step is None:
            return result
        delta, motion, correlation, blocks = step
        turn = rotation_from_rotvec(delta[:3])
        pose = Rigid(turn @ pose.rotation, turn @ pose.translation + delta[3:])
        result = ClimbResult(pose, iteration + 1, correlation, blocks, motion)
        if motion < _STILL_PX:
            break
    return result


def _gauss_newton_step(
    points: ViewPoints, target: Target, occluder: Occluder, buffer: FloatArray, pose: Rigid, tau_px: float
) -> tuple[FloatArray, float, float, int] | None:
    seen = compare_blocks(points, target, occluder, buffer, pose)
    if seen is None:
        return None
    blocks, count, rho, Bu, Bv = seen.blocks, seen.count, seen.rho, seen.by_u, seen.by_v
    of = blocks.of_point

    # What follows are the sums of products of the centred gradient, projected off B, without ever forming it.
    m_uu, m_uv, m_vv = (np.einsum("nk,nk->n", *pair) for pair in ((Bu, Bu), (Bu, Bv), (Bv, Bv)))
    Ju, Jv = _pose_jacobian(seen.points_camera, target.camera)
    along_b = blocks.sum(seen.b_u[:, None] * Ju + seen.b_v[:, None] * Jv)
    along_a = blocks.sum(seen.a_u[:, None] * Ju + seen.a_v[:, None] * Jv)

    weight = rho**2 / (1 + (_own_steps(seen) / tau_px) ** 2) ** 2
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
    channel_sums = channel_sums.reshape(-1, 6)
    H -= channel_sums.T @ channel_sums
    H -= (curvature[:, None] * along_b).T @ along_b
    g = (weight[:, None] * (along_a - rho[:, None] * along_b)).sum(axis=0)
    H, g = H.astype(np.float64), g.astype(np.float64)
    scale = np.sqrt(np.diag(H)) + 1e-12
    try:
        delta = np.linalg.solve(H / np.outer(scale, scale) + 1e-6 * np.eye(6), g / scale) / scale
    except np.linalg.LinAlgError:
        return None
    motion = float(np.median(np.hypot(Ju @ delta, Jv @ delta)))
    if motion > _MOST_MOTION_PX:
        delta *= _MOST_MOTION_PX / motion
    return delta, motion, float(np.average(rho)), len(blocks)


def _own_steps(seen: BlockComparison) -> FloatArray:
    """Return how far each block (B,) would move by its own Lucas-Kanade step, level pixels."""
    uu, uv, vv, right_u, right_v = seen.normal_equations()
    # A straight edge says nothing of its own direction: the damping keeps that from becoming a long step.
    det = uu * vv - uv * uv + 1e-3 * (uu + vv) ** 2 + 1e-12
    return np.hypot((vv * right_u - uv * right_v) / det, (uu * right_v - uv * right_u) / det)


def _pose_jacobian(points_camera: FloatArray, camera: Camera) -> tuple[FloatArray, FloatArray]:
    """Return du / d (w, t) and dv / d (w, t), each (n, 6) float32, for X' = exp([w]x) X + t."""
    x, y, z = points_camera[:, 0], points_camera[:, 1], points_camera[:, 2]
    a, b, inverse, zero = x / z, y / z, 1 / z, np.zeros_like(z)
    Ju = np.stack([-a * b, 1 + a * a, -b, inverse, zero, -a * inverse], axis=-1) * np.float32(camera.fx)
    Jv = np.stack([-1 - b * b, a * b, a, zero, inverse, -b * inverse], axis=-1) * np.float32(camera.fy)
    return Ju, Jv
