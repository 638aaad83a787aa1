"""Sub-pixel point matches of a finished pose: where each block of the scan's view lies in the photo by its own."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.arrays import BoolArray, FloatArray
from ladarreg_core.camera import Camera
from ladarreg_core.matches import Matches
from ladarreg_core.matching.blocks import BlockComparison
from ladarreg_core.matching.sampling import ViewPoints

_LEAST_CORRELATION = 0.4  # a block that is less alike is no match
_LEAST_SHARED = 0.1
_DAMPING = 0.3
_SD_OF_MEDIAN = 1.4826
_LEAST_SCATTER_PX = 0.02
_OUTLIER_SIGMA = 3.5


@dataclass(frozen=True, slots=True, eq=False)
class BlockMatches:
    """The blocks as point matches."""

    matches: Matches
    """M matches, in the photo's own pixels."""
    inliers: BoolArray
    """(M,) which of them lie where most do."""
    scatter_px: float
    """Standard deviation of the inliers' offsets from the pose, photo pixels; NaN without any."""


def block_matches(seen: BlockComparison, points: ViewPoints, working: Camera, camera: Camera) -> BlockMatches:
    """Return a match for each block: where it lies in the photo by its own.

    A block moves by its own Lucas-Kanade step. Along a straight edge it says nothing: that part is damped, so that
    what a block cannot tell stays where the pose of all blocks puts it. A least-squares pose of these matches is
    therefore the finished pose again, but for how blocks are weighted.

    Args:
        seen: the blocks at the finished pose.
        points: the points that were compared.
        working: the ideal camera they were compared in.
        camera: the photo's own camera.
    """
    uu, uv, vv, right_u, right_v = (np.asarray(value, np.float64) for value in seen.normal_equations())
    # Only what a block shares with the photo curves; the rest of its gradient is noise.
    shared = np.maximum(seen.rho, _LEAST_SHARED).astype(np.float64)
    damping = _DAMPING * float(np.median(shared * (uu + vv)))
    uu, uv, vv = shared * uu + damping, shared * uv, shared * vv + damping
    det = np.maximum(uu * vv - uv * uv, np.finfo(np.float64).tiny)  # flat blocks stay where they are
    offset = np.stack([vv * right_u - uv * right_v, uu * right_v - uv * right_u], axis=-1) / det[:, None]

    nearest = _middles(seen)
    at = points.points[seen.index[nearest]].astype(np.float64)
    ranges = np.linalg.norm(at, axis=-1)
    pixel = seen.uv[nearest].astype(np.float64) + offset
    own = camera.project(working.unproject(pixel))
    alike = (seen.rho >= _LEAST_CORRELATION) & np.isfinite(own).all(axis=-1)
    grid = points.blocks.grid[points.blocks.of_point[seen.index[nearest]]][alike]
    names = tuple(f"b{row}.{column}" for row, column in grid.tolist())
    matches = Matches(at[alike] / ranges[alike, None], ranges[alike], own[alike], names)
    if not len(matches):
        return BlockMatches(matches, np.zeros(0, np.bool_), float("nan"))
    off = np.abs(offset[alike])
    scatter = _SD_OF_MEDIAN * float(np.median(off)) + _LEAST_SCATTER_PX
    inliers = off.max(axis=-1) <= _OUTLIER_SIGMA * scatter
    return BlockMatches(matches, inliers, scatter * camera.focal_px / working.focal_px)


def _middles(seen: BlockComparison) -> NDArray[np.intp]:
    """Return the point of each block (b,) that lies nearest to its middle."""
    of = seen.blocks.of_point
    middle: FloatArray = seen.blocks.sum(seen.uv) / seen.count[:, None]
    distance = ((seen.uv - middle[of]) ** 2).sum(axis=-1)
    order = np.lexsort((distance, of))
    return np.asarray(order[np.searchsorted(of[order], np.arange(len(seen.blocks)))])
