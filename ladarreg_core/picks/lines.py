"""Range measurement of a drawn line: its two ends, with the ranges of all the surface between them.

A straight edge in space is straight in both images, whichever points along it were drawn. Along its image at z = 1,
with s the fraction of the way from end to end, the inverse depth is linear:

    1 / z(s) = (1 - s) / z_a + s / z_b

so that the many ranges under the line determine two numbers, each far more certain than a single range, and an end on a
depth edge or in a hole gets its depth from the rest of the line. Two ends with such ranges contain all information of
the line; samples along it would repeat the errors of its ends as if they were independent measurements.

Samples at constant intervals on both sides, as in the thesis, correspond only without perspective; `kappa` relates
them.

Source: thesis 2.3.1 for the lines; least median of squares (Rousseeuw 1984) for ranges of other surfaces.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.foundations.arrays import FloatArray, IntArray
from ladarreg_core.frames import look_along
from ladarreg_core.scan import Scan
from ladarreg_core.surface.ranges import EDGE_FRACTION, MeasuredRanges, measured_ranges, range_quality

_MIN_SAMPLES, _MAX_SAMPLES = 9, 65
_MIN_USED = 3
_MIN_SHARE = 0.5  # of the samples with a return that must lie on one straight line
_MIN_SPAN = 0.3  # of the line's length that they must cover
_GATE_SIGMA = 3.0
_MIN_SPREAD = 5e-4  # of the depth; scatter below a scanner's resolution is meaningless
_MAX_SPREAD = 0.02
_MIN_PAIR = 0.25  # of the line's length between the two samples of a trial line
_NEAR_GATE = 3.0
_CURVED_SIGMA = 4.0
_MIN_FOR_CURVATURE = 12  # samples; fewer share cells, whose noise then looks like curvature


@dataclass(frozen=True, slots=True, eq=False)
class LineOnScan:
    """The straight edge under a line drawn on the scan."""

    rays: FloatArray
    """(2, 3) unit, of its ends, scanner frame."""
    ranges: FloatArray
    """(2,) of its ends, m."""
    range_weights: FloatArray
    """(2,) information of these ranges relative to a single good one; about ten for long lines."""
    sampled: int
    """How many rays were taken along it."""
    used: int
    """How many of them had a return from the straight edge."""


def along_line(ends: FloatArray, fractions: FloatArray) -> NDArray[np.float64]:
    """Return rays (K, 3) at fractions (K,) of the straight line that a perspective view shows between two rays."""
    a, b = _at_unit_depth(ends)
    rays = a + np.asarray(fractions)[:, None] * (b - a)
    return np.asarray(rays / np.linalg.norm(rays, axis=-1, keepdims=True))


def line_on_scan(scan: Scan, ends: FloatArray) -> LineOnScan | None:
    """Fit the straight edge under a drawn line.

    Args:
        scan: the scan.
        ends: (2, 3) unit rays, scanner frame.

    Returns:
        The edge; None if there are too few ranges under the line, or they are not on a straight line.
    """
    s = np.linspace(0, 1, _sample_count(scan, ends))
    rays, found = _snapped_to_outline(scan, along_line(ends, s))
    ranges = found.outline
    a, b = _at_unit_depth(ends)
    # at z = 1 of the line's own view, the length of a ray turns its range into a depth
    length = np.linalg.norm(a + s[:, None] * (b - a), axis=1)
    known = np.isfinite(ranges)
    if np.count_nonzero(known) < _MIN_USED:
        return None
    s, inverse, length = s[known], (length / ranges)[known], length[known]
    on_edge = _consensus(s, inverse)
    if on_edge is None or np.ptp(s[on_edge]) < _MIN_SPAN:
        return None
    # a range's noise in 1/z is that of the range times |d (1/z) / d r| = inverse^2 / length
    information = range_quality(scan, rays[known], _only(found, known)) * (length / inverse**2) ** 2
    design = np.column_stack([1 - s, s])[on_edge]
    weights = information[on_edge]
    try:
        solution = np.linalg.inv(design.T @ (weights[:, None] * design)) @ (design.T * weights)  # (2, K)
    except np.linalg.LinAlgError:
        return None
    at_ends = solution @ inverse[on_edge]
    if not (at_ends > 0).all():
        return None
    end_length = np.linalg.norm(np.stack([a, b]), axis=1)
    end_ranges = end_length / at_ends
    shares, cells = found.shares[known][on_edge], found.cells[known][on_edge]
    variance = _variance(solution / np.sqrt(weights), shares, cells)
    variance = variance * (end_length / at_ends**2) ** 2  # over that of a single range
    return LineOnScan(ends, end_ranges, 1 / variance, len(known), int(np.count_nonzero(on_edge)))


def kappa_of(depths_scan: FloatArray, depths_photo: FloatArray) -> NDArray[np.float64]:
    """Return kappa of lines from the depths of their ends; 1 if an end is not in front of the photo's camera.

    Args:
        depths_scan: (..., 2) along the viewing direction of the view, > 0, m.
        depths_photo: (..., 2) along that of the photo's camera, m.

    Returns:
        (...,) (z_b / z_a in the photo's camera) / (z_b / z_a on the scan's side).
    """
    ahead = np.asarray((depths_photo > 0).all(axis=-1))
    safe = np.where(ahead[..., None], depths_photo, 1.0)
    kappa = (safe[..., 1] / safe[..., 0]) / (depths_scan[..., 1] / depths_scan[..., 0])
    return np.where(ahead, kappa, 1.0)


def fraction_in_photo(fraction: FloatArray, kappa: FloatArray) -> NDArray[np.float64]:
    """Return the position along a line in the photo of the point at `fraction` of the line in the view.

    Args:
        fraction: (N,) s_scan, 0 to 1.
        kappa: (N,) as `kappa_of`, > 0.

    Returns:
        s_photo (N,), with odds(s_photo) = kappa odds(s_scan), odds(s) = s / (1 - s): the image of a point at t of a
        line in space has the odds (z_b / z_a) odds(t).
    """
    return np.asarray(kappa * fraction / (1 - fraction + kappa * fraction))


def _snapped_to_outline(scan: Scan, rays: FloatArray) -> tuple[FloatArray, MeasuredRanges]:
    """Return rays (K, 3) and the ranges along them; rays beside a nearer surface are moved onto it by one cell.

    Lines drawn along outlines are often off by a cell; an outline belongs to the nearer surface, while the range beside
    it is that of the farther one. Measured: 13 % of outlines drawn with .6 cells of noise were on the background.
    """
    cells = np.asarray(scan.geometry.cell_of(rays), dtype=np.float64)
    step = cells[-1] - cells[0]
    across = np.array([-step[1], step[0]]) / max(float(np.hypot(*step)), 1e-12)
    trial = np.stack([rays, scan.geometry.ray_at(cells + across), scan.geometry.ray_at(cells - across)])
    found = measured_ranges(scan, trial.reshape(-1, 3))
    reach = np.nan_to_num(found.outline.reshape(3, -1), nan=np.inf)
    side = 1 + np.argmin(reach[1:], axis=0)
    at = np.arange(len(rays))
    beside = reach[side, at] * (1 + EDGE_FRACTION) < reach[0]
    chosen = np.where(beside, side, 0) * len(rays) + at
    return trial.reshape(-1, 3)[chosen], _only(found, chosen)


def _only(found: MeasuredRanges, chosen: NDArray[Any]) -> MeasuredRanges:
    return MeasuredRanges(*(getattr(found, name)[chosen] for name in MeasuredRanges.__dataclass_fields__))


def _variance(coefficients: FloatArray, shares: FloatArray, cells: IntArray) -> NDArray[np.float64]:
    """Return the variances (2,) of sums of samples (2, K), a sample being shares (K, 4) of cells (K, 4).

    Neighbouring samples share cells, whose noise does not average out twice.
    """
    _, cell = np.unique(cells.ravel(), return_inverse=True)
    parts = coefficients[:, :, None] * shares
    return np.array([(np.bincount(cell, part.ravel()) ** 2).sum() for part in parts])


def _at_unit_depth(ends: FloatArray) -> tuple[FloatArray, FloatArray]:
    forward = look_along(ends.sum(axis=0))[2]
    return ends[0] / (ends[0] @ forward), ends[1] / (ends[1] @ forward)


def _sample_count(scan: Scan, ends: FloatArray) -> int:
    """Return one sample for each cell that the line crosses, within limits: denser ones would share their ranges."""
    cells = np.asarray(scan.geometry.cell_of(ends), dtype=np.float64)
    crossed = np.nan_to_num(np.abs(cells[1] - cells[0]).max(), nan=0.0, posinf=0.0)
    return int(np.clip(np.rint(crossed) + 1, _MIN_SAMPLES, _MAX_SAMPLES))


def _consensus(s: FloatArray, inverse: FloatArray) -> NDArray[np.bool_] | None:
    """Return the samples (K,) on the line that most of them support; None without such a line."""
    first, second = np.triu_indices(len(s), 1)
    far = s[second] - s[first] >= _MIN_PAIR
    if not far.any():
        return None
    first, second = first[far], second[far]
    slope = (inverse[second] - inverse[first]) / (s[second] - s[first])
    error = np.abs(inverse - (inverse[first] - slope * s[first])[:, None] - slope[:, None] * s)
    median = np.median(error, axis=1)
    best = int(np.argmin(median))
    typical = float(np.median(inverse))
    of_few = 1 + 5 / max(len(s) - 2, 1)  # the best of many trials fits few samples too closely
    spread = float(np.clip(1.4826 * of_few * median[best] / typical, _MIN_SPREAD, None))
    if spread > _MAX_SPREAD:
        return None
    gate = _GATE_SIGMA * spread * typical
    on_edge = np.asarray(error[best] <= gate)
    enough = np.count_nonzero(on_edge) >= max(_MIN_USED, _MIN_SHARE * len(s))
    near = error[best] <= _NEAR_GATE * gate  # possibly the same surface, curved
    return on_edge if enough and not _curved(s[near], inverse[near], typical) else None


def _curved(s: FloatArray, inverse: FloatArray, typical: float) -> bool:
    """Return whether a parabola fits samples (K,) so much better than a line that they lie on a curved surface."""
    if len(s) < _MIN_FOR_CURVATURE:
        return False
    x = 2 * s - 1
    design = np.column_stack([np.ones_like(x), x, x * x])
    bend, _, rank, _ = np.linalg.lstsq(design, inverse, rcond=None)
    if rank < 3:
        return False
    error = inverse - design @ bend
    sigma = np.sqrt((error @ error) / (len(s) - 3) * np.linalg.inv(design.T @ design)[2, 2])
    return bool(abs(bend[2]) > max(_CURVED_SIGMA * sigma, _MIN_SPREAD * typical))
