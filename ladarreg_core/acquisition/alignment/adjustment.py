"""Joint adjustment of the poses of several scans by the planes that they share: all at once, the planes unknown, too.

Each plane has an offset and two inclinations of its own, which are eliminated (a Schur complement), so that only the
disagreement of several views of it moves a pose. What the planes do not determine is held by the prior of the poses,
such as the angles of a pan/tilt unit. A residual and its derivatives are linear in a point, so that each view of a
plane enters through the second moments of its points.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.acquisition.alignment.voxel_planes import (
    MIN_ACROSS,
    VOXELS_M,
    SharedPlanes,
    dots,
    plane_moments,
    shared_planes,
)
from ladarreg_core.foundations.arrays import BoolArray, FloatArray, IntArray
from ladarreg_core.foundations.progress import Progress, Report
from ladarreg_core.frames import Rigid, rotation_from_rotvec, rotvec_from_rotation, skew

GATES: tuple[tuple[float, float], ...] = ((0.1, 6.0), (0.05, 4.0), (0.025, 2.5), (0.015, 2.0), (0.015, 2.0))
"""Distance (m) and angle (deg) within which two views' patches are one plane, in turn."""

_HUBER = 1.5
_MAD = 1.4826
_MIN_SIGMA_M = 2e-4
_STEPS_A_GATE = 3
_TILE_M = 0.1  # side of the tiles in which a plane may be uneven
_COARSE = ((0.05, 120_000), (0.025, 240_000))
"""At gates at least so wide, m, about so many points of all views are enough: poses still move by far more."""


@dataclass(frozen=True, slots=True, eq=False)
class RangeView:
    """Points that one scan shares with others."""

    points: FloatArray
    """(N, 3) m, in the scan's own frame."""
    world_from_scan: Rigid
    """Its pose, as far as it is known."""
    information: FloatArray
    """(6, 6) inverse covariance of that pose's error (w, t): rotation (rad) about the world's origin, then shift (m).
    Zero: nothing is known."""


@dataclass(frozen=True, slots=True, eq=False)
class Adjustment:
    """Adjusted poses, and what they rest on."""

    poses: tuple[Rigid, ...]
    """`world_from_scan` of each view."""
    covariance: NDArray[np.float64]
    """(6 V, 6 V) of the errors (w, t) of all views, with their priors."""
    moved: NDArray[np.float64]
    """(V, 6) how far each view's pose is from where its prior has it, less what the common parameters did."""
    data: NDArray[np.float64]
    """(6 V, 6 V) information of the planes and of what else was given, without the priors."""
    planes_data: NDArray[np.float64]
    """(6 V, 6 V) information of the planes alone."""
    common: FloatArray | None
    """(C,) common parameters, if there are any."""
    common_covariance: NDArray[np.float64] | None
    """(C, C)."""
    points: IntArray
    """(V,) points of each view that lie on shared planes."""
    planes: int
    """Planes that were used."""
    sigma_m: float
    """Range noise that the residuals show."""


@dataclass(frozen=True, slots=True, eq=False)
class Common:
    """Parameters that move all views, such as an error of the mount."""

    moves: Callable[[Sequence[Rigid]], NDArray[np.float64]]
    """The (V, 6, C) derivatives of the views' (w, t) at their poses."""
    information: FloatArray
    """(C, C) prior."""


