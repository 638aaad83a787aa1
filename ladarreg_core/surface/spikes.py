"""Removal of range spikes: isolated returns that differ from their neighbourhood."""

from __future__ import annotations

import cv2
import numpy as np

from ladarreg_core.arrays import BoolArray, FloatArray

SPIKE_FRACTION = 0.05
"""A range that differs by more than this fraction from the median of its 5 x 5 cells is a spike. Unremoved, spikes
falsely occlude a twelfth of a room's pixels."""


def fill_from_nearest(image: FloatArray, valid: BoolArray) -> FloatArray:
    """Return the image (H, W) with every invalid cell set to the value of its nearest valid one.

    An image without any valid cell becomes zeros.
    """
    if valid.all():
        return image
    if not valid.any():
        return np.zeros_like(image)
    _, labels = cv2.distanceTransformWithLabels(
        (~valid).astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL
    )
    hole = ~valid
    rim = valid & (cv2.dilate(hole.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0)  # the nearest cells of holes
    value_of = np.zeros(int(labels.max()) + 1, image.dtype)
    value_of[labels[rim]] = image[rim]
    filled = image.copy()
    filled[hole] = value_of[labels[hole]]
    return filled


def median_range(ranges: FloatArray) -> FloatArray:
    """Return the 5 x 5 median of ranges (H, W), float32, m; holes (NaN) count as their nearest return."""
    filled = fill_from_nearest(ranges.astype(np.float32), np.isfinite(ranges))
    return np.asarray(cv2.medianBlur(np.ascontiguousarray(filled), 5))


def gate_spikes(ranges: FloatArray) -> FloatArray:
    """Return ranges (H, W) float32, m, with spikes set to NaN: those over 5 % off the median of their 5 x 5 cells."""
    median = median_range(ranges)
    with np.errstate(invalid="ignore"):
        spike = np.abs(ranges - median) > SPIKE_FRACTION * median
    return np.where(spike, np.float32(np.nan), ranges).astype(np.float32)
