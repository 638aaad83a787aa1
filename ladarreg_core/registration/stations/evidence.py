"""What speaks for and against two stations being where an alignment puts them, apart from what was optimised."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.frames import Rigid
from ladarreg_core.registration.stations.search import View
from ladarreg_core.registration.stations.sight import Sight
from ladarreg_core.registration.stations.surfels import Surfels

_SAMPLE = 5000
_SEED = 20_011
_AROUND = 24
_SHIFTS_M = (0.25, 0.4, 0.6, 0.85)
_MIN_LIT = 400
_MIN_CONTRAST = 0.12
_SAME_FACING = 0.8


@dataclass(frozen=True, slots=True)
class Seen:
    """What each station says of the other's surfaces, floors and ceilings left out."""

    judged: int
    """Points that were judged."""
    agreeing: float
    """Share that the other station measured as well: the overlap."""
    contradicted: float
    """Share of those in plain view of the other station that it saw through."""


def seen(first: View, second: View, pose: Rigid, *, tolerance_m: float) -> Seen:
    """Return what two stations see of each other's surfaces at a pose `first_from_second`."""
    rng = np.random.default_rng(_SEED)
    good = bad = total = 0
    for surfels, station, move in (
        (second.surfels, first, pose),
        (first.surfels, second, pose.inverse),
    ):
        upright = np.flatnonzero(~surfels.is_level)
        points = move @ surfels.points[rng.permutation(upright)[:_SAMPLE]]
        codes = station.picture.judge(points, tolerance_m)
        good += int((codes == Sight.AGREES).sum())
        bad += int((codes == Sight.CONTRADICTS).sum())
        total += len(codes)
    return Seen(total, good / max(total, 1), bad / max(good + bad, 1))


@dataclass(frozen=True, slots=True)
class Print:
    """How far the intensities of both scans show the same print; nothing was aligned by them."""

    points: int
    """Points that both scans measured with an intensity."""
    correlation: float
    """Of the local contrasts; NaN where there is no print, or no intensity."""
    by_chance: float
    """The median with the surfaces shifted along themselves by 25 to 85 cm."""


def compared_print(first: Surfels, second: Surfels, pose: Rigid) -> Print:
    """Return how well the intensities agree at a pose `first_from_second`."""
    from scipy.spatial import cKDTree

    light = _contrast(first)
    other = _contrast(second)
    lit_first, lit_second = np.isfinite(light), np.isfinite(other)
    if min(lit_first.sum(), lit_second.sum()) < _MIN_LIT:
        return Print(0, float("nan"), float("nan"))
    tree = cKDTree(first.points[lit_first])
    normals, values = first.normals[lit_first], light[lit_first]
    pick = np.random.default_rng(_SEED).permutation(np.flatnonzero(lit_second))[: 3 * _SAMPLE]
    points, facing = pose @ second.points[pick], second.normals[pick] @ pose.rotation.T
    apart = 0.8 * first.spacing_m

    def compare(moved: FloatArray) -> tuple[int, float]:
        distance, near = tree.query(moved, distance_upper_bound=apart)
        there = np.isfinite(distance)
        there[there] = (normals[near[there]] * facing[there]).sum(-1) > _SAME_FACING
        a, b = values[near[there]], other[pick[there]]
        if len(a) < _MIN_LIT or min(a.std(), b.std()) < _MIN_CONTRAST:
            return len(a), float("nan")
        return len(a), float(np.corrcoef(a, b)[0, 1])

    count, correlation = compare(points)
    if not np.isfinite(correlation):
        return Print(count, float("nan"), float("nan"))
    helper = np.where(np.abs(facing[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    along = np.cross(helper, facing)
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    up = np.cross(facing, along)
    chance = [
        compare(points + sign * shift * direction)[1]
        for shift in _SHIFTS_M for direction in (along, up) for sign in (-1.0, 1.0)
    ]  # fmt: skip
    found = [value for value in chance if np.isfinite(value)]
    return Print(count, correlation, float(np.median(found)) if found else float("nan"))


def _contrast(surfels: Surfels) -> NDArray[np.float64]:
    """Return the logarithm of the intensity (N,) less that of its surroundings, NaN where there is none."""
    from scipy.spatial import cKDTree

    light = np.full(len(surfels.points), np.nan)
    lit = np.flatnonzero(np.isfinite(surfels.intensity))
    if len(lit) < _MIN_LIT:
        return light
    _, near = cKDTree(surfels.points[lit]).query(surfels.points[lit], _AROUND)
    own = surfels.intensity[lit]
    light[lit] = np.clip(own - np.median(own[near], axis=-1), -1.5, 1.5)
    return light
