"""A scan reduced to a coarser grid."""

from __future__ import annotations

import numpy as np

import ladarreg_core as lr
from ladarreg_core.scanner.grids import AzimuthElevation


def thinned(scan: lr.Scan, step: int) -> lr.Scan:
    """Keep every cell of every `step`-th row and column."""
    ranges, intensity = scan.ranges[::step, ::step], scan.intensity[::step, ::step]
    old = scan.geometry
    assert isinstance(old, AzimuthElevation)
    rows, columns = ranges.shape
    offset = [(n - 1 - step * (m - 1)) / 2 for n, m in ((old.columns, columns), (old.rows, rows))]
    steps = old.d_azimuth_rad, old.d_elevation_rad
    geometry = AzimuthElevation(
        rows, columns, step * steps[0], step * steps[1], offset[0] * steps[0], offset[1] * steps[1]
    )
    np.testing.assert_allclose(geometry.rays, scan.rays[::step, ::step], atol=1e-12)
    return lr.Scan(geometry, ranges, intensity)
