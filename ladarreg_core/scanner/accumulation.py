"""Several clouds of one standpoint become one, before it is arranged in a grid; those from elsewhere are refused."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import ShapeError
from ladarreg_core.foundations.arrays import ByteArray, FloatArray
from ladarreg_core.foundations.formatting import format_percent
from ladarreg_core.scanner.gridding import GriddedCloud, grid_points

_MAX_ELSEWHERE = 0.15
"""Share of the ranges that may differ: people and cars move, scanners do not."""
_SAID = 0.04
_SAMPLES = 4000
_POOL = 400_000
_NEIGHBOURS = 8
_APART_RAD = np.radians(1.0)
_MIN_COMPARED = 100
_RANGE_M, _RANGE_SHARE = 0.1, 0.02
_SEED = 41


@dataclass(frozen=True, slots=True, eq=False)
class OneCloud:
    """The points of one of several clouds, in the frame of its scanner."""

    name: str
    """Of its file, for messages."""
    points: NDArray[np.float64]
    """(N, 3) m; those that are not finite, or zero, are no returns."""
    intensity: FloatArray
    """(N,)."""
    color: ByteArray | None = None
    """(N, 3) uint8 RGB."""
    ring: NDArray[np.int64] | None = None
    """(N,) the beam of each point."""

    def returns(self) -> OneCloud:
        """Return the cloud of its returns alone."""
        with np.errstate(over="ignore", invalid="ignore"):
            distance = np.sqrt(np.einsum("ij,ij->i", self.points, self.points))
        use = np.isfinite(distance) & (distance > 0)
        color, ring = (None if each is None else each[use] for each in (self.color, self.ring))
        return OneCloud(self.name, self.points[use], self.intensity[use], color, ring)


def accumulate(clouds: Sequence[OneCloud], *, most_cells: int) -> tuple[GriddedCloud, tuple[str, ...]]:
    """Return the grid of several clouds that were taken from one standpoint, with notes on them.

    Cells that several clouds met contain their mean. Colours are kept if all clouds have them. Of a scanner with lines,
    all clouds are arranged as the first one is: its lines meet the same directions again.

    Args:
        clouds: two or more, the first one is what the others are compared with.
        most_cells: size to which finer grids are thinned.

    Raises:
        ShapeError: if the ranges of a cloud differ from those of the first in more than 15 % of the directions,
            so that it was plainly taken from elsewhere, or a cloud has no returns.
    """
    found = [cloud.returns() for cloud in clouds]
    for cloud in found:
        if not len(cloud.points):
            raise ShapeError(f"{cloud.name} has no returns; leave it out")
    first, notes = found[0], []
    for cloud in found[1:]:
        share = share_elsewhere(first.points, cloud.points)
        if share is None:
            notes.append(f"{cloud.name} looks elsewhere than {first.name}: whether it was taken from the same place "
                         "could not be checked")  # fmt: skip
        elif share > _MAX_ELSEWHERE:
            raise ShapeError(
                f"{cloud.name} was not taken from where {first.name} was: {format_percent(share)} of its ranges differ "
                "from those in the same direction; accumulate clouds of one standpoint only; others are stations, or "
                "have photographs of their own"
            )
        elif share > _SAID:
            notes.append(f"{format_percent(share)} of the ranges of {cloud.name} differ from those of {first.name}: "
                         "something moved in between")  # fmt: skip
    colors = [cloud.color for cloud in found]
    rings = [cloud.ring for cloud in found]
    grid = grid_points(
        np.concatenate([cloud.points for cloud in found]),
        np.concatenate([cloud.intensity for cloud in found]),
        np.concatenate([c for c in colors if c is not None]) if all(c is not None for c in colors) else None,
        ring=np.concatenate([r for r in rings if r is not None]) if all(r is not None for r in rings) else None,
        most_cells=most_cells,
        turns_of=len(first.points),
    )
    counts = ", ".join(f"{len(cloud.points):,}" for cloud in found[:6]) + (", ..." if len(found) > 6 else "")
    said = f"{len(found)} clouds of one standpoint were accumulated, of {counts} returns, in the frame of {first.name}"
    return grid, (said, *notes, grid.describe())


def share_elsewhere(first: FloatArray, second: FloatArray) -> float | None:
    """Return the share of the points (M, 3) of a second cloud whose range differs from those of a first (N, 3).

    A range differs if it is outside of those of the nearest directions of the first cloud by more than 10 cm and 2 %.

    Returns:
        The share, 0 to 1; None if the clouds have too few directions in common to say.
    """
    from scipy.spatial import cKDTree

    rng = np.random.default_rng(_SEED)
    first, second = (
        cloud if len(cloud) <= most else cloud[rng.choice(len(cloud), most, replace=False)]
        for cloud, most in ((first, _POOL), (second, _SAMPLES))
    )
    if len(first) < _NEIGHBOURS:
        return None
    far, near = (np.linalg.norm(cloud, axis=1) for cloud in (first, second))
    apart, index = cKDTree(first / far[:, None]).query(second / near[:, None], k=_NEIGHBOURS)
    beside = apart <= _APART_RAD
    compared = beside.sum(axis=1) >= _NEIGHBOURS // 2
    if compared.sum() < _MIN_COMPARED:
        return None
    there = far[index]
    low, high = np.where(beside, there, np.inf).min(axis=1), np.where(beside, there, 0.0).max(axis=1)
    allowed = _RANGE_M + _RANGE_SHARE * near
    differs = (near < low - allowed) | (near > high + allowed)
    return float(differs[compared].mean())
