"""Planes that several views see: points grouped by voxels, each view's patch tested for itself, then joined."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.foundations.arrays import BoolArray, FloatArray, IntArray

VOXELS_M = (0.5, 0.25)
"""Sides of the voxels, tried in this order; what is no plane in a large one may be several in smaller ones."""
SMALL_VOXELS_M = (0.5, 0.25, 0.125)
"""Sides with which furniture counts as well. Patches as small as this, beside edges and other things, have shifted the
mount by up to .2 mm: they are for what nothing larger shows."""

MIN_POINTS = 20
"""Points of a patch. With fewer, two surfaces that meet at a slight angle pass for one, and many such patches along one
edge shift a mount all the same way."""
SMALL_LEAST_POINTS = 8
"""The same with which furniture counts as well."""

_FLATTEST = 0.1  # thickness over the smaller extent of a patch
_MIN_EXTENT = 0.12  # of the voxel's side
_TOO_THICK = 0.3  # variance beyond that of the typical patch, as a share of it
_MIN_INCLINED = 0.2  # cosine between rays and normal
_BORDER_BINS = 100
_CLEAR_M = 0.05
_SCATTER = 4.0  # standard deviations of a sample's variance
MIN_ACROSS = 0.1
"""Share of the range noise that acts across a surface, however grazing the rays."""
_OFFSET_CELLS = 1 << 20


@dataclass(frozen=True, slots=True, eq=False)
class SharedPlanes:
    """Planes that at least two views see, and the points on them."""

    point: IntArray
    """(M,) index of each point that lies on one."""
    plane: IntArray
    """(M,) its plane, 0 to K - 1."""
    patch: IntArray
    """(M,) its patch, the part of a plane that one view sees, from 0."""
    normals: NDArray[np.float64]
    """(K, 3) unit."""
    centres: NDArray[np.float64]
    """(K, 3) m."""
    block: IntArray
    """(K,) number of the metre-sized block of the room that each plane lies in."""

    @property
    def count(self) -> int:
        """K."""
        return len(self.normals)

    def select(self, planes: BoolArray) -> SharedPlanes:
        """Return some of the planes, (K,) bool."""
        number = np.cumsum(planes) - 1
        keep = planes[self.plane]
        return SharedPlanes(
            self.point[keep], number[self.plane[keep]], self.patch[keep],
            self.normals[planes], self.centres[planes], self.block[planes],
        )  # fmt: skip


def shared_planes(
    points: FloatArray, rays: FloatArray, view: IntArray, *, farthest_apart_m: float, largest_angle_rad: float,
    voxels_m: Sequence[float] = VOXELS_M, least_points: int = MIN_POINTS,
) -> SharedPlanes:  # fmt: skip
    """Find planes that at least two views see.

    A patch is judged within its own view, where a wrong pose between views does not make it thicker.

    Args:
        points: (N, 3) m, all in one frame.
        rays: (N, 3) unit, along which each was measured, in the same frame.
        view: (N,) view of each point, from 0.
        farthest_apart_m: largest distance between two views' patches of one plane.
        largest_angle_rad: largest angle between their normals.
        voxels_m: sides of the voxels, falling.
        least_points: points of a patch.
    """
    left = np.arange(len(points))
    found: list[SharedPlanes] = []
    for side in voxels_m:
        if not len(left):
            break
        level, used = _of_voxels(
            points[left], rays[left], view[left], side, farthest_apart_m, largest_angle_rad, least_points
        )
        found.append(replace(level, point=left[level.point]))
        left = left[~used]
    first = np.cumsum([0] + [planes.count for planes in found])[: len(found)]
    first_patch = np.cumsum([0] + [int(planes.patch.max(initial=-1)) + 1 for planes in found])[: len(found)]
    return SharedPlanes(
        np.concatenate([planes.point for planes in found] or [np.zeros(0, np.intp)]),
        np.concatenate(
            [planes.plane + start for planes, start in zip(found, first, strict=True)] or [np.zeros(0, int)]
        ),
        np.concatenate(
            [planes.patch + start for planes, start in zip(found, first_patch, strict=True)] or [np.zeros(0, int)]
        ),
        np.concatenate([planes.normals for planes in found] or [np.zeros((0, 3))]),
        np.concatenate([planes.centres for planes in found] or [np.zeros((0, 3))]),
        np.concatenate([planes.block for planes in found] or [np.zeros(0, np.int64)]),
    )


def _of_voxels(
    points: FloatArray, rays: FloatArray, view: IntArray, side: float, farthest_apart_m: float,
    largest_angle_rad: float, least_points: int,
) -> tuple[SharedPlanes, BoolArray]:  # fmt: skip
    """Return the planes of one size of voxels, and the points (N,) of patches that are flat."""
    cell = np.floor(points / side - _clear_of_walls(points, side)).astype(np.int64)
    codes, voxel = np.unique(_code(cell), return_inverse=True)
    groups, group = np.unique(voxel * (int(view.max()) + 1) + view, return_inverse=True)
    count, centre, normal, spread = plane_moments(points, group, len(groups))
    with np.errstate(invalid="ignore"):
        flat = (count >= least_points) & (spread[:, 1] > (_MIN_EXTENT * side) ** 2)
        flat &= spread[:, 0] < (_FLATTEST**2) * spread[:, 1]
    if flat.any():
        # In units of what the range noise does across the patch: what is thicker than others is bent, or two surfaces.
        across = np.bincount(group, dots(rays, normal[group]) ** 2, len(groups)) / count
        # The rays of one line lie in a plane, whatever they meet: such a plane is along the rays, and none of the room.
        flat &= across > _MIN_INCLINED**2
        noise = (across + MIN_ACROSS**2) * np.maximum(count - 3, 1) / count
        thickness = spread[:, 0] / noise
        limit = 1 + _TOO_THICK + _SCATTER * np.sqrt(2 / np.maximum(count - 3, 1))
        flat &= thickness < limit * np.median(thickness[flat])
    of_voxel = groups // (int(view.max()) + 1)
    candidates = np.flatnonzero(flat)
    # The largest flat patch of each voxel is the one that others are compared with.
    largest = np.full(len(codes), -1)
    order = candidates[np.argsort(count[candidates], kind="stable")]
    largest[of_voxel[order]] = order
    to = largest[of_voxel[candidates]]
    between = centre[candidates] - centre[to]
    apart = np.maximum(np.abs((between * normal[to]).sum(-1)), np.abs((between * normal[candidates]).sum(-1)))
    aligned = np.abs((normal[candidates] * normal[to]).sum(-1)) > np.cos(largest_angle_rad)
    joined = candidates[aligned & (apart < farthest_apart_m)]
    views = np.bincount(of_voxel[joined], minlength=len(codes))
    joined = joined[views[of_voxel[joined]] >= 2]
    member = np.zeros(len(groups), np.bool_)
    member[joined] = True
    index = np.flatnonzero(member[group])
    shared, plane = np.unique(voxel[index], return_inverse=True)
    patch = (np.cumsum(member) - 1)[group[index]]
    _, centres, normals, _ = plane_moments(points[index], plane, len(shared))
    # Consecutive numbers along any axis, so that a share of the blocks is spread over the room.
    block = np.floor(centres).astype(np.int64) @ np.array([1, 3, 2])
    used = np.zeros(len(points), np.bool_)
    used[index] = True
    return SharedPlanes(index, plane, patch, normals, centres, block), used


def _clear_of_walls(points: FloatArray, side: float) -> NDArray[np.float64]:
    """Return where voxels begin, (3,), in voxels, so that few points are near their borders.

    A wall on a border would be cut in two by its own noise, and each half look like a thinner wall beside it.
    """
    begin = np.empty(3)
    reach = max(1, round(_CLEAR_M / side * _BORDER_BINS))
    for axis in range(3):
        at = points[:, axis] / side
        at = (at - np.floor(at)) * _BORDER_BINS
        bins = np.bincount(np.minimum(at.astype(np.intp), _BORDER_BINS - 1), minlength=_BORDER_BINS)
        near = sum(np.roll(bins, k) for k in range(-reach, reach + 1))
        begin[axis] = (int(np.argmin(near)) + 0.5) / _BORDER_BINS
    return begin


def _code(cell: IntArray) -> NDArray[np.int64]:
    c = np.asarray(cell, np.int64) + _OFFSET_CELLS
    return np.asarray((c[:, 0] << 42) | (c[:, 1] << 21) | c[:, 2])


def dots(a: FloatArray, b: FloatArray) -> NDArray[np.float64]:
    """Return the scalar products (N,) of vectors (N, 3); summing over a short last axis takes ten times as long."""
    return np.asarray(np.einsum("ij,ij->i", a, b))


def plane_moments(
    points: FloatArray, group: IntArray, groups: int
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return count (G,), centre (G, 3), normal (G, 3) and variances (G, 3) along the axes, least first."""
    count = np.bincount(group, minlength=groups)
    with np.errstate(invalid="ignore", divide="ignore"):
        centre = np.stack([np.bincount(group, points[:, i], groups) for i in range(3)], axis=-1) / count[:, None]
        off = np.ascontiguousarray((points - centre[group]).T)
        spread = np.empty((groups, 3, 3))
        for i in range(3):
            for j in range(i, 3):
                spread[:, i, j] = spread[:, j, i] = np.bincount(group, off[i] * off[j], groups) / count
    values, axes = np.linalg.eigh(np.nan_to_num(spread))
    return count, centre, axes[..., 0], np.maximum(values, 0)
