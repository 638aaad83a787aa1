"""The tone curve of sRGB: between the codes of a picture and linear light."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ladarreg_core.foundations.arrays import ByteArray, FloatArray


def linear_light(codes: ArrayLike) -> NDArray[np.float64]:
    """Return the linear light (...,), 0 to 1, of sRGB codes from 0 to 255."""
    c = np.asarray(codes, dtype=np.float64) / 255
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


def encoded_codes(linear: FloatArray) -> NDArray[np.float64]:
    """Return the sRGB codes (...,) of linear light, which is clipped to 0 to 1, not rounded."""
    c = np.clip(linear, 0, 1)
    return np.asarray(255 * np.where(c <= 0.0031308, c * 12.92, 1.055 * c ** (1 / 2.4) - 0.055))


def encoded_light(linear: FloatArray) -> ByteArray:
    """Return the sRGB codes (...,) uint8 of linear light, which is clipped to 0 to 1."""
    return np.asarray(np.rint(encoded_codes(linear)), dtype=np.uint8)
