"""Initial poses without corner matches: the scan, rendered from a grid of positions, is correlated with the photo.

A virtual camera renders the coarse channels of the scan at each position; the Fourier transform correlates them with
the photo at all small rotations at once. No single feature has to match, only the image as a whole.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.camera import Camera
from ladarreg_core.foundations.arrays import BoolArray, FloatArray
from ladarreg_core.foundations.parallel import side_by_side
from ladarreg_core.frames import Rigid, rotation_about
from ladarreg_core.matching.images.photo_levels import PhotoLevels
from ladarreg_core.matching.images.scan_levels import ScanLevels

MAX_STARTS = 5
"""Maximum number of poses returned."""
_LEVEL = 2
_SCALE = 0.5  # of that level: the basin of refinement is several of these pixels wide
_STEP_OF_RANGE = 0.06
_GRID = tuple((x, y, z) for x in range(-4, 5) for y in (-0.5, 0.5) for z in (-0.6, 0.6))
_NEAR_STEP_M = 0.2
_GRID_NEAR = tuple((x, y, z) for x in range(-2, 3) for y in (-1, 0, 1) for z in (-1, 0, 1))
_MAX_ROTATION_RAD, _MAX_ROTATION_NEAR_RAD = np.deg2rad(16), np.deg2rad(7)  # beyond, false peaks dominate
_MIN_OVERLAP = 0.3  # of the photo ...
_MIN_SHARED = 0.5  # ... or of what the scan shows of it, if that is less
_MIN_SHOWN = 0.05  # of the photo
_NEAREST_DEPTH_M = 0.05
_MIN_POINTS = 100
_APART_PX = 16.0
_BASIN_SAMPLES = 300


@dataclass(frozen=True, slots=True, eq=False)
class ScoredPose:
    """An initial pose with its score."""

    camera_from_scanner: Rigid
    """The pose."""
    score: float
    """Correlation of the channels times the square root of the pixels compared: standard deviations above zero."""


def likely_poses(scan: ScanLevels, photo: PhotoLevels, *, around: Rigid | None = None) -> list[ScoredPose]:
    """Return the poses at which the scan correlates best with the photo, best first.

    Args:
        scan: the scan's levels; the photo is assumed to have the roll of the view.
        photo: the photo's levels.
        around: the pose to search around; None: the scanner, in the direction of the view.

    Returns:
        at most `MAX_STARTS` poses, each in a basin of its own; none if the view has hardly any returns.
    """
    cloud = _Cloud.of(scan)
    if len(cloud.points) < _MIN_POINTS:
        return []
    middle = float(np.median(np.linalg.norm(cloud.points, axis=-1)))
    if around is None:
        base, positions, step, max_rotation = (
            scan.view.view_from_scanner,
            _GRID,
            _STEP_OF_RANGE * middle,
            _MAX_ROTATION_RAD,
        )
    else:
        base, positions, max_rotation = around, _GRID_NEAR, _MAX_ROTATION_NEAR_RAD
        step = max(_NEAR_STEP_M, _STEP_OF_RANGE * middle)
    slider = _Slider(photo, max_rotation)

    def scored(position: tuple[float, float, float]) -> ScoredPose | None:
        seen_from = Rigid(base.rotation, base.translation - step * np.array(position))
        best = slider.best(*cloud.seen_by(slider.camera, seen_from))
        if best is None:
            return None
        turn, score = best
        return ScoredPose(turn @ seen_from, score)

    found = [item for item in side_by_side(scored, positions) if item is not None]
    found.sort(key=lambda item: -item.score)
    return _one_per_basin(found, photo.cameras[0], cloud.points)


@dataclass(frozen=True, slots=True, eq=False)
class _Cloud:
    """Returns of the scan at the coarse level, with their channels."""

    points: FloatArray
    """(N, 3) float32, scanner frame, m."""
    channels: FloatArray
    """(N, C) float32."""

    @staticmethod
    def of(scan: ScanLevels) -> _Cloud:
        camera, channels = scan.cameras[_LEVEL], scan.channels[_LEVEL]
        height, width = scan.ranges.shape
        rows = np.minimum((np.arange(camera.height) + 0.5) * height / camera.height, height - 1).astype(np.intp)
        columns = np.minimum((np.arange(camera.width) + 0.5) * width / camera.width, width - 1).astype(np.intp)
        ranges = scan.ranges[np.ix_(rows, columns)]
        v, u = np.nonzero(np.isfinite(ranges))
        rays = scan.view.view_from_scanner.rotation.T @ camera.unproject(np.stack([u, v], axis=-1)).T
        return _Cloud((rays.T * ranges[v, u][:, None]).astype(np.float32), channels[v, u])

    def seen_by(self, camera: Camera, pose: Rigid) -> tuple[FloatArray, BoolArray]:
        """Return the channels (C, h, w) of the nearest return in each pixel, and a mask (h, w) of pixels with one."""
        there = pose @ self.points
        in_front = np.flatnonzero(there[:, 2] > _NEAREST_DEPTH_M)
        uv = camera.project(there[in_front])
        inside = camera.contains(uv, border=-0.49)
        index = in_front[inside]
        pixel = np.rint(uv[inside]).astype(np.intp) @ np.array([1, camera.width])
        depth = there[index, 2]
        nearest = np.full(camera.height * camera.width, np.inf, np.float32)
        np.minimum.at(nearest, pixel, depth)
        shown = depth == nearest[pixel]
        mask = np.isfinite(nearest)
        first = np.zeros(len(nearest), np.intp)
        first[pixel[shown]] = index[shown]
        image = self.channels.take(first, axis=0) * mask[:, None]
        shape = (camera.height, camera.width)
        return np.ascontiguousarray(image.T).reshape(-1, *shape), mask.reshape(shape)


class _Slider:
    """Correlates rendered views of the scan with the photo at every shift; the photo is transformed once."""

    def __init__(self, photo: PhotoLevels, max_rotation_rad: float) -> None:
        level = photo.cameras[_LEVEL]
        self.camera = level.scaled(_SCALE)
        # Plane by plane: OpenCV's area interpolation supports at most four channels.
        planes = [*np.moveaxis(photo.channels[_LEVEL], -1, 0), photo.usable[_LEVEL].astype(np.float32)]
        small = [
            np.asarray(cv2.resize(np.ascontiguousarray(p), self.camera.size, interpolation=cv2.INTER_AREA))
            for p in planes
        ]
        mask = (small.pop() > 0.99).astype(np.float32)
        channels = np.stack(small) * mask
        channels -= mask * (channels.sum(axis=(1, 2)) / max(float(mask.sum()), 1.0))[:, None, None]
        reach = self.camera.fx * np.tan(max_rotation_rad)
        height, width = self.camera.height, self.camera.width
        self._reach = tuple(int(min(reach, side - 1)) for side in (height, width))
        padded = [n + r for n, r in zip((height, width), self._reach, strict=True)]
        self._shape = tuple(cv2.getOptimalDFTSize(n) for n in padded)
        self._channels, self._mask = self._transform(channels), self._transform(mask)
        self._energy = self._transform((channels**2).sum(axis=0))

    def best(self, channels: FloatArray, mask: BoolArray) -> tuple[Rigid, float] | None:
        """Return the best rotation of the virtual camera and its score, or None if too little overlaps."""
        where = mask.astype(np.float32)
        total = float(where.sum())
        if total < _MIN_SHOWN * mask.size:
            return None
        least = min(_MIN_OVERLAP * mask.size, _MIN_SHARED * total)
        centred = channels - where * (channels.sum(axis=(1, 2)) / total)[:, None, None]
        seen = self._transform(where)
        product = self._at_shifts((np.conj(self._transform(centred)) * self._channels).sum(axis=0))
        pixels = self._at_shifts(np.conj(seen) * self._mask)
        of_photo = self._at_shifts(np.conj(seen) * self._energy)
        of_scan = self._at_shifts(np.conj(self._transform((centred**2).sum(axis=0))) * self._mask)
        enough = (pixels >= least) & (of_photo > 1e-6) & (of_scan > 1e-6)
        if not enough.any():
            return None
        length = np.sqrt(np.where(enough, of_photo * of_scan, 1))
        score = np.where(enough, product / length * np.sqrt(np.maximum(pixels, 0)), -np.inf)
        row, column = np.unravel_index(int(score.argmax()), score.shape)
        dv, du = int(row) - self._reach[0], int(column) - self._reach[1]
        # A positive rotation about y shifts the image to the right, one about x shifts it up.
        turn = rotation_about("y", np.arctan2(du, self.camera.fx)) @ rotation_about(
            "x", -np.arctan2(dv, self.camera.fy)
        )
        return Rigid(turn, np.zeros(3)), float(score[row, column])

    def _transform(self, image: FloatArray) -> NDArray[np.complex64]:
        return np.asarray(np.fft.rfft2(image, self._shape))

    def _at_shifts(self, product: NDArray[np.complex64]) -> FloatArray:
        """Return the correlation (2 r_v + 1, 2 r_u + 1) at all shifts within reach."""
        whole = np.roll(np.asarray(np.fft.irfft2(product, self._shape)), self._reach, axis=(0, 1))
        return np.asarray(whole[: 2 * self._reach[0] + 1, : 2 * self._reach[1] + 1])


def _one_per_basin(found: list[ScoredPose], camera: Camera, points: FloatArray) -> list[ScoredPose]:
    """Return the best pose of each basin of refinement, at most `MAX_STARTS`."""
    some = points[:: max(1, len(points) // _BASIN_SAMPLES)].astype(np.float64)
    kept: list[tuple[ScoredPose, FloatArray]] = []
    for item in found:
        uv = camera.project(item.camera_from_scanner @ some)
        apart = (np.nanmedian(np.hypot(*(uv - other).T)) > _APART_PX for _, other in kept)
        if all(apart):
            kept.append((item, uv))
        if len(kept) == MAX_STARTS:
            break
    return [item for item, _ in kept]
