"""Curves of the simplex parameters and cost over its iterations, thinned so that they can always be drawn."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import OptionError, ShapeError
from ladarreg_core.frames import ThesisParameters

CURVE_NAMES = ("Tx", "Ty", "Tz", "α", "β", "γ")
"""The first three in m, the others in degrees."""
MOST_POINTS = 1200
_LEAST_COST = 1e-30


@dataclass(frozen=True, slots=True, eq=False)
class DrawnCurves:
    """Snapshot of the curves."""

    parameters: tuple[NDArray[np.float64], ...]
    """Iterations, then Tx, Ty, Tz (m), alpha, beta, gamma (degrees); each (n,)."""
    cost: tuple[NDArray[np.float64], NDArray[np.float64]]
    """Iterations and log10 of the cost; each (n,)."""


class SimplexCurves:
    """Collects one iteration at a time; beyond the limit every second one is dropped, but never the last.

    Source: thesis Figures 3.2 and 3.9.
    """

    def __init__(self, *, most_points: int = MOST_POINTS) -> None:
        if most_points < 4:
            raise OptionError(f"most_points is {most_points}; a curve needs at least 4")
        self._most = most_points
        self._stride, self._count = 1, 0
        self._offset, self._number = 0.0, 0
        self._rows: list[tuple[float, ...]] = []
        self._last: tuple[float, ...] | None = None

    def add(self, iteration: int, parameters: ThesisParameters, cost: float) -> None:
        """Add an iteration.

        Args:
            iteration: its number, from 1; where it restarts, as with a new descent, counting continues.
            parameters: the best vertex.
            cost: its cost; a value that is not a positive number is replaced by the last one that was.

        Raises:
            ShapeError: if a parameter is not finite.
        """
        p = parameters
        values = [p.Tx, p.Ty, p.Tz, *map(math.degrees, (p.alpha, p.beta, p.gamma))]
        if not all(map(math.isfinite, values)):
            raise ShapeError("a parameter of the simplex is not finite; it needs six finite numbers")
        before = self._last
        if before is not None and iteration <= self._number:
            self._offset = before[0]
        self._number = iteration
        at = self._offset + iteration
        level = math.log10(cost) if _LEAST_COST < cost < math.inf else (before[-1] if before else math.nan)
        self._last = (at, *values, level)
        if self._count % self._stride == 0:
            self._rows.append(self._last)
            if len(self._rows) >= self._most:
                self._rows = self._rows[::2]
                self._stride *= 2
        self._count += 1

    def __len__(self) -> int:
        return self._count

    def snapshot(self) -> DrawnCurves:
        """Return the current curves, including the last iteration; before the first, a single point of NaN."""
        rows = self._rows
        if self._last is not None and rows[-1] is not self._last:
            rows = [*rows, self._last]
        # A chart that once had no point never recovers its scale.
        columns = np.ascontiguousarray(np.array(rows or [(0.0, *[math.nan] * 7)], dtype=np.float64).T)
        return DrawnCurves(tuple(columns[:7]), (columns[0], columns[7]))
