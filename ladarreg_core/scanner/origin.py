"""Where the scanner stood, found from the pattern of a cloud's points.

A scanner sends its beams at equal angles, so that the density of points on a surface falls with the square of the
distance and with the cosine of the incidence: log density = c + log |n . (p - o)| - 3 log |p - o|, which every flat
patch of the cloud says about the origin o. Scanners that turn about the vertical axis send more beams towards it:
- log cos(elevation). A robust fit over a few thousand patches gives candidates; visibility decides between them: from
the right place, no point lies behind a surface that other points show.
"""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ladarreg_core.arrays import BoolArray, FloatArray, IntArray

_SEED = 31
_POOL = 150_000  # points among which neighbours are searched
_PATCHES = 2_500
_WITNESSES = 20_000  # points that may hide each other
_NEIGHBOURS = 40
_LEAST_POINTS = 200
_LEAST_PATCHES = 60
_FLAT = 0.1
_TAU = 0.5
_ELEVATIONS = 6_000
_FINE_RAD = np.radians(0.25)
_SHARP = 0.7
_SURELY_SHARP = 1.2
_SHARPENED = 6
_HIDDEN = 0.12
_HIDDEN_IF_SHARP = 0.3
_AS_GOOD = 0.05
_CLEARLY_WORSE = 0.15
_LEAST_GAIN = 0.8
_LEAST_DIFFERENCE = 0.06
_FARTHEST = 12  # in units of the cloud's size: a field of view of ten degrees
_FARTHEST_CENTRE = 30
_MOST_KNOWN = 64
_known: dict[bytes, OriginEstimate] = {}
_known_lock = threading.Lock()


@dataclass(frozen=True, slots=True)
class OriginEstimate:
    """What the points say about where the scanner stood."""

    position: tuple[float, float, float] | None
    """In the coordinates of the points, m; None if they do not say."""
    hidden_share: float
    """Share of the points that lie behind surfaces, seen from `position`; from the centre if it is None."""
    hidden_from_centre: float
    """The same from (0, 0, 0)."""
    may_be_centre: bool = False
    """Whether (0, 0, 0) is not clearly contradicted: the densities of uneven patterns are a weak hint."""


def estimate_origin(points: FloatArray) -> OriginEstimate:
    """Estimate where the scanner stood, in a few seconds whatever the number of points.

    Args:
        points: (N, 3) float64, m, in any coordinates with axis Z up; points that are not finite are ignored.

    Returns:
        The origin; (0, 0, 0) itself where nothing contradicts it. None where the points do not determine it: fewer than
        200, no flat surfaces, thinned to equal distances, or taken from several places. The answers on the last clouds
        are kept: clouds to which further ones are added are read again.
    """
    picked = points[_sample(len(points), 4 * _POOL)]
    with np.errstate(over="ignore", invalid="ignore"):
        picked = picked[np.isfinite(picked).all(axis=1) & (np.abs(picked) < 1e9).all(axis=1)]
    if len(picked) < _LEAST_POINTS:
        return OriginEstimate((0.0, 0.0, 0.0), 0.0, 0.0)
    key = hashlib.blake2b(picked.tobytes(), digest_size=16).digest()
    found = _known.get(key)
    if found is None:
        found = _estimate(picked)
        with _known_lock:
            _known[key] = found
            if len(_known) > _MOST_KNOWN:
                _known.pop(next(iter(_known)))
    return found


def kept_answers() -> list[list[Any]]:
    """Return the answers that are kept, as plain values that `keep_answers` takes in another process."""
    with _known_lock:
        return [
            [key.hex(), found.position, found.hidden_share, found.hidden_from_centre, found.may_be_centre]
            for key, found in _known.items()
        ]


def keep_answers(rows: Iterable[Sequence[Any]]) -> None:
    """Keep answers of another process, so that the same clouds are not examined again.

    Raises:
        ValueError, TypeError: if they are not what `kept_answers` returns.
    """
    for key, position, hidden_share, hidden_from_centre, may_be_centre in rows:
        place = None
        if position is not None:
            x, y, z = map(float, position)
            place = (x, y, z)
        found = OriginEstimate(place, float(hidden_share), float(hidden_from_centre), bool(may_be_centre))
        with _known_lock:
            _known[bytes.fromhex(key)] = found


