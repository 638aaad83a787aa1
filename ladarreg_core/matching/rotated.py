"""Descriptors of a picture as they would be, were it turned: both the places of the samples and the orientations."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.arrays import FloatArray
from ladarreg_core.features.channels import ORIENTATIONS
from ladarreg_core.features.descriptors import unit_rows

_SIDE = 7
_BIN_RAD = np.pi / ORIENTATIONS


def describe_turned(
    channels: FloatArray, uv: NDArray[np.float64], angle_rad: float, *, spacing_px: float = 6.0
) -> FloatArray:
    """Return the descriptors of pixels that a picture turned back by an angle would have.

    What lies d beside a corner in an upright picture lies at d turned by the angle in this one, and an edge's
    orientation there is greater by the angle. Between two orientation channels it is interpolated linearly.

    Args:
        channels: (H, W, 8) normalised channels.
        uv: (N, 2) pixels; samples beyond the picture take its border's value.
        angle_rad: by which the picture is turned clockwise on the screen (u right, v down).
        spacing_px: between the 7 x 7 samples.

    Returns:
        (N, 392) float32, mean removed, unit length; at an angle of 0 those of `describe`.
    """
    height, width = channels.shape[:2]
    reach = (np.arange(_SIDE) - _SIDE // 2) * spacing_px
    dv, du = np.meshgrid(reach, reach, indexing="ij")
    offsets = turned_by(np.stack([du.ravel(), dv.ravel()], axis=-1), angle_rad)
    u = np.clip(np.rint(uv[:, 0, None] + offsets[:, 0]).astype(np.intp), 0, width - 1)
    v = np.clip(np.rint(uv[:, 1, None] + offsets[:, 1]).astype(np.intp), 0, height - 1)
    samples = channels.reshape(-1, ORIENTATIONS).take(v * width + u, axis=0)
    bins = angle_rad / _BIN_RAD
    whole = int(np.floor(bins))
    part = np.float32(bins - whole)
    each = np.eye(ORIENTATIONS, dtype=np.float32)
    samples = samples @ (np.roll(each, whole, axis=0) * (1 - part) + np.roll(each, whole + 1, axis=0) * part)
    return unit_rows(samples.reshape(len(uv), _SIDE * _SIDE * ORIENTATIONS))


def turned_by(uv: NDArray[np.float64], angle_rad: float) -> NDArray[np.float64]:
    """Return vectors (N, 2) of pixels (u right, v down) turned by an angle, rad, clockwise on the screen."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.asarray(uv @ np.array([[c, -s], [s, c]]).T)
