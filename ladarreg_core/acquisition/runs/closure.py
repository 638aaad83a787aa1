"""The closure of a run: the first stop measured again at the end, which shows whether the unit lost steps."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.acquisition.interfaces import PanTilt
from ladarreg_core.acquisition.line_sweep import LineSweep
from ladarreg_core.scan import Scan

MAX_APART = 0.05
"""Share of the returns that may be elsewhere the second time: a passer-by, edges."""
SEARCHED_DEG = 6.0
"""How far around the first stop the place is sought that looks like the second measurement."""
_APART_M, _APART_SHARE = 0.03, 0.01
_CAPPED_M = 0.1
_BETTER = 0.7  # of what is left of the differences where the unit has slipped; noise cannot be had away by turning
_SAME_DEG = 0.25
_LATENCY_S = 0.1  # of the readings of a unit that moves, which is found only with the mount
_FEWEST_RETURNS = 50
_SLOPE_LINES, _STRAIGHT_M, _ROUNDS, _OUTLIER, _SIGMAS = 9, 0.4, 4, 4.0, 6.0
_MAX_SHIFTS = 12  # to each side; coarser steps for finer scans

Values = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Closure:
    """What the first stop looked like at the end of a run."""

    closed: bool
    """Whether it was as before, or too little was seen to say."""
    apart: float | None
    """Share of the returns that were clearly elsewhere; None if too few directions have two."""
    slip_deg: tuple[float, float] | None = None
    """Pan and tilt by which the unit seems to be off."""

    def sentence(self) -> str:
        """Return what is wrong and what to do; of a run that has closed, that it has."""
        if self.apart is None:
            return "the first stop could not be compared at the end: too few directions have a return both times"
        if self.closed:
            return f"the first stop looked the same at the end ({self.apart:.1%} of it elsewhere)"
        slip = ""
        if self.slip_deg is not None:
            slip = f": it looks like pan {self.slip_deg[0]:+.2f}, tilt {self.slip_deg[1]:+.2f} deg from there"
        return (
            f"the run does not close: at the end {self.apart:.0%} of the first stop was elsewhere{slip}. The unit has "
            "lost steps, the scanner was knocked, or much has moved in the room; look where the pieces begin not to "
            "fit and measure them again, or resume the run if something was only in the way at its end"
        )

    def as_fields(self) -> dict[str, Any]:
        """Return it as `closure.json` states it."""
        slip = None if self.slip_deg is None else list(self.slip_deg)
        return {"closed": self.closed, "apart": self.apart, "slip_deg": slip, "said": self.sentence()}


def closure_of_sweep(first: LineSweep, again: LineSweep, beside: Iterable[LineSweep], at: PanTilt) -> Closure:
    """Return whether the first stop of a sweep, or the beginning of a pass, is as it was.

    Args:
        first: the piece of the first stop, or the first pass of a unit that moves.
        again: what was measured there at the end, by a unit at rest.
        beside: pieces of the stops beside it at the same tilt, which show where the unit may have been instead.
        at: the first stop, as read back.
    """
    line = _median(again)
    found: list[tuple[float, Values]] = []
    for sweep in (first, *beside):
        stops = [(float(sweep.pan_rad[0]), _median(sweep))] if sweep.track is None else (
            list(zip(sweep.pan_rad.tolist(), sweep.ranges_m, strict=True))
        )  # fmt: skip
        for pan, ranges in stops:
            offset = math.degrees((pan - at.pan_rad + math.pi) % (2 * math.pi) - math.pi)
            if abs(offset) <= SEARCHED_DEG and ranges.shape == line.shape:
                found.append((offset, ranges))
    if not found:
        return Closure(True, None)
    same = _SAME_DEG + (0.0 if first.track is None else _speed_deg_s(first) * _LATENCY_S)
    own = [pair for pair in found if abs(pair[0]) <= same] or [min(found, key=lambda pair: abs(pair[0]))]
    kept = min(own, key=lambda pair: _left(line, pair[1]))
    best = min(found, key=lambda pair: _left(line, pair[1]))
    apart = _apart(line, kept[1])
    if apart is None:
        return Closure(True, None)
    slip = best[0] - kept[0]
    slipped = abs(slip) > same and _left(line, best[1]) < _BETTER * _left(line, kept[1])
    if not slipped:  # it may be between the stops, or beyond the first
        slip, sigma = _slip_of_slope(line, kept, found)
        slipped = abs(slip) > max(same, _SIGMAS * sigma)
    return Closure(apart <= MAX_APART and not slipped, apart, (slip, 0.0) if slipped else None)


def _slip_of_slope(line: Values, own: tuple[float, Values], found: list[tuple[float, Values]]) -> tuple[float, float]:
    """Return by what angle a line was turned, deg, and its standard deviation, from surfaces that are seen obliquely.

    The lines beside the first stop show how fast the range of each ray changes with the angle.
    """
    near = sorted(found, key=lambda pair: abs(pair[0] - own[0]))[:_SLOPE_LINES]
    offsets = np.array([offset for offset, _ in near]) - own[0]
    if len(near) < 3 or np.ptp(offsets) < _SAME_DEG:
        return 0.0, math.inf
    ranges = np.stack([ranges for _, ranges in near]).astype(np.float64)
    centred = offsets - offsets.mean()
    slope = centred @ (ranges - ranges.mean(axis=0)) / (centred @ centred)  # NaN where a return is missing
    level = ranges.mean(axis=0) - slope * offsets.mean()
    bent = np.abs(ranges - level - slope * offsets[:, None]).max(axis=0)
    missing = np.asarray(line, np.float64) - level
    with np.errstate(invalid="ignore"):
        use = (bent < _APART_M + _APART_SHARE * level) & (np.abs(missing) < _STRAIGHT_M)
    if use.sum() < _FEWEST_RETURNS:
        return 0.0, math.inf
    slip, sigma = 0.0, math.inf
    for _ in range(_ROUNDS):
        if not (information := float(slope[use] @ slope[use])):
            return 0.0, math.inf
        slip = float(slope[use] @ missing[use]) / information
        rest = missing - slip * slope
        noise = 1.4826 * float(np.median(np.abs(rest[use]))) + 1e-4
        sigma = noise / math.sqrt(information)
        use &= np.abs(rest) < _OUTLIER * noise
    return slip, sigma


def _median(sweep: LineSweep) -> Values:
    """Return the median of each ray (N,) of the lines of a stop."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # rays without a return
        return np.asarray(np.nanmedian(sweep.ranges_m, axis=0), np.float32)


