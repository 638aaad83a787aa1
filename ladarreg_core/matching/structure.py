"""Where a scan has structure to compare: detail that two independent halves of its cells show alike.

Bare walls and ceilings fill most of a full-dome scan. Normalised, their speckle and range noise would be compared with
the photograph like structure, and its regions would disagree at any pose.
"""

from __future__ import annotations

import cv2
import numpy as np

from ladarreg_core.arrays import BoolArray, FloatArray
from ladarreg_core.surface.spikes import fill_from_nearest

_MIN_CORRELATION = 0.4
_FINE_CELLS, _COARSE_CELLS = 1.0, 6.0  # detail is what lies between these scales
_WINDOW = (17, 33)  # columns of a half, rows: a third of a block's area at one pixel per cell
_TINY = 1e-12
_LEAST_COLUMNS = 8


def structured_cells(ranges: FloatArray, gray: FloatArray) -> BoolArray:
    """Return the cells (H, W) around which even and odd columns show the same detail, in intensity or in range.

    The noise of neighbouring cells is independent. Where it is not, because the scan was smoothed or resampled, all
    cells count as structured.

    Args:
        ranges: (H, W) m, without spikes; NaN = no return.
        gray: (H, W) gray levels of the laser's intensity, without holes.
    """
    height, width = ranges.shape
    if width < _LEAST_COLUMNS:
        return np.ones((height, width), np.bool_)
    valid = np.isfinite(ranges)
    log_range = np.log(np.maximum(fill_from_nearest(np.asarray(ranges, np.float32), valid), _TINY)).astype(np.float32)
    alike = np.maximum(_correlation(np.asarray(gray, np.float32)), _correlation(log_range)) > _MIN_CORRELATION
    return np.asarray(cv2.resize(alike.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0)


def _correlation(image: FloatArray) -> FloatArray:
    """Return the local correlation (H, W // 2) of the detail of even columns with that of the odd ones beside them."""
    count = image.shape[1] // 2
    even, odd = image[:, 0 : 2 * count : 2], image[:, 1 : 2 * count : 2]
    beside = odd.copy()
    beside[:, 1:] = (odd[:, 1:] + odd[:, :-1]) / 2  # on both sides of the even column
    first, second = _detail(np.ascontiguousarray(even)), _detail(beside)

    def mean(values: FloatArray) -> FloatArray:
        return np.asarray(cv2.blur(values, _WINDOW))

    length = np.sqrt(np.maximum(mean(first * first) * mean(second * second), 0))
    return np.asarray(mean(first * second) / (length + np.float32(_TINY)))


def _detail(half: FloatArray) -> FloatArray:
    fine, coarse = (
        cv2.GaussianBlur(half, (0, 0), sigmaX=cells / 2, sigmaY=cells) for cells in (_FINE_CELLS, _COARSE_CELLS)
    )
    return np.asarray(fine - coarse)
