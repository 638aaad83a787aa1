"""Rings of spinning scanners: which point is on which, however unequally they are spaced, and the step along them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.foundations.arrays import FloatArray, IntArray
from ladarreg_core.frames import wrap_angle
from ladarreg_core.scanner.grids import RingGrid
from ladarreg_core.scanner.point_spacing import LARGE_CLOUD

MAX_COLUMNS = 32_000  # cv2.remap refuses 32,767
"""Largest number of columns of a grid."""
_SEED = 20
_MIN_RINGS = 4
_MIN_ON_A_RING = 8
_MIN_GAPS = 12
_MAX_OVERLAP = 0.25
_CLEAN_OVERLAP = 0.02


def ring_grid(
    latitude: FloatArray, longitude: FloatArray, beam: IntArray | None, *,
    centre: float, most_cells: int, one_turn: int,
) -> tuple[RingGrid, IntArray] | None:  # fmt: skip
    """Return a grid whose rows are the rings of a cloud, and the flat cell (N,) of each point; None without rings.

    Args:
        latitude: (N,), rad.
        longitude: (N,), rad, from the centre of the grid.
        beam: (N,), the beam of each point, if known; used if consistent with the latitudes.
        centre: longitude of the centre, rad.
        most_cells: size to which finer clouds are thinned.
        one_turn: the step along the rings is that of the first so many points; the rest are further turns.
    """
    labels = _rings_of(latitude, beam)
    step = None if labels is None else _step_along_rings(longitude[:one_turn], labels[:one_turn])
    if labels is None or step is None:
        return None
    several = one_turn < len(labels)
    return _on_rings(latitude, longitude, labels, step, centre, most_cells, several=several)


def _rings_of(latitude: FloatArray, beam: IntArray | None) -> IntArray | None:
    """Return the row (N,) of each point, counted from the highest ring; None without rings."""
    if beam is not None:
        labels, overlap = _ordered_labels(latitude, np.unique(beam, return_inverse=True)[1])
        if overlap < _MAX_OVERLAP:
            return labels
    if len(latitude) > LARGE_CLOUD:  # a share of them shows whether there are rings at all
        few = np.random.default_rng(_SEED).choice(latitude, LARGE_CLOUD // 4)
        if _rings_of(few, None) is None:
            return None
    lowest, highest = float(latitude.min()), float(latitude.max())
    bins = int(np.clip(len(latitude) // 4, 64, 1 << 15))
    if highest - lowest < 1e-6:
        return None
    counts = np.histogram(latitude, bins=bins, range=(lowest, highest))[0].astype(np.float64)
    position = (latitude - lowest) / (highest - lowest) * bins
    best, least = None, _MAX_OVERLAP
    for sigma in (1.0, 2.0, 4.0, 8.0, 16.0, 32.0):
        bounds = _valleys(_smoothed(counts, sigma))
        if len(bounds) + 1 > len(latitude) / _MIN_ON_A_RING:
            continue
        if len(bounds) + 1 < _MIN_RINGS:
            break
        labels, overlap = _ordered_labels(latitude, np.searchsorted(bounds, position))
        if overlap < least:
            best, least = labels, overlap
        if least < _CLEAN_OVERLAP:
            break
    return best


def _smoothed(counts: NDArray[np.float64], sigma: float) -> NDArray[np.float64]:
    reach = int(np.ceil(3 * sigma))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    return np.convolve(counts, kernel / kernel.sum(), mode="full")[reach : reach + len(counts)]


def _valleys(density: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the bins that separate the peaks of the density; a valley must be below a third of both its peaks."""
    bounds: list[float] = []
    peak, low, low_from, low_to = 0.0, np.inf, 0, 0
    # A floor prevents stray points between the rings from counting as peaks.
    floor = 0.02 * float(np.percentile(density[density > 0], 95)) if (density > 0).any() else 0.0
    for k, value in enumerate(density.tolist()):
        if value > peak and low == np.inf:
            peak = value
        elif value < low and value < peak / 3:
            low, low_from, low_to = value, k, k
        elif value == low:
            low_to = k
        elif low < np.inf and value > 3 * low and value > floor:
            bounds.append((low_from + low_to + 1) / 2)
            peak, low = value, np.inf
    return np.array(bounds)


