"""Sampling of the scan points that are compared with the photo: strong edges, spread over the view, in blocks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.camera import Camera
from ladarreg_core.foundations.arrays import BoolArray, FloatArray
from ladarreg_core.matching.features.channels import channel_products
from ladarreg_core.matching.images.scan_levels import ScanLevels

_COUNT = (7000, 7000, 3500)
_STRATUM_PX = (32, 16, 8)
_MIN_NORM = 0.15
_BORDER_PX = 4


@dataclass(frozen=True, slots=True, eq=False)
class Blocks:
    """Assignment of points to blocks; points are sorted by block."""

    starts: NDArray[np.intp]
    """(B,) index of each block's first point."""
    of_point: NDArray[np.intp]
    """(N,) block of each point."""
    grid: NDArray[np.intp]
    """(B, 2) row and column of each block in the view."""

    def __len__(self) -> int:
        return len(self.starts)

    def sum(self, values: FloatArray) -> FloatArray:
        """Return the sums (..., B) of values (..., N) over each block."""
        return np.add.reduceat(values, self.starts, axis=-1)


@dataclass(frozen=True, slots=True, eq=False)
class ViewPoints:
    """N scan points of one level, sorted by block."""

    points: FloatArray
    """(N, 3) float32, scanner frame, m."""
    uv: FloatArray
    """(N, 2) level pixels of the view."""
    channels: FloatArray
    """(N, C) the scan's channels at the points."""
    blocks: Blocks
    """Their blocks."""

    def __len__(self) -> int:
        return len(self.points)


def edge_strength(
    scan: ScanLevels, channels: FloatArray, *, level: int, away_from_edges: bool = False
) -> FloatArray | None:
    """Return the edge strength at the pixels that points may be drawn from, or None if the view has none.

    Args:
        scan: the scan's levels.
        channels: (h, w, C) of that level; the strength is their norm.
        level: pyramid level.
        away_from_edges: leave out pixels near depth edges and holes.

    Returns:
        (h, w) float32; 0 at pixels that no point may be drawn from.
    """
    surface, edge = _at_level(scan, scan.cameras[level], level)
    norm = np.sqrt(channel_products(channels, channels))
    usable = np.isfinite(surface) & (norm > _MIN_NORM)
    if away_from_edges:
        usable &= ~edge
    if scan.structured is not None:
        usable &= scan.structured[_pixels_of_level(scan, scan.cameras[level])]
    usable[:_BORDER_PX] = usable[-_BORDER_PX:] = False
    usable[:, :_BORDER_PX] = usable[:, -_BORDER_PX:] = False
    usable[::2, 1::2] = usable[1::2, ::2] = False
    return norm * usable if usable.any() else None


def draw_points(
    scan: ScanLevels, channels: FloatArray, strength: FloatArray, *, level: int, seed: int, count: int | None = None
) -> ViewPoints:
    """Draw the points of one level at random from the strongest pixels of each stratum, twice as many as needed.

    Args:
        scan: the scan's levels.
        channels: (h, w, C) of that level.
        strength: (h, w) of `edge_strength`.
        level: pyramid level.
        seed: random seed.
        count: maximum number of points; None: the default of the level.
    """
    camera, limit = scan.cameras[level], count or _COUNT[level]
    surface, _ = _at_level(scan, camera, level)
    pixel = _strongest_in_strata(strength, _STRATUM_PX[level], 2 * limit)
    if len(pixel) > limit:
        pixel = np.random.default_rng(seed).choice(pixel, limit, replace=False)
    v, u = np.divmod(pixel, camera.width)

    side, across = scan.block_px >> level, camera.width // (scan.block_px >> level) + 1
    by_block = np.sort(((v // side) * across + u // side) * strength.size + pixel)
    label, pixel = np.divmod(by_block, strength.size)
    v, u = np.divmod(pixel, camera.width)
    starts, of_point = runs(label)
    grid = np.stack(np.divmod(label[starts], across), axis=-1)

    uv = np.stack([u, v], axis=-1).astype(np.float64)
    rays = camera.unproject(uv) @ scan.view.view_from_scanner.rotation
    points = (rays * surface[v, u][:, None]).astype(np.float32)
    return ViewPoints(points, uv, channels[v, u], Blocks(starts, of_point, grid))


def _at_level(scan: ScanLevels, camera: Camera, level: int) -> tuple[FloatArray, BoolArray]:
    if level == 0:
        return scan.ranges, scan.edge
    grid = _pixels_of_level(scan, camera)
    return scan.ranges[grid], scan.edge[grid]


def _pixels_of_level(scan: ScanLevels, camera: Camera) -> tuple[NDArray[np.intp], ...]:
    """Return the index of the level-0 pixels at the pixels of another level."""
    height, width = scan.ranges.shape
    rows = np.minimum((np.arange(camera.height) + 0.5) * height / camera.height, height - 1).astype(np.intp)
    columns = np.minimum((np.arange(camera.width) + 0.5) * width / camera.width, width - 1).astype(np.intp)
    return np.ix_(rows, columns)


def _strongest_in_strata(strength: FloatArray, side_px: int, count: int) -> NDArray[np.intp]:
    """Return the flat indices (K,) of the strongest pixels of each stratum, about `count` in all, by pixel.

    Only pixels with an even sum of row and column are looked at, as `edge_strength` leaves no others; of equally strong
    ones all are returned. The side is even.
    """
    height, width = strength.shape
    rows, columns = -(-height // side_px), -(-width // side_px)
    half, area = side_px // 2, side_px**2 // 2
    whole = np.zeros((rows * side_px, columns * side_px), np.float32)
    whole[:height, :width] = strength
    strata = np.empty((rows, columns, half, 2, half), np.float32)
    for k in range(2):
        strata[:, :, :, k] = whole[k::2, k::2].reshape(rows, half, columns, half).transpose(0, 2, 1, 3)
    strata = strata.reshape(rows, columns, area)
    filled = int(np.count_nonzero(strata.any(axis=-1)))
    of_each = min(-(-count // max(filled, 1)), area)
    strata.partition(area - of_each, axis=-1)
    least = np.maximum(strata[..., area - of_each], np.finfo(np.float32).tiny)
    least = least.repeat(side_px, axis=1)[:, None]
    chosen = whole.reshape(rows, side_px, columns * side_px) >= least
    return np.flatnonzero(chosen.reshape(whole.shape)[:height, :width])


def runs(label: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the start index (R,) of each run of equal labels, and the run (N,) of each label."""
    starts = np.flatnonzero(np.diff(label, prepend=label[:1] - 1))
    return starts, np.repeat(np.arange(len(starts)), np.diff(starts, append=len(label)))
