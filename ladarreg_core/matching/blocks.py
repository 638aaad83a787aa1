"""Block-wise comparison of scan points with the photo at a pose: correlation, step and sub-pixel match of a block."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.arrays import BoolArray, FloatArray
from ladarreg_core.camera import Camera
from ladarreg_core.features.channels import channel_products
from ladarreg_core.frames import Rigid
from ladarreg_core.matches import Matches
from ladarreg_core.matching.sampling import Blocks, ViewPoints, runs
from ladarreg_core.matching.zbuffer import Occluder

MIN_POINTS = 8
"""Least number of visible points of a block."""
MIN_BLOCKS = 8
"""Least number of such blocks in a comparison."""
_MIN_CORRELATION = 0.4  # a block that correlates less is no match
_MIN_SHARED = 0.1
_DAMPING = 0.3
_SD_OF_MEDIAN = 1.4826
_MIN_SCATTER_PX = 0.02
_OUTLIER_SIGMA = 3.5


class Target:
    """The photo's channels at one level, laid out for sampling values and gradients together."""

    def __init__(self, camera: Camera, channels: FloatArray, usable: BoolArray) -> None:
        self.camera = camera
        self.channels = channels
        self.usable = usable
        self._values = channels.reshape(-1, channels.shape[-1])

    @cached_property
    def squares(self) -> FloatArray:
        """(h w,) the channels' squared norm at each pixel."""
        return channel_products(self._values, self._values)

    @cached_property
    def usable_everywhere(self) -> bool:
        """Whether every pixel is usable."""
        return bool(self.usable.all())

    def seen_by(self, camera: Camera) -> Target:
        """Return the same image attributed to another camera of the same size."""
        return Target(camera, self.channels, self.usable)

    def sample(self, uv: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return channels and their derivatives by u and v, each (N, 8), at pixels (N, 2) inside the image.

        The derivatives are central differences at the nearest pixel; the channels are smooth enough for that.
        """
        width = self.camera.width
        base = np.floor(uv).astype(np.intp)
        fraction = (uv - base).astype(np.float32)
        first = base[:, 1] * width + base[:, 0]
        a, b = (np.repeat(fraction[:, k], self._values.shape[1]).reshape(len(uv), -1) for k in range(2))
        upper = _between(self._at(first), self._at(first + 1), a)
        lower = _between(self._at(first + width), self._at(first + width + 1), a)
        nearest = first + (fraction[:, 0] >= 0.5) + width * (fraction[:, 1] >= 0.5)
        by_u = self._at(nearest + 1)
        by_u -= self._at(nearest - 1)
        by_u *= np.float32(0.5)
        by_v = self._at(nearest + width)
        by_v -= self._at(nearest - width)
        by_v *= np.float32(0.5)
        return _between(upper, lower, b), by_u, by_v

    def _at(self, pixels: NDArray[np.intp]) -> FloatArray:
        return self._values.take(pixels, axis=0)


def _between(start: FloatArray, end: FloatArray, share: FloatArray) -> FloatArray:
    """Return start + share (end - start); `end` is overwritten."""
    end -= start
    end *= share
    end += start
    return end


def project_visible(
    points: ViewPoints, target: Target, occluder: Occluder, buffer: FloatArray, pose: Rigid, *, border: float
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return the points in the camera frame (N, 3), their pixels (N, 2), and a mask of those visible.

    A visible point lies at least `border` pixels inside the image, on a usable pixel, and is not occluded.
    """
    camera = target.camera
    # One row per coordinate: NumPy is several times as fast on long rows as on many short ones.
    rows = pose.rotation.astype(np.float32) @ np.ascontiguousarray(points.points.T)
    rows += pose.translation.astype(np.float32)[:, None]
    x, y, z = rows
    shrink = 1 / np.where(z > 0.05, z, 1)
    if camera.distortion:  # only while a change of the lens is being estimated
        uv = camera.project(np.stack([x * shrink, y * shrink, np.ones_like(x)], axis=-1))
    else:
        scale, centre = (
            np.array(pair, np.float32)[:, None] for pair in ((camera.fx, camera.fy), (camera.cx, camera.cy))
        )
        uv = (rows[:2] * shrink * scale + centre).T
    visible = camera.contains(uv, border=border) & occluder.visible(rows.T, buffer)
    if not target.usable_everywhere:
        near = np.rint(np.where(visible[:, None], uv, 0)).astype(np.intp)
        visible &= target.usable[near[:, 1], near[:, 0]]
    return rows.T, uv, visible


def block_counts(blocks: Blocks, visible: BoolArray) -> tuple[FloatArray, BoolArray]:
    """Return the number of visible points of each block (B,), and a mask of the blocks that have enough."""
    count = blocks.sum(visible.astype(np.float32))
    return count, count >= MIN_POINTS


@dataclass(frozen=True, eq=False)
class BlockComparison:
    """Comparison of n visible points in b blocks; the channels of both sides are centred and normalised per block."""

    points_camera: FloatArray
    """(n, 3) m, camera frame."""
    index: NDArray[np.intp]
    """(n,) indices into the points compared."""
    uv: FloatArray
    """(n, 2) their projections, level pixels of the photo."""
    blocks: Blocks
    """Their blocks."""
    count: FloatArray
    """(b,) number of points."""
    rho: FloatArray
    """(b,) correlation, at least 0."""
    by_u: FloatArray
    """(n, 8) the photo's channels' derivative by u, in units of the block's length."""
    by_v: FloatArray
    """(n, 8) likewise by v."""
    a_u: FloatArray
    """(n,) the scan's channels times `by_u`."""
    a_v: FloatArray
    """(n,) likewise `by_v`."""
    b_u: FloatArray
    """(n,) the photo's channels times `by_u`."""
    b_v: FloatArray
    """(n,) likewise `by_v`."""

    @cached_property
    def gradient_products(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Scalar products (n,) of each point's derivatives: u with u, u with v, v with v."""
        by_u, by_v = self.by_u, self.by_v
        return channel_products(by_u, by_u), channel_products(by_u, by_v), channel_products(by_v, by_v)

    @cached_property
    def gradient_sums(self) -> tuple[FloatArray, FloatArray]:
        """Sums (b, 8) of the derivatives by u and v over each block."""
        return self.blocks.sum(self.by_u), self.blocks.sum(self.by_v)

    def normal_equations(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return uu, uv, vv and the right-hand sides u, v, (b,) each, of every block's own Lucas-Kanade step."""
        sum_u, sum_v = self.gradient_sums

        def gram(products: FloatArray, sums: FloatArray, along: FloatArray) -> FloatArray:
            return np.asarray(self.blocks.sum(products) - sums / self.count - along)

        along_u, along_v = self.blocks.sum(self.b_u), self.blocks.sum(self.b_v)
        product_uu, product_uv, product_vv = self.gradient_products
        uu = gram(product_uu, (sum_u * sum_u).sum(axis=1), along_u * along_u)
        uv = gram(product_uv, (sum_u * sum_v).sum(axis=1), along_u * along_v)
        vv = gram(product_vv, (sum_v * sum_v).sum(axis=1), along_v * along_v)
        return (
            uu,
            uv,
            vv,
            self.blocks.sum(self.a_u) - self.rho * along_u,
            self.blocks.sum(self.a_v) - self.rho * along_v,
        )


def compare_blocks(
    points: ViewPoints, target: Target, occluder: Occluder, buffer: FloatArray, pose: Rigid
) -> BlockComparison | None:
    """Compare the scan points visible at a pose with the photo; return None if too few blocks remain."""
    points_camera, uv, visible = project_visible(points, target, occluder, buffer, pose, border=2)
    _, enough = block_counts(points.blocks, visible)
    if np.count_nonzero(enough) < MIN_BLOCKS:
        return None
    kept = np.flatnonzero(visible & enough[points.blocks.of_point])
    blocks = _sub_blocks(points.blocks.of_point[kept])
    of = blocks.of_point
    count = blocks.sum(np.ones(len(kept), np.float32))

    def centred(values: FloatArray) -> FloatArray:
        return np.asarray(values - (blocks.sum(values) / count[:, None]).take(of, axis=0))

    seen = uv[kept]
    A = centred(points.channels.take(kept, axis=0))
    B, Bu, Bv = target.sample(seen)
    B = centred(B)
    length_a, length_b = (
        np.sqrt(blocks.sum(channel_products(A, A))) + 1e-9,
        np.sqrt(blocks.sum(channel_products(B, B))) + 1e-9,
    )
    A /= length_a.take(of)[:, None]
    shrink = (1 / length_b).take(of)[:, None]
    for values in (B, Bu, Bv):
        values *= shrink
    rho = np.maximum(blocks.sum(channel_products(A, B)), 0)
    return BlockComparison(
        points_camera.T.take(kept, axis=1).T, kept, seen, blocks, count, rho, Bu, Bv,
        channel_products(A, Bu), channel_products(A, Bv), channel_products(B, Bu), channel_products(B, Bv),
    )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class BlockMatches:
    """Sub-pixel point matches, one for each block."""

    matches: Matches
    """M matches, in the photo's own pixels."""
    inliers: BoolArray
    """(M,) bool, offset within 3.5 robust standard deviations."""
    scatter_px: float
    """Standard deviation of the inliers' offsets from the projection, photo pixels; NaN without matches."""


def block_matches(seen: BlockComparison, points: ViewPoints, working: Camera, camera: Camera) -> BlockMatches:
    """Return one match for each block, displaced from its projection by the block's own Lucas-Kanade step.

    The step is damped along straight edges, where a block does not constrain it, so that the match stays at the
    projection in that direction. The least-squares pose of these matches is therefore the finished pose, apart from
    the weighting of blocks.

    Args:
        seen: the blocks at the finished pose.
        points: the points that were compared.
        working: the ideal camera of the comparison.
        camera: the photo's own camera.
    """
    uu, uv, vv, right_u, right_v = (np.asarray(value, np.float64) for value in seen.normal_equations())
    # Only the signal that a block shares with the photo contributes curvature; the rest of its gradient is noise.
    shared = np.maximum(seen.rho, _MIN_SHARED).astype(np.float64)
    damping = _DAMPING * float(np.median(shared * (uu + vv)))
    uu, uv, vv = shared * uu + damping, shared * uv, shared * vv + damping
    det = np.maximum(uu * vv - uv * uv, np.finfo(np.float64).tiny)  # flat blocks do not move
    offset = np.stack([vv * right_u - uv * right_v, uu * right_v - uv * right_u], axis=-1) / det[:, None]

    nearest = _centre_points(seen)
    at = points.points[seen.index[nearest]].astype(np.float64)
    ranges = np.linalg.norm(at, axis=-1)
    pixel = seen.uv[nearest].astype(np.float64) + offset
    own = camera.project(working.unproject(pixel))
    matched = (seen.rho >= _MIN_CORRELATION) & np.isfinite(own).all(axis=-1)
    grid = points.blocks.grid[points.blocks.of_point[seen.index[nearest]]][matched]
    names = tuple(f"b{row}.{column}" for row, column in grid.tolist())
    matches = Matches(at[matched] / ranges[matched, None], ranges[matched], own[matched], names)
    if not len(matches):
        return BlockMatches(matches, np.zeros(0, np.bool_), float("nan"))
    off = np.abs(offset[matched])
    scatter = _SD_OF_MEDIAN * float(np.median(off)) + _MIN_SCATTER_PX
    inliers = off.max(axis=-1) <= _OUTLIER_SIGMA * scatter
    return BlockMatches(matches, inliers, scatter * camera.focal_px / working.focal_px)


def _centre_points(seen: BlockComparison) -> NDArray[np.intp]:
    """Return the index of the point of each block (b,) nearest to the block's centroid."""
    of = seen.blocks.of_point
    middle: FloatArray = seen.blocks.sum(seen.uv) / seen.count[:, None]
    distance = ((seen.uv - middle[of]) ** 2).sum(axis=-1)
    order = np.lexsort((distance, of))
    return np.asarray(order[np.searchsorted(of[order], np.arange(len(seen.blocks)))])


def _sub_blocks(labels: NDArray[np.intp]) -> Blocks:
    starts, of_point = runs(labels)
    return Blocks(starts, of_point, labels[starts, None])
