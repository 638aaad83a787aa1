"""Where the points of a line in space lie along its images in two pictures.

Source: thesis 2.3.1 for sampled lines, whose constant intervals on both sides hold only without perspective.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.arrays import FloatArray


def kappa_of(depths_scan: FloatArray, depths_photo: FloatArray) -> NDArray[np.float64]:
    """Return kappa of lines from the depths of their ends; 1 where an end does not lie in front of the photo's camera.

    Args:
        depths_scan: (..., 2) along the viewing direction of the picture on the scan's side, > 0, m.
        depths_photo: (..., 2) along that of the photo's camera, m.

    Returns:
        (...,) (z_b / z_a in the photo's camera) / (z_b / z_a on the scan's side).
    """
    ahead = np.asarray((depths_photo > 0).all(axis=-1))
    safe = np.where(ahead[..., None], depths_photo, 1.0)
    kappa = (safe[..., 1] / safe[..., 0]) / (depths_scan[..., 1] / depths_scan[..., 0])
    return np.where(ahead, kappa, 1.0)


def fraction_in_photo(fraction: FloatArray, kappa: FloatArray) -> NDArray[np.float64]:
    """Return where along a line in the photo that lies which is at `fraction` of it on the scan's side.

    Args:
        fraction: (N,) s_scan, 0 to 1.
        kappa: (N,) as `kappa_of`, > 0.

    Returns:
        s_photo (N,), with odds(s_photo) = kappa odds(s_scan), odds(s) = s / (1 - s): the image of a point at t of a
        line in space has the odds (z_b / z_a) odds(t).
    """
    return np.asarray(kappa * fraction / (1 - fraction + kappa * fraction))
