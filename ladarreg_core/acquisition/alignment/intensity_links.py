"""Alignment of scans by their intensities, where they see the same surfaces from nearly the same place.

What is printed or painted on a surface shows a shift along it, to which its ranges are blind. A residual is the
difference of the logarithms of two scans' intensities at one point, both smoothed alike; it is linear in a small move.

Source: direct alignment by Gauss and Newton, after Lucas and Kanade 1981.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.acquisition.alignment.intensity_view import IntensityView, Seen, by_point, lengths, lookup, lookup_at
from ladarreg_core.acquisition.alignment.voxel_planes import dots
from ladarreg_core.foundations.arrays import BoolArray, FloatArray, IntArray
from ladarreg_core.foundations.progress import Progress, Report
from ladarreg_core.frames import Rigid

BLUR_CELLS = (6.0, 3.0, 1.5)
"""Smoothing of the intensities, in turn: from far off only what is coarse leads to the right place."""

_POINTS_A_LINK = 5_000
_MIN_POINTS = 200  # of a link
_STRAIGHT_RAD = 0.003  # off by half of its square
_PROBED = 97  # of so many points one is looked up first
MAD = 1.4826
"""Standard deviations a median deviation."""
MIN_SIGMA = 0.01
"""Least standard deviation that is believed of a difference of logarithms."""
MIN_CONTRAST = 0.02
"""Standard deviation of the logarithm within a patch from which on it has texture."""
_MIN_CORRELATION = 0.6
_PATCH_CELLS, _PATCH_BLURS = 24, 8.0  # least side of a patch, in cells and in standard deviations of the smoothing
MIN_OF_PATCH = 8
"""Samples of a patch."""
MISFIT_BLURS = 0.2
"""How far the texture of a patch may seem shifted beside its noise, standard deviation in blurs: by interpolation, by
the border of a scan, by gloss. However strong its edges, no patch is more exact than that."""
LINK_MISFIT_BLURS = 0.04
"""The same, common to all patches of a link: many are parts of one long edge, or of one glossy wall."""
_PATCH_HUBER = 2.5  # standard deviations
_CHI2_MEDIAN = 1.386  # of two degrees of freedom
_UNSEEN = 2.0
"""Variances are larger than patches say by this factor: each pair of views is compared in both directions, which is
little more than once."""


@dataclass(frozen=True, slots=True, eq=False)
class Anchor:
    """Where the second view of a link saw its points at some poses."""

    local: FloatArray
    """(N, 3) m, in its frame."""
    cells: FloatArray
    """(N, 2)"""
    by_local: FloatArray
    """(N, 2, 3) derivatives of the cells by the point."""

    def cells_at(self, local: FloatArray) -> FloatArray | None:
        """Return the cells (N, 2) of the points after a small move; None if it was too far for a straight line."""
        move = local - self.local
        if not (dots(move, move) < _STRAIGHT_RAD**2 * dots(local, local)).all():
            return None
        return np.asarray(self.cells + np.einsum("nij,nj->ni", self.by_local, move))


@dataclass(frozen=True, slots=True, eq=False)
class Link:
    """Points of one view that another one sees, too, with what the first one sees there."""

    first: int
    second: int
    points: FloatArray
    """(N, 3) m, in the first's frame."""
    light: tuple[FloatArray, ...]
    """(N,) of each level."""
    slopes: tuple[FloatArray, ...]
    """(N, 3) derivatives of the light by the point, in the first's frame, of each level; NaN near edges."""
    patch: tuple[IntArray, ...]
    """(N,) number of the patch of the first's grid in which a point lies, of each level."""
    gap: tuple[FloatArray, ...]
    """(N,) the first's `IntensityView.gap` there, of each level."""
    anchor: Anchor | None = None
    """Where the second saw the points at some poses."""

    def every(self, stride: int) -> Link:
        """Return the link of every n-th point."""
        thin = slice(None, None, stride)
        light, slopes = (tuple(one[thin] for one in each) for each in (self.light, self.slopes))
        patch = tuple(one[thin] for one in self.patch)
        gap = tuple(one[thin] for one in self.gap)
        anchor = None
        if self.anchor is not None:
            anchor = Anchor(self.anchor.local[thin], self.anchor.cells[thin], self.anchor.by_local[thin])
        return Link(self.first, self.second, self.points[thin], light, slopes, patch, gap, anchor)

    def anchored(self, views: Sequence[IntensityView], poses: Sequence[Rigid]) -> Link:
        """Return the link with its cells of the second view found at some poses, from which small moves lead on.

        Finding the cells of rays in a table takes as long as all the rest of a comparison.
        """
        scan = views[self.second].scan
        local = poses[self.second].inverse @ (poses[self.first] @ self.points)
        cells = np.asarray(scan.geometry.cell_of(local), np.float64)
        along = [by_point(scan, local, np.broadcast_to(unit, cells.shape), cells) for unit in np.eye(2)]
        return replace(self, anchor=Anchor(local, cells, np.stack(along, axis=1)))