def _estimate(picked: FloatArray) -> OriginEstimate:
    """Return where the scanner stood that met the points (N, 3), at least 200 and all finite."""
    middle = np.median(picked, axis=0)
    cloud = _Cloud.of(picked - middle)
    centre = OriginEstimate((0.0, 0.0, 0.0), 1.0, 1.0)
    near = float(np.abs(middle).max()) < _FARTHEST_CENTRE * cloud.size
    if near:
        hidden_from_centre = cloud.hidden_from(-middle)
        centre = OriginEstimate((0.0, 0.0, 0.0), hidden_from_centre, hidden_from_centre)
        if cloud.sharpness(-middle) > _SHARP and hidden_from_centre < _HIDDEN_IF_SHARP:
            return centre
    best, hidden, misfit = cloud.best_origin()
    flat = cloud.misfit_without_origin()
    sharp = cloud.sharpness(best) > _SHARP
    as_good = centre.hidden_share <= hidden + 0.03 and cloud.misfit(-middle) < misfit + _AS_GOOD
    if near and not sharp and as_good:
        return centre
    gain = misfit < min(_LEAST_GAIN * flat, flat - _LEAST_DIFFERENCE) and hidden < _HIDDEN
    if not (gain or (sharp and hidden < _HIDDEN_IF_SHARP)) or np.linalg.norm(best) > _FARTHEST * cloud.size:
        return OriginEstimate(None, centre.hidden_share, centre.hidden_share)
    x, y, z = (best + middle).tolist()
    alike = near and not sharp and cloud.misfit(-middle) < misfit + _CLEARLY_WORSE
    return OriginEstimate((x, y, z), hidden, centre.hidden_share, alike and centre.hidden_share < _HIDDEN_IF_SHARP)


