"""An edge aligner for comparison: edges where planes of the cloud meet, on the edges of the photo.

Written from the paper, for a peer in the benchmarks. The cloud is cut into voxels, planes are fitted in each by RANSAC,
and where two of them meet, points are sampled on their intersection, with its direction: edges at which the range is
continuous, since a scanner measures those at depth jumps wrongly. A rotation is first searched for by the number of
edge points that have an edge of the photo beside them; then the distances of the points from the edges, as lines, are
minimised, within a radius that decreases.

Source: Yuan, Liu, Hong, Zhang, 'Pixel-level extrinsic self calibration of high resolution LiDAR and camera in
targetless environments', RA-L 2021 (livox_camera_calib).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations, product

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial import cKDTree

from ladarreg_core.camera import CameraModel
from ladarreg_core.foundations.arrays import ByteArray, FloatArray
from ladarreg_core.frames import Rigid, rotation_from_rotvec

_SEED = 17
_VOXEL_SHARE, _VOXEL_M = 0.06, (0.4, 1.5)
_MIN_POINTS, _MAX_POINTS = 25, 800
_PLANES, _TRIPLES = 4, 40
_MIN_SHARE = 0.15  # of a voxel's points: trees have thin slices, too
_THICK_M = 0.03
_MAX_COS = np.cos(np.radians(30))
_SIZES, _SHIFTS = (1.0, 2.0, 4.0), (0.0, 0.5)  # of voxels: far away, points are sparse
_STEPS = 40  # a voxel
_SPACINGS = 3.0
_APART_RAD, _MAX_SAMPLES = 0.004, 6000
_CANNY, _MIN_EDGE_PX = (20, 50), 40
_NEIGHBOURS = 6
_SIDEWAYS_COS = np.cos(np.radians(25))
_SEARCHES_DEG = ((5.0, 0.5), (1.0, 0.25))
_SEARCHED, _SEARCH_PX = 1500, 6.0
_RADII_PX = (16.0, 12.0, 10.0, 8.0, 6.0, 5.0, 4.0)
_ROUNDS = 3
_MIN_MATCHES = 30
_SIGMA_PX, _INDEPENDENT, _GUESS_M = 2.0, 150, 0.3


@dataclass(frozen=True, slots=True, eq=False)
class CloudEdges:
    """Points on the edges of a cloud."""

    points: FloatArray
    """(N, 3) m, scanner frame."""
    directions: FloatArray
    """(N, 3) unit vectors along the edges."""


def cloud_edges(points: FloatArray) -> CloudEdges:
    """Return where planes of a cloud meet.

    Args:
        points: (N, 3) m, finite, scanner frame.
    """
    rng = np.random.default_rng(_SEED)
    side = float(np.clip(_VOXEL_SHARE * np.median(np.linalg.norm(points, axis=1)), *_VOXEL_M))
    found: list[tuple[FloatArray, FloatArray]] = []
    for size, shift in product(_SIZES, _SHIFTS):
        for voxel in _voxels(points + shift * size * side, size * side):
            mine = voxel if len(voxel) <= _MAX_POINTS else voxel[rng.choice(len(voxel), _MAX_POINTS, replace=False)]
            planes = list(_planes(mine - shift * size * side, rng))
            for one, two in combinations(planes, 2):
                found += [(edge, way) for edge, way in [_intersection(one, two, size * side)] if len(edge)]
    if not found:
        return CloudEdges(np.zeros((0, 3)), np.zeros((0, 3)))
    every = np.concatenate([edge for edge, _ in found])
    ways = np.concatenate([np.tile(way, (len(edge), 1)) for edge, way in found])
    # One point in each direction: near edges, and those of several voxels, must not outnumber all others.
    rays = np.round(every / np.linalg.norm(every, axis=1, keepdims=True) / _APART_RAD)
    order = rng.permutation(len(every))
    chosen = order[np.unique(rays[order], axis=0, return_index=True)[1]][:_MAX_SAMPLES]
    return CloudEdges(every[chosen], ways[chosen])


def align_by_edges(points: FloatArray, pixels: ByteArray, camera: CameraModel, start: Rigid) -> Rigid | None:
    """Return the pose that puts the edges of a cloud on those of a photo; None without enough of them.

    Args:
        points: (N, 3) m, finite, scanner frame.
        pixels: (H, W, 3) RGB.
        camera: of the photo.
        start: the guess, `camera_from_scanner`.
    """
    edges, photo = cloud_edges(points), _PhotoEdges.of(pixels)
    if len(edges.points) < _MIN_MATCHES or photo is None:
        return None
    pose = _turned(edges, photo, camera, start)
    for radius in _RADII_PX:
        for _ in range(_ROUNDS):
            matched = photo.matches(edges, camera, pose, radius)
            if len(matched[0]) < _MIN_MATCHES:
                return None
            pose = _solved(edges, matched, camera, pose, start)
    return pose


def _voxels(points: FloatArray, side: float) -> Iterator[FloatArray]:
    cells = np.floor(points / side).astype(np.int64)
    _, at, counts = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    at = at.ravel()
    ordered = points[np.argsort(at, kind="stable")]
    ends = np.cumsum(counts)
    for k in np.flatnonzero(counts >= 2 * _MIN_POINTS):
        yield ordered[ends[k] - counts[k] : ends[k]]


def _planes(points: FloatArray, rng: np.random.Generator) -> Iterator[tuple[FloatArray, float, FloatArray]]:
    """Yield the planes of a voxel: normal, distance, points."""
    left = points
    for _ in range(_PLANES):
        if len(left) < _MIN_POINTS:
            return
        a, b, c = left[rng.integers(len(left), size=(3, _TRIPLES))]
        normals = np.cross(b - a, c - a)
        length = np.linalg.norm(normals, axis=1)
        normals = normals[length > 1e-9] / length[length > 1e-9, None]
        if not len(normals):
            return
        off = np.abs(left @ normals.T - (a[length > 1e-9] * normals).sum(1))
        best = int(np.argmax((off < _THICK_M).sum(0)))
        mine = off[:, best] < _THICK_M
        if mine.sum() < max(_MIN_POINTS, _MIN_SHARE * len(points)):
            return
        middle = left[mine].mean(0)
        _, spread, axes = np.linalg.svd(left[mine] - middle, full_matrices=False)
        if spread[1] > 5 * spread[2]:  # a plane, not a line or a tree
            yield axes[2], float(axes[2] @ middle), left[mine]
        left = left[~mine]


def _intersection(
    one: tuple[FloatArray, float, FloatArray], two: tuple[FloatArray, float, FloatArray], side: float
) -> tuple[FloatArray, FloatArray]:
    """Return points on the intersection of two planes that both reach, (N, 3) m, and its direction."""
    nothing = np.zeros((0, 3)), np.zeros(3)
    if abs(float(one[0] @ two[0])) >= _MAX_COS:
        return nothing
    way = np.cross(one[0], two[0])
    way /= np.linalg.norm(way)
    middle = (one[2].mean(0) + two[2].mean(0)) / 2
    at = np.linalg.solve(np.vstack([one[0], two[0], way]), [one[1], two[1], float(way @ middle)])
    along = at + np.linspace(-side, side, 2 * _STEPS + 1)[:, None] * way
    for plane in (one, two):
        tree = cKDTree(plane[2])
        spacing = float(np.median(tree.query(plane[2], k=2)[0][:, 1]))
        along = along[tree.query(along)[0] < max(_SPACINGS * spacing, side / _STEPS)]
        if not len(along):
            return nothing
    return along, way


@dataclass(frozen=True, slots=True, eq=False)
class _PhotoEdges:
    """Edge pixels of the photo."""

    uv: FloatArray
    tree: cKDTree

    @staticmethod
    def of(pixels: ByteArray) -> _PhotoEdges | None:
        gray = cv2.GaussianBlur(cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY), (0, 0), 1.2)
        edges = cv2.Canny(gray, *_CANNY)
        _, labels, figures, _ = cv2.connectedComponentsWithStats(edges, connectivity=8)
        long = figures[:, cv2.CC_STAT_AREA] >= _MIN_EDGE_PX
        long[0] = False
        v, u = np.nonzero(long[labels])
        if len(u) < _MIN_MATCHES:
            return None
        uv = np.column_stack([u, v]).astype(np.float64)
        return _PhotoEdges(uv, cKDTree(uv))

    def matches(
        self, edges: CloudEdges, camera: CameraModel, pose: Rigid, radius_px: float
    ) -> tuple[NDArray[np.intp], FloatArray, FloatArray]:
        """Return the edge points (M,) that have an edge of their direction nearby, with its place and normal (M, 2)."""
        with np.errstate(invalid="ignore", divide="ignore"):
            uv = camera.project(pose @ edges.points)
            ahead = camera.project(pose @ (edges.points + 0.02 * edges.directions)) - uv
            ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
        inside = np.flatnonzero(camera.contains(uv) & np.isfinite(ahead).all(axis=1))
        apart, index = self.tree.query(uv[inside], k=_NEIGHBOURS, distance_upper_bound=radius_px)
        near = np.isfinite(apart).all(axis=1)
        inside, there = inside[near], self.uv[index[near]]
        middle = there.mean(axis=1)
        offsets = there - middle[:, None]
        _, axes = np.linalg.eigh(offsets.transpose(0, 2, 1) @ offsets)
        normals = axes[:, :, 0]
        alike = np.abs((axes[:, :, 1] * ahead[inside]).sum(1)) > _SIDEWAYS_COS
        return inside[alike], middle[alike], normals[alike]


def _turned(edges: CloudEdges, photo: _PhotoEdges, camera: CameraModel, start: Rigid) -> Rigid:
    """Return the start turned so that most of the edge points lie beside an edge of the photo."""
    every = np.random.default_rng(_SEED).permutation(len(edges.points))[:_SEARCHED]
    few = CloudEdges(edges.points[every], edges.directions[every])

    def pose(rotation: FloatArray) -> Rigid:
        return Rigid.from_centre(rotation_from_rotvec(rotation) @ start.rotation, start.centre)

    def met(turn: FloatArray) -> int:
        return len(photo.matches(few, camera, pose(turn), _SEARCH_PX)[0])

    best = np.zeros(3)
    for reach, step in _SEARCHES_DEG:
        steps = np.radians(np.arange(-reach, reach + 1e-9, step))
        # pitch and yaw of the camera together, which look alike in the photo, then its roll
        best = max((best + np.array([pitch, yaw, 0]) for pitch, yaw in product(steps, steps)), key=met)
        best = max((best + np.array([0, 0, roll]) for roll in steps), key=met)
    return pose(best)


def _solved(
    edges: CloudEdges,
    matched: tuple[NDArray[np.intp], FloatArray, FloatArray],
    camera: CameraModel,
    pose: Rigid,
    start: Rigid,
) -> Rigid:
    """Return the pose that minimises the distances of matched points from the lines of their edges.

    The guess holds what the edges do not determine: few of them seldom determine the position.
    """
    index, places, normals = matched
    points = edges.points[index]
    weight = np.sqrt(min(1.0, _INDEPENDENT / len(points))) / _SIGMA_PX

    def moved(x: FloatArray) -> Rigid:
        return Rigid.from_centre(rotation_from_rotvec(x[:3]) @ pose.rotation, pose.centre + x[3:])

    def residuals(x: FloatArray) -> FloatArray:
        uv = camera.project(moved(x) @ points)
        off = np.nan_to_num(((uv - places) * normals).sum(1), nan=100.0, posinf=100.0, neginf=-100.0)
        return np.append(weight * off, (moved(x).centre - start.centre) / _GUESS_M)

    found = least_squares(
        residuals, np.zeros(6), loss="huber", f_scale=weight * _SIGMA_PX, x_scale=[0.01] * 3 + [0.1] * 3, max_nfev=4
    )
    return moved(found.x)
