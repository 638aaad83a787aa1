"""The simplex's parameters and cost over its steps, kept few enough to be drawn at any moment."""

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
    """The curves at one moment."""

    parameters: tuple[NDArray[np.float64], ...]
    """Steps, then Tx, Ty, Tz (m), alpha, beta, gamma (degrees); each (n,)."""
    cost: tuple[NDArray[np.float64], NDArray[np.float64]]
    """Steps, and log10 of the cost; each (n,)."""


class SimplexCurves:
    """Grows by one step at a time; where it grows too long every second step is forgotten, but never the last.

    Source: thesis Figures 3.2 and 3.9.
    """

    def __init__(self, *, most_points: int = MOST_POINTS) -> None:
        if most_points < 4:
            raise OptionError(f"most_points is {most_points}; a curve needs at least 4")
        self._most = most_points
        self._stride, self._seen = 1, 0
        self._earlier, self._number = 0.0, 0
        self._rows: list[tuple[float, ...]] = []
        self._last: tuple[float, ...] | None = None

    def add(self, iteration: int, parameters: ThesisParameters, cost: float) -> None:
        """Add a step.

        Args:
            iteration: its number, from 1; where it does not grow, as when a descent starts again, counting goes on.
            parameters: the best vertex.
            cost: its cost; what is no positive number is drawn as the last one that was.

        Raises:
            ShapeError: if a parameter is not finite.
        """
        p = parameters
        values = [p.Tx, p.Ty, p.Tz, *map(math.degrees, (p.alpha, p.beta, p.gamma))]
        if not all(map(math.isfinite, values)):
            raise ShapeError("a parameter of the simplex is not finite; it needs six finite numbers")
        before = self._last
        if before is not None and iteration <= self._number:
            self._earlier = before[0]
        self._number = iteration
        at = self._earlier + iteration
        level = math.log10(cost) if _LEAST_COST < cost < math.inf else (before[-1] if before else math.nan)
        self._last = (at, *values, level)
        if self._seen % self._stride == 0:
            self._rows.append(self._last)
            if len(self._rows) >= self._most:
                self._rows = self._rows[::2]
                self._stride *= 2
        self._seen += 1

    def __len__(self) -> int:
        return self._seen

    def snapshot(self) -> DrawnCurves:
        """Return what is to be drawn now, the last step always in it; one step that is not known before the first."""
        rows = self._rows
        if self._last is not None and rows[-1] is not self._last:
            rows = [*rows, self._last]
        # A chart that was once without any step never finds its scale again.
        columns = np.ascontiguousarray(np.array(rows or [(0.0, *[math.nan] * 7)], dtype=np.float64).T)
        return DrawnCurves(tuple(columns[:7]), (columns[0], columns[7]))
