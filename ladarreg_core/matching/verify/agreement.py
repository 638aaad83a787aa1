"""Agreement of scan and photo at a pose, relative to that at all small shifts (the pair's own null distribution).

The centred channels of each block are correlated with the photo at each whole-pixel shift; a window pools 3 x 3 blocks.
(Messages and the verdict call a window a region.) At the true pose the correlation peaks lie at zero shift all over the
image; at a wrong pose they are spread over all shifts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import comb, exp, lgamma, log, log1p

import numpy as np

from ladarreg_core.foundations.arrays import BoolArray, FloatArray, IntArray
from ladarreg_core.frames import Rigid
from ladarreg_core.matching.features.channels import channel_products
from ladarreg_core.matching.images.blocks import Target, project_visible
from ladarreg_core.matching.images.sampling import ViewPoints
from ladarreg_core.matching.images.zbuffer import Occluder

_MIN_POINTS = 12
_MIN_NEIGHBOURS = 5
_TINY = 1e-9
_MAX_EXACT = 800  # blocks; the binomial coefficients of more overflow


@dataclass(frozen=True, slots=True, eq=False)
class Agreement:
    """Pooled correlation maps of one level at one pose."""

    level: int
    """Pyramid level."""
    radius: int
    """Largest shift, level pixels."""
    maps: FloatArray
    """(W, 2r+1, 2r+1) pooled correlation of each window over shifts (row: v, column: u)."""
    grid: IntArray
    """(W, 2) row and column of each window's central block."""
    pooled_blocks: IntArray
    """(W,) number of blocks pooled in each window."""
    members: tuple[IntArray, ...]
    """Indices of the visible points of each window's central block."""
    uv: FloatArray
    """(N, 2) level pixels of all points at this pose."""
    visible: BoolArray
    """(N,) bool."""
    block_maps: FloatArray = field(default_factory=lambda: np.zeros((0, 1, 1)))
    """(B, 2r+1, 2r+1) correlation of every single block minus its mean over the shifts, before pooling."""

    @property
    def windows(self) -> int:
        """Number of windows."""
        return len(self.maps)

    @property
    def _scale(self) -> float:
        return 0.5**self.level

    def peaks(self) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Return the sub-pixel peaks (W, 2) as (u, v) in level pixels, their heights (W,) in standard deviations of
        the window's map, and a mask (W,) of those on the border of the map."""
        side = 2 * self.radius + 1
        flat = self.maps.reshape(len(self.maps), side * side)
        best = flat.argmax(axis=1)
        row, column = np.divmod(best, side)
        border = (row == 0) | (row == side - 1) | (column == 0) | (column == side - 1)
        r, c = np.clip(row, 1, side - 2), np.clip(column, 1, side - 2)
        k = np.arange(len(flat))
        du = _vertex(self.maps[k, r, c - 1], self.maps[k, r, c], self.maps[k, r, c + 1])
        dv = _vertex(self.maps[k, r - 1, c], self.maps[k, r, c], self.maps[k, r + 1, c])
        shift = np.stack([c + du, r + dv], axis=-1) - self.radius
        height = (flat[k, best] - flat.mean(axis=1)) / (flat.std(axis=1) + 1e-12)
        return shift, height, border

    def agreeing(self, tolerance_px: float) -> BoolArray:
        """Return a mask (W,) of the windows that peak within `tolerance_px` working pixels of zero shift."""
        return np.asarray(self._peak_distances(self.maps) <= tolerance_px * self._scale + 1e-9)

    def false_alarm(self, tolerance_px: float, *, least_chance: float) -> float:
        """Return a bound on the probability that so many blocks agree by chance.

        Single blocks are counted, because they share no pixels. The probability for one block is estimated from the
        pair itself, since a repeated pattern agrees at many shifts: it is the largest fraction of blocks that agree
        with any one far shift. It is at least `least_chance`, because refinement pulls some blocks to zero
        shift at any pose.

        Source: the binomial distribution's upper tail.
        """
        count = len(self.block_maps)
        if not count:
            return 1.0
        near = tolerance_px * self._scale + 1e-9
        agreeing = self.agreeing_blocks(tolerance_px)
        u, v = (shift.reshape(-1) for shift in self._shifts())
        best = self.block_maps.reshape(count, -1).argmax(axis=1)
        far = np.hypot(u, v) > 2 * near
        apart = np.hypot(u[far, None] - u[best], v[far, None] - v[best])
        p = max(least_chance, float((apart <= near).mean(axis=1).max(initial=0.0)))
        if count > _MAX_EXACT:
            return _upper_tail(agreeing, count, p)
        return float(sum(comb(count, k) * p**k * (1 - p) ** (count - k) for k in range(agreeing, count + 1)))

    def agreeing_blocks(self, tolerance_px: float) -> int:
        """Return the number of single blocks that peak within `tolerance_px` working pixels of zero shift."""
        return int((self._peak_distances(self.block_maps) <= tolerance_px * self._scale + 1e-9).sum())

    def gains(self) -> FloatArray:
        """Return the gain (B,) of each single block: its correlation within a pixel of zero shift, above its mean over
        all shifts."""
        near = slice(self.radius - 1, self.radius + 2)
        return np.asarray(self.block_maps[:, near, near].mean(axis=(1, 2)))

    def _peak_distances(self, maps: FloatArray) -> FloatArray:
        """Return the distance (n,) of each map's (n, 2r+1, 2r+1) peak from zero shift, level pixels."""
        if not len(maps):
            return np.zeros(0)
        u, v = self._shifts()
        return np.asarray(np.hypot(u, v).reshape(-1)[maps.reshape(len(maps), -1).argmax(axis=1)])

    def contrast(self, *, near_px: float, far_px: float) -> float:
        """Return zb: peak at near shifts above the mean of far ones, in standard deviations; mean over windows."""
        if not len(self.maps):
            return 0.0
        distance = np.hypot(*self._shifts()) / self._scale
        near, far = distance <= near_px, distance > far_px
        if not far.any():
            return 0.0
        away = self.maps[:, far]
        return float(np.mean((self.maps[:, near].max(axis=1) - away.mean(axis=1)) / (away.std(axis=1) + 1e-12)))

    def _shifts(self) -> tuple[FloatArray, FloatArray]:
        v, u = np.mgrid[-self.radius : self.radius + 1, -self.radius : self.radius + 1].astype(np.float64)
        return u, v


