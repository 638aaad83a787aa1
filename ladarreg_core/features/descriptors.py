"""Orientation descriptors: samples of the channels around a corner, comparable between laser and camera."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.arrays import FloatArray

_SIDE = 7
_SPACING_PX = 6


def describe(channels: FloatArray, uv: FloatArray) -> FloatArray:
    """Return the descriptors of pixels: 7 x 7 samples, 6 pixels apart, of the eight channels.

    Args:
        channels: (H, W, 8) normalised channels.
        uv: (N, 2) pixels; samples outside the image take the value of its border.

    Returns:
        (N, 392) float32, mean removed, unit length; zeros without structure.
    """
    height, width = channels.shape[:2]
    reach = np.arange(_SIDE) - _SIDE // 2
    dv, du = np.meshgrid(reach * _SPACING_PX, reach * _SPACING_PX, indexing="ij")
    u = np.clip(np.rint(uv[:, 0, None] + du.reshape(-1)).astype(np.intp), 0, width - 1)
    v = np.clip(np.rint(uv[:, 1, None] + dv.reshape(-1)).astype(np.intp), 0, height - 1)
    samples = channels.reshape(-1, channels.shape[-1]).take(v * width + u, axis=0)
    return unit_rows(samples.reshape(len(uv), _SIDE * _SIDE * channels.shape[-1]))


def unit_rows(rows: NDArray[Any]) -> FloatArray:
    """Return rows (N, D) with their mean removed and unit length; rows without contrast become zeros."""
    centred = rows - rows.mean(axis=1, keepdims=True)
    length = np.linalg.norm(centred, axis=1, keepdims=True)
    return np.asarray(np.where(length > 1e-6, centred / np.maximum(length, 1e-6), 0), dtype=np.float32)
