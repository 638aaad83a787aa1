"""Where a second station may stand, from nothing but two upright scans: yaw, position and height, all of them tried.

Walls are drawn on a plan, each facing direction on a layer of its own; the plans are correlated at every yaw. Floors,
tables and ceilings give the height. What scores best is ranked by what each station saw, and saw through, of the
other's surfaces.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.frames import Rigid, rotation_about
from ladarreg_core.registration.stations.sight import RangePicture, Sight
from ladarreg_core.registration.stations.surfels import Surfels

_YAWS = 90
_FACINGS = 12
_CELLS_ACROSS = 44
_FINEST_CELL_M = 0.2
_HEIGHT_BIN_M = 0.05
_HEIGHTS = 3
_OF_A_YAW = 6
_OF_ALL = 90
_SAMPLE = 900
_BEARINGS = 240
_BAND = 0.14  # tangent of the elevations that free space is taken from
_AS_HIGH_M = 0.8  # and of the walls that may not stand in it, above or below the scanner
_BLOCKED_SHARE = 0.25  # of the rays of a bearing that something may stop before its free space ends
_CLEARANCE_CELLS = 2.0
_LEVEL_WEIGHT = 0.15  # floors and ceilings agree in any two rooms
_CONTRADICTION = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """What is computed once of each scan."""

    surfels: Surfels
    picture: RangePicture


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """A pose that the second scan may have."""

    first_from_second: Rigid
    score: float
    """Weighted share of agreeing surfaces less those that are contradicted, -2 to 1."""


def search(first: View, second: View, *, keep: int, by_free_space: bool = False, seed: int = 0) -> list[Hypothesis]:
    """Return the best poses of the second scan in the frame of the first, the best one first.

    Args:
        first: the scan whose frame is used; it and the other one stand upright, within a few degrees.
        second: the scan that is placed.
        keep: number of hypotheses.
        by_free_space: whether a wall of one scan where the other saw through speaks against a place on the plan
            already. It takes longer, and finds stations that have few walls in common.
        seed: of the samples.
    """
    places = _places(first.surfels, second.surfels, by_free_space=by_free_space)
    heights = _heights(first.surfels, second.surfels)
    poses = [Rigid(rotation_about("z", yaw), np.array([x, y, z])) for _, yaw, x, y in places for z in heights]
    samples = (judged_sample(first.surfels, _SAMPLE, seed), judged_sample(second.surfels, _SAMPLE, seed + 1))
    scored = [Hypothesis(pose, sight_score(first, second, pose, samples)) for pose in poses]
    scored.sort(key=lambda one: -one.score)
    return apart(scored, keep=keep)


def apart(
    hypotheses: Sequence[Hypothesis], *, keep: int, distance_m: float = 0.35, angle_rad: float = 0.12
) -> list[Hypothesis]:
    """Return the first of hypotheses that are nearly the same, at most `keep`."""
    kept: list[Hypothesis] = []
    for one in hypotheses:
        if all(differ(one.first_from_second, other.first_from_second, distance_m, angle_rad) for other in kept):
            kept.append(one)
            if len(kept) == keep:
                break
    return kept


def differ(one: Rigid, other: Rigid, distance_m: float, angle_rad: float) -> bool:
    """Return whether two poses are apart by more than a distance or an angle."""
    return bool(np.linalg.norm(one.translation - other.translation) > distance_m or one.angle_to(other) > angle_rad)


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """Points of a scan that are judged by another one."""

    points: NDArray[np.float64]
    weight: NDArray[np.float64]


def judged_sample(surfels: Surfels, count: int, seed: int) -> Sample:
    """Return points of a scan, spread evenly over its surfaces, with the weights of their evidence."""
    rng = np.random.default_rng(seed)
    index = rng.permutation(len(surfels.points))[:count]
    weight = np.where(surfels.is_level[index], _LEVEL_WEIGHT, 1.0)
    return Sample(surfels.points[index], weight)


def sight_score(
    first: View, second: View, pose: Rigid, samples: tuple[Sample, Sample], *, tolerance: float = 0.25
) -> float:
    """Return how well two stations agree at a pose: agreeing less contradicted surfaces, by weight."""
    back = pose.inverse
    total = good = bad = 0.0
    for sample, station, move in ((samples[1], first, pose), (samples[0], second, back)):
        points = move @ sample.points
        seen = station.picture.judge(points, tolerance)
        total += float(sample.weight.sum())
        good += float(sample.weight[seen == Sight.AGREES].sum())
        bad += float(sample.weight[seen == Sight.CONTRADICTS].sum())
    return (good - _CONTRADICTION * bad) / max(total, 1e-9)


def _heights(first: Surfels, second: Surfels) -> list[float]:
    """Return heights of the second station in the first's frame, by level surfaces."""
    from scipy import ndimage

    levels = []
    for surfels in (first, second):
        level = surfels.is_level
        z, up = surfels.points[level, 2], surfels.normals[level, 2] > 0
        levels.append((z[up], z[~up]))
    every = [z for pair in levels for z in pair if len(z)]
    if not every:
        return [0.0]
    low, high = min(z.min() for z in every), max(z.max() for z in every)
    bins = max(2, int((high - low) / _HEIGHT_BIN_M) + 2)
    total = np.zeros(2 * bins - 1)
    for one, other in zip(*levels, strict=True):
        a, b = (np.sqrt(np.bincount(((z - low) / _HEIGHT_BIN_M).astype(int), minlength=bins)) for z in (one, other))
        total += np.correlate(ndimage.gaussian_filter1d(a, 1.0), ndimage.gaussian_filter1d(b, 1.0), "full")
    peaks = np.flatnonzero((total >= np.roll(total, 1)) & (total >= np.roll(total, -1)) & (total > 0))
    best = peaks[np.argsort(-total[peaks], kind="stable")][:_HEIGHTS]
    return [float((k - (bins - 1)) * _HEIGHT_BIN_M) for k in best] or [0.0]