def _upper_tail(least: int, count: int, p: float) -> float:
    """Return the probability of at least `least` of `count`, each of probability `p` < 1, in logarithms."""
    terms = np.array(
        [
            lgamma(count + 1) - lgamma(k + 1) - lgamma(count - k + 1) + k * log(p) + (count - k) * log1p(-p)
            for k in range(least, count + 1)
        ]
    )
    highest = float(terms.max())
    return min(1.0, exp(highest) * float(np.exp(terms - highest).sum()))


def _vertex(before: FloatArray, at: FloatArray, after: FloatArray) -> FloatArray:
    curvature = before - 2 * at + after
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = np.where(curvature < 0, 0.5 * (before - after) / curvature, 0.0)
    return np.clip(offset, -0.5, 0.5)


def joined(parts: Sequence[Agreement]) -> Agreement:
    """Return the agreement of several pictures of one photograph at one pose, all at one level, as that of one picture.

    Its grid and pixels remain those of each picture.
    """
    first = parts[0]
    if len(parts) == 1:
        return first
    before = np.cumsum([0, *(len(part.visible) for part in parts)])
    members = tuple(index + start for part, start in zip(parts, before, strict=False) for index in part.members)
    side = 2 * first.radius + 1
    blocks = [part.block_maps for part in parts if len(part.block_maps)]
    return Agreement(
        first.level,
        first.radius,
        np.concatenate([part.maps for part in parts]),
        np.concatenate([part.grid for part in parts]),
        np.concatenate([part.pooled_blocks for part in parts]),
        members,
        np.concatenate([part.uv for part in parts]),
        np.concatenate([part.visible for part in parts]),
        np.concatenate(blocks) if blocks else np.zeros((0, side, side)),
    )


