"""One piece of a mosaic, and its surface in the directions of another viewpoint."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.foundations.arrays import BoolArray, ByteArray, FloatArray
from ladarreg_core.frames import Rigid
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grid_window import grid_rays
from ladarreg_core.scanner.grids import ScanGeometry, SphericalGrid

Float32 = NDArray[np.float32]

CENTRAL_M = 1e-6
"""Up to this distance from the origin a scanner's centre is taken to be there."""
_STEEPEST = float(np.tan(np.radians(84.0)))
_NOISE_M = 0.012
_SMOOTH_CELLS = 7
_ROWS_AT_ONCE = 128
_COARSER = 2
_MAX_ITERATIONS = 5
_CONVERGED = 0.02  # cells
_MAX_OFF = 0.6  # cells
_BORDER_SHARE = 0.12
_AT_EDGE = 0.35
_HIDDEN_CELLS = 3.0


@dataclass(frozen=True, slots=True)
class PlacedPiece:
    """A piece of a mosaic that is read when it is needed, and where its scanner was."""

    load: Callable[[], Scan]
    """Reads the piece; may be called several times."""
    world_from_scanner: Rigid
    """From the unit's angles and the mount, or refined."""
    name: str
    """Display name."""


@dataclass(frozen=True, slots=True, eq=False)
class SeenSurface:
    """What a piece shows in some directions (N,) from the origin of the world."""

    ranges: Float32
    """(N,) m from the world's origin; NaN = none."""
    intensity: Float32
    """(N,) in the unit of the sensor."""
    score: Float32
    """(N,) 0 to 1: how well the piece shows it."""
    color: ByteArray | None
    """(N, 3) RGB."""