def adjust(
    views: Sequence[RangeView],
    *,
    common: Common | None = None,
    use_blocks: Callable[[IntArray], BoolArray] | None = None,
    more: Callable[[Sequence[Rigid], int], tuple[FloatArray, FloatArray]] | None = None,
    gates: Sequence[tuple[float, float]] = GATES,
    start: Adjustment | None = None,
    steps: int = _STEPS_A_GATE,
    voxels_m: Sequence[float] = VOXELS_M,
    report: Report | None = None,
) -> Adjustment:
    """Adjust the poses of all views by the planes that they share.

    Args:
        views: the views.
        common: parameters that all views share.
        use_blocks: chooses planes by their `SharedPlanes.block`; None: all of them.
        more: returns further information (6 V, 6 V) and its gradient (6 V,), such as that of intensities, at some
            poses and with the number of the gate.
        gates: as `GATES`.
        start: an earlier adjustment of the same views, to begin with its result; by the first of the common parameters.
        steps: at each gate.
        voxels_m: sides of the voxels that planes are looked for in.
        report: receives the progress; may raise `Cancelled`.

    Source: planes eliminated as in bundle adjustment; Triggs et al. 2000, section 6.1.
    """
    count, extra = len(views), 0 if common is None else len(common.information)
    poses = [view.world_from_scan for view in views] if start is None else list(start.poses)
    moved = np.zeros((count, 6)) if start is None else start.moved.copy()
    shared = np.zeros(extra)
    if start is not None and start.common is not None:
        shared[: len(start.common)] = start.common
    prior = np.zeros((6 * count, 6 * count))
    for k, view in enumerate(views):
        prior[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] = view.information
    done, total = 0, len(gates) * steps
    equations = _Equations.none(count)
    of_planes = equations.information
    jacobian = np.zeros((6 * count, extra))
    for stage, (apart, angle) in enumerate(gates):
        cloud = _Cloud.of(views, every=_stride(views, apart))
        owner = cloud.owner
        world, rays = cloud.at(poses)
        found = shared_planes(
            world, rays, owner, farthest_apart_m=apart, largest_angle_rad=float(np.radians(angle)), voxels_m=voxels_m
        )
        if use_blocks is not None:
            found = found.select(use_blocks(found.block))
        groups = _Groups.of(found, owner, count)
        relief = _relief(found, groups, world)
        for _ in range(steps):
            if report is not None:
                report(Progress(done, total, "aligning the pieces"))
            done += 1
            equations = _equations(found, groups, world, rays, count, relief)
            of_planes = equations.information
            if more is not None:
                added, slope = more(poses, stage)
                equations = replace(
                    equations, information=equations.information + added, gradient=equations.gradient + slope
                )
            if common is not None:
                jacobian = common.moves(poses).reshape(6 * count, extra)
            step, again = _solved(equations, prior, moved.ravel(), jacobian, common, shared)
            turned = (step + jacobian @ again).reshape(count, 6)
            poses = [_moved(pose, one) for pose, one in zip(poses, turned, strict=True)]
            moved += step.reshape(count, 6)
            shared = np.asarray(shared + again, np.float64)
            world, rays = cloud.at(poses)
    full = _system(equations, prior, jacobian, common)
    covariance = np.asarray(np.linalg.pinv(full, hermitian=True), np.float64)
    spread = np.hstack([np.eye(6 * count), jacobian])
    used = np.bincount(owner[found.point], minlength=count)
    return Adjustment(
        tuple(poses), spread @ covariance @ spread.T, moved, equations.information, of_planes,
        np.asarray(shared, np.float64) if extra else None, covariance[6 * count :, 6 * count :] if extra else None,
        used, found.count, equations.sigma_m,
    )  # fmt: skip


def off_planes(
    views: Sequence[RangeView],
    poses: Sequence[Rigid],
    found: SharedPlanes,
    owner: IntArray,
    *,
    within_views: bool = False,
) -> NDArray[np.float64]:
    """Return the distances (M,) of points from the planes fitted to all views of each.

    Args:
        views: the views.
        poses: `world_from_scan` of each.
        found: the planes and their points.
        owner: (N,) view of each point.
        within_views: fit a plane to each view alone instead: the noise that no pose can remove.
    """
    world, _ = _Cloud.of(views).at(poses)
    group = found.plane * len(views) + owner[found.point] if within_views else found.plane
    names, group = np.unique(group, return_inverse=True)
    _, centre, normal, _ = plane_moments(world[found.point], group, len(names))
    return dots(world[found.point] - centre[group], normal[group])


def planes_of(
    views: Sequence[RangeView], poses: Sequence[Rigid], *, apart_m: float, angle_rad: float,
    voxels_m: Sequence[float] = VOXELS_M,
) -> tuple[SharedPlanes, IntArray]:  # fmt: skip
    """Return the planes that views at some poses share, and the view (N,) of each point."""
    cloud = _Cloud.of(views)
    world, rays = cloud.at(poses)
    found = shared_planes(
        world, rays, cloud.owner, farthest_apart_m=apart_m, largest_angle_rad=angle_rad, voxels_m=voxels_m
    )
    return found, cloud.owner