def _speed_deg_s(sweep: LineSweep) -> float:
    """Return the mean speed of a unit that moves."""
    assert sweep.track is not None
    return float(np.degrees(np.ptp(sweep.track.pan_rad)) / max(float(np.ptp(sweep.track.time_s)), 1e-3))


def closure_of_scans(first: Scan, again: Scan) -> Closure:
    """Return whether a scan at the first stop is as it was; scans of different grids cannot be compared."""
    if first.shape != again.shape:
        return Closure(True, None)
    apart = _apart(again.ranges, first.ranges)
    if apart is None:
        return Closure(True, None)
    steps = _steps_deg(first)
    shifts = [np.unique(np.linspace(-most, most, 2 * min(most, _MAX_SHIFTS) + 1).round().astype(int))
              for most in (int(SEARCHED_DEG // max(step, 1e-6)) for step in steps)]  # fmt: skip
    stride = max(1, round(math.sqrt(first.ranges.size / 20_000)))
    still = _shifted(first.ranges, again.ranges, 0, 0, stride)
    left, down, right = still, 0, 0
    for rows in shifts[0]:
        for columns in shifts[1]:
            tried = _shifted(first.ranges, again.ranges, int(rows), int(columns), stride)
            if tried < left:
                left, down, right = tried, int(rows), int(columns)
    slipped = left < _BETTER * still and max(abs(down) * steps[0], abs(right) * steps[1]) > _SAME_DEG
    # A scan that is turned to the left shows everything farther to its right.
    slip = (right * steps[1], down * steps[0]) if slipped else None
    return Closure(apart <= MAX_APART and not slipped, apart, slip)


def _shifted(first: Values, again: Values, rows: int, columns: int, stride: int) -> float:
    """Return what is left of the differences if what was at a cell is so many cells farther down and to the right."""
    height, width = first.shape
    before = first[max(0, -rows) : height - max(0, rows), max(0, -columns) : width - max(0, columns)]
    after = again[max(0, rows) : height - max(0, -rows), max(0, columns) : width - max(0, -columns)]
    return _left(after[::stride, ::stride], before[::stride, ::stride])


def _steps_deg(scan: Scan) -> tuple[float, float]:
    """Return the steps of a scan's grid, down and across, at its middle."""
    rows, columns = scan.shape
    row, column = rows // 2, columns // 2
    at = np.array([[row, column], [min(row + 1, rows - 1), column], [row, min(column + 1, columns - 1)]], float)
    here, below, beside = scan.geometry.ray_at(at)
    down, across = (float(np.arccos(np.clip(here @ other, -1, 1))) for other in (below, beside))
    return math.degrees(down), math.degrees(across)


def _apart(again: Values, before: Values) -> float | None:
    """Return the share of directions with returns clearly apart; None if too few have two."""
    both = np.isfinite(again) & np.isfinite(before)
    if both.sum() < _FEWEST_RETURNS:
        return None
    far = np.abs(again[both] - before[both]) > _APART_M + _APART_SHARE * before[both]
    return float(far.mean())


def _left(again: Values, before: Values) -> float:
    """Return the mean difference, each capped so that edges and what has moved do not decide, m."""
    both = np.isfinite(again) & np.isfinite(before)
    if both.sum() < _FEWEST_RETURNS:
        return _CAPPED_M
    return float(np.minimum(np.abs(again[both] - before[both]), _CAPPED_M).mean())