def _ordered_labels(latitude: FloatArray, group: IntArray) -> tuple[IntArray, float]:
    """Return the groups numbered from the highest latitude, and their overlap.

    The overlap is the interquartile range of a group in units of the distance to its nearest neighbour: .5 for evenly
    spread latitudes, infinite if the groups cannot be ordered.
    """
    sorting = np.lexsort((latitude, group))
    values, groups = latitude[sorting], group[sorting]
    starts = np.flatnonzero(np.diff(groups, prepend=-1))
    sizes = np.diff(np.append(starts, len(groups)))
    if len(starts) < 2:
        return group, np.inf

    def quantile(q: float) -> FloatArray:
        return np.asarray(values[starts + np.floor(q * (sizes - 1)).astype(np.intp)])

    middle, spread = quantile(0.5), quantile(0.75) - quantile(0.25)
    order = np.argsort(-middle, kind="stable")
    steps = -np.diff(middle[order])
    if steps.min() <= 0:
        return group, np.inf
    nearest = np.minimum(np.append(np.inf, steps), np.append(steps, np.inf))
    overlap = float(np.average(spread[order] / nearest, weights=sizes[order]))
    row_of = np.empty(len(order), np.intp)
    row_of[order] = np.arange(len(order))
    labels = np.empty(len(groups), np.intp)
    labels[sorting] = row_of[np.cumsum(np.diff(groups, prepend=groups[0]) != 0)]
    return labels, overlap


def _step_along_rings(longitude: FloatArray, labels: IntArray) -> float | None:
    """Return the longitude step of the beams, rad; None if the rings are not sequences of equal steps."""
    order = np.lexsort((longitude, labels))
    gaps = np.diff(longitude[order])[np.diff(labels[order]) == 0]
    gaps = gaps[gaps > 1e-7]
    if len(gaps) < _MIN_GAPS:
        return None
    step = float(np.median(gaps))
    for _ in range(3):  # gaps are whole multiples of the step
        whole = np.rint(gaps / step)
        near = (whole >= 1) & (whole <= 4)
        if not near.any():
            return None
        step = float(np.median(gaps[near] / whole[near]))
    return step if step < 0.4 else None


def _on_rings(
    latitude: FloatArray,
    longitude: FloatArray,
    labels: IntArray,
    step: float,
    centre: float,
    most_cells: int,
    *,
    several: bool,
) -> tuple[RingGrid, IntArray]:
    rows = int(labels.max()) + 1
    sizes = np.bincount(labels, minlength=rows)
    order = np.lexsort((latitude, labels))
    starts = np.append(0, np.cumsum(sizes)[:-1])
    middle = latitude[order][starts + sizes // 2]
    full = float(np.ptp(longitude)) > 2 * np.pi - 4 * step
    if full:  # a full turn has a whole number of columns
        step = 2 * np.pi / max(2, round(2 * np.pi / step))
    step = max(step, 2 * np.pi / MAX_COLUMNS, float(np.ptp(longitude)) * rows / most_cells)

    position = -longitude / step
    spin = np.exp(2j * np.pi * position)
    common = np.angle(spin.sum()) / (2 * np.pi)
    per_ring = np.bincount(labels, spin.real, rows) + 1j * np.bincount(labels, spin.imag, rows)
    phases = np.angle(per_ring * np.exp(-2j * np.pi * common)) / (2 * np.pi)
    phases[np.abs(per_ring) < 0.3 * sizes] = 0.0  # no phase: the ring's points are not at equal steps
    index = position - common - phases[labels]
    column = np.rint(index).astype(np.intp)
    if full:
        columns = max(2, round(2 * np.pi / step))
        half = (columns - 1) // 2
        column = (column + half) % columns
        offset = half
    else:
        offset = -int(column.min())
        columns = max(2, int(column.max()) + offset + 1)
        column = column + offset
    if not several:
        column = _spread_collisions(labels, column, index - np.rint(index), columns)
    # The law's centre is the longitude of column (W - 1)/2 at phase 0.
    law_centre = centre - ((columns - 1) / 2 - offset + common) * step
    law = RingGrid(middle, phases, columns, step, float(wrap_angle(law_centre)))
    return law, labels * law.shape[1] + column


def _spread_collisions(rows: IntArray, column: IntArray, rest: FloatArray, columns: int) -> IntArray:
    """Move the second point of a cell into the empty neighbour on its side: jitter causes such pairs."""
    result = column.copy()
    for direction in (1, -1):
        flat = rows.astype(np.int64) * columns + result
        order = np.lexsort((rest * direction, flat))
        last = np.append(np.diff(flat[order]) != 0, True)
        crowded = np.append(False, np.diff(flat[order]) == 0)
        movers = order[last & crowded]
        movers = movers[(rest[movers] * direction > 0) & (result[movers] + direction < columns)]
        movers = movers[result[movers] + direction >= 0]
        taken = np.unique(flat)
        target = flat[movers] + direction
        at = np.minimum(np.searchsorted(taken, target), len(taken) - 1)
        movers = movers[taken[at] != target]
        result[movers] += direction
    return result