def _stride(views: Sequence[RangeView], apart_m: float) -> int:
    """Return n where every n-th point is used at a gate."""
    points = sum(len(view.points) for view in views)
    enough = next((most for least_m, most in _COARSE if apart_m >= least_m), points)
    return max(1, points // max(enough, 1))


@dataclass(frozen=True, slots=True, eq=False)
class _Cloud:
    """The points of all views, each in its own frame."""

    points: tuple[NDArray[np.float64], ...]
    """(N, 3) m of each view."""
    rays: tuple[NDArray[np.float64], ...]
    """(N, 3) unit, along which they were measured."""
    owner: IntArray
    """(M,) view of each point of all."""

    @staticmethod
    def of(views: Sequence[RangeView], *, every: int = 1) -> _Cloud:
        points = tuple(np.asarray(view.points[::every], np.float64) for view in views)
        rays = tuple(each / np.sqrt(dots(each, each))[:, None] for each in points)
        return _Cloud(points, rays, np.repeat(np.arange(len(views)), [len(each) for each in points]))

    def at(self, poses: Sequence[Rigid]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the points (M, 3) in the world, and the unit rays along which they were measured."""
        points = [pose @ each for pose, each in zip(poses, self.points, strict=True)]
        rays = [each @ pose.rotation.T for pose, each in zip(poses, self.rays, strict=True)]
        return np.concatenate(points), np.concatenate(rays)


@dataclass(frozen=True, slots=True, eq=False)
class _Groups:
    """The points of each plane that one view sees: a group."""

    group: IntArray
    """(M,) of each point on a plane."""
    plane: IntArray
    """(G,)"""
    view: IntArray
    """(G,)"""

    @staticmethod
    def of(found: SharedPlanes, owner: IntArray, views: int) -> _Groups:
        names, group = np.unique(found.plane * views + owner[found.point], return_inverse=True)
        return _Groups(group, names // views, names % views)


@dataclass(frozen=True, slots=True, eq=False)
class _Equations:
    """Normal equations of the poses, the planes eliminated, in units of the noise."""

    information: NDArray[np.float64]
    gradient: NDArray[np.float64]
    sigma_m: float

    @staticmethod
    def none(views: int) -> _Equations:
        return _Equations(np.zeros((6 * views, 6 * views)), np.zeros(6 * views), _MIN_SIGMA_M)


def _equations(
    found: SharedPlanes,
    groups: _Groups,
    world: FloatArray,
    rays: FloatArray,
    views: int,
    relief: FloatArray,
) -> _Equations:
    """Return the normal equations of the planes.

    Args:
        found: the planes.
        groups: what each view sees of them.
        world: (N, 3) m, points of all views.
        rays: (N, 3) their directions.
        views: V.
        relief: (G,) as `_relief` returns it.
    """
    if not found.count:
        return _Equations.none(views)
    point, plane = found.point, found.plane
    normal, centre = found.normals, found.centres
    off = world[point] - centre[plane]
    u, v = _along(normal)
    facing = normal[plane]
    across = dots(rays[point], facing)
    spread = np.sqrt(across**2 + MIN_ACROSS**2)
    # Robust weights from what is left when each plane has fitted itself.
    left = dots(off, facing)
    left -= _own_fit(plane, found.count, left, dots(off, u[plane]), dots(off, v[plane]))
    scaled = left / spread
    sigma = max(_MAD * float(np.median(np.abs(scaled))), _MIN_SIGMA_M)
    weight = np.minimum(1.0, _HUBER * sigma / np.maximum(np.abs(scaled), 1e-12)) / spread**2
    # The residual, its derivatives and the plane's own unknowns are linear in (q, 1), q from the plane's centre.
    of_plane, of_view, count = groups.plane, groups.view, len(groups.plane)
    S = _second_moments(off, weight, groups.group, count)
    S /= (1 + S[:, 3, 3] * relief / sigma**2)[:, None, None]
    A = np.zeros((count, 6, 4))
    n, c = normal[of_plane], centre[of_plane]
    for axis in range(3):
        A[:, :3, axis] = np.cross(np.eye(3)[axis], n)
        A[:, 3:, 3] = n
    A[:, :3, 3] = np.cross(c, n)
    B = np.zeros((count, 3, 4))
    B[:, 0, 3] = 1
    B[:, 1, :3], B[:, 2, :3] = u[of_plane], v[of_plane]
    nu = np.concatenate([n, np.zeros((count, 1))], axis=-1)
    AS, BS = A @ S, B @ S
    H, C = AS @ A.transpose(0, 2, 1), AS @ B.transpose(0, 2, 1)
    g, h = (AS @ nu[..., None])[..., 0], (BS @ nu[..., None])[..., 0]
    D = np.zeros((found.count, 3, 3))
    np.add.at(D, of_plane, BS @ B.transpose(0, 2, 1))
    e = np.zeros((found.count, 3))
    np.add.at(e, of_plane, h)
    D[:, range(3), range(3)] += 1e-12 * (1 + np.abs(D).max(axis=(1, 2)))[:, None]
    inverse = np.linalg.inv(D)
    blocks = np.zeros((views, views, 6, 6))
    np.add.at(blocks, (of_view, of_view), H)
    gradient = np.zeros((views, 6))
    np.add.at(gradient, of_view, g - np.einsum("gij,gjk,gk->gi", C, inverse[of_plane], e[of_plane]))
    first, second = _pairs(of_plane)
    np.add.at(
        blocks, (of_view[first], of_view[second]),
        -np.einsum("gij,gjk,glk->gil", C[first], inverse[of_plane[first]], C[second]),
    )  # fmt: skip
    information = blocks.transpose(0, 2, 1, 3).reshape(6 * views, 6 * views)
    # Residuals of one plane are correlated where it is not quite flat: what the views of each scatter by counts.
    inflated = _scatter(S, nu, B, inverse, e, of_plane, sigma)
    return _Equations(information / inflated, gradient.ravel() / inflated, sigma)


def _scatter(
    S: FloatArray, nu: FloatArray, B: FloatArray, inverse: FloatArray, e: FloatArray, of_plane: IntArray, sigma: float
) -> float:
    """Return the variance of a residual that explains how far the views of a plane are from it as a whole."""
    weight = S[:, 3, 3]
    fit = np.einsum("gij,gj->gi", inverse[of_plane], e[of_plane])
    left = nu - np.einsum("gij,gi->gj", B, fit)
    mean = np.einsum("gj,gj->g", left, S[:, :, 3]) / np.maximum(weight, 1e-12)
    typical = float(np.median(mean**2 * weight)) / 0.2275  # the median of half a chi^2, two views sharing a mean
    return max(sigma**2, typical)


def _along(normal: FloatArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return two unit vectors (K, 3) along each plane."""
    helper = np.where(np.abs(normal[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    u = np.cross(helper, normal)
    u /= np.linalg.norm(u, axis=-1, keepdims=True)
    return np.asarray(u), np.asarray(np.cross(normal, u))


def _relief(found: SharedPlanes, groups: _Groups, world: FloatArray) -> NDArray[np.float64]:
    """Return the variance (G,), m^2, of how far each view's part of a plane is from the whole because it is not flat.

    Views see different parts, and however many points they have, none shows the plane better than its panels and
    ledges let it. Relief is what the means of small tiles scatter by beyond the noise of their points.
    """
    if not found.count:
        return np.zeros(0)
    point, plane = found.point, found.plane
    group, count = groups.group, len(groups.plane)
    u, v = _along(found.normals)
    off = world[point] - found.centres[plane]
    value, along_u, along_v = (dots(off, axis[plane]) for axis in (found.normals, u, v))
    value = value - _own_fit(group, count, value, along_u, along_v)
    code = (group * 4096 + np.floor(along_u / _TILE_M).astype(np.int64) + 2048) * 4096
    code += np.floor(along_v / _TILE_M).astype(np.int64) + 2048
    _, first, tile_of, sizes = np.unique(code, return_index=True, return_inverse=True, return_counts=True)
    mean = np.bincount(tile_of, value) / sizes
    within = np.maximum(np.bincount(tile_of, value**2) - sizes * mean**2, 0)
    owner_of_tile = group[first]
    tiles = np.bincount(owner_of_tile, minlength=count)
    points = np.bincount(owner_of_tile, sizes, count)
    noise = np.bincount(owner_of_tile, within, count) / np.maximum(points - tiles, 1)
    between = np.bincount(owner_of_tile, sizes * mean**2, count)
    relief = np.maximum(between - np.maximum(tiles - 3, 0) * noise, 0) / np.maximum(points, 1)
    return np.asarray(relief / np.maximum(tiles, 1))


def _own_fit(
    plane: IntArray, planes: int, value: FloatArray, along_u: FloatArray, along_v: FloatArray
) -> NDArray[np.float64]:
    """Return what a plane fitted to each group, by an offset and two inclinations, explains of each point's value."""
    own = (np.ones(len(plane)), along_u, along_v)
    D, e = np.empty((planes, 3, 3)), np.empty((planes, 3))
    for i in range(3):
        e[:, i] = np.bincount(plane, own[i] * value, planes)
        for j in range(i, 3):
            D[:, i, j] = D[:, j, i] = np.bincount(plane, own[i] * own[j], planes)
    D[:, range(3), range(3)] += 1e-12 * (1 + np.abs(D).max(axis=(1, 2)))[:, None]
    fit = np.linalg.solve(D, e[..., None])[..., 0][plane]
    return np.asarray(fit[:, 0] + fit[:, 1] * along_u + fit[:, 2] * along_v)


def _second_moments(off: FloatArray, weight: FloatArray, group: IntArray, groups: int) -> NDArray[np.float64]:
    """Return the weighted sums (G, 4, 4) of (q, 1)(q, 1)^T."""
    x, y, z = np.ascontiguousarray(off.T)
    q = (x, y, z, None)
    out = np.empty((groups, 4, 4))
    for i in range(4):
        first = q[i]
        weighted = weight if first is None else weight * first
        for j in range(i, 4):
            second = q[j]
            product = weighted if second is None else weighted * second
            out[:, i, j] = out[:, j, i] = np.bincount(group, product, groups)
    return out


def _pairs(of_plane: IntArray) -> tuple[IntArray, IntArray]:
    """Return all ordered pairs of entries with the same plane; entries are sorted by plane."""
    count = np.bincount(of_plane)
    first = np.repeat(np.arange(len(of_plane)), count[of_plane])
    begin = np.cumsum(count) - count
    within = np.arange(len(first)) - np.repeat(np.cumsum(count[of_plane]) - count[of_plane], count[of_plane])
    return first, begin[of_plane[first]] + within


def _system(
    equations: _Equations, prior: FloatArray, jacobian: FloatArray, common: Common | None
) -> NDArray[np.float64]:
    """Return the information matrix of the views' own moves and the common parameters."""
    own = equations.information + prior
    if common is None:
        return np.asarray(own)
    mixed = equations.information @ jacobian
    return np.block([[own, mixed], [mixed.T, jacobian.T @ mixed + common.information]])


def _solved(
    equations: _Equations,
    prior: FloatArray,
    moved: FloatArray,
    jacobian: FloatArray,
    common: Common | None,
    shared: FloatArray,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the step of Gauss and Newton: of the views (6 V,) and of the common parameters (C,)."""
    gradient = equations.gradient + prior @ moved
    if common is not None:
        gradient = np.concatenate([gradient, jacobian.T @ equations.gradient + common.information @ shared])
    full = _system(equations, prior, jacobian, common)
    scale = 1 / np.sqrt(np.maximum(np.diag(full), 1e-12))
    step = -scale * np.linalg.lstsq(full * scale[:, None] * scale, scale * gradient, rcond=1e-13)[0]
    return step[: len(moved)], step[len(moved) :]


def _moved(pose: Rigid, step: FloatArray) -> Rigid:
    turn = rotation_from_rotvec(step[:3])
    return Rigid(turn @ pose.rotation, turn @ pose.translation + step[3:])


def move_between(before: Rigid, after: Rigid) -> NDArray[np.float64]:
    """Return (w, t), (6,): the rotation (rad) about the world's origin and the shift (m) from one pose to another."""
    turn = after.rotation @ before.rotation.T
    return np.concatenate([rotvec_from_rotation(turn), after.translation - turn @ before.translation])


def adjoint(pose: Rigid) -> NDArray[np.float64]:
    """Return the (6, 6) matrix from a small move (w, t) in a scan's own frame to that in the world."""
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = pose.rotation
    out[3:, :3] = skew(pose.translation) @ pose.rotation
    return out
