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
from numpy.typing import ArrayLike

from ladarreg_core.foundations.arrays import BoolArray, FloatArray, IntArray

_SEED = 31
_POOL = 150_000  # points among which neighbours are searched
_PATCHES = 2_500
_WITNESSES = 20_000  # points that may hide each other
_NEIGHBOURS = 40
_MIN_POINTS = 12
_MIN_PATCHES = 60
_MIN_POOL = 4_000  # points; of fewer only lines count
_FLAT = 0.1
_TAU = 0.5
_ELEVATIONS = 6_000
_BINS_DEG = (0.25, 0.12, 0.06, 0.03, 0.015)  # lidars have lines .1 to 2 degrees apart
_MIN_IN_BIN, _MIN_BINS = 24, 3  # points in a wide bin, and such bins
_COINCIDENT_RAD = 2e-6  # angles on one line of a grid differ by rounding only
_MIN_LINES, _MIN_IN_LINE, _MIN_IN_ROW = 4, 4, 9  # a lattice has eight places at one distance
_SHARP = 0.9  # sharpness and regularity are nats, from 0 to log 8 = 2.08
_SURELY_SHARP = 1.2
_SURELY_REGULAR, _CLEARLY_LESS = 1.6, 0.6
_MIN_DROP = 0.03  # nats, from a centre of lines to the places around it
_AROUND = 0.012  # distance of the places beside a centre of lines, of the cloud's size
_SHARPENED = 6
_COARSE_TURNS = 5
_MAX_HIDDEN = 0.5  # shares of the points that lie behind others: here, from a centre of lines
_HIDDEN = 0.12
_HIDDEN_IF_SHARP = 0.3
_AS_GOOD = 0.05
_AS_HIDDEN = 0.06
_CLEAR = ((0.15, 0.12), (0.3, 0.03))  # misfit and hidden share of a searched place that is taken without lines
_MIN_GAIN = 0.8
_MIN_DIFFERENCE = 0.06
_FARTHEST = 12  # in units of the cloud's size: a field of view of ten degrees
_FARTHEST_CENTRE = 30
FARTHEST_ZERO_M = 1_000.0
"""Distance of the points beyond which zero is that of a map, and never taken for the scanner, m."""
_MAX_KNOWN = 64
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
    by_visibility_alone: bool = False
    """Whether only what is hidden speaks for it: uneven patterns say little else."""


def estimate_origin(points: FloatArray, *, stated: Sequence[ArrayLike] = ()) -> OriginEstimate:
    """Estimate where the scanner stood, in a few seconds whatever the number of points.

    Candidates are zero (nearer than a kilometre), the stated places and one that is searched for. In this order, the
    first that is clear is the answer:

    1. a known place from which the directions form the lines of a scanner, and from its neighbourhood less so;
    2. the searched place, if that is true of it;
    3. a known place that explains the densities as well as the searched one, and from which little is hidden;
    4. the searched place, if it explains the densities well and nearly nothing is hidden from it;
    5. a known place from which far less is hidden than from elsewhere in the cloud, unless the densities contradict it.

    Args:
        points: (N, 3) float64, m, in any coordinates with axis Z up; points that are not finite are ignored.
        stated: places (3,), m, where the file may say that the scanner stood.

    Returns:
        The origin; a known place is returned exactly. None where the points do not determine it: too few of them, no
        flat surfaces, thinned to equal distances, or taken from several places. The answers on the last clouds are
        kept: clouds to which further ones are added are read again.
    """
    picked = points[_sample(len(points), 4 * _POOL)]
    with np.errstate(over="ignore", invalid="ignore"):
        picked = picked[np.isfinite(picked).all(axis=1) & (np.abs(picked) < 1e9).all(axis=1)]
    picked = picked[picked.any(axis=1)]  # (0, 0, 0) is no return
    if len(picked) < _MIN_POINTS:
        return OriginEstimate(None, 0.0, 0.0)
    known = [np.zeros(3), *(np.asarray(place, dtype=np.float64) for place in stated)]
    key = hashlib.blake2b(picked.tobytes() + np.stack(known).tobytes(), digest_size=16).digest()
    found = _known.get(key)
    if found is None:
        found = _estimate(picked, known)
        with _known_lock:
            _known[key] = found
            if len(_known) > _MAX_KNOWN:
                _known.pop(next(iter(_known)))
    return found


def kept_answers() -> list[list[Any]]:
    """Return the answers that are kept, as plain values that `keep_answers` takes in another process."""
    with _known_lock:
        return [
            [key.hex(), found.position, found.hidden_share, found.hidden_from_centre, found.by_visibility_alone]
            for key, found in _known.items()
        ]


