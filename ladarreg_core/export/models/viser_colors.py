"""Compensation of viser's filmic tone mapping: textures and lines that are displayed in their true colours."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ladarreg_core.foundations.arrays import ByteArray
from ladarreg_core.foundations.linear_light import encoded_light, linear_light

VISER_BASE_COLOR = 8.0
"""Factor on the texture: the curve needs 15 times white to display white, and an 8-bit texture ends at 1. With 4 the
brightest grays are 5 levels too dark; with 8 every gray is within 2 levels; with 16 dark grays become too coarse."""

# Stephen Hill's fit of the ACES reference and output transforms, as three.js applies it at exposure 1.
_INPUT = np.array([[0.59719, 0.35458, 0.04823], [0.07600, 0.90834, 0.01566], [0.02840, 0.13383, 0.83777]])
_OUTPUT = np.array([[1.60475, -0.53108, -0.07367], [-0.10208, 1.10813, -0.00605], [-0.00327, -0.07276, 1.07602]])
_PRE_EXPOSURE = 1 / 0.6
_A, _B, _C, _D, _E = 0.0245786, 0.000090537, 0.983729, 0.4329510, 0.238081


def shown_colors(texture_rgb: ArrayLike, *, base_color: float = VISER_BASE_COLOR) -> ByteArray:
    """Return the colours that an unlit ACES-filmic viewer displays for a texture; both (..., 3) uint8."""
    v = linear_light(np.asarray(texture_rgb)) * (base_color * _PRE_EXPOSURE) @ _INPUT.T
    fitted = (v * (v + _A) - _B) / (v * (_C * v + _D) + _E)
    return encoded_light(fitted @ _OUTPUT.T)


def texture_for_viewer(wanted_rgb: ArrayLike, *, base_color: float = VISER_BASE_COLOR) -> ByteArray:
    """Return the texture, (..., 3) uint8, that an unlit ACES-filmic viewer displays as the wanted colours.

    Grays are exact to two levels and colours to three, except very bright saturated colours outside the range of the
    curve, which are clipped.
    """
    wanted = np.asarray(wanted_rgb)
    packed = wanted.reshape(-1, 3).astype(np.uint32) @ np.array([65536, 256, 1], dtype=np.uint32)
    colors, index = np.unique(packed, return_inverse=True)
    rgb = np.stack([colors >> 16, (colors >> 8) & 255, colors & 255], axis=-1)
    brightest = base_color * _PRE_EXPOSURE
    limit = (brightest * (brightest + _A) - _B) / (brightest * (_C * brightest + _D) + _E)
    x = np.clip(linear_light(rgb) @ np.linalg.inv(_OUTPUT).T, 0, limit)
    # x = (v^2 + A v - B) / (C v^2 + D v + E), solved for the positive v.
    a, b, c = 1 - _C * x, _A - _D * x, -(_B + _E * x)
    v = (np.sqrt(b * b - 4 * a * c) - b) / (2 * a)
    return encoded_light(v @ np.linalg.inv(_INPUT).T / brightest)[index.ravel()].reshape(wanted.shape)


def line_colors_for_viewer(wanted_rgb: ArrayLike) -> ByteArray:
    """Return the colours, (..., 3) uint8, to set in viser for lines, which it tone maps (unlike points)."""
    return texture_for_viewer(wanted_rgb, base_color=1.0)
