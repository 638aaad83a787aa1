"""What a scan measured where an operator points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ladarreg_core.scan import Scan
from ladarreg_core.surface.ranges import measured_ranges


@dataclass(frozen=True, slots=True)
class Probe:
    """A measurement."""

    range_m: float | None
    """Along the ray, m; None without a return, or at a depth edge."""
    intensity: float | None
    """Of the nearest cell, in the sensor's unit; None outside the grid."""
    cell: tuple[float, float] | None
    """Fractional row and column; None outside the grid."""


def probe(scan: Scan, ray: ArrayLike) -> Probe:
    """Return what was measured along a unit ray (3,), scanner frame."""
    direction = np.asarray(ray, dtype=np.float64)[None]
    row, column = (float(v) for v in np.asarray(scan.geometry.cell_of(direction), dtype=np.float64)[0])
    height, width = scan.shape
    if not (-0.5 <= row <= height - 0.5 and -0.5 <= column <= width - 0.5):
        return Probe(None, None, None)
    measured = float(measured_ranges(scan, direction).ranges[0])
    nearest = scan.intensity[min(max(round(row), 0), height - 1), min(max(round(column), 0), width - 1)]
    return Probe(measured if np.isfinite(measured) else None, float(nearest), (row, column))
