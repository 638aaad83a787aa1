"""Bilinear lookup in images of any size: `cv2.remap` is limited to 32,766 rows and columns."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.foundations.arrays import FloatArray

_LONGEST_SIDE = 32_000
_PIXEL_OUTSIDE = np.float32(-100)


def look_up(
    picture: NDArray[Any], u: FloatArray, v: FloatArray, *, outside: tuple[float, ...] | None = None
) -> NDArray[Any]:
    """Return an image's values at fractional pixels, interpolated bilinearly.

    Args:
        picture: (h, w) or (h, w, C), uint8 or float32.
        u: (H, W) columns, finite; (0, 0) is the centre of the top-left pixel.
        v: (H, W) rows, finite.
        outside: value outside the image, one number per channel; None: that of the nearest border pixel.

    Returns:
        values (H, W) or (H, W, C) of the image's type.
    """
    height, width = u.shape
    if max(height, width) <= _LONGEST_SIDE and max(picture.shape[:2]) <= _LONGEST_SIDE:
        return _remap(picture, u, v, outside)
    result = np.empty((*u.shape, *picture.shape[2:]), dtype=picture.dtype)
    if max(height, width) > _LONGEST_SIDE:
        tiles = _halves(height, width)
        for tile in tiles:
            result[tile] = look_up(picture, u[tile], v[tile], outside=outside)
        return result
    # The image is too large: crop it to the part that these pixels need.
    rows, columns = picture.shape[:2]
    inside = (u > -1) & (u < columns) & (v > -1) & (v < rows)
    if outside is None:
        u, v = np.clip(u, 0, columns - 1), np.clip(v, 0, rows - 1)
        inside = np.ones(u.shape, dtype=np.bool_)
    if not inside.any():
        result[:] = np.array(outside, dtype=picture.dtype) if picture.ndim == 3 else (outside or (0,))[0]
        return result
    top, left = max(int(v[inside].min()) - 1, 0), max(int(u[inside].min()) - 1, 0)
    bottom, right = min(int(v[inside].max()) + 3, rows), min(int(u[inside].max()) + 3, columns)
    if max(bottom - top, right - left) > _LONGEST_SIDE:
        for tile in _halves(height, width):
            result[tile] = look_up(picture, u[tile], v[tile], outside=outside)
        return result
    u, v = (np.where(inside, a - np.float32(b), _PIXEL_OUTSIDE) for a, b in ((u, left), (v, top)))
    return _remap(np.ascontiguousarray(picture[top:bottom, left:right]), u, v, outside)


def _halves(height: int, width: int) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    if height >= width:
        middle = height // 2
        return (slice(0, middle), slice(None)), (slice(middle, None), slice(None))
    middle = width // 2
    return (slice(None), slice(0, middle)), (slice(None), slice(middle, None))


def _remap(picture: NDArray[Any], u: FloatArray, v: FloatArray, outside: tuple[float, ...] | None) -> NDArray[Any]:
    u, v = np.ascontiguousarray(u, dtype=np.float32), np.ascontiguousarray(v, dtype=np.float32)
    if outside is None:
        drawn = cv2.remap(picture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    else:
        drawn = cv2.remap(picture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=outside)
    return np.asarray(drawn, dtype=picture.dtype)
