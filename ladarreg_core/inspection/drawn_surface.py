"""What a picture of a coarse scan shows between its lines: the surface on which a pick there would lie.

A 64-line lidar leaves most pixels of a view between two returns, and an accumulated cloud has cells without any. The
nearest cell there makes steps and specks on which nobody can point at anything. A pixel is therefore given the range of
a pick on it, and the intensity of the same returns; where there is none, it stays as it was.
"""

from __future__ import annotations

from weakref import WeakKeyDictionary

import cv2
import numpy as np

from ladarreg_core.foundations.arrays import BoolArray, FloatArray
from ladarreg_core.surface.perspective import View
from ladarreg_core.surface.ranges import measured_ranges

_COARSE_RAD = 2e-3  # of the coarser direction; a terrestrial scanner is finer by an order of magnitude
_MAX_PIXELS = 1_500_000  # of a view; a larger one would take minutes
_WINDOW, _MIN_RETURNS = (9, 5), 6  # with fewer in so many columns and rows there is no surface to be found
_PIXELS_AT_ONCE = 40_000
_drawn: WeakKeyDictionary[View, tuple[FloatArray, FloatArray]] = WeakKeyDictionary()


def drawn_surface(view: View) -> tuple[FloatArray, FloatArray]:
    """Return the ranges and the intensity with which a view is drawn.

    Args:
        view: the view. What was found is kept for as long as the view is.

    Returns:
        Ranges, (h, w) float32 m, NaN without a surface; intensity, (h, w) float32. Those of the view itself if the
        scan's cells are closer than 2 mrad in both directions, or the view has more than 1.5 Mpixel.
    """
    if max(view.scan.geometry.step_rad) < _COARSE_RAD or view.intensity.size > _MAX_PIXELS:
        return view.ranges, view.intensity
    found = _drawn.get(view)
    if found is None:
        found = _drawn[view] = _between_lines(view)
    return found


def _between_lines(view: View) -> tuple[FloatArray, FloatArray]:
    ranges, intensity = view.ranges.copy(), view.intensity.copy()
    scan = view.scan
    reflected = np.where(scan.valid, scan.intensity, 0).reshape(-1)
    returned = scan.valid.reshape(-1)
    pixels = np.argwhere(view.inside & _near_returns(view))
    for first in range(0, len(pixels), _PIXELS_AT_ONCE):
        row, column = pixels[first : first + _PIXELS_AT_ONCE].T
        found = measured_ranges(scan, view.rays_at(np.column_stack([column, row]).astype(np.float64)))
        known = np.isfinite(found.sigma)  # the others are of the four cells beside the ray, as the view has them
        row, column, cells = row[known], column[known], found.cells[known]
        ranges[row, column] = found.ranges[known]
        shares = found.shares[known] * returned[cells]
        total = shares.sum(axis=1)
        lit = total > 0
        intensity[row[lit], column[lit]] = (shares * reflected[cells]).sum(axis=1)[lit] / total[lit]
    return ranges, intensity


def _near_returns(view: View) -> BoolArray:
    """Return the pixels (h, w) around which there are returns enough; most of the sky has none."""
    count = cv2.boxFilter(view.scan.valid.astype(np.float32), -1, _WINDOW, normalize=False)
    enough = (count > _MIN_RETURNS - 0.5).astype(np.float32)
    return np.asarray(view.resample(enough) > 0)
