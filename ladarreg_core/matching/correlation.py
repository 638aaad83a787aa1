"""Matching every corner of one picture with every corner of the other by one matrix product."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.arrays import FloatArray
from ladarreg_core.features.descriptors import unit_rows

_WINDOW_PX = 15


def edge_picture(gray: FloatArray) -> FloatArray:
    """Return the magnitude of the Sobel gradient (H, W) float32: the thesis's edge detector response."""
    picture = np.ascontiguousarray(gray, dtype=np.float32)
    gx, gy = (np.asarray(cv2.Sobel(picture, cv2.CV_32F, *order), dtype=np.float32) for order in ((1, 0), (0, 1)))
    return np.sqrt(gx * gx + gy * gy)


def windows_at(image: FloatArray, uv: FloatArray, *, side_px: int = _WINDOW_PX) -> FloatArray:
    """Return the windows (N, side^2) around pixels (N, 2), normalised: their products are correlation coefficients."""
    half = side_px // 2
    padded = cv2.copyMakeBorder(image, half, half, half, half, cv2.BORDER_REFLECT)
    view = np.lib.stride_tricks.sliding_window_view(padded, (side_px, side_px))
    u = np.clip(np.rint(uv[:, 0]).astype(np.intp), 0, image.shape[1] - 1)
    v = np.clip(np.rint(uv[:, 1]).astype(np.intp), 0, image.shape[0] - 1)
    return unit_rows(view[v, u].reshape(len(uv), side_px * side_px))


def correlation_product(
    scan_gray: FloatArray, scan_uv: FloatArray, photo_gray: FloatArray, photo_uv: FloatArray
) -> FloatArray:
    """Return m (N, M): the mean of gray-level and edge correlation of each scan corner with each photo corner.

    Source: thesis 2.3.2, m_ij.
    """
    scan = np.hstack([windows_at(scan_gray, scan_uv), windows_at(edge_picture(scan_gray), scan_uv)])
    photo = np.hstack([windows_at(photo_gray, photo_uv), windows_at(edge_picture(photo_gray), photo_uv)])
    return np.asarray(scan @ photo.T / 2)


def unique_matches(
    score: FloatArray, *, margin: float, mutual: bool = True
) -> tuple[NDArray[np.intp], NDArray[np.intp], FloatArray]:
    """Return the pairs whose best score beats the second best by more than `margin`.

    Args:
        score: (N, M) of each scan feature with each photo feature.
        margin: T1 of the thesis: C1 - C2 must exceed it.
        mutual: whether the scan feature must also be the best of the photo feature.

    Returns:
        indices (K,) into the scan's and the photo's features, and their scores (K,).

    Source: thesis 2.3.2, C1 - C2 > T1.
    """
    if score.shape[0] < 1 or score.shape[1] < 2:
        none = np.zeros(0, np.intp)
        return none, none, np.zeros(0)
    best = score.argmax(axis=1)
    rows = np.arange(len(score))
    first = score[rows, best]
    second = np.partition(score, -2, axis=1)[:, -2]
    keep = first - second > margin
    if mutual:
        keep &= score.argmax(axis=0)[best] == rows
    chosen = np.flatnonzero(keep)
    return chosen, best[chosen], first[chosen]
