"""A straight edge drawn in a scan's picture: two places of it in space, and how well they are known across it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ladarreg_core.errors import OptionError
from ladarreg_core.foundations.arrays import FloatArray, read_only
from ladarreg_core.foundations.formatting import format_length
from ladarreg_core.inspection.measuring.points import AT_EDGE, PICKED_PX, MeasuredPoints
from ladarreg_core.picks.lines import LineOnScan, along_line, line_on_scan
from ladarreg_core.scan import Scan
from ladarreg_core.surface.ranges import EDGE_FRACTION, usual_noise_m

MIN_SCAN_LINE_M = 0.001
"""Shortest line that has a direction in space, m."""
_SAMPLES = 9  # along a line, at which it is asked how well it was picked
_MOST = 0.75  # of the ranges under a line, which of a wrong edge may be half
_ENDS = ("first", "second")


@dataclass(frozen=True, slots=True, eq=False)
class LineInScan:
    """A straight edge as a scan shows it."""

    xyz: FloatArray
    """(2, 3) float64, two places of it, scanner frame, m."""
    sigma_m: float
    """Standard deviation of each across the line, in the direction in which it is larger, m."""
    notes: tuple[str, ...] = ()
    """What is doubtful, in sentences."""


def line_in_scan(scan: Scan, rays: ArrayLike, *, sigma_rad: float = 0.0) -> LineInScan:
    """Measure a straight edge that was drawn in a scan.

    As for matches that are lines, its ends get their ranges from the straight edge under all of it, so that they may
    lie at a depth edge or in a hole. Where there is none, each end is measured as a point.

    Args:
        scan: the scan.
        rays: (2, 3) directions of its ends, of any length, scanner frame.
        sigma_rad: standard deviation of each end along each axis, rad, where that is more than half a cell: of what was
            picked in a picture of fewer pixels.

    Returns:
        The line.

    Raises:
        OptionError: if it is too short, or an end has no range and no straight edge is under the line.
        ShapeError: if the rays are not (2, 3), or one has no direction.
    """
    given = read_only(rays, np.float64, (2, 3), "the ends of the line")
    picked = MeasuredPoints.of_scan(scan, rays=given, sigma_rad=sigma_rad)
    ends = given / np.linalg.norm(given, axis=1, keepdims=True)
    edge = line_on_scan(scan, ends) if np.linalg.norm(ends[1] - ends[0]) > 0 else None
    notes: list[str] = []
    if edge is None:
        for which, why in zip(_ENDS, picked.refusals, strict=True):
            if why:
                raise OptionError(
                    f"the line's {which} end {why}; under the whole line there is no straight edge either"
                )
        xyz = picked.xyz
        notes.append(
            "The surface under the line is not straight, or has too few returns: only its two ends count, as points."
        )
        for which, flags in zip(_ENDS, picked.flags, strict=True):
            notes += [f"The {which} end {flag}." for flag in flags]
    else:
        xyz = edge.rays * edge.ranges[:, None]
        notes += _beside_edge(picked, edge)
    along = xyz[1] - xyz[0]
    if np.linalg.norm(along) < MIN_SCAN_LINE_M:
        raise OptionError("the line has no length in the scan, so its direction is unknown; draw it longer")
    noise = 0.0 if edge is None else float((usual_noise_m(scan) / np.sqrt(edge.range_weights)).max())
    return LineInScan(xyz, _sigma_across(scan, ends, xyz, sigma_rad, noise), tuple(notes))


def _beside_edge(picked: MeasuredPoints, edge: LineOnScan) -> list[str]:
    """Return what of a drawn line lies beside the straight edge under most of it, in sentences; by a cell, nothing."""
    own = np.linalg.norm(picked.xyz, axis=1)  # NaN without a range of its own
    off = np.abs(own - edge.ranges)
    with np.errstate(invalid="ignore"):
        beside = off > EDGE_FRACTION * edge.ranges
    beside &= [AT_EDGE not in flags for flags in picked.flags]
    found = [
        f"The {which} end lies on another surface than most of the line, {format_length(float(by))} nearer or farther: "
        "what counts is the straight edge under most of it."
        for which, by, one in zip(_ENDS, off, beside, strict=True) if one
    ]  # fmt: skip
    if not found and edge.used < _MOST * edge.sampled:
        found = [
            "Part of the line runs over another surface, or none: what counts is the straight edge under most of it."
        ]
    return found


def _sigma_across(scan: Scan, ends: FloatArray, xyz: FloatArray, sigma_rad: float, noise_m: float) -> float:
    """Return the standard deviation of the ends of a line (2, 3) across it: by where it was picked, and by the noise.

    On a surface, what is picked beside the edge lies nearer or farther, too; at an outline it does not.
    """
    rays = along_line(ends, np.linspace(0, 1, _SAMPLES))
    picked = MeasuredPoints.of_scan(scan, rays=rays, sigma_rad=sigma_rad)
    across = np.linalg.svd((xyz[1] - xyz[0])[None])[2][1:]
    on_surface = np.array([not why for why in picked.refusals])
    own = picked.own[on_surface] @ across.T
    widest = [float(np.linalg.norm(one, ord=2)) for one in own]
    aside = max(sigma_rad, PICKED_PX * max(scan.geometry.step_rad)) * float(np.linalg.norm(xyz, axis=1).max())
    return float(np.hypot(max(aside, float(np.median(widest)) if widest else 0.0), noise_m))
