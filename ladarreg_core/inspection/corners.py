"""Snapping: the corner nearest to a clicked pixel, sub-pixel."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike

from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.inspection.pictures import Stretch, compensated, stretched
from ladarreg_core.matching.features.corners import CornerOptions, find_corners
from ladarreg_core.photo import Photo
from ladarreg_core.surface.perspective import View

_HALF = 16
_REFINED_HALF, _MAX_MOVED_PX = 4, 2.5
_OPTIONS = CornerOptions(count=40, q_min=0.3, pre_blur_px=1.0, non_maximum_px=2, sub_pixel=True, border_px=3)


def nearest_corner(gray: FloatArray, at: ArrayLike, *, reach_px: float = 8.0) -> FloatArray | None:
    """Return the sub-pixel corner (2,) nearest to a pixel; None where there is none within reach.

    Args:
        gray: (h, w) image, 0 to 255.
        at: (u, v).
        reach_px: largest distance, px.

    Source: the thesis's corner detector (2.3.2).
    """
    u, v = np.asarray(at, dtype=np.float64)
    height, width = gray.shape
    if not (np.isfinite([u, v]).all() and 0 <= u <= width - 1 and 0 <= v <= height - 1):
        return None
    left, top = max(round(u) - _HALF, 0), max(round(v) - _HALF, 0)
    window = np.ascontiguousarray(gray[top : round(v) + _HALF + 1, left : round(u) + _HALF + 1], dtype=np.float32)
    if min(window.shape) < 2 * _OPTIONS.border_px + 3:
        return None
    corners = find_corners(window, _OPTIONS)
    if not len(corners):
        return None
    corner = np.array([left, top])
    distance = np.linalg.norm(corners.uv + corner - (u, v), axis=1)
    # Prefer strong corners: a weak one beside a strong one is its texture.
    strong = corners.w >= 0.05 * corners.w.max()
    distance = np.where(strong, distance, np.inf)
    best = int(np.argmin(distance))
    if not distance[best] <= reach_px:
        return None
    refined = _refine(window, corners.uv[best])
    return np.asarray(refined + corner)


def _refine(window: FloatArray, at: FloatArray) -> FloatArray:
    """Return the point where the edges around a corner (2,) intersect.

    The maximum of the detector lies up to a pixel inside the angle. Source: Foerstner and Guelch (1987), as
    `cv2.cornerSubPix`.
    """
    start = np.array([[at]], np.float32)
    ends = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 40, 0.005)
    no_dead_zone = (-1, -1)
    found = np.asarray(cv2.cornerSubPix(window, start, (_REFINED_HALF, _REFINED_HALF), no_dead_zone, ends))[0, 0]
    moved = float(np.linalg.norm(found - at))
    return np.asarray(found if np.isfinite(moved) and moved <= _MAX_MOVED_PX else at, dtype=np.float64)


def gray_of_view(view: View) -> FloatArray:
    """Return the intensity of a view, contrast-stretched, (h, w) float32, 0 to 255."""
    return stretched(compensated(view), np.isfinite(view.ranges), Stretch()).astype(np.float32)


def gray_of_photo(photo: Photo) -> FloatArray:
    """Return a photo in gray levels, (h, w) float32, 0 to 255."""
    return np.asarray(cv2.cvtColor(photo.pixels, cv2.COLOR_RGB2GRAY), dtype=np.float32)
