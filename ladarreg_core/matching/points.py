"""The scan points that are compared with the photo: strong edges, spread over the view, grouped into blocks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.arrays import BoolArray, FloatArray
from ladarreg_core.camera import Camera
from ladarreg_core.matching.levels import ScanLevels

BLOCK_PX = 48
"""Side of a block, full-resolution pixels of the scan's view."""
_COUNT = (7000, 7000, 3500)
_STRATUM_PX = (32, 16, 8)
_LEAST_NORM = 0.15
_BORDER_PX = 4


@dataclass(frozen=True, slots=True, eq=False)
class Blocks:
    """Which block each point belongs to; points are sorted by block."""

    starts: NDArray[np.intp]
    """(B,) index of each block's first point."""
    of_point: NDArray[np.intp]
    """(N,) block of each point."""
    grid: NDArray[np.intp]
    """(B, 2) row and column of each block in the view."""

    def __len__(self) -> int:
        return len(self.starts)

    def sum(self, values: FloatArray) -> FloatArray:
        """Return the sums (B, ...) of values (N, ...) over each block."""
        return np.add.reduceat(values, self.starts, axis=0)


@dataclass(frozen=True, slots=True, eq=False)
class ViewPoints:
    """N scan points of one level, sorted by block."""

    points: FloatArray
    """(N, 3) float32, scanner frame, m."""
    uv: FloatArray
    """(N, 2) level pixels of the view."""
    channels: FloatArray
    """(N, 8) the scan's own channels there."""
    blocks: Blocks
    """Their blocks."""

    def __len__(self) -> int:
        return len(self.points)


def select_points(
    scan: ScanLevels,
    channels: FloatArray,
    *,
    level: int,
    seed: int,
    count: int | None = None,
    away_from_edges: bool = False,
) -> ViewPoints | None:
    """Choose points for one level.

    Args:
        scan: the scan's levels.
        channels: (h, w, 8) of that level, whose norm says how strong an edge is.
        level: which level.
        seed: of the draw among the strongest.
        count: how many at the most; None: the level's standard.
        away_from_edges: leave out what is near depth edges and holes.

    Returns:
        the points; None where the view has none.
    """
    camera = scan.cameras[level]
    wanted = count or _COUNT[level]
    surface, edge = _at_level(scan, camera, level)
    norm = np.sqrt(np.einsum("hwk,hwk->hw", channels, channels))
    usable = np.isfinite(surface) & (norm > _LEAST_NORM)
    if away_from_edges:
        usable &= ~edge
    usable[:_BORDER_PX] = usable[-_BORDER_PX:] = False
    usable[:, :_BORDER_PX] = usable[:, -_BORDER_PX:] = False
    checker = np.indices(usable.shape, sparse=True)
    usable &= (checker[0] + checker[1]) % 2 == 0
    v, u = np.nonzero(usable)
    if not len(v):
        return None
    kept = _strongest_in_strata(u, v, norm[v, u], _STRATUM_PX[level], wanted, np.random.default_rng(seed))
    u, v = u[kept], v[kept]

    side = BLOCK_PX >> level
    block_row, block_column = v // side, u // side
    label = block_row * (camera.width // side + 1) + block_column
    order = np.argsort(label, kind="stable")
    u, v, label = u[order], v[order], label[order]
    names, starts, of_point = np.unique(label, return_index=True, return_inverse=True)
    grid = np.stack(np.divmod(names, camera.width // side + 1), axis=-1)

    uv = np.stack([u, v], axis=-1).astype(np.float64)
    rays = camera.unproject(uv) @ scan.view.view_from_scanner.rotation
    points = (rays * surface[v, u][:, None]).astype(np.float32)
    return ViewPoints(points, uv, channels[v, u], Blocks(starts, of_point, grid))


def _at_level(scan: ScanLevels, camera: Camera, level: int) -> tuple[FloatArray, BoolArray]:
    if level == 0:
        return scan.ranges, scan.edge
    height, width = scan.ranges.shape
    rows = np.minimum((np.arange(camera.height) + 0.5) * height / camera.height, height - 1).astype(np.intp)
    columns = np.minimum((np.arange(camera.width) + 0.5) * width / camera.width, width - 1).astype(np.intp)
    grid = np.ix_(rows, columns)
    return scan.ranges[grid], scan.edge[grid]


def _strongest_in_strata(
    u: NDArray[np.intp],
    v: NDArray[np.intp],
    strength: FloatArray,
    stratum_px: int,
    count: int,
    rng: np.random.Generator,
) -> NDArray[np.intp]:
    """Keep the strongest of each stratum, twice as many as wanted, and draw `count` of them."""
    label = (v // stratum_px) * 100_000 + u // stratum_px
    weakness = 1 - strength / (np.float64(strength.max()) * (1 + 1e-9) + 1e-12)  # in [0, 1): sorts within a stratum
    order = np.argsort(label + weakness, kind="stable")
    _, starts, sizes = np.unique(label[order], return_index=True, return_counts=True)
    rank = np.arange(len(order)) - np.repeat(starts, sizes)
    kept = order[rank < int(np.ceil(2 * count / len(starts)))]
    if len(kept) > count:
        kept = rng.choice(kept, count, replace=False)
    return np.sort(kept)
