"""Covariance of stations by the scatter of what they share: surfaces vote as blocks of the room, not as points.

Neighbouring points of a surface err together (it is not quite flat, its noise depends on its print), so that their
number says too much. The scatter of whole blocks about the solution says what the points together are worth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.arrays import FloatArray, IntArray
from ladarreg_core.frames import Rigid
from ladarreg_core.range_alignment.adjustment import RangeView, planes_of
from ladarreg_core.range_alignment.voxel_planes import LEAST_ACROSS, SharedPlanes

_HUBER = 1.5
_MAD = 1.4826
_LEAST_SIGMA_M = 2e-4
_FEW = 20
_STEPS = 3
_APART_M, _ANGLE_RAD = 0.015, float(np.radians(2.0))
_UNHELD = 1e-9  # of the largest eigenvalue
_NOTHING_M2 = 1e6
_LEAST_SHARE = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Polished:
    """Poses by the surfaces that stations share, with their uncertainty."""

    poses: tuple[Rigid, ...]
    """`world_from_scan` of each view."""
    covariance: NDArray[np.float64]
    """(6 V, 6 V) of the errors (w, t): w in rad about the world's origin, t in m; zero for the fixed view."""
    planes: int
    """Shared planes that it rests on."""
    noise_m: float
    """Typical range noise that the planes show."""


def polish(views: Sequence[RangeView], poses: Sequence[Rigid], *, fixed: int) -> Polished:
    """Return poses to the last digit, from poses that are within a few millimetres, and their covariance.

    Each patch of a plane has the noise that it shows: dark, far or grazing surfaces count less.

    Args:
        views: the views; their priors are not used.
        poses: their poses.
        fixed: index of the view that does not move.
    """
    poses = list(poses)
    free = np.r_[0 : 6 * fixed, 6 * fixed + 6 : 6 * len(views)]
    for step in range(_STEPS + 1):
        found, owner = planes_of(views, poses, apart_m=_APART_M, angle_rad=_ANGLE_RAD)
        information, score, noise = _equations(views, poses, found, owner)
        H, G = information[np.ix_(free, free)], score[:, free]
        scale = 1 / np.sqrt(np.maximum(np.diag(H), 1e-12))
        values, axes = np.linalg.eigh(H * scale[:, None] * scale)
        held = values > _UNHELD
        bread = scale[:, None] * (axes * np.where(held, 1 / np.maximum(values, _UNHELD), 0.0)) @ axes.T * scale
        if step == _STEPS:
            break
        moves = np.zeros(6 * len(views))
        moves[free] = -bread @ G.sum(0)
        poses = [Rigid.from_rotvec(m[:3], m[3:]) @ pose for m, pose in zip(moves.reshape(-1, 6), poses, strict=True)]
    covariance = np.zeros_like(information)
    lost = (scale[:, None] * axes * np.where(held, 0.0, _NOTHING_M2)) @ axes.T * scale
    covariance[np.ix_(free, free)] = _scattered(bread, G) + lost
    return Polished(tuple(poses), covariance, found.count, noise)


def _scattered(bread: FloatArray, score: FloatArray) -> NDArray[np.float64]:
    """Return the covariance by the scatter of the blocks; where they are few, at least by that of all directions.

    Source: White 1980 (the sandwich), with blocks of the room as clusters.
    """
    blocks = int(np.count_nonzero(np.abs(score).sum(-1)))
    meat = score.T @ score * (blocks / max(blocks - score.shape[1], 1))
    values, axes = np.linalg.eigh(bread)
    root = (axes * np.sqrt(np.maximum(values, 0))) @ axes.T
    share, turn = np.linalg.eigh(root @ meat @ root)
    known = share[values > 0] if len(share) else share
    least = _LEAST_SHARE * float(np.mean(known)) if len(known) else 1.0
    return np.asarray(root @ (turn * np.maximum(share, least)) @ turn.T @ root)