@dataclass(frozen=True, eq=False)
class _Cloud:
    """Patches and witnesses of a cloud whose median is zero."""

    centres: FloatArray
    normals: FloatArray
    log_density: FloatArray
    witnesses: FloatArray
    witness_normals: FloatArray
    flat: BoolArray
    spacing: FloatArray
    ordered: FloatArray
    size: float

    @staticmethod
    def of(points: FloatArray) -> _Cloud:
        from scipy.spatial import cKDTree

        size = float(np.percentile(np.linalg.norm(points, axis=1), 90)) or 1.0
        pool = points[_sample(len(points), _POOL)]
        tree = cKDTree(pool)
        centres = pool[_sample(len(pool), _PATCHES)]
        normals, flat, radius = _planes(tree, pool, centres, _NEIGHBOURS)
        with np.errstate(divide="ignore"):
            log_density = np.log((_NEIGHBOURS - 1) / (np.pi * radius**2))
        good = flat & (radius > 0)
        witnesses = pool[_sample(len(pool), _WITNESSES)]
        own = cKDTree(witnesses)
        witness_normals, witness_flat, reach = _planes(own, witnesses, witnesses, 9)
        return _Cloud(
            centres[good], normals[good], log_density[good], witnesses, witness_normals, witness_flat,
            np.maximum(reach / 1.6, 1e-6 * size), witnesses[:: max(1, len(witnesses) // _ELEVATIONS)], size,
        )  # fmt: skip

    @cached_property
    def _squares(self) -> FloatArray:
        return np.asarray((self.centres**2).sum(1))

    @cached_property
    def _heights(self) -> FloatArray:
        return np.asarray((self.normals * self.centres).sum(1))

    def misfits(self, origins: FloatArray, *models: bool) -> list[FloatArray]:
        """Return the robust misfits (K,) of the log density for origins (K, 3).

        Args:
            origins: (K, 3) m.
            models: whether the scanner turns about the vertical axis; one answer for each.
        """
        with np.errstate(divide="ignore", invalid="ignore"):
            square = (self._squares - 2 * origins @ self.centres.T + (origins**2).sum(1)[:, None]).clip(1e-12)
            towards = np.abs(self._heights - origins @ self.normals.T)
            model = np.log(towards + 0.02 * np.sqrt(square)) - 1.5 * np.log(square)
            found = []
            for vertical in models:
                expected = model
                if vertical:
                    level = (self.centres[:, 0] - origins[:, :1]) ** 2 + (self.centres[:, 1] - origins[:, 1:2]) ** 2
                    expected = model - 0.5 * np.log((level / square).clip(1e-3))
                residual = self.log_density - expected
                residual -= _medians(residual)[:, None]
                of_tau = (residual / _TAU) ** 2
                found.append(np.asarray((of_tau / (1 + of_tau)).mean(axis=1)))
        return found

    def misfit(self, origin: FloatArray) -> float:
        """Return the misfit of an origin (3,) under the better of the two models."""
        if len(self.centres) < _LEAST_PATCHES:
            return 1.0
        return min(float(each[0]) for each in self.misfits(origin[None], False, True))

    def misfit_without_origin(self) -> float:
        """Return the misfit of a constant density."""
        if len(self.centres) < _LEAST_PATCHES:
            return 1.0
        square = ((self.log_density - np.median(self.log_density)) / _TAU) ** 2
        return float((square / (1 + square)).mean())

    def best_origin(self) -> tuple[FloatArray, float, float]:
        """Return the origin (3,), its hidden share and its misfit."""
        from scipy.optimize import minimize

        found: list[tuple[float, float, FloatArray]] = []
        if len(self.centres) < _LEAST_PATCHES:
            return np.zeros(3), 1.0, 1.0
        starts = self._starts()
        parts = [self.misfits(part, False, True) for part in np.array_split(starts, len(starts) // 128 + 1)]
        for vertical, of_parts in zip((False, True), zip(*parts, strict=True), strict=True):
            misfits = np.concatenate(of_parts)
            taken: list[FloatArray] = []
            for k in np.argsort(misfits, kind="stable"):
                if all(np.linalg.norm(starts[k] - other) > 0.15 * self.size for other in taken):
                    taken.append(starts[k])
                if len(taken) == 4:
                    break
            for start in taken:
                simplex = start + 0.08 * self.size * np.vstack([np.zeros(3), np.eye(3)])
                answer = minimize(
                    lambda o, vertical=vertical: float(self.misfits(o[None], vertical)[0][0]),
                    start, method="Nelder-Mead",
                    options={"initial_simplex": simplex, "xatol": 1e-4 * self.size, "fatol": 1e-6, "maxfev": 250},
                )  # fmt: skip
                found.append((self.hidden_from(answer.x), float(answer.fun), np.asarray(answer.x)))
        found.sort(key=lambda each: each[0] + each[1])
        distinct = [
            origin
            for k, (_, _, origin) in enumerate(found)
            if all(np.linalg.norm(origin - other) > 0.02 * self.size for _, _, other in found[:k])
        ]
        for origin in distinct[:_SHARPENED]:
            if (sharp := self._sharpened(origin)) is not None:
                found.append((self.hidden_from(sharp), self.misfit(sharp), sharp))
                if found[-1][0] < _HIDDEN and self.sharpness(sharp) > _SURELY_SHARP:
                    break
        # A sharp set of elevations is far stronger evidence than the densities, which are those of points in lines.
        hidden, misfit, origin = min(found, key=lambda each: each[0] + each[1] - 0.5 * self.sharpness(each[2]))
        return origin, hidden, misfit

    def sharpness(self, origin: FloatArray) -> float:
        """Return how concentrated the elevations are on single values: 0 for none, 2.08 for rings.

        It is the information that bins of a quarter of a degree have beyond bins of two degrees: this does not reward
        origins from which everything is at the same elevation.
        """
        offset = self.ordered - origin
        elevation = np.arctan2(offset[:, 2], np.hypot(offset[:, 0], offset[:, 1])) + np.pi / 2
        fine = np.bincount((elevation / _FINE_RAD).astype(np.intp), minlength=8 * 91).astype(np.float64)
        coarse = fine[: len(fine) // 8 * 8].reshape(-1, 8).sum(1)
        fine, coarse = (counts[counts > 0] / len(offset) for counts in (fine, coarse))
        return float(np.log(8) + (fine * np.log(fine)).sum() - (coarse * np.log(coarse)).sum())

    def _sharpened(self, start: FloatArray) -> FloatArray | None:
        """Return the origin near a start from which the elevations are sharpest; None if they are not."""
        generator = np.random.default_rng(_SEED)
        origin, sharpest = start, self.sharpness(start)
        reach = min(0.3, 0.1 * self.size)
        for turn in range(11):
            for candidate in origin + reach * generator.normal(size=(300 if turn < 2 else 50, 3)):
                value = self.sharpness(candidate)
                if value > sharpest:
                    origin, sharpest = candidate, value
            reach *= 0.55
            if turn == 3 and sharpest < 0.4 * _SHARP:
                return None
        return origin if sharpest > _SHARP else None

    def _starts(self) -> FloatArray:
        """Return candidates (K, 3): a grid over the cloud, and a coarse one beyond it for narrow fields of view."""
        low, high = np.percentile(self.witnesses, [2, 98], axis=0)
        inner = _lattice(low, high, 10, 10, 7)
        margin = np.maximum(high - low, 0.2 * self.size)
        outer = _lattice(low - margin, high + margin, 9, 9, 5)
        quantiles = self.witnesses[_sample(len(self.witnesses), 400)]
        return np.concatenate([inner, outer, quantiles * [1, 1, 1] + [0, 0, 0.05 * self.size]])

    def hidden_from(self, origin: FloatArray) -> float:
        """Return the share of the witnesses that lie behind others, seen from an origin (3,).

        Each witness is drawn in a buffer whose cells match the angle between it and its neighbours, so that a surface
        is closed from near and from far.
        """
        offset = self.witnesses - origin
        distance = np.linalg.norm(offset, axis=1).clip(1e-9)
        rays = offset / distance[:, None]
        elevation, azimuth = np.arcsin(rays[:, 2].clip(-1, 1)), np.arctan2(rays[:, 1], rays[:, 0])
        facing = np.abs((self.witness_normals * rays).sum(1)).clip(0.1)
        angle = (self.spacing * np.where(self.flat, np.sqrt(facing), 1) / distance).clip(1e-4, 0.3)
        level = np.ceil(np.log2(angle)).astype(np.intp)
        hidden = np.zeros(len(offset), np.bool_)
        for each in np.unique(level):
            cell = _cells(azimuth, elevation, 2.0 ** int(each))
            writers = np.flatnonzero(level == each)
            order = writers[np.lexsort((distance[writers], cell[writers]))]
            first = np.flatnonzero(np.diff(cell[order], prepend=-1))
            nearest, cells = order[first], cell[order[first]]
            at = np.searchsorted(cells, cell).clip(max=len(cells) - 1)
            front = nearest[at]
            behind = distance - distance[front]
            through = np.abs(((self.witnesses - self.witnesses[front]) * self.witness_normals[front]).sum(1))
            depth = np.where(self.flat[front], through, behind / 2)
            slack = 2 * (self.spacing[front] + np.minimum(self.spacing, self.spacing[front]))
            hidden |= (cells[at] == cell) & (behind > slack) & (depth > slack)
        return float(hidden.mean())


def _medians(values: FloatArray) -> FloatArray:
    """Return the median (K,) of rows (K, M) of numbers, without what `np.median` takes for short rows."""
    middle = values.shape[1] // 2
    if values.shape[1] % 2:
        return np.asarray(np.partition(values, middle, axis=1)[:, middle])
    parted = np.partition(values, (middle - 1, middle), axis=1)
    return np.asarray((parted[:, middle - 1] + parted[:, middle]) / 2)


def _planes(
    tree: Any, pool: FloatArray, centres: FloatArray, neighbours: int
) -> tuple[FloatArray, BoolArray, FloatArray]:
    """Return normals (K, 3), whether the neighbourhood is flat (K,), and its radius (K,)."""
    distance, index = tree.query(centres, k=min(neighbours, len(pool)))
    offsets = pool[index] - pool[index].mean(axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(offsets.transpose(0, 2, 1) @ offsets)
    flat = (values[:, 0] < _FLAT**2 * values[:, 1]) & (values[:, 1] > 0.1 * values[:, 2])
    return vectors[:, :, 0], flat, distance[:, -1]


def _cells(azimuth: FloatArray, elevation: FloatArray, side: float) -> IntArray:
    """Return the number (N,) of a cell of about equal area for each direction."""
    row = np.floor((elevation + np.pi / 2) / side).astype(np.int64)
    width = np.cos(np.minimum((row + 0.5) * side - np.pi / 2, np.pi / 2 - side / 4)).clip(side / 8)
    return np.asarray(row * 1_000_003 + np.floor(azimuth * width / side).astype(np.int64) + 500_000)


def _lattice(low: FloatArray, high: FloatArray, *counts: int) -> FloatArray:
    axes = [np.linspace(a, b, count) for a, b, count in zip(low, high, counts, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def _sample(count: int, most: int) -> IntArray:
    """Return at most `most` of `count` indices, in order, always the same."""
    if count <= most:
        return np.arange(count)
    return np.sort(np.random.default_rng(_SEED).choice(count, most, replace=False, shuffle=False))
