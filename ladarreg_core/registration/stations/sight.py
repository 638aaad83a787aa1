"""What a station saw and saw through: its ranges by direction, against which points of another scan are judged."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.scan import Scan

_MAX_CELLS = 500_000
_FINEST_RAD = float(np.radians(0.35))
_SPANNED = 0.6  # of a direction's cell, across a surface that is seen obliquely
_COARSER = 1.7  # than the steps of the scan, so that no cell between returns stays empty


class Sight(IntEnum):
    """What one station's ranges say of a point."""

    UNKNOWN = 0
    """It measured nothing in that direction."""
    AGREES = 1
    """It measured a surface there."""
    CONTRADICTS = 2
    """It saw through the point to something behind: no surface can be there."""
    HIDDEN = 3
    """Something nearer hides the point."""


@dataclass(frozen=True, slots=True, eq=False)
class RangePicture:
    """Nearest and farthest ranges around each direction, on a grid of azimuth and elevation."""

    nearest: NDArray[np.float32]
    """(H, W) m; infinite where nothing was measured."""
    farthest: NDArray[np.float32]
    """(H, W) m; 0 where nothing was measured."""
    measured: NDArray[np.bool_]
    """(H, W) whether something was measured in the direction itself, and not only beside it."""

    def judge(self, points: FloatArray, tolerance_m: float | FloatArray) -> NDArray[np.int8]:
        """Return the `Sight` of points (N, 3), m, in the scanner's frame, each within its tolerance.

        Far away the tolerance is at least what a direction spans. Where a surface returned nothing, what was measured
        beside it says nothing of it.
        """
        ranges = np.linalg.norm(points, axis=-1)
        at = _cells(points, ranges, self.nearest.shape)
        near, far = self.nearest[at], self.farthest[at]
        within = np.maximum(tolerance_m, _SPANNED * np.pi / self.nearest.shape[0] * ranges)
        out = np.full(len(points), Sight.AGREES, np.int8)
        behind = ranges < near - within
        out[behind & self.measured[at]] = Sight.CONTRADICTS
        out[behind & ~self.measured[at]] = Sight.UNKNOWN
        out[ranges > far + within] = Sight.HIDDEN
        out[far == 0] = Sight.UNKNOWN
        return out


def range_picture(scan: Scan) -> RangePicture:
    """Return the ranges of a scan by direction."""
    thin, _ = scan.thinned(_MAX_CELLS)
    points = thin.points[thin.valid].astype(np.float64)
    ranges = np.linalg.norm(points, axis=-1)
    step = max(_FINEST_RAD, _COARSER * max(thin.geometry.step_rad))
    width = max(16, int(2 * np.pi / step))
    shape = (width // 2, width)
    at = _cells(points, ranges, shape)
    nearest, farthest = np.full(shape, np.inf, np.float32), np.zeros(shape, np.float32)
    np.minimum.at(nearest, at, ranges.astype(np.float32))
    np.maximum.at(farthest, at, ranges.astype(np.float32))
    around = np.ones((3, 3), np.uint8)
    wide = [cv2.copyMakeBorder(image, 1, 1, 1, 1, cv2.BORDER_WRAP) for image in (nearest, farthest)]
    inner = (slice(1, -1), slice(1, -1))
    return RangePicture(
        np.asarray(cv2.erode(wide[0], around), np.float32)[inner],
        np.asarray(cv2.dilate(wide[1], around), np.float32)[inner],
        farthest > 0,
    )


def _cells(points: FloatArray, ranges: FloatArray, shape: tuple[int, ...]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    rows, columns = shape
    with np.errstate(invalid="ignore", divide="ignore"):
        polar = np.arccos(np.clip(points[:, 2] / np.maximum(ranges, 1e-9), -1, 1))
    around = np.arctan2(points[:, 1], points[:, 0]) + np.pi
    row = np.minimum((polar / np.pi * rows).astype(np.intp), rows - 1)
    column = np.minimum((around / (2 * np.pi) * columns).astype(np.intp), columns - 1)
    return row, column
