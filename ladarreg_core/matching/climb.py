"""Direct alignment: Gauss-Newton on the correlation of blocks of channels (block-wise ECC).

Each block of the scan's view is compared with the photo by normalised correlation alone, so a block may be brighter
or fainter there; a block that does not agree, or wants to move elsewhere, loses its weight.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.arrays import BoolArray, FloatArray
from ladarreg_core.camera import Camera
from ladarreg_core.frames import Rigid, rotation_from_rotvec
from ladarreg_core.matching.occlusion import Occluder
from ladarreg_core.matching.points import Blocks, ViewPoints

LEAST_POINTS = 8
"""Visible points that a block needs."""
LEAST_BLOCKS = 8
"""Such blocks that a climb needs."""
_MOST_MOTION_PX = 4.0
_STILL_PX = 0.02
_REFRESH_VISIBILITY = 3


class Target:
    """The photo's channels at one level, laid out for sampling values and gradients together."""

    def __init__(self, camera: Camera, channels: FloatArray, usable: BoolArray) -> None:
        self.camera = camera
        self.channels = channels
        self.usable = usable
        self._values = channels.reshape(-1, channels.shape[-1])

    def sample(self, uv: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return channels and their derivatives by u and v, each (N, 8), at pixels (N, 2) inside the picture.

        The derivatives are the central differences at the nearest pixel: the channels are smooth enough.
        """
        width = self.camera.width
        base = np.floor(uv).astype(np.intp)
        fraction = (uv - base).astype(np.float32)
        a, b = fraction[:, :1], fraction[:, 1:]
        first = base[:, 1] * width + base[:, 0]
        upper = self._at(first) * (1 - a) + self._at(first + 1) * a
        lower = self._at(first + width) * (1 - a) + self._at(first + width + 1) * a
        nearest = first + (fraction[:, 0] >= 0.5) + width * (fraction[:, 1] >= 0.5)
        half = np.float32(0.5)
        by_u = (self._at(nearest + 1) - self._at(nearest - 1)) * half
        by_v = (self._at(nearest + width) - self._at(nearest - width)) * half
        return upper * (1 - b) + lower * b, by_u, by_v

    def _at(self, pixels: NDArray[np.intp]) -> FloatArray:
        return self._values.take(pixels, axis=0)


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


def project_visible(
    points: ViewPoints, target: Target, occluder: Occluder, buffer: FloatArray, pose: Rigid, *, border: float
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return points in the camera frame (N, 3), their pixels (N, 2), and which are visible `border` inside."""
    points_camera = pose @ points.points
    camera = target.camera
    depth = np.where(points_camera[:, 2] > 0.05, points_camera[:, 2], 1)[:, None]
    uv = points_camera[:, :2] / depth * np.array([camera.fx, camera.fy], np.float32) + np.array(
        [camera.cx, camera.cy], np.float32
    )
    visible = camera.contains(uv, border=border) & occluder.visible(points_camera, buffer)
    near = np.rint(np.where(visible[:, None], uv, 0)).astype(np.intp)
    visible &= target.usable[near[:, 1], near[:, 0]]
    return points_camera, uv, visible


def block_counts(blocks: Blocks, visible: BoolArray) -> tuple[FloatArray, BoolArray]:
    """Return the visible points of each block (B,), and which blocks have enough."""
    count = blocks.sum(visible.astype(np.float32))
    return count, count >= LEAST_POINTS


def _gauss_newton_step(
    points: ViewPoints, target: Target, occluder: Occluder, buffer: FloatArray, pose: Rigid, tau_px: float
) -> tuple[FloatArray, float, float, int] | None:
    points_camera, uv, visible = project_visible(points, target, occluder, buffer, pose, border=2)
    _, enough = block_counts(points.blocks, visible)
    if np.count_nonzero(enough) < LEAST_BLOCKS:
        return None
    kept = np.flatnonzero(visible & enough[points.blocks.of_point])
    blocks = _sub_blocks(points.blocks.of_point[kept])
    of = blocks.of_point
    count = blocks.sum(np.ones(len(kept), np.float32))

    def total(a: FloatArray, b: FloatArray) -> FloatArray:
        return np.asarray(np.einsum("nk,nk->n", a, b))

    def centred(values: FloatArray) -> FloatArray:
        return np.asarray(values - (blocks.sum(values) / count[:, None]).take(of, axis=0))

    A = centred(points.channels.take(kept, axis=0))
    B, Bu, Bv = target.sample(uv.take(kept, axis=0))
    B = centred(B)
    length_a, length_b = np.sqrt(blocks.sum(total(A, A))) + 1e-9, np.sqrt(blocks.sum(total(B, B))) + 1e-9
    A /= length_a.take(of)[:, None]
    shrink = (1 / length_b).take(of)[:, None]
    for values in (B, Bu, Bv):
        values *= shrink
    rho = np.maximum(blocks.sum(total(A, B)), 0)

    # What follows are the sums of products of the centred gradient, projected off B, without ever forming it.
    a_u, a_v, b_u, b_v = total(A, Bu), total(A, Bv), total(B, Bu), total(B, Bv)
    m_uu, m_uv, m_vv = total(Bu, Bu), total(Bu, Bv), total(Bv, Bv)
    Ju, Jv = _pose_jacobian(points_camera.take(kept, axis=0), target.camera)
    along_b = blocks.sum(b_u[:, None] * Ju + b_v[:, None] * Jv)
    along_a = blocks.sum(a_u[:, None] * Ju + a_v[:, None] * Jv)

    weight = rho**2 / (1 + (_own_steps(blocks, count, rho, Bu, Bv, a_u, a_v, b_u, b_v) / tau_px) ** 2) ** 2
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


def _own_steps(
    blocks: Blocks,
    count: FloatArray,
    rho: FloatArray,
    Bu: FloatArray,
    Bv: FloatArray,
    a_u: FloatArray,
    a_v: FloatArray,
    b_u: FloatArray,
    b_v: FloatArray,
) -> FloatArray:
    """Return how far each block (B,) would move by its own Lucas-Kanade step, level pixels."""
    sum_u, sum_v = blocks.sum(Bu), blocks.sum(Bv)

    def gram(first: FloatArray, second: FloatArray, sums: FloatArray, along: FloatArray) -> FloatArray:
        products = blocks.sum(np.einsum("nk,nk->n", first, second))
        return np.asarray(products - sums / count - along)

    along_u, along_v = blocks.sum(b_u), blocks.sum(b_v)
    uu = gram(Bu, Bu, (sum_u * sum_u).sum(axis=1), along_u * along_u)
    uv = gram(Bu, Bv, (sum_u * sum_v).sum(axis=1), along_u * along_v)
    vv = gram(Bv, Bv, (sum_v * sum_v).sum(axis=1), along_v * along_v)
    right_u, right_v = blocks.sum(a_u) - rho * along_u, blocks.sum(a_v) - rho * along_v
    # A straight edge says nothing of its own direction: the damping keeps that from becoming a long step.
    det = uu * vv - uv * uv + 1e-3 * (uu + vv) ** 2 + 1e-12
    return np.hypot((vv * right_u - uv * right_v) / det, (uu * right_v - uv * right_u) / det)


def _sub_blocks(labels: NDArray[np.intp]) -> Blocks:
    names, starts, of_point = np.unique(labels, return_index=True, return_inverse=True)
    return Blocks(starts, of_point, names[:, None])


def _pose_jacobian(points_camera: FloatArray, camera: Camera) -> tuple[FloatArray, FloatArray]:
    """Return du / d (w, t) and dv / d (w, t), each (n, 6) float32, for X' = exp([w]x) X + t."""
    x, y, z = points_camera[:, 0], points_camera[:, 1], points_camera[:, 2]
    a, b, inverse, zero = x / z, y / z, 1 / z, np.zeros_like(z)
    Ju = np.stack([-a * b, 1 + a * a, -b, inverse, zero, -a * inverse], axis=-1) * np.float32(camera.fx)
    Jv = np.stack([-1 - b * b, a * b, a, zero, inverse, -b * inverse], axis=-1) * np.float32(camera.fy)
    return Ju, Jv
