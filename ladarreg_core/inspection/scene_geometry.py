"""Geometry of the 3-D scene: outlines of cameras, rays, and marks at the points of matches."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ladarreg_core.camera import CameraModel
from ladarreg_core.foundations.arrays import BoolArray, ByteArray, FloatArray, IntArray, read_only
from ladarreg_core.frames import Rigid
from ladarreg_core.inspection.viewpoints import field_of_view
from ladarreg_core.results.registration import PoseResult
from ladarreg_core.scan import Scan

_NEAR_OF_DISTANCE = 0.01
_FACTORS = tuple(int(step * 10**power) for power in range(5) for step in (1, 2, 5))[:13]
"""By how much ellipses may be enlarged."""
_RING_PARTS = 24
_SHEET_SQUARES = 16
"""Of a picture's sheet: interpolation within them displaces a picture 60 deg wide by at most 0.03 % of its width."""
_HEAD_LENGTH, _HEAD_WIDTH = 0.25, 0.1
"""Of an arrow, as shares of its length."""


def camera_outline(camera: CameraModel, camera_from_scanner: Rigid, *, depth_m: float) -> NDArray[np.float32]:
    """Return the frustum of a camera as lines: four edges and the four sides of its image.

    Args:
        camera: intrinsics; distortion is ignored, and the optical axis is taken as central.
        camera_from_scanner: its pose.
        depth_m: distance from the centre to the image.

    Returns:
        (8, 2, 3) float32, both ends of each line, m, scanner frame.
    """
    across, upright = (np.tan(angle / 2) for angle in field_of_view(camera))
    corners = depth_m * np.array([[s * across, t * upright, 1] for s, t in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
    points = camera_from_scanner.inverse @ np.vstack([np.zeros((1, 3)), corners])
    centre, image = np.broadcast_to(points[0], (4, 3)), points[1:]
    edges = np.stack([centre, image], axis=1)
    sides = np.stack([image, np.roll(image, -1, axis=0)], axis=1)
    return np.concatenate([edges, sides]).astype(np.float32)


def camera_outlines(camera: CameraModel, poses: tuple[Rigid, ...], *, depth_m: float) -> NDArray[np.float32]:
    """Return the outlines of several poses in one array, (8 n, 2, 3)."""
    if not poses:
        return np.zeros((0, 2, 3), dtype=np.float32)
    return np.concatenate([camera_outline(camera, pose, depth_m=depth_m) for pose in poses])


def picture_sheet(
    camera: CameraModel, camera_from_scanner: Rigid, *, distance_m: float, squares: int = _SHEET_SQUARES
) -> FloatArray:
    """Return a curved sheet before a camera that bears its picture: seen from the camera, each pixel lies on its ray.

    Args:
        camera: intrinsics, of any model; its distortion bends the sheet's net.
        camera_from_scanner: its pose.
        distance_m: distance of every corner of the net from the camera's centre.
        squares: how many of the net's squares lie along the longer side of the picture.

    Returns:
        (R, C, 3) corners of the net, m, scanner frame, which divide the picture evenly from its upper left corner to
        its lower right one; NaN where the camera has no ray.
    """
    longest = max(camera.size)
    columns, rows = (max(2, round(squares * side / longest)) + 1 for side in camera.size)
    shares = np.stack(np.meshgrid(np.linspace(0, 1, columns), np.linspace(0, 1, rows)), axis=-1)
    rays = camera.unproject(shares * np.array(camera.size, np.float64) - 0.5)
    return camera_from_scanner.centre + distance_m * rays @ camera_from_scanner.rotation


def distance_of_picture(
    camera: CameraModel, camera_from_scanner: Rigid, origin: ArrayLike, direction: ArrayLike, *, depth_m: float
) -> float | None:
    """Return where a ray meets the picture of a frustum as `camera_outline` draws it, in lengths of its direction.

    Args:
        camera: the camera.
        camera_from_scanner: its pose.
        origin: (3,) where the ray begins, m, scanner frame.
        direction: (3,) of any length.
        depth_m: distance of the picture from the camera.

    Returns:
        None: the ray passes it, or leaves it behind.
    """
    start = (camera_from_scanner @ np.asarray(origin, np.float64)[None])[0]
    along = camera_from_scanner.rotation @ np.asarray(direction, np.float64)
    if along[2] == 0.0:
        return None
    distance = float((depth_m - start[2]) / along[2])
    halves = depth_m * np.tan(np.array(field_of_view(camera)) / 2)
    inside = bool((np.abs((start + distance * along)[:2]) <= halves).all())
    return distance if distance > 0 and inside else None


def dashed(segments: FloatArray, *, dashes: int) -> NDArray[np.float32]:
    """Return lines (N, 2, 3) as dashes (N * dashes, 2, 3), with a dash at both ends."""
    ends = np.arange(2 * dashes).reshape(-1, 2) / (2 * dashes - 1)
    start, along = segments[:, None, None, 0], (segments[:, 1] - segments[:, 0])[:, None, None]
    return np.asarray((start + ends[None, :, :, None] * along).reshape(-1, 2, 3), dtype=np.float32)


def rays_to(points: FloatArray, centres: tuple[FloatArray, ...]) -> NDArray[np.float32]:
    """Return lines from every centre (3,) to every point (N, 3): (centres * N, 2, 3), ordered by centre."""
    lines = [np.stack([np.broadcast_to(centre, points.shape), points], axis=1) for centre in centres]
    if not lines:
        return np.zeros((0, 2, 3), dtype=np.float32)
    return np.concatenate(lines).astype(np.float32)


def error_ellipses(centres: ArrayLike, covariances: ArrayLike, *, size_m: float) -> tuple[NDArray[np.float32], int]:
    """Return the standard deviations of positions as ellipses in their three principal planes, enlarged to be seen.

    Args:
        centres: (N, 3) positions, m.
        covariances: (N, 3, 3) of these, m^2.
        size_m: the half axes of a typical one are to be at most so long.

    Returns:
        (K, 2, 3) float32 the lines, m, and the factor by which they are enlarged: 1, 2, 5, 10, 20 ... up to 10,000.
    """
    middles = np.asarray(centres, np.float64).reshape(-1, 3)
    known = np.asarray(covariances, np.float64).reshape(-1, 3, 3)
    if not len(middles):
        return np.zeros((0, 2, 3), np.float32), 1
    variances, axes = np.linalg.eigh(known)
    halves = axes * np.sqrt(np.maximum(variances, 0.0))[:, None, :]  # columns
    typical = float(np.median(np.sqrt(np.maximum(variances[:, -1], 0.0))))
    factor = max((one for one in _FACTORS if one * typical <= size_m), default=1)
    angle = np.linspace(0, 2 * np.pi, _RING_PARTS + 1)
    rings = []
    for i, j in ((0, 1), (0, 2), (1, 2)):
        at = np.cos(angle)[None, :, None] * halves[:, None, :, i] + np.sin(angle)[None, :, None] * halves[:, None, :, j]
        ring = middles[:, None] + factor * at
        rings.append(np.stack([ring[:, :-1], ring[:, 1:]], axis=2).reshape(-1, 2, 3))
    return np.concatenate(rings).astype(np.float32), factor


def arrows(starts: ArrayLike, ends: ArrayLike, *, factor: float = 1.0) -> NDArray[np.float32]:
    """Return arrows from where something was to where it is now.

    Args:
        starts: (N, 3) where it was, m.
        ends: (N, 3) where it is, m; the arrows' heads lie here.
        factor: by how much the arrows are enlarged.

    Returns:
        (3 N, 2, 3) float32 a shaft and the two sides of the head of each, m; an arrow of no length is a point.
    """
    now = np.asarray(ends, np.float64).reshape(-1, 3)
    along = factor * (now - np.asarray(starts, np.float64).reshape(-1, 3))
    aside = np.cross(along, np.eye(3)[np.argmin(np.abs(along), axis=1)])  # as long as that axis is far from it
    length = np.linalg.norm(aside, axis=1, keepdims=True)
    aside *= np.linalg.norm(along, axis=1, keepdims=True) / np.where(length > 0, length, 1.0)
    tails = [now - along, *(now - _HEAD_LENGTH * along + side * _HEAD_WIDTH * aside for side in (1, -1))]
    return np.concatenate([np.stack([tail, now], axis=1) for tail in tails]).astype(np.float32)


def crosses(points: ArrayLike, *, per_range: float) -> NDArray[np.float64]:
    """Return three short lines (3 N, 2, 3) through each of the points (N, 3), along the axes, those of each together.

    Args:
        points: (N, 3) m, scanner frame.
        per_range: how far they reach from a point, as a share of its range.
    """
    at = np.asarray(points, np.float64).reshape(-1, 3)
    reach = per_range * np.linalg.norm(at, axis=1)[:, None, None] * np.eye(3)
    return np.asarray(np.stack([at[:, None] - reach, at[:, None] + reach], axis=2).reshape(-1, 2, 3))


def faded(colors: ArrayLike, background: ArrayLike, *, share: float) -> NDArray[np.uint8]:
    """Blend RGB colours (N, 3) with the background by a share from 0 to 1."""
    bright = np.asarray(colors, dtype=np.float64)
    return np.rint((1 - share) * bright + share * np.asarray(background, dtype=np.float64)).astype(np.uint8)


def for_both_ends(colors: ArrayLike) -> NDArray[np.uint8]:
    """Repeat one RGB colour per line (N, 3) for both of its ends, (N, 2, 3)."""
    return np.repeat(np.asarray(colors, dtype=np.uint8)[:, None], 2, axis=1)


def repeated(color: ArrayLike, count: int) -> NDArray[np.uint8]:
    """Repeat one RGB colour (3,), giving (count, 3)."""
    return np.tile(np.asarray(color, dtype=np.uint8), (count, 1))


def spread(count: int, most: int) -> NDArray[np.int64]:
    """Return at most `most` evenly spread indices of 0 .. count - 1."""
    return np.unique(np.linspace(0, max(count - 1, 0), min(count, most)).round().astype(np.int64))


@dataclass(frozen=True, slots=True, eq=False)
class Marks:
    """Marked points with finite positions; read-only."""

    points: FloatArray
    """(N, 3) float32, m, scanner frame; finite."""
    colors: ByteArray
    """(N, 3) uint8 RGB."""
    on: BoolArray
    """(N,) bool: whether the solver uses the point."""
    given: IntArray
    """(N,) index of each in the input points."""

    def __post_init__(self) -> None:
        points = read_only(self.points, np.float32, (None, 3), "the marks' points")
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "colors", read_only(self.colors, np.uint8, (len(points), 3), "the marks' colours"))
        object.__setattr__(self, "on", read_only(self.on, np.bool_, (len(points),), "the marks' 'on'"))
        object.__setattr__(self, "given", read_only(self.given, np.int64, (len(points),), "the marks' numbers"))

    @staticmethod
    def of(points: ArrayLike, colors: ArrayLike, on: ArrayLike) -> Marks:
        """Create marks of the finite ones among points (N, 3).

        Raises:
            ShapeError: if the arrays disagree.
        """
        given = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        every = Marks(
            np.nan_to_num(given), np.asarray(colors).reshape(-1, 3), np.asarray(on, np.bool_), np.arange(len(given))
        )
        return every.at(np.flatnonzero(np.isfinite(given).all(axis=1)))

    def __len__(self) -> int:
        return len(self.points)

    def at(self, index: IntArray) -> Marks:
        """Return the marks at these indices."""
        return Marks(self.points[index], self.colors[index], self.on[index], self.given[index])

    def chosen(self, wanted: ArrayLike) -> Marks:
        """Return the marks selected by a mask (N,) bool."""
        return self.at(np.flatnonzero(np.asarray(wanted, dtype=np.bool_)))

    def dimmed(self, background: ArrayLike, *, on: float, off: float) -> NDArray[np.uint8]:
        """Blend the colours with the background, by different shares for marks that are on and off."""
        bright = faded(self.colors, background, share=on)
        return np.where(self.on[:, None], bright, faded(self.colors, background, share=off))

    def before(self, distance_m: float) -> NDArray[np.float32]:
        """Return the points (N, 3) moved along their rays toward the scanner, so that they clear their surface."""
        ranges = np.linalg.norm(self.points, axis=1, keepdims=True)
        share = np.clip(distance_m / np.maximum(ranges, 1e-9), 0, 0.5)
        return np.asarray(self.points * (1 - share), dtype=np.float32)

    def nearest_to_ray(self, origin: ArrayLike, direction: ArrayLike, *, radius_m: float) -> int | None:
        """Return the index of the mark nearest to a ray; None where it passes all of them.

        Args:
            origin: (3,) m.
            direction: (3,) of any length.
            radius_m: largest distance from the ray, or one hundredth of the distance along it if that is larger.
        """
        start, along = np.asarray(origin, np.float64), np.asarray(direction, np.float64)
        along = along / np.linalg.norm(along)
        offset = self.points.astype(np.float64) - start
        ahead = offset @ along
        across = np.linalg.norm(offset - ahead[:, None] * along, axis=1)
        near = (ahead > 0) & (across <= np.maximum(radius_m, _NEAR_OF_DISTANCE * ahead))
        if not near.any():
            return None
        return int(np.argmin(np.where(near, across / np.maximum(ahead, 1e-12), np.inf)))


def marks_of_result(result: PoseResult, colors: Sequence[tuple[int, int, int]], *, most: int) -> Marks:
    """Return marks at `most` inliers at most, evenly spread, with the colours in turn."""
    points = np.asarray(result.matches.points, dtype=np.float64)
    inliers = np.flatnonzero(np.asarray(result.inliers) & np.isfinite(points).all(axis=1))
    inliers = inliers[spread(len(inliers), most)] if len(inliers) else inliers
    palette = np.asarray(colors, dtype=np.uint8)[np.arange(len(inliers)) % len(colors)]
    return Marks(points[inliers], palette, np.ones(len(inliers), np.bool_), inliers)


def spread_points(scan: Scan, most: int) -> NDArray[np.float32]:
    """Return at most so many of a scan's points (N, 3), m, evenly spread over its grid, frame of its scanner."""
    stride = max(1, math.ceil(math.sqrt(np.count_nonzero(scan.valid) / most)))
    points = scan.thinned_points(stride).reshape(-1, 3)
    found = points[np.isfinite(points).all(axis=-1)]
    return np.ascontiguousarray(found[:: max(1, -(-len(found) // most))], dtype=np.float32)