def links_of(
    levels: Sequence[Sequence[IntensityView]], poses: Sequence[Rigid], *, seed: int = 0, report: Report | None = None
) -> list[Link]:
    """Return the links between all views that overlap at some poses, each pair in both directions.

    Args:
        levels: the views, smoothed less and less.
        poses: `world_from_scan` of each view.
        seed: of the choice of points.
        report: receives the progress; may raise `Cancelled`.
    """
    found = []
    rng = np.random.default_rng(seed)
    views = levels[-1]
    for a, view in enumerate(views):
        if report is not None:
            report(Progress(a, len(views), "comparing the intensities"))
        stride = max(1, int(np.sqrt(view.scan.ranges.size / 200_000)))
        part = slice(None, None, stride)
        points = view.scan.points_at(part, part).reshape(-1, 3)
        cells = np.arange(view.light.size).reshape(view.light.shape)[part, part].ravel()
        good = np.isfinite(view.light.ravel()[cells]) & np.isfinite(points[:, 0])
        points, cells = points[good], cells[good]
        world = poses[a] @ points
        axis = poses[a].rotation @ view.scan.mean_direction
        for b, other in enumerate(views):
            if a == b or axis @ poses[b].rotation @ other.scan.mean_direction < -0.9:
                continue
            there, most = poses[b].inverse, most_gap(view, other, poses[a], poses[b])
            few = there @ world[::_PROBED]
            if not lookup(other, few).good(lengths(few), most).any():
                continue
            local = there @ world
            at = np.flatnonzero(lookup(other, local).good(lengths(local), most) & (view.gap.ravel()[cells] <= most))
            if len(at) < _MIN_POINTS:
                continue
            if len(at) > _POINTS_A_LINK:
                # Blank surfaces say nothing, and their many small residuals would make texture look like outliers.
                steep = np.hypot(*(slope.ravel()[cells[at]].astype(np.float32) for slope in view.by_cell))
                steep = np.where(np.isfinite(steep), steep, 0) + 1e-9
                chance = np.minimum(steep, np.quantile(steep, 0.98)) ** 2
                at = np.sort(rng.choice(at, _POINTS_A_LINK, replace=False, p=chance / chance.sum()))
            found.append(_link(a, b, [level[a] for level in levels], points[at].astype(np.float64), cells[at]))
    return found


