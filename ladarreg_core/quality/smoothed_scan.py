"""The scan that a registration's models show once its range spikes are smoothed by stereo, and what that did."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ladarreg_core.pose.diagnostics import diagnose
from ladarreg_core.quality.smoothing import smooth_scan
from ladarreg_core.quality.stereo_limits import MOST_SIGMA_Z_OVER_Z
from ladarreg_core.results import PoseResult
from ladarreg_core.scan import Scan


@dataclass(frozen=True, slots=True, eq=False)
class SmoothedScan:
    """A scan with its spikes under matches replaced."""

    scan: Scan
    """The scan to show; the one that was given where nothing was replaced."""
    cells_replaced: int
    """How many cells have another range."""
    sentence: str
    """What was done, or why nothing was."""


def smoothed_scan(scan: Scan, result: PoseResult) -> SmoothedScan:
    """Replace the range spikes that lie under a registration's matches, and say what that did.

    Args:
        scan: the scan.
        result: an accepted registration of it.

    Raises:
        LadarregError: as `smooth_scan`.

    Source: thesis 3.2 and 3.5.
    """
    smoothed = smooth_scan(scan, result)
    with np.errstate(invalid="ignore"):
        count = int(np.count_nonzero((smoothed.ranges != scan.ranges) & scan.valid))
    if count:
        words = f"{count} range spikes under matches were replaced by their stereo range."
    elif not _parallax(result):
        words = "Nothing was replaced: scanner and camera stand nearly at the same place, where stereo tells no range."
    else:
        words = "Nothing was replaced: no match lies on a range spike that stereo contradicts."
    return SmoothedScan(smoothed, count, words)


def _parallax(result: PoseResult) -> bool:
    """Return whether stereo knows ranges well enough to be compared with the laser's."""
    figures = diagnose(
        result.camera_from_scanner, result.matches, result.inliers, result.camera, sigma_px=result.sigma_px
    )
    return bool(figures.get("stereo_sigma_z_over_z", np.inf) <= MOST_SIGMA_Z_OVER_Z)
