"""From picks to matches: the scan's range where something was picked, and points along drawn lines."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.arrays import FloatArray
from ladarreg_core.frames import look_along
from ladarreg_core.matches import Matches, Pick
from ladarreg_core.scan import Scan

_SAMPLES_A_LINE = 9
_EDGE_FRACTION = 0.04


def matches_from_picks(scan: Scan, picks: Sequence[Pick]) -> tuple[Matches, tuple[str, ...]]:
    """Return the matches that a solver eats, and a sentence for everything that had to be left out.

    A point takes the range of the surface under it; a line is sampled at constant intervals on both sides. The
    samples of one line are not independent, so each weighs 1 / sqrt of their number. Where the scan has no return, or
    a depth edge runs, nothing is measured.

    Args:
        scan: the scan.
        picks: points and lines; those switched off are skipped.

    Source: thesis 2.3.1.
    """
    rays, uv, ids, fractions, weights = [], [], [], [], []
    for pick in picks:
        if not pick.on:
            continue
        count = 1 if pick.kind == "point" else _SAMPLES_A_LINE
        along = np.zeros(1) if count == 1 else np.linspace(0, 1, count)
        rays.append(_along_line(pick.scan, along))
        uv.append(pick.photo[0] + along[:, None] * (pick.photo[-1] - pick.photo[0]))
        ids += [pick.id] * count
        fractions.append(along)
        weights.append(np.full(count, pick.weight / np.sqrt(count)))
    if not ids:
        return Matches(np.zeros((0, 3)), np.zeros(0), np.zeros((0, 2))), ("No match is switched on.",)
    all_rays = np.concatenate(rays)
    ranges = surface_range(scan, all_rays)
    found = np.isfinite(ranges)
    notes = tuple(
        f"Match {name}: {lost} of {total} points have no usable range (no return, or a depth edge) and are left out."
        for name, lost, total in _losses(ids, found)
    )
    matches = Matches(
        all_rays,
        np.where(found, ranges, 1),
        np.concatenate(uv),
        tuple(ids),
        np.concatenate(fractions),
        np.concatenate(weights),
    )
    return matches.subset(found), notes


def _losses(ids: list[str], found: NDArray[np.bool_]) -> list[tuple[str, int, int]]:
    total = Counter(ids)
    lost = Counter(name for name, known in zip(ids, found.tolist(), strict=True) if not known)
    return [(name, lost[name], total[name]) for name in lost]


def _along_line(ends: FloatArray, along: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return rays (K, 3) at fractions of the straight line that a perspective view shows between two rays."""
    if len(ends) == 1:
        return np.asarray(ends, dtype=np.float64)
    forward = look_along(ends.sum(axis=0))[2]
    first, last = ends[0] / (ends[0] @ forward), ends[1] / (ends[1] @ forward)
    rays = first + along[:, None] * (last - first)
    return np.asarray(rays / np.linalg.norm(rays, axis=-1, keepdims=True))


def surface_range(scan: Scan, rays: FloatArray) -> NDArray[np.float64]:
    """Return the range (N,), m, of the surface that rays (N, 3) meet; NaN without a return or at a depth edge.

    Inside a surface, bilinear in 1/range of the four cells around, which is exact on a plane up to their angles.
    """
    cells = np.asarray(scan.geometry.cell_of(rays), dtype=np.float64)
    height, width = scan.shape
    row, column = cells[:, 0], cells[:, 1]
    with np.errstate(invalid="ignore"):
        inside = (row >= -0.5) & (row <= height - 0.5) & (column >= -0.5) & (column <= width - 0.5)
    row, column = np.where(inside, row, 0), np.where(inside, column, 0)
    i = np.clip(np.floor(row).astype(np.intp), 0, height - 2)
    j = np.clip(np.floor(column).astype(np.intp), 0, width - 2)
    a, b = np.clip(row - i, 0, 1), np.clip(column - j, 0, 1)
    corners = np.stack([scan.ranges[i + di, j + dj] for di in (0, 1) for dj in (0, 1)]).astype(np.float64)
    with np.errstate(invalid="ignore"):
        low, high = corners.min(axis=0), corners.max(axis=0)
        smooth = inside & (high - low <= _EDGE_FRACTION * low)
    weights = np.stack([(1 - a) * (1 - b), (1 - a) * b, a * (1 - b), a * b])
    inverse = (weights / np.where(smooth, corners, 1)).sum(axis=0)
    return np.where(smooth, 1 / inverse, np.nan)
