"""Block-wise comparison of scan points with the photo at a pose: correlation, step and sub-pixel match of a block."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.lib.stride_tricks import as_strided
from numpy.typing import NDArray

from ladarreg_core.camera import Camera
from ladarreg_core.foundations.arrays import BoolArray, FloatArray, IntArray
from ladarreg_core.frames import Rigid
from ladarreg_core.matches import Matches
from ladarreg_core.matching.features.channels import channel_products
from ladarreg_core.matching.images.sampling import Blocks, ViewPoints, runs
from ladarreg_core.matching.images.zbuffer import Occluder
from ladarreg_core.results.compared_blocks import ComparedBlocks

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

    def neighbourhoods(self, side_px: int) -> tuple[FloatArray, FloatArray]:
        """Return views of all square neighbourhoods, by the row and column of their first pixel.

        Returns:
            channels (h - side + 1, w - side + 1, side, C side) and their squared norm (..., side, side).
        """
        height, width = self.usable.shape
        there = (height - side_px + 1, width - side_px + 1, side_px)
        channels = np.ascontiguousarray(self.channels)
        squares = self.squares.reshape(height, width)
        by_row, by_column, by_value = channels.strides
        shape, strides = (*there, side_px * channels.shape[-1]), (by_row, by_column, by_row, by_value)
        return as_strided(channels, shape, strides, writeable=False), as_strided(
            squares, (*there, side_px), squares.strides * 2, writeable=False
        )

    @cached_property
    def usable_everywhere(self) -> bool:
        """Whether every pixel is usable."""
        return bool(self.usable.all())

    def seen_by(self, camera: Camera) -> Target:
        """Return the same image attributed to another camera of the same size."""
        return Target(camera, self.channels, self.usable)

    def sample(self, uv: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return channels and their derivatives by u and v, each (C, N), at pixels (N, 2) inside the image.

        The derivatives are central differences at the nearest pixel, and the channels are continued from there; they
        are smooth enough for both.
        """
        width = self.camera.width
        nearest = np.rint(uv)
        column, row = nearest.astype(np.intp).T
        du, dv = (uv - nearest).astype(np.float32).T
        at = row * width + column
        values = rows(self._at(at))
        by_u, by_v = (rows(self._at(at + step) - self._at(at - step)) for step in (1, width))
        by_u *= np.float32(0.5)
        by_v *= np.float32(0.5)
        values += by_u * du
        values += by_v * dv
        return values, by_u, by_v

    def _at(self, pixels: NDArray[np.intp]) -> FloatArray:
        return self._values.take(pixels, axis=0)


def rows(values: FloatArray) -> FloatArray:
    """Return values (N, C) as one row a channel, (C, N): NumPy is several times as fast on few long rows."""
    return np.ascontiguousarray(values.T)