def _places(first: Surfels, second: Surfels, *, by_free_space: bool) -> list[tuple[float, float, float, float]]:
    """Return (score, yaw, x, y) of the second station, best first, by the walls of both, and by what is free."""
    from scipy import fft, ndimage

    reach = max(first.reach_m, second.reach_m)
    cell = max(_FINEST_CELL_M, reach / _CELLS_ACROSS)
    half = int(np.ceil(reach / cell)) + 2
    size = fft.next_fast_len(4 * half, real=True)
    plan = ndimage.gaussian_filter(_plan(first, 0.0, cell, half), (0, 1.0, 1.0))
    spectrum = np.conj(fft.rfft2(plan, (size, size)))
    if by_free_space:
        free, walls = (np.conj(fft.rfft2(one(first, 0.0, cell, half), (size, size))) for one in (_free, _standing))
    found = []
    for k in range(_YAWS):
        yaw = 2 * np.pi * k / _YAWS
        turned = fft.rfft2(_plan(second, yaw, cell, half), (size, size))
        shared = (np.conj(spectrum) * np.conj(turned)).sum(0)
        if by_free_space:
            for known, one in ((free, _standing), (walls, _free)):
                shared -= np.conj(known) * np.conj(fft.rfft2(one(second, yaw, cell, half), (size, size)))
        score = fft.irfft2(shared, (size, size))
        peak = score == ndimage.maximum_filter(score, 5, mode="wrap")
        at = np.flatnonzero(peak)
        at = at[np.argsort(-score.ravel()[at], kind="stable")][:_OF_A_YAW]
        for x, y in zip(*np.unravel_index(at, score.shape), strict=True):
            shift = [int(v) - size if v > size // 2 else int(v) for v in (x, y)]
            found.append((float(score[x, y]), yaw, shift[0] * cell, shift[1] * cell))
    found.sort(key=lambda one: -one[0])
    return found[:_OF_ALL]


def _plan(surfels: Surfels, yaw: float, cell: float, half: int) -> NDArray[np.float32]:
    """Return the plan (F, 2 half, 2 half) of the walls, a layer for each direction that they face."""
    wall = surfels.is_wall
    turn = rotation_about("z", yaw)[:2, :2]
    xy, facing = surfels.points[wall, :2] @ turn.T, surfels.normals[wall, :2] @ turn.T
    at = np.floor(xy / cell).astype(np.intp) + half
    inside = ((at >= 0) & (at < 2 * half)).all(-1)
    at, facing = at[inside], facing[inside]
    bearing = np.mod(np.arctan2(facing[:, 1], facing[:, 0]) / (2 * np.pi) * _FACINGS, _FACINGS)
    low = np.floor(bearing)
    plan = np.zeros(_FACINGS * (2 * half) ** 2)
    place = at[:, 0] * 2 * half + at[:, 1]
    for layer, weight in ((low, 1 - (bearing - low)), (low + 1, bearing - low)):
        plan += np.bincount(
            np.mod(layer.astype(np.intp), _FACINGS) * (2 * half) ** 2 + place, weight, len(plan)
        )  # fmt: skip
    return np.sqrt(plan).reshape(_FACINGS, 2 * half, 2 * half).astype(np.float32)


def _free(surfels: Surfels, yaw: float, cell: float, half: int) -> NDArray[np.float32]:
    """Return the plan (2 half, 2 half) of what nearly all level rays pass: 1 where it is free, else 0."""
    across = np.hypot(surfels.returns[:, 0], surfels.returns[:, 1])
    level = np.abs(surfels.returns[:, 2]) < _BAND * across
    bearing = _bearing_of(surfels.returns[level, 0], surfels.returns[level, 1])
    order = np.lexsort((across[level], bearing))
    count = np.bincount(bearing, minlength=_BEARINGS)
    first = np.cumsum(count) - count
    reach = np.zeros(_BEARINGS)
    seen = count > 0
    reach[seen] = across[level][order][(first + (_BLOCKED_SHARE * count).astype(np.intp))[seen]]
    at = (np.arange(-half, half) + 0.5) * cell
    x, y = np.meshgrid(at, at, indexing="ij")
    turn = rotation_about("z", -yaw)[:2, :2]
    own = _bearing_of(turn[0, 0] * x + turn[0, 1] * y, turn[1, 0] * x + turn[1, 1] * y)
    return np.asarray(np.hypot(x, y) < reach[own] - _CLEARANCE_CELLS * cell, np.float32)


def _bearing_of(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.intp]:
    return np.asarray(np.mod(np.arctan2(y, x) / (2 * np.pi), 1.0) * _BEARINGS, np.intp) % _BEARINGS


def _standing(surfels: Surfels, yaw: float, cell: float, half: int) -> NDArray[np.float32]:
    """Return the plan (2 half, 2 half) of the walls at the height of the scanner: their number in each cell."""
    wall = surfels.is_wall & (np.abs(surfels.points[:, 2]) < _AS_HIGH_M)
    xy = surfels.points[wall, :2] @ rotation_about("z", yaw)[:2, :2].T
    at = np.floor(xy / cell).astype(np.intp) + half
    at = at[((at >= 0) & (at < 2 * half)).all(-1)]
    place = at[:, 0] * 2 * half + at[:, 1]
    return np.bincount(place, minlength=(2 * half) ** 2).reshape(2 * half, 2 * half).astype(np.float32)
