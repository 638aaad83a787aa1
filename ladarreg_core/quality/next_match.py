"""Where the next match would help most.

A match in a place adds information to the pose; its gain is the growth of log det of that information,

    log det(S + J P J^T) - log det S

with P the pose's covariance, J the pixel's derivative by the pose and S the covariance of the new match's residual, its
pixel's noise and its range's. Source: Fedorov, Theory of optimal experiments (1972): D-optimal design.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ladarreg_core.arrays import BoolArray, FloatArray, IntArray, read_only
from ladarreg_core.camera import Camera
from ladarreg_core.errors import OptionError
from ladarreg_core.frames import Rigid
from ladarreg_core.pose.covariance import pose_jacobian
from ladarreg_core.results import PoseResult
from ladarreg_core.scan import Scan
from ladarreg_core.surface.ranges import surface_range
from ladarreg_core.surface.uncertainty import covariance_factor
from ladarreg_core.surface.visibility import project_scan

_CANDIDATES = 900
_MOST_PLACES = 100
_BORDER = 0.02  # of the photo's shorter side: nearer to its edge there is nothing to pick by
_TAKEN = 0.02  # of the photo's diagonal around a match: the same thing twice is no second measurement
_HALF = 0.6  # what is left of an uncertainty that may be called halved


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """A place where a match would help, and by how much."""

    ray: FloatArray
    """(3,) unit, scanner frame."""
    cell: tuple[int, int]
    """Row and column of the scan."""
    uv: FloatArray
    """(2,) photo pixel where the pose expects it."""
    where: str
    """Which part of the photo: 'the upper left', 'the middle', ..."""
    gain: float
    """Growth of log det of the pose's information by a match here, after those at the places before it."""
    here_px: tuple[float, float]
    """Standard deviation of the picture here, now and with this match alone, px."""
    median_px: tuple[float, float]
    """Median standard deviation over the picture, now and with this match alone, px."""

    def in_words(self) -> str:
        """Return the advice as a sentence."""
        now, then = self.here_px
        left = then / now if now > 0 else 1.0
        if left <= 1 - _HALF:
            does = "more than halve the uncertainty there"
        elif left <= _HALF:
            does = "halve the uncertainty there"
        else:
            does = f"lower the uncertainty there by {1 - left:.0%}"
        return (
            f"A match near {self.where} of the photo, around pixel ({self.uv[0]:.0f}, {self.uv[1]:.0f}), would {does} "
            f"({_px(now)} to {_px(then)} px) and bring the whole picture's from {_px(self.median_px[0])} to "
            f"{_px(self.median_px[1])} px."
        )


def advise(
    scan: Scan,
    result: PoseResult,
    *,
    places: int = 3,
    apart: float = 0.15,
    pickable: BoolArray | None = None,
) -> tuple[Place, ...]:
    """Return where the next match would help most, best first; none where the photo sees nothing that can be picked.

    Places are surfaces that the photo sees, away from its edge, from depth edges and from the matches that there are.
    Each after the first is the best once the ones before it have been used.

    Args:
        scan: the scan.
        result: a pose of a photo of it, with its covariance and noise.
        places: at most so many.
        apart: least distance between places in the photo, as a share of its diagonal.
        pickable: (H, W) bool, cells that show something to pick by; None: all.

    Raises:
        OptionError: if `places` is not a whole number from 1 to 100, or `apart` not a number from 0 to 1.
        ShapeError: if the mask is not on the scan's grid, or the pose's covariance is not finite and positive.

    Source: Fedorov, Theory of optimal experiments (1972).
    """
    whole = isinstance(places, int | np.integer) and not isinstance(places, bool)
    if not whole or not 1 <= places <= _MOST_PLACES:
        raise OptionError(f"places is {places!r}; it must be a whole number from 1 to {_MOST_PLACES}")
    number = isinstance(apart, int | float | np.floating | np.integer) and not isinstance(apart, bool)
    if not number or not 0 <= apart <= 1:
        raise OptionError(f"apart is {apart!r}; it must be a number from 0 to 1")
    if pickable is not None:
        pickable = read_only(pickable, np.bool_, scan.shape, "the mask of cells to pick from")
    covariance = covariance_factor(result.covariance)
    covariance = covariance @ covariance.T
    pose, camera = result.camera_from_scanner, result.camera
    projection = project_scan(scan, camera, pose)
    seen = projection.visible & ~projection.grazing & ~projection.untested
    judged = _seen_at(scan, camera, pose, _spread_over(seen))
    free = judged if pickable is None else _seen_at(scan, camera, pose, _spread_over(seen & pickable))
    free = free.subset(_free(free, result))
    if not len(free):
        return ()

    noise = _noise(free, result)
    diagonal = float(np.hypot(*camera.size))
    now = _sigma(judged.by_pose, covariance)
    usable = np.ones(len(free), dtype=np.bool_)
    given: FloatArray = covariance
    found: list[Place] = []
    while len(found) < places and usable.any():
        gains = np.where(usable, _gains(free.by_pose, noise, given), -np.inf)
        k = int(np.argmax(gains))
        alone = _with_match(covariance, free.by_pose[k], noise[k])
        here = free.by_pose[k : k + 1]
        found.append(
            Place(
                free.rays[k],
                (int(free.cells[k, 0]), int(free.cells[k, 1])),
                free.uv[k],
                part_of_photo(free.uv[k], camera),
                float(gains[k]),
                (float(_sigma(here, covariance)[0]), float(_sigma(here, alone)[0])),
                (float(np.median(now)), float(np.median(_sigma(judged.by_pose, alone)))),
            )
        )
        given = _with_match(given, free.by_pose[k], noise[k])
        usable &= np.linalg.norm(free.uv - free.uv[k], axis=1) > apart * diagonal
    return tuple(found)


