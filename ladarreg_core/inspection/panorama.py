"""The whole turn of a scan in one equirectangular picture, and where photographs lie in it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.camera import CameraModel
from ladarreg_core.errors import OptionError
from ladarreg_core.foundations.arrays import BoolArray, FloatArray
from ladarreg_core.frames import Rigid
from ladarreg_core.inspection.pictures import Stretch, stretched
from ladarreg_core.inspection.viewpoints import typical_range
from ladarreg_core.scan import Scan

_WIDTH = 1536
_MIN_SPAN_RAD, _MARGIN_RAD = math.radians(20.0), math.radians(1.0)
_PER_SIDE, _ROUNDS, _SMOOTHED = 24, 4, 6
_EMPTY = np.array((11, 12, 15), np.uint8)


@dataclass(frozen=True, slots=True)
class Strip:
    """The extent of an equirectangular picture of the full turn.

    Its left border looks backwards (azimuth pi), its middle along X, its right border backwards again.
    """

    low_rad: float
    """Elevation of its lower border."""
    high_rad: float
    """Elevation of its upper border."""

    def directions(self, width: int) -> FloatArray:
        """Return the unit rays (h, width, 3) through the centres of the pixels, which are square."""
        height = max(2, round(width * (self.high_rad - self.low_rad) / (2 * math.pi)))
        azimuth = math.pi - 2 * math.pi * (np.arange(width) + 0.5) / width
        elevation = self.high_rad - (self.high_rad - self.low_rad) * (np.arange(height) + 0.5) / height
        level = np.cos(elevation)[:, None]
        rays = np.empty((height, width, 3), np.float32)
        rays[..., 0], rays[..., 1] = level * np.cos(azimuth), level * np.sin(azimuth)
        rays[..., 2] = np.sin(elevation)[:, None]
        return rays


def strip_of(scan: Scan) -> Strip:
    """Return the strip that contains the returns of a scan: the full turn, as high as they reach."""
    elevation = np.arcsin(np.clip(scan.sampled_directions[:, 2], -1, 1))
    low, high = float(elevation.min()) - _MARGIN_RAD, float(elevation.max()) + _MARGIN_RAD
    missing = max(0.0, _MIN_SPAN_RAD - (high - low)) / 2
    return Strip(max(low - missing, -math.pi / 2), min(high + missing, math.pi / 2))


def strip_picture(scan: Scan, *, width: int = _WIDTH) -> NDArray[np.uint8]:
    """Render the full turn, (h, width, 3) uint8 RGB: the intensity, compensated for range, or else the nearness."""
    if not 2 <= width <= 8192:
        raise OptionError(f"the strip is {width} px wide; 2 to 8192 are supported")
    at, inside = _nearest_cells(scan, strip_of(scan).directions(width))
    ranges = np.where(inside, scan.ranges[at], np.nan)
    seen = np.isfinite(ranges)
    if scan.has_intensity:
        values = scan.intensity[at].astype(np.float32)
        if scan.intensity_is == "raw" and seen.any():
            share = np.nan_to_num(ranges / np.median(ranges[seen]), nan=1.0)
            values = values * np.clip(share, 0.25, 4.0).astype(np.float32) ** 2
    else:
        values = np.where(seen, 1 / np.where(seen, ranges, 1), 0).astype(np.float32)
    gray = stretched(values, seen, Stretch())
    return np.where(seen[..., None], np.repeat(gray[..., None], 3, axis=-1), _EMPTY)


def photo_outline(scan: Scan, camera: CameraModel, camera_from_scanner: Rigid) -> NDArray[np.float64]:
    """Return the border of a photograph as seen from the scanner, unit rays (N, 3), once around.

    Each border ray of the camera is followed to the surface that the scan shows there, smoothed along the border; where
    the scan has no return, to its median range. Rays without a direction (beyond the lens model) are left out; none are
    left of a camera that looks all around.

    Args:
        scan: the scan.
        camera: the photograph's camera.
        camera_from_scanner: its pose.
    """
    if camera.as_panorama is not None:
        return np.empty((0, 3))
    along = np.arange(_PER_SIDE) / _PER_SIDE
    right, bottom = camera.width - 0.5, camera.height - 0.5
    u = np.concatenate([along, np.ones(_PER_SIDE), 1 - along, np.zeros(_PER_SIDE)]) * (right + 0.5) - 0.5
    v = np.concatenate([np.zeros(_PER_SIDE), along, np.ones(_PER_SIDE), 1 - along]) * (bottom + 0.5) - 0.5
    rays = np.asarray(camera.unproject(np.stack([u, v], axis=-1)) @ camera_from_scanner.rotation, np.float64)
    rays = rays[np.isfinite(rays).all(axis=1)]
    centre = camera_from_scanner.centre
    typical = typical_range(scan)
    reach = np.full(len(rays), typical)
    along_ray = rays @ centre
    directions = rays
    for _ in range(_ROUNDS):
        # The distance t at which |centre + t ray| is the range that the scan has in that direction.
        square = along_ray**2 + reach**2 - centre @ centre
        distance = np.where(square > 0, np.sqrt(np.maximum(square, 0)) - along_ray, reach)
        points = centre + np.where(distance > 0, distance, typical)[:, None] * rays
        directions = points / np.maximum(np.linalg.norm(points, axis=1, keepdims=True), 1e-12)
        at, inside = _nearest_cells(scan, directions)
        found = np.where(inside, scan.ranges[at], np.nan)
        reach = np.where(np.isfinite(found), found, typical)
        if len(reach):  # one thing in front of the room does not notch the outline
            reach = np.median([np.roll(reach, by) for by in range(-_SMOOTHED, _SMOOTHED + 1)], axis=0)
    return directions


def _nearest_cells(
    scan: Scan, directions: NDArray[np.floating]
) -> tuple[tuple[NDArray[np.intp], NDArray[np.intp]], BoolArray]:
    """Return the nearest cells (rows, columns) of directions (..., 3), and which of them lie inside the grid (...,).

    Up to one cell beyond the borders belongs to them, so that the seam of a full turn shows no gap.
    """
    cells = scan.geometry.cell_of(directions)
    inside = np.ones(cells.shape[:-1], np.bool_)
    found = []
    for k, count in enumerate(scan.shape):
        at = cells[..., k]
        inside &= (at >= -1) & (at <= count)  # false for NaN
        found.append(np.clip(np.rint(np.nan_to_num(at)), 0, count - 1).astype(np.intp))
    return (found[0], found[1]), inside