def _equations(
    views: Sequence[RangeView], poses: Sequence[Rigid], found: SharedPlanes, owner: IntArray
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Return information (6 V, 6 V), the score (B, 6 V) of each block, the planes eliminated, and the noise, m."""
    if not found.count:
        return np.zeros((6 * len(views),) * 2), np.zeros((1, 6 * len(views))), float("nan")
    count = len(views)
    local = [np.asarray(view.points, np.float64) for view in views]
    world = np.concatenate([pose @ p for pose, p in zip(poses, local, strict=True)])[found.point]
    centre = np.stack([pose.translation for pose in poses])[owner[found.point]]
    rays = world - centre
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    n, plane = found.normals[found.plane], found.plane
    helper = np.where(np.abs(n[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    u = np.cross(helper, n)
    u /= np.linalg.norm(u, axis=-1, keepdims=True)
    v = np.cross(n, u)
    off = world - found.centres[plane]
    r = (off * n).sum(-1)
    spread2 = (rays * n).sum(-1) ** 2 + LEAST_ACROSS**2
    own = np.stack([np.ones(len(r)), (off * u).sum(-1), (off * v).sum(-1)], axis=-1)
    group = plane * count + owner[found.point]
    names, group = np.unique(group, return_inverse=True)
    of_plane, of_view = names // count, names % count
    left = r - _fitted(own, r, 1 / spread2, plane, found.count)
    noise = _noise(left / np.sqrt(spread2), group, len(names))
    noise2 = spread2 * noise[group] ** 2
    scaled = np.abs(left) / np.sqrt(noise2)
    weight = np.minimum(1.0, _HUBER / np.maximum(scaled, 1e-12)) / noise2
    left = r - _fitted(own, r, weight, plane, found.count)
    # What of each view's motion the plane's own three unknowns do not absorb.
    a = np.concatenate([np.cross(world, n), n], axis=-1)
    # What is cut off by the robust weight answers to no motion: it is noise to the score, and nothing to the curvature.
    curved = np.where(scaled < _HUBER, 1 / noise2, 0.0)
    A = _sums(a, a, curved, group, len(names))
    C = _sums(a, own, curved, group, len(names))
    D = np.linalg.inv(_regular(_sums(own, own, curved, plane, found.count)))
    score_of = np.stack([np.bincount(group, weight * left * a[:, k], len(names)) for k in range(6)], axis=-1)
    H = np.zeros((count, count, 6, 6))
    np.add.at(H, (of_view, of_view), A)
    per_plane = np.bincount(of_plane, minlength=found.count)
    begin = np.cumsum(per_plane) - per_plane
    for i in range(count):
        for j in range(count):
            first, second = begin + i, begin + j
            pick = (i < per_plane) & (j < per_plane)
            g, h = first[pick], second[pick]
            np.add.at(H, (of_view[g], of_view[h]), -C[g] @ D[pick] @ C[h].transpose(0, 2, 1))
    _, block = np.unique(found.centres.round().astype(np.int64), axis=0, return_inverse=True)
    score = np.zeros((int(block.max(initial=-1)) + 1, count, 6))
    np.add.at(score, (block.ravel()[of_plane], of_view), score_of)
    information = H.transpose(0, 2, 1, 3).reshape(6 * count, 6 * count)
    return information, score.reshape(len(score), 6 * count), float(np.median(noise))


def _noise(scaled: FloatArray, group: IntArray, groups: int) -> NDArray[np.float64]:
    """Return the range noise (G,) of each patch, by its median, drawn to that of all where it has few points."""
    size = np.abs(scaled)
    typical = max(_MAD * float(np.median(size)), _LEAST_SIGMA_M) if len(size) else _LEAST_SIGMA_M
    order = np.lexsort((size, group))
    count = np.bincount(group, minlength=groups)
    middle = (np.cumsum(count) - count) + count // 2
    own = _MAD * size[order[np.minimum(middle, len(size) - 1)]]
    return np.asarray(np.sqrt((count * own**2 + _FEW * typical**2) / (count + _FEW)))


def _sums(one: FloatArray, other: FloatArray, weight: FloatArray, group: IntArray, groups: int) -> NDArray[np.float64]:
    """Return the weighted sums (G, i, j) of the products of two sets of columns."""
    out = np.empty((groups, one.shape[1], other.shape[1]))
    for i in range(one.shape[1]):
        weighted = weight * one[:, i]
        for j in range(other.shape[1]):
            out[:, i, j] = np.bincount(group, weighted * other[:, j], groups)
    return out


def _regular(D: NDArray[np.float64]) -> NDArray[np.float64]:
    D[:, range(3), range(3)] += 1e-9 * np.trace(D, axis1=1, axis2=2)[:, None]
    return D


def _fitted(own: FloatArray, value: FloatArray, weight: FloatArray, plane: IntArray, planes: int) -> FloatArray:
    """Return the values (M,) of the plane that each point's plane fits."""
    D = _regular(_sums(own, own, weight, plane, planes))
    e = _sums(own, value[:, None], weight, plane, planes)
    return np.asarray((own * np.linalg.solve(D, e)[..., 0][plane]).sum(-1))