def _link(first: int, second: int, levels: Sequence[IntensityView], points: FloatArray, cells: IntArray) -> Link:
    row, column = np.divmod(cells, levels[0].light.shape[1])
    at = np.stack([row, column], axis=-1).astype(np.float64)
    by_cell = (np.stack([slope.ravel()[cells] for slope in view.by_cell], axis=-1) for view in levels)
    slopes = [by_point(levels[0].scan, points, each.astype(np.float64), at) for each in by_cell]
    patch = []
    for view in levels:
        size = _patch_cells(view)
        patch.append(np.unique((row // size) * (1 << 20) + column // size, return_inverse=True)[1])
    light = [view.light.ravel()[cells].astype(np.float64) for view in levels]
    gap = tuple(view.gap.ravel()[cells].astype(np.float64) for view in levels)
    return Link(first, second, points, tuple(light), tuple(slopes), tuple(patch), gap)


def most_gap(first: IntensityView, second: IntensityView, of_first: Rigid, of_second: Rigid) -> float:
    """Return the largest `gap` at which two views may be compared."""
    apart = float(np.linalg.norm(of_first.translation - of_second.translation))
    return min(first.most_gap(apart), second.most_gap(apart))


def link_equations(
    links: Sequence[Link], levels: Sequence[Sequence[IntensityView]], poses: Sequence[Rigid], *,
    keep: IntArray | None = None, held_out: int = 4, worth: FloatArray | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:  # fmt: skip
    """Return the information (6 V, 6 V) and the gradient (6 V,) of the views' moves (w, t).

    Each patch that shows texture measures its shift in two directions. Noise has slopes, too, and on a surface that is
    nearly blank more of them than its texture: the slopes of one view are therefore the instruments for those of the
    other, whose noise is another one. What a patch is worth is known beforehand, by its texture, the noise and
    `MISFIT_BLURS`, and not by how well it fits: else a few that are wrong could argue away the one that is right.
    Source: instrumental variables, Reiersol 1941; robust weights, Huber 1964.

    Args:
        links: the links.
        levels: the first of the levels of which the links were made; of each link the finest counts that shows texture.
        poses: `world_from_scan` of each view.
        keep: remainders, modulo `held_out`, of the metre-sized blocks of the room to use; None: all of them.
        held_out: see above.
        worth: (V,) of each view, 0 to 1: variances of its links are larger by as much as it is less than 1.
    """
    count = len(poses)
    blocks, gradient = np.zeros((count, count, 6, 6)), np.zeros((count, 6))
    off: list[FloatArray] = []
    for link in links:
        found = None
        for level in reversed(range(len(levels))):
            found = found or _link_equation(link, level, levels[level], poses, keep, held_out)
        if found is None:
            continue
        H, g, chi2 = found
        off.append(chi2)
        a, b = link.first, link.second
        if worth is not None:
            H, g = min(worth[a], worth[b]) * H, min(worth[a], worth[b]) * g
        blocks[a, a] += H
        blocks[b, b] += H
        blocks[a, b] -= H
        blocks[b, a] -= H
        gradient[a] += g
        gradient[b] -= g
    inflated = _UNSEEN * (max(1.0, float(np.median(np.concatenate(off))) / _CHI2_MEDIAN) if off else 1.0)
    return blocks.transpose(0, 2, 1, 3).reshape(6 * count, 6 * count) / inflated, gradient.ravel() / inflated


def _link_equation(
    link: Link, level: int, views: Sequence[IntensityView], poses: Sequence[Rigid], keep: IntArray | None, held_out: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]] | None:
    """Return information (6, 6) and gradient (6,) of one link by its first view's move, and the chi^2 (P,) of its
    patches; None if it shows no texture.
    """
    seen = residuals(link, level, views, poses, keep, held_out)
    if len(seen.residual) < MIN_OF_PATCH:
        return None
    view, centre = views[link.first], poses[link.first].translation
    sigma = max(MAD * float(np.median(np.abs(seen.residual))), MIN_SIGMA)
    _, patch, count = np.unique(seen.patch, return_inverse=True, return_counts=True)

    def summed(values: FloatArray) -> NDArray[np.float64]:
        return sums_of(values, patch, len(count))

    # Two directions across the rays to each patch, a cell long.
    place = summed(seen.world) / count[:, None]
    ray = place - centre
    far = lengths(ray)[:, None]
    ray /= far
    aside = np.cross(ray, np.where(np.abs(ray[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]]))
    aside /= np.linalg.norm(aside, axis=-1, keepdims=True)
    cell = far[..., None] * float(np.mean(view.scan.geometry.step_rad))
    across = np.stack([aside, np.cross(ray, aside)], axis=1) * cell  # (P, 2, 3)
    other, own = (np.einsum("nij,nj->ni", across[patch], slopes) for slopes in (seen.slopes, seen.instruments))

    alike, variance = likeness(seen.light, seen.light + seen.residual, patch, count)
    textured = (count >= MIN_OF_PATCH) & (variance > MIN_CONTRAST**2) & (alike > _MIN_CORRELATION)
    if not textured.any():
        return None

    # Noise is smoothed with the light: samples nearer than that are no news.
    density = np.maximum(1.0, 4 * np.pi * view.blur_cells**2 * count / _patch_cells(view) ** 2)
    response = summed(own[:, :, None] * other[:, None, :])
    noise = summed(own[:, :, None] * own[:, None, :]) * (sigma**2 * density)[:, None, None]
    moments = summed(own * seen.residual[:, None])
    misfit = (MISFIT_BLURS * view.blur_cells) ** 2
    transposed = response.transpose(0, 2, 1)
    floor = 1e-9 * (1e-12 + np.trace(noise, axis1=1, axis2=2))[:, None, None] * np.eye(2)
    scatter = noise + misfit * response @ transposed + floor
    scatter, response, moments = scatter[textured], response[textured], moments[textured]
    weighing = np.linalg.solve(scatter, np.concatenate([response, moments[..., None]], axis=-1))
    chi2 = (moments * weighing[..., 2]).sum(axis=-1)
    weight = np.minimum(1.0, _PATCH_HUBER / np.sqrt(np.maximum(chi2, 1e-12)))
    # Cells by which a patch moves with the first view: (P, 2, 6).
    along = across[textured] / cell[textured] ** 2
    at = place[textured]
    moves = np.concatenate([np.cross(at[:, None], along), along], axis=-1)
    turned = np.einsum("pij,pjk->pik", response, moves)
    information = np.einsum("p,pji,pjk->ik", weight, turned, np.linalg.solve(scatter, turned))
    gradient = np.einsum("p,pji,pj->i", weight, turned, weighing[..., 2])
    # The misfit that is common to the link is an unknown shift, and eliminated.
    of_shift = np.einsum("p,pji,pjk->ik", weight, response, weighing[..., :2])
    mixed = np.einsum("p,pji,pjk->ik", weight, turned, weighing[..., :2])
    of_shift += np.eye(2) / (LINK_MISFIT_BLURS * view.blur_cells) ** 2
    gain = np.linalg.solve(of_shift, mixed.T).T
    information -= gain @ mixed.T
    gradient -= gain @ np.einsum("p,pji,pj->i", weight, response, weighing[..., 2])
    return np.asarray(information), np.asarray(gradient), np.asarray(chi2, np.float64)


def sums_of(values: FloatArray, group: IntArray, groups: int) -> NDArray[np.float64]:
    """Return the sums (G, ...) of values (N, ...) by their group (N,)."""
    flat = values.reshape(len(values), int(np.prod(values.shape[1:])))
    sums = np.stack([np.bincount(group, column, groups) for column in flat.T], axis=-1)
    return np.asarray(sums.reshape(groups, *values.shape[1:]), np.float64)


def likeness(
    first: FloatArray, second: FloatArray, patch: IntArray, count: IntArray
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the correlation (P,) of two lights (M,) in each patch, and the smaller of their variances there (P,)."""
    n = np.maximum(count, 1)
    both = np.stack([first, second], axis=-1)
    mean = sums_of(both, patch, len(count)) / n[:, None]
    variance = np.maximum(sums_of(np.square(both), patch, len(count)) / n[:, None] - np.square(mean), 0)
    mixed = sums_of(first * second, patch, len(count)) / n - mean.prod(axis=-1)
    return mixed / np.maximum(np.sqrt(variance.prod(axis=-1)), 1e-12), variance.min(axis=-1)


def _patch_cells(view: IntensityView) -> int:
    """Return the side of the patches of a level."""
    return max(_PATCH_CELLS, round(_PATCH_BLURS * view.blur_cells))


def comparable(
    link: Link, level: int, views: Sequence[IntensityView], poses: Sequence[Rigid], local: FloatArray, seen: Seen
) -> BoolArray:
    """Return which points (N,) of a link, given in the frame of its second view, both views see."""
    a, b = link.first, link.second
    most = most_gap(views[a], views[b], poses[a], poses[b])
    own = np.isfinite(link.light[level]) & np.isfinite(link.slopes[level][:, 0]) & (link.gap[level] <= most)
    return np.asarray(own & seen.good(lengths(local), most))


@dataclass(frozen=True, slots=True, eq=False)
class _Compared:
    residual: FloatArray
    """(M,) less their median."""
    world: FloatArray
    """(M, 3) the points."""
    slopes: FloatArray
    """(M, 3) derivatives by the point, in the world, from the slopes of the second."""
    instruments: FloatArray
    """(M, 3) the same from the slopes of the first."""
    light: FloatArray
    """(M,) of the first."""
    patch: IntArray
    """(M,)"""


def residuals(
    link: Link, level: int, views: Sequence[IntensityView], poses: Sequence[Rigid], keep: IntArray | None, held_out: int
) -> _Compared:
    """Return how far the views of a link differ at its points, those in some blocks of the room."""
    other = views[link.second]
    pose = poses[link.first]
    world = pose @ link.points
    there = poses[link.second].inverse
    local = there @ world
    cells = None if link.anchor is None else link.anchor.cells_at(local)
    seen = lookup(other, local) if cells is None else lookup_at(other, cells)
    use = comparable(link, level, views, poses, local, seen)
    if keep is not None:
        block = np.floor(world).astype(np.int64) @ np.array([1, 3, 2])
        use &= np.isin(block % held_out, keep)
    world, local = world[use], local[use]
    light = link.light[level][use]
    residual = seen.light[use] - light
    if cells is not None and link.anchor is not None:
        by_local = np.einsum("ni,nij->nj", seen.slopes[use], link.anchor.by_local[use])
    else:
        by_local = by_point(other.scan, local, seen.slopes[use], seen.cells[use])
    by_world = by_local @ there.rotation
    own = link.slopes[level][use] @ pose.rotation.T
    return _Compared(
        residual - (float(np.median(residual)) if len(residual) else 0.0),
        world,
        by_world,
        own,
        light,
        link.patch[level][use],
    )
