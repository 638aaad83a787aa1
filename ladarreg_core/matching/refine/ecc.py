"""Direct alignment: Gauss-Newton on the correlation of blocks of channels (block-wise ECC).

Each block of the scan's view is compared with the photo by normalised correlation, which is invariant to gain. A block
that correlates poorly, or whose own step is long, is down-weighted. The focal length and k1 can be estimated with the
pose; the photo is then not resampled, but projected into through the changed camera.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ladarreg_core.camera import Camera
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.frames import Rigid, rotation_from_rotvec
from ladarreg_core.matching.images.blocks import BlockComparison, Target, compare_blocks
from ladarreg_core.matching.images.sampling import ViewPoints
from ladarreg_core.matching.images.zbuffer import Occluder

_MAX_MOTION_PX = 4.0  # longest step, level pixels, of the median point
_STILL_PX = 0.02  # a refinement ends with a shorter step, level pixels
_REFRESH_VISIBILITY = 3  # steps between two tests of occlusion
_MAX_CHANGE = np.array([math.log(1.6), 0.5, 0.5, 0.5])


@dataclass(frozen=True, slots=True)
class CameraChange:
    """A change of (log f, k1, centre), relative to the ideal camera of the undistorted photo."""

    log_focal: float = 0.0
    """Added to the logarithm of both fx and fy."""
    k1: float = 0.0
    """Added to the first radial distortion coefficient."""
    centre_x: float = 0.0
    """Added to cx, in focal lengths fx before the change: the same at every level."""
    centre_y: float = 0.0
    """Added to cy likewise, in fy."""

    @property
    def values(self) -> FloatArray:
        """(4,) of (log f, k1, centre x, centre y)."""
        return np.array([self.log_focal, self.k1, self.centre_x, self.centre_y])

    def after(self, step: FloatArray) -> CameraChange:
        """Return the change after a step (K,) of its first K parameters, clipped to a plausible range."""
        if not len(step):
            return self
        moved = self.values
        moved[: len(step)] += step
        return CameraChange(*np.clip(moved, -_MAX_CHANGE, _MAX_CHANGE).tolist())

    def applied_to(self, camera: Camera) -> Camera:
        """Return the changed camera; further distortion terms are kept, an ideal camera gets four."""
        factor = math.exp(self.log_focal)
        first, *others = camera.distortion or (0.0,) * 4
        return replace(
            camera,
            fx=camera.fx * factor,
            fy=camera.fy * factor,
            cx=camera.cx + self.centre_x * camera.fx,
            cy=camera.cy + self.centre_y * camera.fy,
            distortion=(first + self.k1, *others),
        )

    @staticmethod
    def between(before: Camera, after: Camera) -> CameraChange:
        """Return the change that leads from one camera to another one, as far as its parameters do."""
        return CameraChange(
            math.log(after.focal_px / before.focal_px),
            _k1(after) - _k1(before),
            (after.cx - before.cx) / before.fx,
            (after.cy - before.cy) / before.fy,
        )


NO_CHANGE = CameraChange()
"""No change."""


def _k1(camera: Camera) -> float:
    return camera.distortion[0] if camera.distortion else 0.0


@dataclass(frozen=True, slots=True, eq=False)
class CameraAnchor:
    """What is known of the camera before: each parameter counts as one more measurement."""

    mean: FloatArray
    """(K,) most probable change of (log f, k1, centre x, centre y) of the target's camera."""
    sigma: FloatArray
    """(K,) standard deviations; infinite: nothing is known."""
    unit_variance: float
    """Variance of a pose whose blocks have unit information: the scale between blocks and measurements."""

    @property
    def information(self) -> FloatArray:
        """(K,) in the unit of the blocks' information."""
        return np.asarray(self.unit_variance / self.sigma**2)


