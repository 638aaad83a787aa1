"""What a photograph should show: the laser's surface from its pose, coloured by others, at its own resolution.

The view is a scan whose intensity is the luminance of the photographs, so that a photograph is verified against it by
the same comparison, with the same false alarms, as against the laser's intensity. A close-up, which shows more than the
laser's intensity resolves, meets pictures of about its own scale there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.camera import Camera, CameraModel
from ladarreg_core.foundations.arrays import ByteArray, FloatArray
from ladarreg_core.frames import CAMERA_AXES_FROM_SCANNER, Rigid
from ladarreg_core.photo import Photo
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import PinholeGrid
from ladarreg_core.surface.visibility.depth_map import depth_map

_SIDE_PX = 720  # of the view
_DEPTH_SIDE_PX = 480  # of what each source sees, for what hides what
_HIDDEN, _HIDDEN_M = 0.015, 0.02  # behind what a source sees
_MIN_COLORED = 0.12  # of the view
_MAX_SOURCES = 6


@dataclass(frozen=True, slots=True, eq=False)
class ColorSource:
    """A verified photograph."""

    photo: Photo
    camera: CameraModel
    camera_from_world: Rigid


@dataclass(frozen=True, slots=True, eq=False)
class ColoredView:
    """The surface as a camera would see it."""

    scan: Scan
    """Ranges, and the luminance as intensity; no return where nothing is coloured."""
    camera_from_scanner: Rigid
    """The pose of the camera in it, if it is right."""
    world_from_scanner: Rigid
    """Where the view is in the world."""
    colored: float
    """Share of the view that has a colour."""


def colored_view(
    camera: CameraModel,
    camera_from_world: Rigid,
    sources: Sequence[ColorSource],
    surfaces: Sequence[tuple[Scan, Rigid]],
) -> ColoredView | None:
    """Return the surface from a pose; None: too little of it is coloured, or the camera is no pinhole.

    Args:
        camera: of the photograph that is to be compared.
        camera_from_world: its pose.
        sources: photographs that colour the surface; of each place the one that shows it largest counts.
        surfaces: scans with their `scanner_from_world`.
    """
    pinhole = camera.as_pinhole
    if pinhole is None or not sources:
        return None
    ideal = _reduced(pinhole, _SIDE_PX)
    depth = _nearest(ideal, camera_from_world, surfaces)
    v, u = np.mgrid[: ideal.height, : ideal.width]
    rays = ideal.unproject(np.stack([u, v], axis=-1).astype(np.float64))
    rays /= rays[..., 2:]
    in_world = camera_from_world.inverse @ (rays * depth[..., None]).reshape(-1, 3)
    light = np.full(depth.size, np.nan, np.float32)
    finest = np.full(depth.size, np.inf)
    for source in sources[:_MAX_SOURCES]:
        size, found = _sampled(source, in_world, surfaces, depth.ravel() / ideal.focal_px)
        better = np.isfinite(found) & (size < finest)
        light[better], finest[better] = found[better], size[better]
    known = np.isfinite(light).reshape(depth.shape) & np.isfinite(depth)
    if known.mean() < _MIN_COLORED:
        return None
    ranges = np.where(known, depth * np.linalg.norm(rays, axis=-1), np.nan)
    axes = Rigid(CAMERA_AXES_FROM_SCANNER, np.zeros(3))
    scan = Scan(
        geometry=PinholeGrid(ideal), ranges=ranges.astype(np.float32),
        intensity=np.where(known, light.reshape(depth.shape), 0).astype(np.float32), intensity_is="range_normalised",
        name="colored surface",
    )  # fmt: skip
    return ColoredView(scan, axes, camera_from_world.inverse @ axes, float(known.mean()))


def _reduced(camera: Camera, side_px: int) -> Camera:
    """Return an ideal camera of the same field with at most `side_px` pixels along its longer side."""
    scale = min(1.0, side_px / max(camera.size))
    width, height = (max(2, round(side * scale)) for side in camera.size)
    return Camera(
        width, height, camera.fx * scale, camera.fy * scale, (camera.cx + 0.5) * scale - 0.5,
        (camera.cy + 0.5) * scale - 0.5,
    )  # fmt: skip


def _nearest(camera: Camera, camera_from_world: Rigid, surfaces: Sequence[tuple[Scan, Rigid]]) -> NDArray[np.float32]:
    """Return the depth (H, W) of the nearest surface of any scan."""
    found = np.full((camera.height, camera.width), np.inf, np.float32)
    for scan, scanner_from_world in surfaces:
        depth = depth_map(scan, camera, camera_from_world @ scanner_from_world.inverse, only_seen=True)
        found = np.fmin(found, depth)
    return np.where(np.isfinite(found), found, np.nan).astype(np.float32)


def _sampled(
    source: ColorSource, points: FloatArray, surfaces: Sequence[tuple[Scan, Rigid]],
    wanted_m: NDArray[np.floating],
) -> tuple[FloatArray, NDArray[np.float32]]:  # fmt: skip
    """Return the size of a pixel (N,), m, and the luminance (N,) at points (N, 3); NaN where they are not seen."""
    there = source.camera_from_world @ points
    uv = source.camera.project(there)
    distance = np.linalg.norm(there, axis=1)
    seen = source.camera.contains(uv) & np.isfinite(distance)
    pinhole = source.camera.as_pinhole
    if pinhole is not None and seen.any():
        ideal = _reduced(pinhole.without_distortion(), _DEPTH_SIDE_PX)
        front = _nearest(ideal, source.camera_from_world, surfaces)
        at = ideal.project(there)
        inside = seen & ideal.contains(at)
        column, row = np.rint(np.where(inside[:, None], at, 0)).astype(int).T
        with np.errstate(invalid="ignore"):
            hidden = there[:, 2] > front[row, column] * (1 + _HIDDEN) + _HIDDEN_M
        seen &= inside & ~hidden
    focal = pinhole.focal_px if pinhole is not None else source.camera.width / (2 * np.pi)
    size = distance / focal
    coarser = float(np.nanmedian(np.where(seen, wanted_m / np.maximum(size, 1e-9), np.nan))) if seen.any() else 1.0
    picture, scale = _luminance(source.photo.pixels, coarser)
    x, y = ((uv + 0.5) * scale - 0.5).astype(np.float32).T
    x, y = (np.ascontiguousarray(np.where(seen, side, -10).reshape(1, -1)) for side in (x, y))
    found = np.concatenate(
        [cv2.remap(picture, x[:, k : k + 30_000], y[:, k : k + 30_000], cv2.INTER_LINEAR)[0]
         for k in range(0, x.shape[1], 30_000)]
    )  # fmt: skip
    return size, np.where(seen, found, np.nan).astype(np.float32)


def _luminance(pixels: ByteArray, coarser: float) -> tuple[NDArray[np.float32], float]:
    """Return the luminance of a photograph, reduced where the view is coarser than it, and the scale."""
    gray = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY).astype(np.float32)
    scale = min(1.0, 1.0 / max(coarser, 1e-6))
    if scale > 0.8:
        return gray, 1.0
    height, width = gray.shape
    size = (max(2, round(width * scale)), max(2, round(height * scale)))
    return np.asarray(cv2.resize(gray, size, interpolation=cv2.INTER_AREA), np.float32), size[0] / width
