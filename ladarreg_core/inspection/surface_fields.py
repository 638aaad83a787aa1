"""Quantities over the scan grid that textures show: errors of the matches, and the resolution of the photograph."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.foundations.arrays import BoolArray, FloatArray, IntArray
from ladarreg_core.results.registration import PoseResult
from ladarreg_core.scan import Scan
from ladarreg_core.surface.remap import look_up

_NODES = 96
_NEIGHBOURS = 4
_NARROWEST_RAD, _WIDEST_RAD = 0.01, 0.15
_REACH = 3.0
_CHUNK = 1024
_LARGEST_GAP = 12
_GAP_REACH = 5
_NORMAL_CELLS = 3
_MAX_OBLIQUE = 0.17  # cosine of the incidence beyond which a cell counts as grazing, 80 degrees


def residual_field(scan: Scan, result: PoseResult) -> NDArray[np.float32]:
    """Return the root mean square residual of the inliers, interpolated over the scan grid.

    Inliers are weighted by a Gaussian of their angular distance, seen from the scanner, whose width is their typical
    spacing.

    Returns:
        (H, W) float32, photo pixels; NaN beyond three widths from all inliers.
    """
    residual = np.linalg.norm(result.residuals_px, axis=-1)
    used = result.inliers & np.isfinite(residual)
    return _interpolated(scan, result.matches.rays[used], residual[used] ** 2, of_mean=np.sqrt)


def depth_error_field(scan: Scan, result: PoseResult) -> NDArray[np.float32]:
    """Return the laser minus stereo depth of the inliers, with its sign, interpolated as `residual_field` does.

    Returns:
        (H, W) float32, m; NaN where no inlier with a stereo depth is near.
    """
    error = result.stereo_depth_error_m
    used = result.inliers & np.isfinite(error)
    return _interpolated(scan, result.matches.rays[used], error[used])


def resolution_field(scan: Scan, result: PoseResult, seen: BoolArray) -> NDArray[np.float32]:
    """Return how much of the surface a pixel of the photograph covers, as the side of a square of the same area.

    Distortion of the lens is neglected; surfaces more oblique than 80 degrees count as 80 degrees.

    Args:
        scan: the scan.
        result: the pose.
        seen: (H, W) cells that the camera sees.

    Returns:
        (H, W) float32, mm per pixel; NaN where the camera sees nothing.
    """
    field = np.full(scan.shape, np.nan, np.float32)
    box = _box_around(seen, margin=_NORMAL_CELLS)
    points = np.where(scan.valid[box][..., None], scan.points[box], np.float32(np.nan)).astype(np.float32)
    to_camera = result.camera_from_scanner.centre.astype(np.float32) - points
    distance = _length(to_camera)
    forward = result.camera_from_scanner.rotation[2].astype(np.float32)
    with np.errstate(invalid="ignore", divide="ignore"):
        depth = -(to_camera @ forward)
        facing = np.abs(np.einsum("hwk,hwk->hw", _normals(points), to_camera)) / distance
        # A pixel off the axis covers less than one on it: its solid angle falls with the cube of the cosine.
        across = depth * np.sqrt(depth / distance) / np.float32(result.camera.focal_px)
        found = 1000 * across / np.sqrt(np.clip(facing, _MAX_OBLIQUE, 1))
    field[box] = np.where(seen[box] & np.isfinite(found), found, np.float32(np.nan))
    return field


def without_pepper(picture: NDArray[np.uint8], known: BoolArray, fillable: BoolArray) -> NDArray[np.uint8]:
    """Return an image in which small gaps among cells of known colour have the mean colour of those around.

    Noise of the ranges hides single cells of a plain wall from the camera; as dark spots they would look like dirt.

    Args:
        picture: (H, W, 3) uint8 RGB.
        known: (H, W) cells whose colour is known.
        fillable: (H, W) other cells that may take a colour.
    """
    if not known.any():
        return picture
    box = _box_around(known, margin=_LARGEST_GAP + 1)
    if known[box].size < known.size:  # what is far from all known cells has no gap
        result = np.array(picture)
        result[box] = without_pepper(picture[box], known[box], fillable[box])
        return result
    count, labels, stats, _ = cv2.connectedComponentsWithStats((~known).astype(np.uint8), connectivity=4)
    small = stats[:count, cv2.CC_STAT_AREA] <= _LARGEST_GAP
    small[0] = False  # the known cells
    gaps = small[labels] & fillable
    if not gaps.any():
        return picture
    reach = (_GAP_REACH, _GAP_REACH)
    flags = known.view(np.uint8)
    weight = cv2.boxFilter(flags, cv2.CV_32F, reach, borderType=cv2.BORDER_CONSTANT)
    mean = cv2.boxFilter(cv2.copyTo(picture, flags), cv2.CV_32F, reach, borderType=cv2.BORDER_CONSTANT)
    result = np.array(picture)
    fill = gaps & (weight > 0.3)  # most of the cells around are known
    result[fill] = np.rint(mean[fill] / weight[fill][:, None])
    return result


def _box_around(cells: BoolArray, *, margin: int) -> tuple[slice, slice]:
    """Return the rows and columns that contain all cells of a mask (H, W) and a margin; none if there are no cells."""
    rows, columns = (np.flatnonzero(cells.any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        return slice(0, 0), slice(0, 0)
    top, left = (max(0, int(at[0]) - margin) for at in (rows, columns))
    return slice(top, int(rows[-1]) + margin + 1), slice(left, int(columns[-1]) + margin + 1)


def _normals(points: FloatArray) -> FloatArray:
    """Return unit normals (H, W, 3) from differences over several cells, which noise of the ranges turns little."""

    def difference(axis: int) -> FloatArray:
        ahead = np.roll(points, -_NORMAL_CELLS, axis=axis)
        behind = np.roll(points, _NORMAL_CELLS, axis=axis)
        index: list[slice | int] = [slice(None), slice(None)]
        for values, end in ((ahead, slice(-_NORMAL_CELLS, None)), (behind, slice(0, _NORMAL_CELLS))):
            index[axis] = end
            values[tuple(index)] = points[tuple(index)]  # one-sided at the border
        ahead, behind = (np.where(np.isfinite(v), v, points) for v in (ahead, behind))
        return np.asarray(ahead - behind)

    normal = np.cross(difference(0), difference(1))
    return np.asarray(normal / np.maximum(_length(normal)[..., None], np.float32(1e-20)))


def _length(vectors: FloatArray) -> FloatArray:
    """Return the lengths (H, W) of vectors (H, W, 3)."""
    return np.asarray(np.sqrt(np.einsum("hwk,hwk->hw", vectors, vectors)))


def _interpolated(
    scan: Scan, rays: FloatArray, values: FloatArray, *, of_mean: Callable[[FloatArray], FloatArray] = np.asarray
) -> NDArray[np.float32]:
    """Interpolate values at rays (M, 3) over the scan grid, and apply a function to the means; NaN far from all."""
    if not len(rays):
        return np.full(scan.shape, np.nan, dtype=np.float32)
    width = _typical_spacing(rays)
    rows, columns = (_nodes(n) for n in scan.shape)
    nodes = np.stack(np.meshgrid(rows, columns, indexing="ij"), axis=-1)
    directions = np.asarray(scan.geometry.ray_at(nodes)).reshape(-1, 3)
    mean, nearest = np.empty(len(directions)), np.empty(len(directions))
    for first in range(0, len(directions), _CHUNK):
        part = slice(first, first + _CHUNK)
        angle = _angles(directions[part], rays)
        nearest[part] = angle.min(axis=1)
        # Relative to the nearest one, so that the weights of a cell far from all do not underflow.
        weight = np.exp((np.square(angle.min(axis=1, keepdims=True)) - np.square(angle)) / np.float32(2 * width**2))
        mean[part] = of_mean(weight @ values / weight.sum(axis=1))
    shape = (len(rows), len(columns))
    field, distance = (_interpolate_nodes(a.reshape(shape), rows, columns, scan.shape) for a in (mean, nearest))
    field[~(distance <= _REACH * width)] = np.nan
    return field


def _angles(directions: FloatArray, rays: FloatArray) -> FloatArray:
    """Return the angles (N, M), rad, float32, between unit rays (N, 3) and (M, 3), computed from chords, which is
    accurate for small ones."""
    chord = np.clip((1 - directions @ rays.T) / 2, 0, 1).astype(np.float32)
    return np.asarray(2 * np.arcsin(np.sqrt(chord, out=chord)))


def _typical_spacing(rays: FloatArray) -> float:
    """Return the median angle, rad, from a match to its fourth neighbour, within limits."""
    some = rays[:: max(1, len(rays) // _CHUNK)]
    if len(some) < 2:
        return _WIDEST_RAD / 2
    around = np.partition(_angles(some, some), min(_NEIGHBOURS, len(some) - 1), axis=1)
    typical = float(np.median(around[:, min(_NEIGHBOURS, len(some) - 1)]))
    return float(np.clip(typical, _NARROWEST_RAD, _WIDEST_RAD))


def _nodes(count: int) -> IntArray:
    """Return indices spread evenly over 0 .. count - 1, including both ends."""
    return np.unique(np.rint(np.linspace(0, count - 1, min(count, _NODES))).astype(np.int64))


def _interpolate_nodes(
    values: FloatArray, rows: IntArray, columns: IntArray, shape: tuple[int, int]
) -> NDArray[np.float32]:
    """Interpolate values at nodes (R, C) over a grid (H, W)."""
    v = np.interp(np.arange(shape[0]), rows, np.arange(len(rows))).astype(np.float32)
    u = np.interp(np.arange(shape[1]), columns, np.arange(len(columns))).astype(np.float32)
    return np.array(look_up(values.astype(np.float32), *np.meshgrid(u, v)), dtype=np.float32)