@dataclass(frozen=True, slots=True)
class RefineOptions:
    """Options of one refinement."""

    tau_px: float
    """Length of a block's own step at which its weight falls to a quarter."""
    iterations: int
    """Maximum number of Gauss-Newton steps."""
    free: int = 0
    """Number of (log f, k1, centre x, centre y) estimated with the pose."""
    damping: float = 0.0
    """Added to the diagonal entries of these."""
    anchor: CameraAnchor | None = None
    """What is known of them before; None: nothing."""


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """A picture at one level with the points of the scan that it is compared with.

    The picture is the photograph itself, or one face of a wide one.
    """

    points: ViewPoints
    """The scan's points of the level."""
    target: Target
    """The picture at that level, with its ideal camera."""
    occluder: Occluder
    """The scan's surface."""
    face_from_camera: Rigid | None = None
    """The rotation of a face; None: the photograph itself."""

    def pose(self, camera_from_scanner: Rigid) -> Rigid:
        """Return the pose of the picture at a pose of the photograph."""
        return camera_from_scanner if self.face_from_camera is None else self.face_from_camera @ camera_from_scanner

    def depth_buffer(self, camera_from_scanner: Rigid) -> FloatArray:
        """Return the scan's nearest depths in the picture at a pose of the photograph; see `Occluder`."""
        return self.occluder.depth_buffer(self.pose(camera_from_scanner))

    def seen_by(self, change: CameraChange) -> Picture:
        """Return the same picture attributed to a changed camera."""
        return replace(self, target=self.target.seen_by(change.applied_to(self.target.camera)))

    def compared(self, camera_from_scanner: Rigid, buffer: FloatArray | None = None) -> BlockComparison | None:
        """Return the blocks at a pose of the photograph; None if too little of the scan is visible."""
        pose = self.pose(camera_from_scanner)
        buffer = self.occluder.depth_buffer(pose) if buffer is None else buffer
        return compare_blocks(self.points, self.target, self.occluder, buffer, pose)

    @property
    def turn(self) -> FloatArray | None:
        """(6, 6): a step (w, t) of the photograph's camera in the frame of the face; None: they are the same."""
        return None if self.face_from_camera is None else np.kron(np.eye(2), self.face_from_camera.rotation)

    def system(self, seen: BlockComparison, options: RefineOptions) -> StepSystem:
        """Return the contribution of the picture's blocks to a step of the photograph's pose."""
        system, turn = _step_system(seen, self.target.camera, options), self.turn
        if turn is None:
            return system
        return StepSystem(turn.T @ system.H @ turn, turn.T @ system.g, system.Ju @ turn, system.Jv @ turn)

    def block_systems(self, seen: BlockComparison, options: RefineOptions) -> tuple[FloatArray, FloatArray]:
        """Return the contributions of its blocks, each by itself; see `_block_systems`."""
        H, g = _block_systems(seen, self.target.camera, options)
        turn = self.turn
        return (H, g) if turn is None else (turn.T @ H @ turn, g @ turn)


@dataclass(frozen=True, slots=True, eq=False)
class RefineResult:
    """Result of one refinement."""

    camera_from_scanner: Rigid
    """The pose."""
    change: CameraChange
    """The change of the camera."""
    correlation: float
    """Mean block correlation before the last step."""
    motion_px: float
    """Median motion of the last step, level pixels; if it is more, that by the change of the camera alone."""


def refine_pose(
    pictures: Sequence[Picture], start: Rigid, options: RefineOptions, *, change: CameraChange = NO_CHANGE
) -> RefineResult | None:
    """Refine a pose by maximising the correlation of the blocks of all pictures.

    Args:
        pictures: those of one camera, at one level: a photograph, its faces, or several photographs with one pose.
        start: initial `camera_from_scanner`.
        options: weights and number of steps; of a photograph with faces, the camera is not free.
        change: initial change of the camera relative to the target's.

    Returns:
        the refined pose, or None if too little of the scan is visible in the pictures.
    """
    pose = start
    buffers = [picture.depth_buffer(pose) for picture in pictures]
    result = None
    for iteration in range(options.iterations):
        if iteration and iteration % _REFRESH_VISIBILITY == 0:
            buffers = [picture.depth_buffer(pose) for picture in pictures]
        changed = options.free or change != NO_CHANGE
        seen_by = [picture.seen_by(change) for picture in pictures] if changed else pictures
        step = _gauss_newton_step(seen_by, buffers, pose, change, options)
        if step is None:
            return result
        delta, motion, correlation = step
        turn = rotation_from_rotvec(delta[:3])
        pose = Rigid(turn @ pose.rotation, turn @ pose.translation + delta[3:6])
        change = change.after(delta[6:])
        result = RefineResult(pose, change, correlation, motion)
        if motion < _STILL_PX:
            break
    return result


