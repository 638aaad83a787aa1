"""Where a scan has structure to compare: detail that two independent halves of its cells show alike.

Bare walls and ceilings fill most of a full-dome scan. Normalised, their speckle and range noise would be compared with
the photograph like structure, and its regions would disagree at any pose.
"""

from __future__ import annotations

import cv2
import numpy as np

from ladarreg_core.foundations.arrays import BoolArray, FloatArray
from ladarreg_core.surface.spikes import fill_from_nearest

_MIN_CORRELATION = 0.4
_FINE_CELLS, _COARSE_CELLS = 1.0, 6.0  # detail is what lies between these scales
_WINDOW = (17, 33)  # columns of a half, rows: a third of a block's area at one pixel per cell
_SMALL_WINDOW = (5, 9)  # the same of a coarse scan
_FIT_PX = 7  # side of the window that a plane is fitted in
_MIN_FITTED = 8
_SHELL = 1.3  # ratio of ranges that are compared with each other
_PLANE_SHARE = 0.3  # at least this share of a scan's surfaces at any range is plane ...
_ABOVE_NOISE = 2.5  # ... and so many times what these leave is no noise
_TINY = 1e-12
_MIN_COLUMNS = 8


def structured_cells(ranges: FloatArray, gray: FloatArray) -> BoolArray:
    """Return the cells (H, W) around which even and odd columns show the same detail, in intensity or in range.

    The noise of neighbouring cells is independent. Where it is not, because the scan was smoothed or resampled, all
    cells count as structured.

    Args:
        ranges: (H, W) m, without spikes; NaN = no return.
        gray: (H, W) gray levels of the laser's intensity, without holes.
    """
    height, width = ranges.shape
    if width < _MIN_COLUMNS:
        return np.ones((height, width), np.bool_)
    valid = np.isfinite(ranges)
    log_range = np.log(np.maximum(fill_from_nearest(np.asarray(ranges, np.float32), valid), _TINY)).astype(np.float32)
    alike = np.maximum(_correlation(np.asarray(gray, np.float32)), _correlation(log_range)) > _MIN_CORRELATION
    return np.asarray(cv2.resize(alike.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0)


def painted_cells(gray: FloatArray) -> BoolArray:
    """Return the cells (H, W) of a coarse scan around which even and odd columns show the same detail of intensity.

    Args:
        gray: (H, W) gray levels of the laser's intensity, without holes.
    """
    height, width = gray.shape
    if width < _MIN_COLUMNS:
        return np.ones((height, width), np.bool_)
    alike = _correlation(np.asarray(gray, np.float32), _SMALL_WINDOW) > _MIN_CORRELATION
    return np.asarray(cv2.resize(alike.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0)


def shaped_pixels(ranges: FloatArray, *, focal_px: float, cell_rad: float) -> BoolArray:
    """Return the pixels (h, w) of a view around which the returns lie on no plane: at outlines, edges and steps.

    The ground fills half of a scan outdoors and shows nothing; normalised, its noise would be compared with the
    photograph. A plane's inverse range is linear in a perspective view, however obliquely it is seen. What remains is
    measured square to the plane, as an angle seen from the scanner, and compared with what the planes at about the same
    range leave: that is the noise. A cell's width is enough at any noise.

    Args:
        ranges: (h, w) m; NaN = no return.
        focal_px: focal length of the view.
        cell_rad: angle between neighbouring returns in the scan's finer direction.
    """
    valid = np.isfinite(ranges)
    found = np.zeros(ranges.shape, np.bool_)
    if not valid.any():
        return found
    inverse = np.where(valid, 1 / np.where(valid, ranges, 1), 0).astype(np.float64)
    inverse /= float(np.median(inverse[valid]))  # the sums below are then of about equal size
    left, across, down, fitted = _plane_residuals(inverse, valid)
    tangent = np.hypot(across, down) * focal_px / inverse[fitted]  # of the angle of incidence
    off = left / inverse[fitted] / np.hypot(1, tangent)
    shell = np.floor(np.log(ranges[fitted]) / np.log(_SHELL)).astype(np.int64)
    shell -= shell.min(initial=0)
    least = np.zeros(len(off))
    for number in np.unique(shell):
        noise = float(np.quantile(off[np.abs(shell - number) <= 1], _PLANE_SHARE))
        least[shell == number] = min(_ABOVE_NOISE * noise, cell_rad)
    found[fitted] = off > least
    return found


def _plane_residuals(inverse: FloatArray, valid: BoolArray) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
    """Return RMS residual, horizontal and vertical slope (N,) of the planes fitted around pixels, and which (h, w)."""
    offset = np.arange(_FIT_PX, dtype=np.float64) - _FIT_PX // 2
    one = np.ones(_FIT_PX)

    def moment(values: FloatArray, x: FloatArray, y: FloatArray) -> FloatArray:
        return np.asarray(cv2.sepFilter2D(values, cv2.CV_64F, x, y, borderType=cv2.BORDER_CONSTANT))

    weight = valid.astype(np.float64)
    count = np.rint(moment(weight, one, one))
    fitted = np.asarray(valid & (count >= _MIN_FITTED))
    n = count[fitted]
    total, by_x, by_y = (moment(inverse, x, y)[fitted] for x, y in ((one, one), (offset, one), (one, offset)))
    squares = moment(inverse * inverse, one, one)[fitted]
    x, y, xx, yy, xy = (
        moment(weight, *axes)[fitted]
        for axes in ((offset, one), (one, offset), (offset**2, one), (one, offset**2), (offset, offset))
    )
    # the normal equations about the centre of the returns
    xx, yy, xy = xx - x * x / n, yy - y * y / n, xy - x * y / n
    rhs_x, rhs_y = by_x - x * total / n, by_y - y * total / n
    determinant = np.maximum(xx * yy - xy * xy, 1e-9)
    across, down = (yy * rhs_x - xy * rhs_y) / determinant, (xx * rhs_y - xy * rhs_x) / determinant
    rest = squares - total * total / n - across * rhs_x - down * rhs_y
    return np.sqrt(np.maximum(rest, 0) / (n - 3)), across, down, fitted


def _correlation(image: FloatArray, window: tuple[int, int] = _WINDOW) -> FloatArray:
    """Return the local correlation (H, W // 2) of the detail of even columns with that of the odd ones beside them."""
    count = image.shape[1] // 2
    even, odd = image[:, 0 : 2 * count : 2], image[:, 1 : 2 * count : 2]
    beside = odd.copy()
    beside[:, 1:] = (odd[:, 1:] + odd[:, :-1]) / 2  # on both sides of the even column
    first, second = _detail(np.ascontiguousarray(even)), _detail(beside)

    def mean(values: FloatArray) -> FloatArray:
        return np.asarray(cv2.blur(values, window))

    length = np.sqrt(np.maximum(mean(first * first) * mean(second * second), 0))
    return np.asarray(mean(first * second) / (length + np.float32(_TINY)))


def _detail(half: FloatArray) -> FloatArray:
    fine, coarse = (
        cv2.GaussianBlur(half, (0, 0), sigmaX=cells / 2, sigmaY=cells) for cells in (_FINE_CELLS, _COARSE_CELLS)
    )
    return np.asarray(fine - coarse)
