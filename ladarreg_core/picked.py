"""From picks to matches: the scan's range where something was picked, and points along drawn lines."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.arrays import FloatArray
from ladarreg_core.camera import Camera
from ladarreg_core.errors import OptionError
from ladarreg_core.frames import look_along
from ladarreg_core.matches import Matches, Pick
from ladarreg_core.scan import Scan

SAMPLES_PER_LINE = 9
"""Points taken along a drawn line where nothing else is said."""
_MOST_SAMPLES = 1000
_EDGE_FRACTION = 0.04


def check_samples(samples_per_line: object) -> None:
    """Raise an OptionError if a line cannot be sampled by so many points."""
    whole = isinstance(samples_per_line, int) and not isinstance(samples_per_line, bool)
    if not whole or not 2 <= samples_per_line <= _MOST_SAMPLES:  # type: ignore[operator]
        raise OptionError(f"samples_per_line is {samples_per_line!r}; it must be a whole number from 2 to 1000")


def matches_from_picks(
    scan: Scan, picks: Sequence[Pick], *, camera: Camera | None = None, samples_per_line: int = SAMPLES_PER_LINE
) -> tuple[Matches, tuple[str, ...]]:
    """Return the matches that a solver eats, and a sentence for everything that had to be left out.

    A point takes the range of the surface under it; a line is sampled at constant intervals on both sides. The
    samples of one line are not independent, so each weighs 1 / sqrt of their number. Where the scan has no return, or
    a depth edge runs, nothing is measured.

    Args:
        scan: the scan.
        picks: points and lines; those switched off are skipped, and lines of no length left out.
        camera: the photo's; what lies outside its picture is left out.
        samples_per_line: points along each line, its ends among them.

    Raises:
        OptionError: if `samples_per_line` is not a whole number from 2 to 1000.

    Source: thesis 2.3.1.
    """
    check_samples(samples_per_line)
    rays, uv, ids, fractions, weights = [], [], [], [], []
    refused: list[str] = []
    for pick in picks:
        if not pick.on:
            continue
        if pick.kind == "line" and ((pick.scan[0] == pick.scan[1]).all() or (pick.photo[0] == pick.photo[1]).all()):
            refused.append(f"Match {pick.id} is a line of no length and is left out; draw it again.")
            continue
        count = 1 if pick.kind == "point" else samples_per_line
        along = np.zeros(1) if count == 1 else np.linspace(0, 1, count)
        rays.append(_along_line(pick.scan, along))
        uv.append(pick.photo[0] + along[:, None] * (pick.photo[-1] - pick.photo[0]))
        ids += [pick.id] * count
        fractions.append(along)
        weights.append(np.full(count, pick.weight / np.sqrt(count)))
    if not ids:
        nothing = Matches(np.zeros((0, 3)), np.zeros(0), np.zeros((0, 2)))
        return nothing, tuple(refused) or ("No match is switched on.",)
    all_rays = np.concatenate(rays)
    ranges, edge = _measured(scan, all_rays)
    all_uv = np.concatenate(uv)
    outside = np.zeros(len(ids), np.bool_) if camera is None else ~camera.contains(all_uv, border=-0.5)
    found = np.isfinite(ranges) & ~outside
    matches = Matches(
        all_rays,
        np.where(found, ranges, 1),
        all_uv,
        tuple(ids),
        np.concatenate(fractions),
        np.concatenate(weights),
    )
    return matches.subset(found), (*refused, *_losses(ids, found, edge & ~outside, outside))


def _losses(
    ids: list[str], found: NDArray[np.bool_], edge: NDArray[np.bool_], outside: NDArray[np.bool_]
) -> tuple[str, ...]:
    """Return a sentence for every pick that lost points, with the cause."""
    total = Counter(ids)
    at_edge = Counter(name for name, lost in zip(ids, (~found & edge).tolist(), strict=True) if lost)
    empty = Counter(name for name, lost in zip(ids, (~found & ~edge & ~outside).tolist(), strict=True) if lost)
    beyond = Counter(name for name, lost in zip(ids, outside.tolist(), strict=True) if lost)
    sentences = []
    for name in dict.fromkeys(ids):
        causes = [
            f"{count[name]} {words}"
            for count, words in (
                (beyond, "outside the photo"),
                (empty, "without a return"),
                (at_edge, "at a depth edge"),
            )
            if count[name]
        ]
        if causes:
            lost = at_edge[name] + empty[name] + beyond[name]
            sentences.append(f"Match {name}: {lost} of {total[name]} points are left out, {' and '.join(causes)}.")
    return tuple(sentences)


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
    return _measured(scan, rays)[0]


def _measured(scan: Scan, rays: FloatArray) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the range (N,) of `surface_range`, and whether a depth edge (N,) is why there is none."""
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
        edge = inside & (high - low > _EDGE_FRACTION * low)
    weights = np.stack([(1 - a) * (1 - b), (1 - a) * b, a * (1 - b), a * b])
    inverse = (weights / np.where(smooth, corners, 1)).sum(axis=0)
    return np.where(smooth, 1 / inverse, np.nan), np.asarray(edge)
