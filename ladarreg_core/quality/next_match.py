"""Suggestions for the next match: the positions where one would reduce the uncertainty of the pose most.

A match adds information to the pose; its gain is the growth of log det of that information,

    log det(S + J P J^T) - log det S

with P the covariance of the pose, J the derivative of the pixel by the pose and S the covariance of the new match's
residual, from its pixel noise and its range noise. Source: Fedorov, Theory of optimal experiments (1972): D-optimal
design.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ladarreg_core.camera import CameraModel
from ladarreg_core.foundations.arrays import BoolArray, FloatArray, IntArray, read_only
from ladarreg_core.foundations.formatting import format_number
from ladarreg_core.foundations.validation import require_int, require_number
from ladarreg_core.results.registration import PoseResult
from ladarreg_core.scan import Scan
from ladarreg_core.surface.ranges import surface_range
from ladarreg_core.surface.uncertainty import covariance_factor
from ladarreg_core.surface.visibility.visible_points import LARGEST_WHOLE_SCAN, project_scan

_CANDIDATES = 900
_SAMPLED_CELLS = 1_000_000
"""Of a larger scan than is projected in one piece."""
_MAX_SUGGESTIONS = 100
_BORDER = 0.02  # of the photo's shorter side: nearer to its edge there is too little context to pick by
_TAKEN = 0.02  # of the photo's diagonal around a match: picking the same detail again adds no measurement
_HALF = 0.6  # remaining share of an uncertainty that the text calls halved
_NOTABLE = 0.02  # share of the median uncertainty that is worth a word


@dataclass(frozen=True, slots=True, eq=False)
class SuggestedMatch:
    """Position where a match would help, with its gain."""

    ray: FloatArray
    """(3,) unit, scanner frame."""
    cell: tuple[int, int]
    """Row and column of the scan."""
    uv: FloatArray
    """(2,) photo pixel predicted by the pose."""
    where: str
    """Part of the photo: 'the upper left', 'the middle', ..."""
    gain: float
    """Growth of log det of the pose's information by this match, given the suggestions before it."""
    local_px: tuple[float, float]
    """Standard deviation of the pixel position here, now and with this match alone, px."""
    median_px: tuple[float, float]
    """Median standard deviation over the photo, now and with this match alone, px."""

    def summary(self) -> str:
        """Return the suggestion as a sentence."""
        now, then = self.local_px
        remaining = _share_left(self.local_px)
        if remaining <= 1 - _HALF:
            effect = "more than halve the uncertainty there"
        elif remaining <= _HALF:
            effect = "halve the uncertainty there"
        else:
            effect = f"reduce the uncertainty there by {1 - remaining:.0%}"
        # as a share: this median is over a sample of the photo, and another figure than that of the whole photo
        gained = 1 - _share_left(self.median_px)
        return (
            f"A match near {self.where} of the photo, around pixel ({self.uv[0]:.0f}, {self.uv[1]:.0f}), would "
            f"{effect} ({format_number(now)} to {format_number(then)} px)"
            + (f" and the median over the photo by {gained:.0%}." if gained >= _NOTABLE else ".")
        )


def _share_left(sigma_px: tuple[float, float]) -> float:
    """Return the share of an uncertainty, now and then, that remains."""
    now, then = sigma_px
    return then / now if now > 0 else 1.0


def suggest_matches(
    scan: Scan,
    result: PoseResult,
    *,
    count: int = 3,
    apart: float = 0.15,
    pickable: BoolArray | None = None,
) -> tuple[SuggestedMatch, ...]:
    """Return the positions where the next match would help most, best first; none where the photo sees nothing
    pickable.

    Positions lie on surfaces that the photo sees, away from its border, from depth edges and from existing matches.
    Each after the first is the best one given that those before it have been used.

    Args:
        scan: the scan.
        result: a pose of a photo of it, with its covariance and noise.
        count: number of suggestions at most.
        apart: least distance between suggestions in the photo, as a share of its diagonal.
        pickable: (H, W) bool, cells with detail that can be picked; None: all.

    Raises:
        OptionError: if `count` is not a whole number from 1 to 100, or `apart` not a number from 0 to 1.
        ShapeError: if the mask is not on the scan's grid, or the pose's covariance is not finite and positive.

    Source: Fedorov, Theory of optimal experiments (1972).
    """
    require_int(count, "count", least=1, most=_MAX_SUGGESTIONS)
    require_number(apart, "apart", least=0, most=1)
    if pickable is not None:
        pickable = read_only(pickable, np.bool_, scan.shape, "the mask of cells to pick from")
    if scan.ranges.size > LARGEST_WHOLE_SCAN:
        part, stride = scan.thinned(_SAMPLED_CELLS)
        some = None if pickable is None else pickable[::stride, ::stride]
        thinned = suggest_matches(part, result, count=count, apart=apart, pickable=some)
        return tuple(replace(one, cell=(one.cell[0] * stride, one.cell[1] * stride)) for one in thinned)
    covariance = covariance_factor(
        result.joint_covariance if result.joint_covariance is not None else result.covariance
    )
    covariance = covariance @ covariance.T
    pose, camera = result.camera_from_scanner, result.camera
    projection = project_scan(scan, camera, pose)
    seen = projection.visible & ~projection.grazing & ~projection.untested
    sampled = _seen_at(scan, result, _spread_over(seen))
    free = sampled if pickable is None else _seen_at(scan, result, _spread_over(seen & pickable))
    free = free.subset(_away_from_matches(free, result))
    if not len(free):
        return ()

    noise = _noise(free, result)
    diagonal = float(np.hypot(*camera.size))
    now = _sigma(sampled.by_pose, covariance)
    usable = np.ones(len(free), dtype=np.bool_)
    updated: FloatArray = covariance
    found: list[SuggestedMatch] = []
    while len(found) < count and usable.any():
        gains = np.where(usable, _gains(free.by_pose, noise, updated), -np.inf)
        k = int(np.argmax(gains))
        alone = _with_match(covariance, free.by_pose[k], noise[k])
        here = free.by_pose[k : k + 1]
        found.append(
            SuggestedMatch(
                free.rays[k],
                (int(free.cells[k, 0]), int(free.cells[k, 1])),
                free.uv[k],
                part_of_photo(free.uv[k], camera),
                float(gains[k]),
                (float(_sigma(here, covariance)[0]), float(_sigma(here, alone)[0])),
                (float(np.median(now)), float(np.median(_sigma(sampled.by_pose, alone)))),
            )
        )
        updated = _with_match(updated, free.by_pose[k], noise[k])
        usable &= np.linalg.norm(free.uv - free.uv[k], axis=1) > apart * diagonal
    return tuple(found)