def project_visible(
    points: ViewPoints, target: Target, occluder: Occluder, buffer: FloatArray, pose: Rigid, *, border: float
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return the points in the camera frame (N, 3), their pixels (N, 2), and a mask of those visible.

    A visible point lies at least `border` pixels inside the image, on a usable pixel, and is not occluded.
    """
    camera = target.camera
    in_camera = pose.rotation.astype(np.float32) @ rows(points.points)
    in_camera += pose.translation.astype(np.float32)[:, None]
    x, y, z = in_camera
    shrink = 1 / np.where(z > 0.05, z, 1)
    if camera.distortion:  # only while a change of the lens is being estimated
        uv = camera.project(np.stack([x * shrink, y * shrink, np.ones_like(x)], axis=-1))
    else:
        scale, centre = (
            np.array(pair, np.float32)[:, None] for pair in ((camera.fx, camera.fy), (camera.cx, camera.cy))
        )
        uv = (in_camera[:2] * shrink * scale + centre).T
    visible = camera.contains(uv, border=border) & occluder.visible(in_camera.T, buffer)
    if not target.usable_everywhere:
        near = np.rint(np.where(visible[:, None], uv, 0)).astype(np.intp)
        visible &= target.usable[near[:, 1], near[:, 0]]
    return in_camera.T, uv, visible


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
    """(C, n) the photo's channels' derivative by u, in units of the block's length."""
    by_v: FloatArray
    """(C, n) likewise by v."""
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
        return _products(by_u, by_u), _products(by_u, by_v), _products(by_v, by_v)

    @cached_property
    def gradient_sums(self) -> tuple[FloatArray, FloatArray]:
        """Sums (C, b) of the derivatives by u and v over each block."""
        return self.blocks.sum(self.by_u), self.blocks.sum(self.by_v)

    @cached_property
    def normal_equations(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        """uu, uv, vv and the right-hand sides u, v, (b,) each, of every block's own Lucas-Kanade step."""
        sum_u, sum_v = self.gradient_sums

        def gram(products: FloatArray, sums: FloatArray, along: FloatArray) -> FloatArray:
            return np.asarray(self.blocks.sum(products) - sums / self.count - along)

        along_u, along_v = self.blocks.sum(self.b_u), self.blocks.sum(self.b_v)
        product_uu, product_uv, product_vv = self.gradient_products
        uu = gram(product_uu, _products(sum_u, sum_u), along_u * along_u)
        uv = gram(product_uv, _products(sum_u, sum_v), along_u * along_v)
        vv = gram(product_vv, _products(sum_v, sum_v), along_v * along_v)
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
    size = np.diff(blocks.starts, append=len(kept))
    count = size.astype(np.float32)

    def centre(values: FloatArray) -> None:
        values -= (blocks.sum(values) / count).repeat(size, axis=-1)

    seen = uv[kept]
    A = rows(points.channels.take(kept, axis=0))
    B, by_u, by_v = target.sample(seen)
    centre(A)
    centre(B)
    length_a, length_b = (np.sqrt(blocks.sum(_products(values, values))) + 1e-9 for values in (A, B))
    A *= (1 / length_a).repeat(size)
    shrink = (1 / length_b).repeat(size)
    for values in (B, by_u, by_v):
        values *= shrink
    rho = np.maximum(blocks.sum(_products(A, B)), 0)
    return BlockComparison(
        points_camera.T.take(kept, axis=1).T, kept, seen, blocks, count, rho, by_u, by_v,
        _products(A, by_u), _products(A, by_v), _products(B, by_u), _products(B, by_v),
    )  # fmt: skip


def _products(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the scalar products (...) of channel vectors (C, ...)."""
    return np.asarray(np.einsum("c...,c...->...", first, second))


@dataclass(frozen=True, slots=True, eq=False)
class BlockMatches:
    """Sub-pixel point matches, one for each block."""

    matches: Matches
    """M matches, in the photo's own pixels."""
    inliers: BoolArray
    """(M,) bool, offset within 3.5 robust standard deviations."""
    scatter_px: float
    """Standard deviation of the inliers' offsets from the projection, photo pixels; NaN without matches."""
    compared: ComparedBlocks | None = None
    """All blocks that were compared, with their information; None: not asked for."""


def block_matches(
    seen: BlockComparison, points: ViewPoints, working: Camera, camera: Camera
) -> tuple[BlockMatches, IntArray]:
    """Return one match for each block, displaced from its projection by the block's own Lucas-Kanade step.

    With them the block of each match (M,), among those compared.

    The step is damped along straight edges, where a block does not constrain it, so that the match stays at the
    projection in that direction. The least-squares pose of these matches is therefore the finished pose, apart from
    the weighting of blocks.

    Args:
        seen: the blocks at the finished pose.
        points: the points that were compared.
        working: the ideal camera of the comparison.
        camera: the photo's own camera.
    """
    uu, uv, vv, right_u, right_v = (np.asarray(value, np.float64) for value in seen.normal_equations)
    # Only the signal that a block shares with the photo contributes curvature; the rest of its gradient is noise.
    shared = np.maximum(seen.rho, _MIN_SHARED).astype(np.float64)
    damping = _DAMPING * float(np.median(shared * (uu + vv)))
    uu, uv, vv = shared * uu + damping, shared * uv, shared * vv + damping
    det = np.maximum(uu * vv - uv * uv, np.finfo(np.float64).tiny)  # flat blocks do not move
    offset = np.stack([vv * right_u - uv * right_v, uu * right_v - uv * right_u], axis=-1) / det[:, None]

    nearest = centre_points(seen)
    at = points.points[seen.index[nearest]].astype(np.float64)
    ranges = np.linalg.norm(at, axis=-1)
    pixel = seen.uv[nearest].astype(np.float64) + offset
    own = camera.project(working.unproject(pixel))
    matched = (seen.rho >= _MIN_CORRELATION) & np.isfinite(own).all(axis=-1)
    of_block = np.flatnonzero(matched)
    names = block_names(seen, points)
    matches = Matches(
        at[matched] / ranges[matched, None], ranges[matched], own[matched], tuple(names[k] for k in of_block.tolist())
    )
    if not len(matches):
        return BlockMatches(matches, np.zeros(0, np.bool_), float("nan")), of_block
    off = np.abs(offset[matched])
    scatter = _SD_OF_MEDIAN * float(np.median(off)) + _MIN_SCATTER_PX
    inliers = off.max(axis=-1) <= _OUTLIER_SIGMA * scatter
    return BlockMatches(matches, inliers, scatter * camera.focal_px / working.focal_px), of_block


def block_names(seen: BlockComparison, points: ViewPoints) -> tuple[str, ...]:
    """Return the name of each block (b,): its row and column in the scan's view."""
    grid = points.blocks.grid[points.blocks.of_point[seen.index[seen.blocks.starts]]]
    return tuple(f"b{row}.{column}" for row, column in grid.tolist())


def centre_points(seen: BlockComparison) -> NDArray[np.intp]:
    """Return the index of the point of each block (b,) nearest to the block's centroid."""
    of = seen.blocks.of_point
    middle: FloatArray = (seen.blocks.sum(seen.uv.T) / seen.count).T
    distance = ((seen.uv - middle[of]) ** 2).sum(axis=-1)
    order = np.lexsort((distance, of))
    return np.asarray(order[np.searchsorted(of[order], np.arange(len(seen.blocks)))])


def _sub_blocks(labels: NDArray[np.intp]) -> Blocks:
    starts, of_point = runs(labels)
    return Blocks(starts, of_point, labels[starts, None])