class LoadedPiece:
    """A piece in memory, ready to be looked up by direction from the world's origin.

    Args:
        scan: the piece.
        world_from_scanner: where its scanner was.
        grid: the grid of the panorama.
    """

    def __init__(self, scan: Scan, world_from_scanner: Rigid, grid: SphericalGrid) -> None:
        self.geometry: ScanGeometry = scan.geometry
        self._rotation = world_from_scanner.rotation.astype(np.float32)
        self._centre = world_from_scanner.translation.astype(np.float32)
        self.central = float(np.linalg.norm(world_from_scanner.translation)) <= CENTRAL_M
        self._step = float(np.mean(scan.geometry.step_rad))
        self._ranges = np.ascontiguousarray(scan.ranges)
        self._light = np.ascontiguousarray(scan.intensity)
        self._color = scan.color
        self._smooth = _one_surface(scan.ranges, scan.geometry.step_rad)
        self._slope = _slope_score(scan.ranges, scan.geometry.step_rad)
        self.valid_cells = int(np.isfinite(scan.ranges).sum())
        self.folded = 0
        self._nearest: _Nearest | None = None
        if not self.central:
            self._nearest = _Nearest.of(scan, world_from_scanner, grid)
            self.folded = self._nearest.hidden

    @cached_property
    def bytes(self) -> int:
        """Memory that the piece takes, about."""
        total = self._ranges.nbytes + self._light.nbytes + self._smooth.nbytes + self._slope.nbytes
        total += getattr(getattr(self.geometry, "table", None), "nbytes", 0)
        total += 0 if self._color is None else self._color.nbytes
        return total + (0 if self._nearest is None else 2 * self._nearest.low.nbytes)

    def seen(self, directions: Float32, cells: Float32) -> SeenSurface:
        """Return what the piece shows.

        Args:
            directions: (N, 3) unit rays from the world's origin.
            cells: (N, 2) their cells in the panorama.
        """
        if self.central:
            ranges, at, smooth = self._along(directions, np.ones(len(directions), np.float32))
        else:
            assert self._nearest is not None
            low, high = self._nearest.at(cells)
            ranges, at, smooth = self._converged(directions, low)
            again = np.isnan(ranges) & (high > low)
            if again.any():
                found = self._converged(directions[again], high[again])
                ranges[again], at[again], smooth[again] = found
            # A surface that a nearer one hides from the origin, although the scanner saw past it.
            behind = self._parallax(low, ranges) > _HIDDEN_CELLS + 2 * _COARSER
            ranges[behind] = np.nan
        return self._described(ranges, at, smooth)

    def _parallax(self, near: Float32, far: Float32) -> Float32:
        """Return by how many cells two points of one direction are apart as the scanner sees them, at most."""
        arm = float(np.linalg.norm(self._centre))
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(arm * (1 / near - 1 / far) / self._step, np.float32)

    def _converged(self, directions: Float32, start: Float32) -> tuple[Float32, Float32, BoolArray]:
        """Return ranges from the origin (N,), NaN = none, with the cells (N, 2) and whether they are within a surface.

        The range is what the piece has in the direction of the point at the range before, until both agree.
        """
        out = np.full(len(directions), np.nan, np.float32)
        out_at = np.full((len(directions), 2), np.nan, np.float32)
        out_smooth = np.zeros(len(directions), bool)
        left = np.flatnonzero(np.isfinite(start))
        rho, d = start[left], directions[left]
        for turn in range(_MAX_ITERATIONS):
            r, at, smooth = self._along(d, rho)
            towards = d * rho[:, None] - self._centre
            points = self._centre + towards * (r / np.linalg.norm(towards, axis=-1))[:, None]
            ahead = np.einsum("nk,nk->n", points, d)
            off = np.linalg.norm(points - d * ahead[:, None], axis=-1) / (ahead * self._step)
            good = off < (_CONVERGED if turn < _MAX_ITERATIONS - 1 else _MAX_OFF)
            done = left[good]
            out[done], out_at[done], out_smooth[done] = ahead[good], at[good], smooth[good]
            go_on = ~good & np.isfinite(ahead) & (ahead > 0)
            left, rho, d = left[go_on], ahead[go_on], d[go_on]
            if not len(left):
                break
        return out, out_at, out_smooth

    def _along(self, directions: Float32, distance: Float32) -> tuple[Float32, Float32, BoolArray]:
        """Return the piece's ranges (N,) towards points at some distances, the cells and whether within a surface."""
        towards = (directions * distance[:, None] - self._centre) @ self._rotation
        at = np.asarray(self.geometry.cell_of(towards), np.float32)
        height, width = self.geometry.shape
        ranges = np.full(len(at), np.nan, np.float32)
        smooth = np.zeros(len(at), bool)
        with np.errstate(invalid="ignore"):
            inside = (at >= -0.5).all(axis=-1) & (at[:, 0] < height - 0.5) & (at[:, 1] < width - 0.5)
        within = np.flatnonzero(inside)
        row, column = at[within, 0], at[within, 1]
        top = np.clip(np.floor(row), 0, height - 2).astype(np.int32)
        left = np.clip(np.floor(column), 0, width - 2).astype(np.int32)
        flat = top * width + left
        one = self._smooth.ravel()[flat]
        down, right = row - top, column - left
        all_ranges = self._ranges.ravel()
        # A plane is linear in 1/r.
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = (1 - down) * ((1 - right) / all_ranges[flat] + right / all_ranges[flat + 1])
            inverse += down * ((1 - right) / all_ranges[flat + width] + right / all_ranges[flat + width + 1])
            nearest = all_ranges[np.rint(row).astype(np.int32) * width + np.rint(column).astype(np.int32)]
            ranges[within] = np.where(one, 1 / inverse, nearest)
        smooth[within] = one
        return ranges, at, smooth

    def _described(self, ranges: Float32, at: Float32, smooth: BoolArray) -> SeenSurface:
        height, width = self.geometry.shape
        light = np.zeros(len(ranges), np.float32)
        score = np.zeros(len(ranges), np.float32)
        color = None if self._color is None else np.zeros((len(ranges), 3), np.uint8)
        there = np.flatnonzero(np.isfinite(ranges))
        row, column, one = at[there, 0], at[there, 1], smooth[there]
        nearest = np.clip(np.rint(row), 0, height - 1).astype(np.int32) * width
        nearest += np.clip(np.rint(column), 0, width - 1).astype(np.int32)
        top = np.clip(np.floor(row), 0, height - 2).astype(np.int32)
        left = np.clip(np.floor(column), 0, width - 2).astype(np.int32)
        flat, down, right = top * width + left, row - top, column - left
        every = self._light.ravel()
        mixed = (1 - down) * ((1 - right) * every[flat] + right * every[flat + 1])
        mixed += down * ((1 - right) * every[flat + width] + right * every[flat + width + 1])
        light[there] = np.where(one, mixed, every[nearest])
        margin = np.minimum(
            np.minimum(row + 0.5, height - 0.5 - row) / max(1.0, _BORDER_SHARE * height),
            np.minimum(column + 0.5, width - 0.5 - column) / max(1.0, _BORDER_SHARE * width),
        )
        slope = self._slope.ravel()[nearest].astype(np.float32) / 255
        score[there] = np.clip(margin, 0.02, 1) * slope * np.where(one, 1, _AT_EDGE)
        if color is not None and self._color is not None:
            color[there] = self._color.reshape(-1, 3)[nearest]
        return SeenSurface(ranges, light, score, color)


