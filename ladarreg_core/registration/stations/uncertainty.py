"""Covariance of stations by the scatter of what they share: surfaces vote as blocks of the room, not as points.

Neighbouring points of a surface err together (it is not quite flat, its noise depends on its print), so that their
number says too much. The scatter of whole blocks about the solution says what the points together are worth.

A direction often rests on a dozen of the blocks only, the few walls that face it. Two things follow. Such blocks pull
the solution toward themselves, and scatter too little about it: each counts as far as it is from the solution without
it. And what a dozen scatter by is itself known to a third only: half of it counts, the other half is what the curvature
says, by the scatter of all directions together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.acquisition.alignment.adjustment import RangeView, planes_of
from ladarreg_core.acquisition.alignment.voxel_planes import MIN_ACROSS, VOXELS_M, SharedPlanes
from ladarreg_core.foundations.arrays import FloatArray, IntArray
from ladarreg_core.frames import Rigid

_HUBER = 1.5
_MAD = 1.4826
_MIN_SIGMA_M = 2e-4
_FEW = 20
_STEPS = 3
_APART_M, _ANGLE_RAD = 0.015, float(np.radians(2.0))
_UNHELD = 1e-9  # of the largest eigenvalue
_NOTHING_M2 = 1e6
_NO_VALUE = 1e-14  # of the largest: a direction that the surfaces do not hold
_ALONE = 1e-6  # of the largest: what a block determines alone has no solution without it
_OWN_SHARE = 0.5
"""How much a direction's own scatter counts, beside that of all directions. Over 30 pairs and 10 loops of simulated
rooms, .25 and .5 state what errors are, 1 states a sixteenth too little for pairs."""


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


def polish(
    views: Sequence[RangeView], poses: Sequence[Rigid], *, fixed: int, voxels_m: Sequence[float] = VOXELS_M
) -> Polished:
    """Return poses to the last digit, from poses that are within a few millimetres, and their covariance.

    Each patch of a plane has the noise that it shows: dark, far or grazing surfaces count less.

    Args:
        views: the views; their priors are not used.
        poses: their poses.
        fixed: index of the view that does not move.
        voxels_m: sides of the voxels that planes are looked for in.
    """
    poses = list(poses)
    free = np.r_[0 : 6 * fixed, 6 * fixed + 6 : 6 * len(views)]
    for step in range(_STEPS + 1):
        found, owner = planes_of(views, poses, apart_m=_APART_M, angle_rad=_ANGLE_RAD, voxels_m=voxels_m)
        equations = _equations(views, poses, found, owner)
        H, G = equations.information[np.ix_(free, free)], equations.score[:, free]
        scale = 1 / np.sqrt(np.maximum(np.diag(H), 1e-12))
        values, axes = np.linalg.eigh(H * scale[:, None] * scale)
        held = values > _UNHELD
        bread = scale[:, None] * (axes * np.where(held, 1 / np.maximum(values, _UNHELD), 0.0)) @ axes.T * scale
        if step == _STEPS:
            break
        moves = np.zeros(6 * len(views))
        moves[free] = -bread @ G.sum(0)
        poses = [Rigid.from_rotvec(m[:3], m[3:]) @ pose for m, pose in zip(moves.reshape(-1, 6), poses, strict=True)]
    covariance = np.zeros_like(equations.information)
    lost = (scale[:, None] * axes * np.where(held, 0.0, _NOTHING_M2)) @ axes.T * scale
    inverse = np.zeros_like(covariance)
    inverse[np.ix_(free, free)] = bread
    covariance[np.ix_(free, free)] = _scattered(bread, _without_themselves(equations, inverse)[:, free]) + lost
    return Polished(tuple(poses), covariance, found.count, equations.noise_m)


@dataclass(frozen=True, slots=True, eq=False)
class _Equations:
    """Normal equations of the poses, the planes eliminated, and what each block of the room contributes."""

    information: NDArray[np.float64]
    """(6 V, 6 V)."""
    score: NDArray[np.float64]
    """(B, 6 V) of each block."""
    block: IntArray
    """(P,) block of each part of the information, rising."""
    one: IntArray
    """(P,) view of its rows."""
    other: IntArray
    """(P,) view of its columns."""
    parts: NDArray[np.float64]
    """(P, 6, 6)."""
    noise_m: float
    """Typical range noise."""


def _scattered(bread: FloatArray, score: FloatArray) -> NDArray[np.float64]:
    """Return the covariance by the scatter of the blocks: half by that of each direction, half by that of all.

    Source: White 1980 (the sandwich), with blocks of the room as clusters.
    """
    values, axes = np.linalg.eigh(bread)
    known = values > _NO_VALUE * values[-1] if len(values) else np.zeros(0, np.bool_)
    if not known.any() or not score.any():
        return np.asarray(bread)
    root = axes[:, known] * np.sqrt(values[known])
    whitened = score @ root
    own = whitened.T @ whitened
    of_all = float(np.trace(own)) / len(own)
    return np.asarray(root @ (_OWN_SHARE * own + (1 - _OWN_SHARE) * of_all * np.eye(len(own))) @ root.T)


def _without_themselves(equations: _Equations, inverse: FloatArray) -> NDArray[np.float64]:
    """Return the score (B, 6 V) of each block as far as it is from the solution of all the others.

    Args:
        equations: as they are at the solution.
        inverse: (6 V, 6 V) of the information, zero for what is fixed.

    Source: Bell and McCaffrey 2002 (CR3), the jackknife over clusters.
    """
    out = equations.score.copy()
    begin = np.searchsorted(equations.block, np.arange(len(out) + 1))
    for b, (first, end) in enumerate(pairwise(begin)):
        if first == end or not out[b].any():
            continue
        views, where = np.unique(np.r_[equations.one[first:end], equations.other[first:end]], return_inverse=True)
        H = np.zeros((len(views), len(views), 6, 6))
        np.add.at(H, (where[: end - first], where[end - first :]), equations.parts[first:end])
        own = H.transpose(0, 2, 1, 3).reshape(6 * len(views), 6 * len(views))
        at = (6 * views[:, None] + np.arange(6)).ravel()
        pull = own @ inverse[np.ix_(at, at)]
        out[b, at] = np.linalg.lstsq(np.eye(len(at)) - pull, out[b, at], rcond=_ALONE)[0]
    return out


def _equations(views: Sequence[RangeView], poses: Sequence[Rigid], found: SharedPlanes, owner: IntArray) -> _Equations:
    count = len(views)
    if not found.count:
        none = np.zeros(0, np.intp)
        size = 6 * count
        return _Equations(
            np.zeros((size, size)), np.zeros((1, size)), none, none, none, np.zeros((0, 6, 6)), float("nan")
        )
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
    spread2 = (rays * n).sum(-1) ** 2 + MIN_ACROSS**2
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
    _, block = np.unique(found.centres.round().astype(np.int64), axis=0, return_inverse=True)
    block = block.ravel()
    parts, one, other, of_block = [A], [of_view], [of_view], [block[of_plane]]
    per_plane = np.bincount(of_plane, minlength=found.count)
    begin = np.cumsum(per_plane) - per_plane
    for i in range(count):
        for j in range(count):
            first, second = begin + i, begin + j
            pick = (i < per_plane) & (j < per_plane)
            g, h = first[pick], second[pick]
            parts.append(-C[g] @ D[pick] @ C[h].transpose(0, 2, 1))
            one.append(of_view[g])
            other.append(of_view[h])
            of_block.append(block[pick])
    all_blocks = np.concatenate(of_block)
    order = np.argsort(all_blocks, kind="stable")
    part, row, column = (np.concatenate(each)[order] for each in (parts, one, other))
    H = np.zeros((count, count, 6, 6))
    np.add.at(H, (row, column), part)
    score = np.zeros((int(block.max(initial=-1)) + 1, count, 6))
    np.add.at(score, (block[of_plane], of_view), score_of)
    return _Equations(
        H.transpose(0, 2, 1, 3).reshape(6 * count, 6 * count), score.reshape(len(score), 6 * count),
        all_blocks[order], row, column, part, float(np.median(noise)),
    )  # fmt: skip


def _noise(scaled: FloatArray, group: IntArray, groups: int) -> NDArray[np.float64]:
    """Return the range noise (G,) of each patch, by its median, drawn to that of all where it has few points."""
    size = np.abs(scaled)
    typical = max(_MAD * float(np.median(size)), _MIN_SIGMA_M) if len(size) else _MIN_SIGMA_M
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
