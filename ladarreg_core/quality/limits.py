"""Limits of stereo geometry and of the spread of matches that several quality statements share.

`stereo_limits` applies them to matches before a pose is solved, `findings` to the pose that came out, and `smoothing`
to the ranges that stereo is to replace.

Source: thesis 3.4.
"""

from __future__ import annotations

import numpy as np

from ladarreg_core.camera import CameraModel
from ladarreg_core.foundations.arrays import FloatArray

MAX_SIGMA_Z_OVER_Z = 0.05
"""Relative uncertainty of a stereo depth above which it cannot be compared with the laser's."""
MIN_DISPARITY_SIGMA = 40.0
"""Derotated disparity, in multiples of sigma_px, below which stereo depths cannot be compared either."""
MIN_ACROSS_OF_FORWARD = 0.25
"""Ratio of |(Tx, Ty)| to |Tz| below which the epipole lies inside the picture, where disparities vanish."""
LARGE_ROLL_RAD = np.deg2rad(20.0)
"""Roll beyond which correlation windows, which are not rotated, no longer match."""
LITTLE_SPREAD = (0.35, 0.18)
"""Share of the photo's area below which the standard deviation of the pose is 1.4 and 2 times that of 48 ideal
matches."""
CENTRAL_PERCENTILES = (5.0, 95.0)
"""Percentiles between which the extent of matches is measured: a few outliers far away add no spread."""


def has_usable_parallax(disparity_over_sigma: float, sigma_z_over_z: float) -> bool:
    """Return whether stereo depths are certain enough to be compared with the laser's."""
    return disparity_over_sigma >= MIN_DISPARITY_SIGMA and sigma_z_over_z <= MAX_SIGMA_Z_OVER_Z


def is_forward_baseline(across: float, forward: float) -> bool:
    """Return whether a baseline of these components points so much along the viewing direction that disparities
    vanish."""
    return across < MIN_ACROSS_OF_FORWARD * abs(forward)


def covered_share(uv: FloatArray, camera: CameraModel) -> float:
    """Return the share of the photo's area that matches at pixels (N, 2) span, 0 to 1."""
    low, high = np.percentile(uv, CENTRAL_PERCENTILES, axis=0)
    whole = (CENTRAL_PERCENTILES[1] - CENTRAL_PERCENTILES[0]) / 100
    return float(np.clip((high - low) / whole / camera.size, 0, 1).prod())