@dataclass(frozen=True, slots=True, eq=False)
class _Nearest:
    """The nearest and the farthest return of a piece in blocks of the panorama's cells: where a search may start."""

    first: tuple[int, int]
    low: Float32
    high: Float32
    columns: int
    hidden: int

    @staticmethod
    def of(scan: Scan, pose: Rigid, grid: SphericalGrid) -> _Nearest:
        """Return the map of a piece, which covers only the part of the panorama that it may show."""
        rows, columns = (-(-side // _COARSER) for side in grid.shape)
        full_turn = grid.d_longitude_rad * grid.columns > 2 * np.pi - 1.5 * grid.d_longitude_rad
        spans = [_block_cells(points, grid, columns) for points, _ in _world_points(scan, pose)]
        used = np.zeros(columns, bool)
        top, bottom = rows, -1
        for row, column, _ in spans:
            if len(row):
                used[column] = True
                top, bottom = min(top, int(row.min())), max(bottom, int(row.max()))
        top, bottom = max(top - 2, 0), min(bottom + 3, rows)
        first, count = _shortest_arc(used) if full_turn else (0, columns)
        first, count = (first - 2, min(count + 4, columns)) if full_turn else (first, count)
        low = np.full((max(bottom - top, 1), count), np.inf, np.float32)
        high = np.full(low.shape, -np.inf, np.float32)
        for row, column, rho in spans:
            place = (np.clip(row - top, 0, len(low) - 1), (column - first) % columns)
            np.minimum.at(low, place, rho)
            np.maximum.at(high, place, rho)
        arm = float(np.linalg.norm(pose.translation))
        step = float(np.mean(scan.geometry.step_rad))
        hidden = 0
        for row, column, rho in spans:
            near = low[np.clip(row - top, 0, len(low) - 1), (column - first) % columns]
            hidden += int((arm * (1 / near - 1 / rho) / step > _HIDDEN_CELLS + _COARSER).sum())
        low, high = _spread(low, high, grid, top, wraps=count == columns and full_turn)
        return _Nearest((top, first), low, high, columns, hidden)

    def at(self, cells: Float32) -> tuple[Float32, Float32]:
        """Return the nearest and farthest range (N,) around cells (N, 2) of the panorama; NaN where there is none."""
        row = np.floor(cells[:, 0] / _COARSER).astype(np.int32) - self.first[0]
        column = (np.floor(cells[:, 1] / _COARSER).astype(np.int32) - self.first[1]) % self.columns
        inside = (row >= 0) & (row < len(self.low)) & (column < self.low.shape[1])
        place = np.where(inside, row, 0), np.where(inside, column, 0)
        return (
            np.where(inside & np.isfinite(self.low[place]), self.low[place], np.float32(np.nan)),
            np.where(inside & np.isfinite(self.high[place]), self.high[place], np.float32(np.nan)),
        )


def _world_points(scan: Scan, pose: Rigid) -> list[tuple[Float32, int]]:
    """Return the returns of a scan in the world, strip by strip."""
    strips = []
    for first in range(0, scan.shape[0], _ROWS_AT_ONCE):
        part = slice(first, min(first + _ROWS_AT_ONCE, scan.shape[0]))
        points = grid_rays(scan.geometry, part, slice(None)).astype(np.float32) * scan.ranges[part, :, None]
        points = points[np.isfinite(scan.ranges[part])]
        strips.append((np.asarray(pose @ points, np.float32), first))
    return strips


def _block_cells(
    points: Float32, grid: SphericalGrid, columns: int
) -> tuple[NDArray[np.int32], NDArray[np.int32], Float32]:
    """Return row and column of the block of each point (N, 3), and its range from the origin."""
    rho = np.linalg.norm(points, axis=-1)
    at = grid.cell_of(points)
    at = at[rho > 0]
    block = np.floor((at + 0.5) / _COARSER).astype(np.int32)
    return block[:, 0], block[:, 1] % columns, rho[rho > 0]


def _shortest_arc(used: BoolArray) -> tuple[int, int]:
    """Return the first column and the number of columns of the shortest arc that holds all used ones."""
    at = np.flatnonzero(used)
    if not len(at):
        return 0, 1
    gaps = np.diff(np.append(at, at[0] + len(used)))
    widest = int(gaps.argmax())
    return int(at[(widest + 1) % len(at)]), len(used) - int(gaps[widest]) + 1


def _spread(low: Float32, high: Float32, grid: SphericalGrid, top: int, *, wraps: bool) -> tuple[Float32, Float32]:
    """Return the extremes of the blocks around each, wider towards the poles, where the columns are close together."""
    latitude = grid.top_latitude_rad - (np.arange(len(low)) + top) * _COARSER * grid.d_latitude_rad
    reach = np.ceil(1.5 / np.maximum(np.cos(latitude), 1e-3)).astype(int)
    reach = np.minimum(reach, low.shape[1])
    kernel = np.ones((3, 1), np.uint8)
    spread: list[Float32] = []
    for extreme, sign in ((low, 1), (high, -1)):
        field = np.asarray(cv2.erode(np.float32(sign) * extreme, kernel, borderType=cv2.BORDER_REPLICATE), np.float32)
        for row in range(len(field)):
            wide = int(reach[row])
            line = np.pad(field[row], wide, mode="wrap" if wraps else "edge")
            field[row] = cv2.erode(line[None], np.ones((1, 2 * wide + 1), np.uint8))[0, wide:-wide]
        spread.append(np.float32(sign) * field)
    return spread[0], spread[1]


def _one_surface(ranges: FloatArray, step_rad: tuple[float, float]) -> BoolArray:
    """Return for each 2 x 2 block of cells (H, W) whether its returns are on one surface; last row and column False."""
    out = np.zeros(ranges.shape, bool)
    steepest = 1 + _STEEPEST * float(np.hypot(*step_rad))
    for first in range(0, len(ranges) - 1, _ROWS_AT_ONCE):
        part = ranges[first : min(first + _ROWS_AT_ONCE + 1, len(ranges))]
        with np.errstate(invalid="ignore"):
            far, near = np.maximum(part[1:], part[:-1]), np.minimum(part[1:], part[:-1])
            far, near = np.maximum(far[:, 1:], far[:, :-1]), np.minimum(near[:, 1:], near[:, :-1])
            out[first : first + len(far), :-1] = far < near * steepest + np.float32(_NOISE_M)
    return out


def _slope_score(ranges: FloatArray, step_rad: tuple[float, float]) -> NDArray[np.uint8]:
    """Return the cosine of the incidence (H, W), 0 to 255, of a surface smoothed over some cells."""
    out = np.empty(ranges.shape, np.uint8)
    margin = _SMOOTH_CELLS
    size = (_SMOOTH_CELLS, _SMOOTH_CELLS)
    for first in range(0, len(ranges), _ROWS_AT_ONCE):
        begin, end = max(first - margin, 0), min(first + _ROWS_AT_ONCE + margin, len(ranges))
        part = ranges[begin:end]
        there = np.isfinite(part)
        share = cv2.blur(there.astype(np.float32), size)
        logs = np.where(there, np.log(np.where(there, part, 1)), 0).astype(np.float32)
        log_range = np.asarray(cv2.blur(logs, size) / np.maximum(share, 1e-6), np.float32)
        squares = np.ones_like(log_range)
        for axis in (0, 1):
            squares += (np.gradient(log_range, axis=axis) / np.float32(step_rad[axis])) ** 2
        cosine = 1 / np.sqrt(squares)
        out[first : first + _ROWS_AT_ONCE] = np.clip(255 * cosine, 1, 255)[first - begin :][:_ROWS_AT_ONCE]
    return out