def part_of_photo(uv: FloatArray, camera: CameraModel) -> str:
    """Return the part of the photo, one of nine, that contains a pixel (2,): 'the upper left', 'the right', 'the
    middle'."""
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
    """Scan cells with their photo pixels under a pose."""

    cells: IntArray
    """(N, 2) row, column."""
    rays: FloatArray
    """(N, 3) unit."""
    ranges: FloatArray
    """(N,) m."""
    uv: FloatArray
    """(N, 2) px."""
    by_pose: FloatArray
    """(N, 2, 6 + K) d uv / d (w, c), and by the uncertain intrinsics."""

    def __len__(self) -> int:
        return len(self.cells)

    def subset(self, keep: BoolArray) -> _Cells:
        return _Cells(self.cells[keep], self.rays[keep], self.ranges[keep], self.uv[keep], self.by_pose[keep])


def _spread_over(mask: BoolArray) -> IntArray:
    """Return some hundred cells (N, 2) of a mask: in each block of the grid, the one nearest to its centre."""
    count = int(np.count_nonzero(mask))
    stride = max(1, int(np.sqrt(count / _CANDIDATES)))
    fine = max(1, stride // 4)
    rows, columns = (index * fine for index in np.nonzero(mask[::fine, ::fine]))
    if len(rows) * fine * fine < count / 3:  # a mask of single rows or columns, which the coarse sample may miss
        rows, columns = np.nonzero(mask)
    off = (rows % stride - stride / 2) ** 2 + (columns % stride - stride / 2) ** 2
    block = rows // stride * (mask.shape[1] // stride + 1) + columns // stride
    order = np.lexsort((off, block))
    _, first = np.unique(block[order], return_index=True)
    chosen = order[first]
    return np.stack([rows[chosen], columns[chosen]], axis=-1)


def _seen_at(scan: Scan, result: PoseResult, cells: IntArray) -> _Cells:
    """Return those cells that lie on a surface and inside the photo."""
    rays = scan.geometry.ray_at(cells)
    ranges = surface_range(scan, rays) if len(rays) else np.zeros(0)
    uv, by_pose = result.pixel_jacobian(rays * ranges[:, None])
    usable = np.isfinite(ranges) & np.isfinite(by_pose).all(axis=(1, 2)) & result.camera.contains(uv)
    return _Cells(cells, rays, ranges, uv, by_pose).subset(usable)


def _away_from_matches(candidates: _Cells, result: PoseResult) -> BoolArray:
    """Return which candidates (N,) lie off the photo's border and away from the existing matches."""
    camera = result.camera
    inside = camera.contains(candidates.uv, border=_BORDER * min(camera.size))
    taken = result.matches.uv[result.inliers]
    radius = _TAKEN * float(np.hypot(*camera.size))
    for first in range(0, len(taken), 256):
        away = candidates.uv[:, None] - taken[None, first : first + 256]
        inside &= ((away * away).sum(axis=-1) > radius * radius).all(axis=1)
    return inside


def _noise(cells: _Cells, result: PoseResult) -> FloatArray:
    """Return the covariance (N, 2, 2) of the residual of a match, px^2, from its pixel and its range noise."""
    # A range error moves the point along its ray; so would an opposite shift of the camera.
    by_range = -np.einsum("nij,nj->ni", cells.by_pose[..., 3:6], cells.rays)
    spread = by_range[:, :, None] * by_range[:, None]
    return np.asarray(result.sigma_px**2 * np.eye(2) + result.sigma_range_m**2 * spread)


def _gains(by_pose: FloatArray, noise: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the growth (N,) of log det of the information."""
    predicted = by_pose @ covariance @ by_pose.swapaxes(1, 2)
    return np.asarray(np.linalg.slogdet(noise + predicted)[1] - np.linalg.slogdet(noise)[1])


def _with_match(covariance: FloatArray, by_pose: FloatArray, noise: FloatArray) -> FloatArray:
    """Return the covariance of the pose after one more match: the Kalman update in Joseph form, which stays
    positive."""
    gain = covariance @ by_pose.T @ np.linalg.inv(by_pose @ covariance @ by_pose.T + noise)
    remaining = np.eye(len(covariance)) - gain @ by_pose
    return np.asarray(remaining @ covariance @ remaining.T + gain @ noise @ gain.T)


def _sigma(by_pose: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the semi-major axis (N,) of the one-sigma ellipses of the pixels, px."""
    predicted = by_pose @ covariance @ by_pose.swapaxes(1, 2)
    return np.asarray(np.sqrt(np.maximum(np.linalg.eigvalsh(predicted)[:, -1], 0)))