def agreement(
    points: ViewPoints,
    target: Target,
    occluder: Occluder,
    pose: Rigid,
    *,
    level: int,
    radius: int,
    only: BoolArray | None = None,
) -> Agreement:
    """Return the agreement at a pose: every block correlated at every shift within `radius` level pixels.

    Args:
        points: the scan's points in their view.
        target: the photo's level.
        occluder: of the scan.
        pose: `camera_from_scanner`.
        level: the pyramid level.
        radius: largest shift, level pixels.
        only: (N,) mask of the points that count; None: all that are visible.
    """
    buffer = occluder.depth_buffer(pose)
    _, uv, visible = project_visible(points, target, occluder, buffer, pose, border=radius + 1)
    if only is not None:
        visible &= only
    of = points.blocks.of_point
    count = points.blocks.sum(visible.astype(np.int64))
    blocks = np.flatnonzero(count >= _MIN_POINTS)
    side = 2 * radius + 1
    if not len(blocks):
        none = np.zeros(0, np.intp)
        return Agreement(level, radius, np.zeros((0, side, side)), np.zeros((0, 2), np.intp), none, (), uv, visible)
    rank = np.full(len(points.blocks), -1)
    rank[blocks] = np.arange(len(blocks))
    kept = np.flatnonzero(visible & (rank[of] >= 0))
    starts = np.searchsorted(rank[of[kept]], np.arange(len(blocks)))
    rho = _correlations(points.channels[kept], uv[kept], starts, target, radius)

    # Subtract each block's mean over the shifts, then pool over 3 x 3 blocks.
    rho -= rho.mean(axis=(1, 2), keepdims=True)
    grid = points.blocks.grid[blocks]
    extent = grid.max(axis=0) + 3
    dense = np.zeros((*extent, side, side))
    there = np.zeros(extent, np.int64)
    dense[grid[:, 0] + 1, grid[:, 1] + 1] = rho
    there[grid[:, 0] + 1, grid[:, 1] + 1] = 1
    pooled, neighbours = np.zeros_like(rho), np.zeros(len(blocks), np.int64)
    for i in range(3):
        for j in range(3):
            pooled += dense[grid[:, 0] + i, grid[:, 1] + j]
            neighbours += there[grid[:, 0] + i, grid[:, 1] + j]
    selected = np.flatnonzero(neighbours >= _MIN_NEIGHBOURS)
    ends = np.append(starts[1:], len(kept))
    members = tuple(kept[starts[k] : ends[k]] for k in selected)
    return Agreement(level, radius, pooled[selected], grid[selected], neighbours[selected], members, uv, visible, rho)


def _correlations(channels: FloatArray, uv: FloatArray, starts: IntArray, target: Target, radius: int) -> FloatArray:
    """Return rho (B, 2r+1, 2r+1): normalised correlation of each block at each shift.

    The photo is sampled at whole pixels: rounding the projections displaces the points by less than a third of a pixel
    rms, in no preferred direction.
    """
    side = 2 * radius + 1
    shifts, kinds = side * side, channels.shape[-1]
    # Around each point all shifts are read at once, row by row of its neighbourhood; every pixel lies in the image.
    column, row = np.rint(uv).astype(np.intp).T - radius
    neighbourhoods, squared = target.neighbourhoods(side)
    count = np.diff(starts, append=len(uv))
    of = np.repeat(np.arange(len(starts)), count)
    A = channels - (np.add.reduceat(channels, starts) / count[:, None].astype(np.float32)).take(of, axis=0)
    norm_a = np.sqrt(np.add.reduceat(channel_products(A, A), starts))
    # One matrix product gives the correlation with A (A is centred, so B need not be) and the sums of B's channels.
    left = np.concatenate([A.T, np.ones((1, len(uv)), np.float32)])
    product, length = np.empty((2, len(starts), shifts))
    for k, (first, n) in enumerate(zip(starts, count, strict=True)):
        block = slice(first, first + n)
        at = row[block], column[block]
        sums = (left[:, block] @ neighbourhoods[at].reshape(n, -1)).reshape(kinds + 1, shifts, kinds)
        product[k] = np.einsum("csc->s", sums[:kinds])
        square = squared[at].reshape(n, -1).sum(axis=0)
        length[k] = square - (sums[kinds] ** 2).sum(axis=1) / n
    rho = product / (norm_a[:, None] * np.sqrt(np.maximum(length, 0)) + _TINY)
    return np.asarray(rho.reshape(-1, side, side))