def keep_answers(rows: Iterable[Sequence[Any]]) -> None:
    """Keep answers of another process, so that the same clouds are not examined again.

    Raises:
        ValueError, TypeError: if they are not what `kept_answers` returns.
    """
    for key, position, hidden_share, hidden_from_centre, alone in rows:
        place = None
        if position is not None:
            x, y, z = map(float, position)
            place = (x, y, z)
        found = OriginEstimate(place, float(hidden_share), float(hidden_from_centre), bool(alone))
        with _known_lock:
            _known[bytes.fromhex(key)] = found


def _estimate(picked: FloatArray, known: Sequence[FloatArray]) -> OriginEstimate:
    """Return where the scanner stood that met the points (N, 3), all finite; `known` begins with zero."""
    middle = np.median(picked, axis=0)
    cloud = _Cloud.of(picked - middle)
    zero_is_near = float(np.linalg.norm(middle)) < min(_FARTHEST_CENTRE * cloud.size, FARTHEST_ZERO_M)
    places = [place - middle for place in known[0 if zero_is_near else 1 :]]
    places = [place for place in places if np.linalg.norm(place) < _FARTHEST_CENTRE * cloud.size]
    from_zero = cloud.hidden_from(-middle) if zero_is_near else 1.0

    def answer(place: FloatArray, *, alone: bool = False) -> OriginEstimate:
        x, y, z = next((each for each in known if np.array_equal(each - middle, place)), place + middle)
        return OriginEstimate((float(x), float(y), float(z)), cloud.hidden_from(place), from_zero, alone)

    by_lines = [place for place in places if cloud.is_centre_of_lines(place)]
    if by_lines:
        return answer(max(by_lines, key=cloud.regularity))
    if len(picked) < _MIN_POOL:  # densities and what is hidden are chance
        return OriginEstimate(None, from_zero, from_zero)
    best, hidden, misfit = cloud.best_origin()
    if np.linalg.norm(best) < _FARTHEST * cloud.size and hidden < _HIDDEN_IF_SHARP and cloud.is_centre_of_lines(best):
        return answer(best)
    flat = cloud.misfit_without_origin()
    gained = min(_MIN_GAIN * flat, flat - _MIN_DIFFERENCE)
    seen = [(cloud.misfit(place), cloud.hidden_from(place), place) for place in places]
    for fit, behind, place in sorted(seen, key=lambda each: each[0] + each[1]):
        if fit < min(misfit + _AS_GOOD, gained) and behind < min(hidden + _AS_HIDDEN, _HIDDEN_IF_SHARP):
            return answer(place)
    is_clear = any(misfit < fit and hidden < behind for fit, behind in _CLEAR)
    if is_clear and misfit < gained and np.linalg.norm(best) < _FARTHEST * cloud.size:
        return answer(best)
    usual = cloud.usually_hidden()
    for fit, behind, place in sorted(seen, key=lambda each: each[1]):
        if fit <= flat and behind < min(_HIDDEN_IF_SHARP, 0.5 * usual):  # little is hidden beside a narrow cloud, too
            return answer(place, alone=True)
    return OriginEstimate(None, from_zero, from_zero)


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
        if len(self.centres) < _MIN_PATCHES:
            return 1.0
        return min(float(each[0]) for each in self.misfits(origin[None], False, True))

    def misfit_without_origin(self) -> float:
        """Return the misfit of a constant density."""
        if len(self.centres) < _MIN_PATCHES:
            return 1.0
        square = ((self.log_density - np.median(self.log_density)) / _TAU) ** 2
        return float((square / (1 + square)).mean())

    def best_origin(self) -> tuple[FloatArray, float, float]:
        """Return the origin (3,), its hidden share and its misfit."""
        from scipy.optimize import minimize

        found: list[tuple[float, float, FloatArray]] = []
        if len(self.centres) < _MIN_PATCHES:
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
                if found[-1][0] < _HIDDEN_IF_SHARP and self.sharpness(sharp) > _SURELY_SHARP:
                    break
        # A sharp set of elevations is far stronger evidence than the densities, which are those of points in lines.
        hidden, misfit, origin = min(found, key=lambda each: each[0] + each[1] - 0.5 * self.sharpness(each[2]))
        return origin, hidden, misfit

    def sharpness(self, origin: FloatArray, *, coarsely: bool = False) -> float:
        """Return how concentrated the elevations are on single values: 0 for none, 2.08 for rings.

        It is the information that fine bins add to bins eight times as wide, for the best of several sizes. All wide
        bins count alike: a floor level with the origin, all of it at one elevation, is only one of many.
        """
        offset = self.ordered[:: 3 if coarsely else 1] - origin
        elevation = np.arctan2(offset[:, 2], np.hypot(offset[:, 0], offset[:, 1])) + np.pi / 2
        return max(_concentration(elevation, np.radians(size)) for size in _BINS_DEG[: 1 if coarsely else None])

    def regularity(self, origin: FloatArray) -> float:
        """Return the sharpness, or the same of the exact lines of a grid: spherical, perspective, or of two mirrors."""
        x, y, z = (self.ordered - origin).T
        rows = _share_in_lines(np.arctan2(z, np.hypot(x, y)), _MIN_IN_ROW)
        pairs = (
            (np.arctan2(y, x), np.arctan2(z, x)),
            (np.arctan2(x, z), np.arctan2(y, z)),  # a camera's axes: z forward
            (np.arctan2(z, x), np.arctan2(y, np.hypot(x, z))),
        )
        exact = max(rows, *(min(_share_in_lines(each, _MIN_IN_LINE) for each in pair) for pair in pairs))
        return max(self.sharpness(origin), float(np.log(8)) * exact)

    def is_centre_of_lines(self, origin: FloatArray) -> bool:
        """Return whether the directions from a place are those of a scanner, and less so from around it."""
        regular = self.regularity(origin)
        if regular < _SHARP:
            return False
        reach = _AROUND * self.size
        around = [origin + sign * reach * axis for axis in np.eye(3) for sign in (-1, 1)]
        beside = max(map(self.regularity, around))
        if regular > _SURELY_REGULAR and beside < _CLEARLY_LESS * regular:
            return True
        return beside < regular - _MIN_DROP and self.hidden_from(origin) < _MAX_HIDDEN

    def usually_hidden(self) -> float:
        """Return the median share that is hidden from places in the cloud."""
        low, high = np.percentile(self.witnesses, [10, 90], axis=0)
        return float(np.median([self.hidden_from(place) for place in _lattice(low, high, 4, 4, 2)]))

    def _sharpened(self, start: FloatArray) -> FloatArray | None:
        """Return the origin near a start from which the elevations are sharpest; None if they are not."""
        generator = np.random.default_rng(_SEED)
        origin, sharpest = start, self.sharpness(start, coarsely=True)
        reach = min(0.3, 0.1 * self.size)
        for turn in range(11):
            coarsely = turn < _COARSE_TURNS
            if turn == _COARSE_TURNS:
                sharpest = self.sharpness(origin)
            for candidate in origin + reach * generator.normal(size=(300 if turn < 2 else 50, 3)):
                value = self.sharpness(candidate, coarsely=coarsely)
                if value > sharpest:
                    origin, sharpest = candidate, value
            reach *= 0.55
            if turn == 3 and sharpest < 0.4 * _SHARP:
                return None
        return origin if sharpest > 0.8 * _SHARP else None

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


