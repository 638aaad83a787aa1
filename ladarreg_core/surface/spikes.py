"""Removal of range spikes: isolated returns that differ from their neighbourhood."""

from __future__ import annotations

import cv2
import numpy as np

from ladarreg_core.foundations.arrays import BoolArray, FloatArray

SPIKE_FRACTION = 0.05
"""A range that differs by more than this fraction from the median of its 5 x 5 cells is a spike. Unremoved, spikes
falsely occlude a twelfth of a room's pixels."""


class NearestValid:
    """The nearest valid cell of every invalid one, found once for several images of the same cells.

    Args:
        valid: (H, W) bool.
    """

    def __init__(self, valid: BoolArray) -> None:
        self._none = not valid.any()
        self._holes = None if valid.all() else ~valid
        if self._none or self._holes is None:
            return
        holes = self._holes.astype(np.uint8)
        _, labels = cv2.distanceTransformWithLabels(holes, cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL)
        rim = valid & (cv2.dilate(holes, np.ones((3, 3), np.uint8)) > 0)  # the nearest cells of holes
        cell_of = np.zeros(int(labels.max()) + 1, np.intp)
        cell_of[labels[rim]] = np.flatnonzero(rim)
        self._nearest = cell_of.take(np.asarray(labels[self._holes], np.intp))

    def fill(self, image: FloatArray) -> FloatArray:
        """Return the image (H, W) with every invalid cell set to its nearest valid one's value; zeros if none is."""
        if self._none:
            return np.zeros_like(image)
        if self._holes is None:
            return image
        filled = image.copy()
        filled[self._holes] = image.reshape(-1).take(self._nearest)
        return filled


def fill_from_nearest(image: FloatArray, valid: BoolArray) -> FloatArray:
    """Return the image (H, W) with every invalid cell set to the value of its nearest valid one.

    An image without any valid cell becomes zeros.
    """
    return NearestValid(valid).fill(image)


def median_range(ranges: FloatArray, nearest: NearestValid | None = None) -> FloatArray:
    """Return the 5 x 5 median of ranges (H, W), float32, m; holes (NaN) count as their nearest return.

    Args:
        ranges: (H, W) m; NaN: no return.
        nearest: of the cells with a return, if it is known.
    """
    filled = (nearest or NearestValid(np.isfinite(ranges))).fill(ranges.astype(np.float32))
    return np.asarray(cv2.medianBlur(np.ascontiguousarray(filled), 5))


def gate_spikes(ranges: FloatArray, median: FloatArray | None = None) -> FloatArray:
    """Return ranges (H, W) float32, m, with spikes set to NaN: those over 5 % off the median of their 5 x 5 cells.

    Args:
        ranges: (H, W) m; NaN: no return.
        median: `median_range` of them, if it is known.
    """
    if median is None:
        median = median_range(ranges)
    with np.errstate(invalid="ignore"):
        spike = np.abs(ranges - median) > SPIKE_FRACTION * median
    return np.where(spike, np.float32(np.nan), ranges).astype(np.float32, copy=False)