def part_of_photo(uv: FloatArray, camera: Camera) -> str:
    """Return which of nine parts of the photo a pixel (2,) lies in: 'the upper left', 'the right', 'the middle'."""
    across, down = (float(uv[k] + 0.5) / camera.size[k] for k in range(2))
    horizontal = "left" if across < 1 / 3 else "right" if across > 2 / 3 else ""
    vertical = "upper" if down < 1 / 3 else "lower" if down > 2 / 3 else ""
    if vertical and horizontal:
        return f"the {vertical} {horizontal}"
    if vertical:
        return "the top" if vertical == "upper" else "the bottom"
    return f"the {horizontal}" if horizontal else "the middle"


@dataclass(frozen=True, slots=True, eq=False)
class _Cells:
    """Some cells as the pose sees them."""

    cells: IntArray
    """(N, 2) row, column."""
    rays: FloatArray
    """(N, 3) unit."""
    ranges: FloatArray
    """(N,) m."""
    uv: FloatArray
    """(N, 2) px."""
    by_pose: FloatArray
    """(N, 2, 6) d uv / d (w, c)."""

    def __len__(self) -> int:
        return len(self.cells)

    def subset(self, keep: BoolArray) -> _Cells:
        return _Cells(self.cells[keep], self.rays[keep], self.ranges[keep], self.uv[keep], self.by_pose[keep])


def _spread_over(mask: BoolArray) -> IntArray:
    """Return some hundred cells (N, 2) of a mask: of each block of the grid the one nearest to its middle."""
    count = int(np.count_nonzero(mask))
    stride = max(1, int(np.sqrt(count / _CANDIDATES)))
    fine = max(1, stride // 4)
    rows, columns = (index * fine for index in np.nonzero(mask[::fine, ::fine]))
    if len(rows) * fine * fine < count / 3:  # a mask of single rows or columns, which such a sample may miss
        rows, columns = np.nonzero(mask)
    off = (rows % stride - stride / 2) ** 2 + (columns % stride - stride / 2) ** 2
    block = rows // stride * (mask.shape[1] // stride + 1) + columns // stride
    order = np.lexsort((off, block))
    _, first = np.unique(block[order], return_index=True)
    chosen = order[first]
    return np.stack([rows[chosen], columns[chosen]], axis=-1)


def _seen_at(scan: Scan, camera: Camera, pose: Rigid, cells: IntArray) -> _Cells:
    """Return the cells that have a surface around them and a pixel."""
    rays = scan.geometry.ray_at(cells)
    ranges = surface_range(scan, rays) if len(rays) else np.zeros(0)
    uv, by_pose = pose_jacobian(pose, rays * ranges[:, None], camera)
    usable = np.isfinite(ranges) & np.isfinite(by_pose).all(axis=(1, 2)) & camera.contains(uv)
    return _Cells(cells, rays, ranges, uv, by_pose).subset(usable)


def _free(candidates: _Cells, result: PoseResult) -> BoolArray:
    """Return which candidates (N,) lie within the photo's border and not on a match."""
    camera = result.camera
    inside = camera.contains(candidates.uv, border=_BORDER * min(camera.size))
    taken = result.matches.uv[result.inliers]
    radius = _TAKEN * float(np.hypot(*camera.size))
    for first in range(0, len(taken), 256):
        away = candidates.uv[:, None] - taken[None, first : first + 256]
        inside &= ((away * away).sum(axis=-1) > radius * radius).all(axis=1)
    return inside


def _noise(cells: _Cells, result: PoseResult) -> FloatArray:
    """Return the covariance (N, 2, 2) of a match's residual from its measured range, px^2."""
    # A range that is off moves the point along its ray, as the camera moving back along it would.
    by_range = -np.einsum("nij,nj->ni", cells.by_pose[..., 3:], cells.rays)
    spread = by_range[:, :, None] * by_range[:, None]
    return np.asarray(result.sigma_px**2 * np.eye(2) + result.sigma_range_m**2 * spread)


def _gains(by_pose: FloatArray, noise: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the growth (N,) of log det of the information."""
    predicted = by_pose @ covariance @ by_pose.swapaxes(1, 2)
    return np.asarray(np.linalg.slogdet(noise + predicted)[1] - np.linalg.slogdet(noise)[1])


def _with_match(covariance: FloatArray, by_pose: FloatArray, noise: FloatArray) -> FloatArray:
    """Return the pose's covariance after one more match: Kalman's update, in the form that stays positive."""
    gain = covariance @ by_pose.T @ np.linalg.inv(by_pose @ covariance @ by_pose.T + noise)
    left = np.eye(6) - gain @ by_pose
    return np.asarray(left @ covariance @ left.T + gain @ noise @ gain.T)


def _sigma(by_pose: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the longer half axis (N,) of the pixels' one-sigma ellipses, px."""
    predicted = by_pose @ covariance @ by_pose.swapaxes(1, 2)
    return np.asarray(np.sqrt(np.maximum(np.linalg.eigvalsh(predicted)[:, -1], 0)))


def _px(value: float) -> str:
    return f"{value:.2g}" if value < 99.5 else f"{value:.0f}"
