"""What a run has measured so far, as a picture all around and as points: for an operator who watches it grow."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.acquisition.line_sweep import LineSweep
from ladarreg_core.acquisition.runs.run_folder import ScanPiece
from ladarreg_core.foundations.arrays import ByteArray, FloatArray
from ladarreg_core.frames import Rigid
from ladarreg_core.scanner.grid_window import grid_rays
from ladarreg_core.scanner.pan_tilt import pan_tilt_pose

HEIGHT, WIDTH = 360, 720
"""Rows and columns of the picture: half a degree each, the zenith at the top, straight ahead in the middle, left at the
left."""
_MAX_POINTS = 200_000
_MAX_PICTURED = 20_000
_DARKEST, _BRIGHTEST = 40, 250
_GROWS = 1.5


class RunPreview:
    """Collects the pieces of a run.

    Args:
        unit_from_scanner: the mount.
        level_from_unit: how the unit itself is turned.
        pieces: how many there will be; each has an equal share of the points.
        step_deg: angle between neighbouring lines; the picture is filled between them.
    """

    def __init__(self, unit_from_scanner: Rigid, level_from_unit: Rigid, *, pieces: int, step_deg: float = 0.0) -> None:
        self._mount, self._level = unit_from_scanner, level_from_unit
        self._wide = 2 * round(abs(step_deg) * WIDTH / 360 / 2 + 0.5) + 1
        self._light = np.zeros((HEIGHT, WIDTH), np.float32)
        self._nearest = np.full((HEIGHT, WIDTH), np.inf, np.float32)
        self._points: list[NDArray[np.float32]] = []
        self._shades: list[NDArray[np.float32]] = []
        self._share = max(1, _MAX_POINTS // max(1, pieces))
        self._taken = 0

    @property
    def is_empty(self) -> bool:
        """Whether nothing has been seen yet."""
        return not self._points

    def add(self, piece: LineSweep | ScanPiece) -> None:
        """Add a piece."""
        points, light = self._points_of(piece)
        points = points @ self._level.rotation.T
        ranges = np.linalg.norm(points, axis=-1)
        there = np.isfinite(ranges) & (ranges > 0)
        points, light, ranges = points[there], light[there], ranges[there]
        if not len(points):
            return
        # Intensity falls with the squared range; without the fall the far walls of a picture are legible.
        shade = (light * ranges**2).astype(np.float32) if light.any() else ranges.astype(np.float32)
        row = (0.5 - np.arcsin(np.clip(points[:, 2] / ranges, -1, 1)) / np.pi) * HEIGHT
        column = (0.5 - np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi)) * WIDTH
        row = np.clip(row.astype(np.int32), 0, HEIGHT - 1)
        column = column.astype(np.int32) % WIDTH
        far_first = np.argsort(-ranges)
        row, column = row[far_first], column[far_first]
        nearer = ranges[far_first] <= self._nearest[row, column] * _GROWS
        self._light[row[nearer], column[nearer]] = shade[far_first][nearer]
        self._nearest[row[nearer], column[nearer]] = ranges[far_first][nearer]
        step = -(-len(points) // self._share)
        self._points.append(points[::step].astype(np.float32))
        self._shades.append(shade[::step])

    def picture(self) -> ByteArray:
        """Return what has been seen, (360, 720) gray; 0 where nothing has."""
        seen = np.isfinite(self._nearest)
        picture = np.zeros((HEIGHT, WIDTH), np.uint8)
        if seen.any():
            picture[seen] = self._gray(self._light[seen])
        wide = np.pad(picture, ((0, 0), (self._wide, self._wide)), mode="wrap")
        filled = cv2.dilate(wide, np.ones((1, min(self._wide, WIDTH // 4 * 2 + 1)), np.uint8))
        return np.asarray(np.where(seen, picture, filled[:, self._wide : -self._wide]), dtype=np.uint8)

    def take_points(self) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """Return the points that are new since the last call, with grays (N,).

        They are (N, 3), m, in the world of the unit, levelled.

        All calls together return at most 200,000 points.
        """
        new, self._taken = self._taken, len(self._points)
        if new == self._taken:
            return np.zeros((0, 3), np.float32), np.zeros(0, np.uint8)
        gray = self._gray(np.concatenate(self._shades))
        points = np.concatenate(self._points[new:])
        return points, gray[-len(points) :]

    def _points_of(self, piece: LineSweep | ScanPiece) -> tuple[FloatArray, FloatArray]:
        if isinstance(piece, LineSweep):
            points = piece.points_in_world(self._mount).reshape(-1, 3)
            light = np.zeros(len(points)) if piece.intensity is None else piece.intensity.ravel()
            return points, light
        scan = piece.scan
        step = max(1, int(np.sqrt(scan.ranges.size / _MAX_PICTURED)) // 2)
        part = slice(None, None, step)
        pose = pan_tilt_pose(piece.at.pan_rad, piece.at.tilt_rad, unit_from_scanner=self._mount)
        local = grid_rays(scan.geometry, part, part) * scan.ranges[part, part, None]
        return pose @ local.reshape(-1, 3), scan.intensity[part, part].ravel()

    def _gray(self, shades: NDArray[np.float32]) -> NDArray[np.uint8]:
        low, high = np.quantile(shades, (0.02, 0.98))
        share = np.clip((shades - low) / max(float(high - low), 1e-9), 0, 1)
        return np.asarray(_DARKEST + share * (_BRIGHTEST - _DARKEST), dtype=np.uint8)
