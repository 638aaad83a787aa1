"""A scan reduced to a coarser grid."""

from __future__ import annotations

import numpy as np

import ladarreg_core as lr
from ladarreg_core.scanner.grids import AzimuthElevation


def thinned(scan: lr.Scan, step: int, *, columns_too: bool = True) -> lr.Scan:
    """Keep every `step`-th row and column; without the columns' thinning, what a lidar of a few lines measures."""
    steps = step, step if columns_too else 1
    ranges, intensity = (values[:: steps[0], :: steps[1]] for values in (scan.ranges, scan.intensity))
    old = scan.geometry
    assert isinstance(old, AzimuthElevation)
    rows, columns = ranges.shape
    across, down = steps[1] * old.d_azimuth_rad, steps[0] * old.d_elevation_rad
    aside = (old.columns - 1) * old.d_azimuth_rad / 2 - (columns - 1) * across / 2
    above = (old.rows - 1) * old.d_elevation_rad / 2 - (rows - 1) * down / 2
    geometry = AzimuthElevation(rows, columns, across, down, aside, above)
    np.testing.assert_allclose(geometry.rays, scan.rays[:: steps[0], :: steps[1]], atol=1e-12)
    return lr.Scan(geometry, ranges, intensity)