def _gauss_newton_step(
    pictures: Sequence[Picture],
    buffers: Sequence[FloatArray],
    pose: Rigid,
    change: CameraChange,
    options: RefineOptions,
) -> tuple[FloatArray, float, float] | None:
    systems, rho = [], []
    for picture, buffer in zip(pictures, buffers, strict=True):
        seen = picture.compared(pose, buffer)
        if seen is not None:
            systems.append(picture.system(seen, options))
            rho.append(seen.rho)
    if not systems:
        return None
    H, g = np.sum([system.H for system in systems], axis=0), np.sum([system.g for system in systems], axis=0)
    H[range(6, len(H)), range(6, len(H))] += options.damping
    if options.anchor is not None:
        information = options.anchor.information
        H[range(6, len(H)), range(6, len(H))] += information
        g[6:] += information * (options.anchor.mean - change.values[: options.free])
    delta = solve_step(H, g)
    if delta is None:
        return None
    motion = _median_motion_px(systems, delta)
    if motion > _MAX_MOTION_PX:
        delta *= _MAX_MOTION_PX / motion
    if options.free:  # the pose compensates most of a change of the camera, and both creep along this valley
        motion = max(motion, _median_motion_px(systems, delta[6:]))
    return delta, motion, float(np.average(np.concatenate(rho)))


def _median_motion_px(systems: Sequence[StepSystem], delta: FloatArray) -> float:
    """Return the median motion of the points by a step (P,) of the last P parameters, level pixels."""
    small, last = delta.astype(np.float32), len(delta)
    motions = [np.hypot(system.Ju[:, -last:] @ small, system.Jv[:, -last:] @ small) for system in systems]
    return float(np.median(np.concatenate(motions)))


@dataclass(frozen=True, slots=True, eq=False)
class StepSystem:
    """Normal equations of one Gauss-Newton step, of n points."""

    H: FloatArray
    """(6 + K, 6 + K) in (w, t) of X' = exp([w]x) X + t and the free intrinsics."""
    g: FloatArray
    """(6 + K,) the right-hand side."""
    Ju: FloatArray
    """(n, 6 + K) du by these parameters, level pixels."""
    Jv: FloatArray
    """(n, 6 + K) dv likewise."""


def _step_system(seen: BlockComparison, camera: Camera, options: RefineOptions) -> StepSystem:
    """Return the normal equations of a step.

    Args:
        seen: the blocks at a pose.
        camera: the level's camera.
        options: weights, and the number of free intrinsics.
    """
    blocks, count, rho = seen.blocks, seen.count, seen.rho
    size = count.astype(np.intp)

    # The sums below are products of the centred gradient with its component along B removed, without forming it.
    m_uu, m_uv, m_vv = seen.gradient_products
    Ju, Jv = _jacobian(seen.points_camera, camera, options.free)
    along_b, along_a = _along(seen, Ju, Jv)

    weight = block_weights(seen, options.tau_px)
    # Only the fraction rho of a block's signal is shared with the photo and contributes curvature; the rest of B's
    # gradient is noise, and including it would shorten every step by rho.
    curvature = weight * rho
    w = curvature.repeat(size)
    cross = (w * m_uv * Ju) @ Jv.T
    H = (w * m_uu * Ju) @ Ju.T + (w * m_vv * Jv) @ Jv.T + cross + cross.T
    # Centring of the gradient, at each block's mean Jacobian: it affects the step, not the point of convergence.
    mean_u, mean_v = blocks.sum(Ju) / count, blocks.sum(Jv) / count
    sum_u, sum_v = seen.gradient_sums
    channel_sums = mean_u[:, None] * sum_u + mean_v[:, None] * sum_v
    channel_sums *= np.sqrt(curvature / count)
    channel_sums = channel_sums.reshape(len(Ju), -1)
    H -= channel_sums @ channel_sums.T
    H -= (curvature * along_b) @ along_b.T
    g = (weight * (along_a - rho * along_b)).sum(axis=1)
    return StepSystem(H.astype(np.float64), g.astype(np.float64), Ju.T, Jv.T)


