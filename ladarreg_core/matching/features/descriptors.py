"""Orientation descriptors: samples of the channels around a corner, comparable between laser and camera."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.foundations.arrays import FloatArray

_SIDE = 7
_SPACING_PX = 6


def describe(channels: FloatArray, uv: FloatArray) -> FloatArray:
    """Return the descriptors of pixels: 7 x 7 samples, 6 pixels apart, of the channels.

    Args:
        channels: (H, W, C) normalised channels.
        uv: (N, 2) pixels; samples outside the image take the value of its border.

    Returns:
        (N, 49 C) float32, as `descriptors_of` returns them.
    """
    height, width = channels.shape[:2]
    reach = np.arange(_SIDE) - _SIDE // 2
    dv, du = np.meshgrid(reach * _SPACING_PX, reach * _SPACING_PX, indexing="ij")
    u = np.clip(np.rint(uv[:, 0, None] + du.reshape(-1)).astype(np.intp), 0, width - 1)
    v = np.clip(np.rint(uv[:, 1, None] + dv.reshape(-1)).astype(np.intp), 0, height - 1)
    samples = channels.reshape(-1, channels.shape[-1]).take(v * width + u, axis=0)
    return descriptors_of(samples.reshape(len(uv), _SIDE * _SIDE, channels.shape[-1]))


def descriptors_of(samples: FloatArray) -> FloatArray:
    """Return samples of channels (N, S, C) as descriptors (N, C S) of unit length; zeros without structure.

    The mean of the first channel is removed: how much structure there is does not say which.
    """
    samples[..., 0] -= samples[..., 0].mean(axis=1, keepdims=True)
    count, sampled, channels = samples.shape
    return _of_unit_length(samples.reshape(count, sampled * channels))


def unit_rows(rows: NDArray[Any]) -> FloatArray:
    """Return rows (N, D) with their mean removed and unit length; rows without contrast become zeros."""
    return _of_unit_length(rows - rows.mean(axis=1, keepdims=True))


def _of_unit_length(rows: NDArray[Any]) -> FloatArray:
    length = np.linalg.norm(rows, axis=1, keepdims=True)
    return np.asarray(np.where(length > 1e-6, rows / np.maximum(length, 1e-6), 0), dtype=np.float32)