def _concentration(angle: FloatArray, size: float) -> float:
    """Return the information, nats, that bins of a size, rad, add to bins eight times as wide, less that of chance."""
    wide = int(2 * np.pi / size / 8) + 2
    counts = np.bincount((angle / size).astype(np.intp), minlength=8 * wide)[: 8 * wide].reshape(wide, 8)
    counts = counts[counts.sum(axis=1) >= _MIN_IN_BIN].astype(np.float64)
    if len(counts) < _MIN_BINS:
        return 0.0
    total = counts.sum(axis=1)
    share = counts / total[:, None]
    entropy = -(share * np.log(np.where(share > 0, share, 1))).sum(axis=1)
    gain = np.log(8) - entropy - ((share > 0).sum(axis=1) - 1) / (2 * total)
    weight = np.minimum(total, np.median(total))
    return float((gain * weight).sum() / weight.sum())


def _share_in_lines(angle: FloatArray, least: int) -> float:
    """Return the share of angles on lines, on which `least` or more coincide; 0 for few lines, or one that has most."""
    apart = np.diff(np.sort(angle)) > _COINCIDENT_RAD
    sizes = np.diff(np.flatnonzero(np.concatenate([[True], apart, [True]])))
    sizes = sizes[sizes >= least]
    if len(sizes) < _MIN_LINES or sizes.max() > 0.5 * len(angle):
        return 0.0
    return float(sizes.sum() / len(angle))


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