def _along(seen: BlockComparison, Ju: FloatArray, Jv: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the derivatives (P, b) of each block's signal along the photo's channels, and along the scan's."""
    return seen.blocks.sum(seen.b_u * Ju + seen.b_v * Jv), seen.blocks.sum(seen.a_u * Ju + seen.a_v * Jv)


def solve_step(H: FloatArray, g: FloatArray) -> FloatArray | None:
    """Return the step that solves the normal equations H (P, P) and g (P,), or None if they are singular."""
    # the projection may leave diagonal entries of rounding error only, of either sign
    scale = np.sqrt(np.maximum(np.diag(H), 0)) + 1e-12
    try:
        return np.asarray(np.linalg.solve(H / np.outer(scale, scale) + 1e-6 * np.eye(len(H)), g / scale) / scale)
    except np.linalg.LinAlgError:
        return None


def _block_systems(seen: BlockComparison, camera: Camera, options: RefineOptions) -> tuple[FloatArray, FloatArray]:
    """Return the contribution of each block to a Gauss-Newton step.

    Args:
        seen: the b blocks at a pose.
        camera: the level's camera at that pose.
        options: those of the refinement that ended at the pose.

    Returns:
        H (b, 6 + K, 6 + K) and g (b, 6 + K), in (w, t) of X' = exp([w]x) X + t and the free intrinsics. H uses each
        block's mean motion, which is sufficient for the jackknife over regions.
    """
    Ju, Jv = _jacobian(seen.points_camera, camera, options.free)
    weight = block_weights(seen, options.tau_px)
    along_b, along_a = _along(seen, Ju, Jv)
    g = (weight * (along_a - seen.rho * along_b)).T
    curvature = (weight * seen.rho).astype(np.float64)
    uu, uv, vv, _, _ = (value.astype(np.float64) for value in seen.normal_equations)
    mean_u, mean_v = ((seen.blocks.sum(J) / seen.count).T.astype(np.float64) for J in (Ju, Jv))
    outer_uv = mean_u[:, :, None] * mean_v[:, None]
    H = uu[:, None, None] * (mean_u[:, :, None] * mean_u[:, None]) + vv[:, None, None] * (
        mean_v[:, :, None] * mean_v[:, None]
    )
    H += uv[:, None, None] * (outer_uv + np.swapaxes(outer_uv, 1, 2))
    return np.asarray(curvature[:, None, None] * H), np.asarray(g, np.float64)


def block_weights(seen: BlockComparison, tau_px: float) -> FloatArray:
    """Return the weights (b,) of blocks in a refinement; `tau_px` as in `RefineOptions`."""
    return np.asarray(seen.rho**2 / (1 + (_block_steps(seen) / tau_px) ** 2) ** 2)


def _block_steps(seen: BlockComparison) -> FloatArray:
    """Return the length of each block's own Lucas-Kanade step (B,), level pixels."""
    uu, uv, vv, right_u, right_v = seen.normal_equations
    # A straight edge does not constrain motion along itself: the damping prevents a long step in that direction.
    det = uu * vv - uv * uv + 1e-3 * (uu + vv) ** 2 + 1e-12
    return np.hypot((vv * right_u - uv * right_v) / det, (uu * right_v - uv * right_u) / det)


def _jacobian(points_camera: FloatArray, camera: Camera, free: int) -> tuple[FloatArray, FloatArray]:
    """Return du / d (w, t, log f, k1, centre) and dv, each (6 + free, n) float32, for X' = exp([w]x) X + t."""
    x, y, z = points_camera[:, 0], points_camera[:, 1], points_camera[:, 2]
    inverse, zero = 1 / z, np.zeros_like(z)
    a, b = x * inverse, y * inverse
    Ja = np.stack([-a * b, 1 + a * a, -b, inverse, zero, -a * inverse])
    Jb = np.stack([-1 - b * b, a * b, a, zero, inverse, -b * inverse])
    s = a * a + b * b
    radial = np.ones_like(a)
    if camera.distortion:
        k1 = np.float32(camera.distortion[0])
        radial = 1 + k1 * s
        aa, ab, bb = radial + 2 * k1 * a * a, 2 * k1 * a * b, radial + 2 * k1 * b * b
        Ja, Jb = aa * Ja + ab * Jb, ab * Ja + bb * Jb
    if free:
        one = np.ones_like(a)
        Ja = np.concatenate([Ja, np.stack([a * radial, a * s, one, zero])[:free]])
        Jb = np.concatenate([Jb, np.stack([b * radial, b * s, zero, one])[:free]])
    return Ja * np.float32(camera.fx), Jb * np.float32(camera.fy)
