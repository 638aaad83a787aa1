"""An empty room with smoothly painted walls: the true colour of every point and pixel is a formula."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from ladarreg_core.camera import CameraModel
from ladarreg_core.export.registered_scan import RegisteredPhoto
from ladarreg_core.frames import CAMERA_AXES_FROM_SCANNER, Rigid
from ladarreg_core.photo import Photo
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import SphericalGrid
from testing.scenes.small_registration import sample_registration

LOW, HIGH = np.array([-3.1, -2.6, -1.4]), np.array([3.4, 2.9, 1.7])
"""Two opposite corners, scanner frame, m."""
POSE = Rigid.from_rotvec([0.04, -0.06, 0.03]) @ Rigid.from_centre(CAMERA_AXES_FROM_SCANNER, (0.25, -0.4, 0.15))
"""A camera that looks along the scanner's X, somewhat turned."""


def paint(points: np.ndarray) -> np.ndarray:
    """The colours (..., 3), 0 to 255, of points (..., 3) of the walls."""
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    waves = [np.sin(2.1 * x + 1.3 * y + 0.4 * z), np.sin(2.3 * y - 1.7 * z + 0.6 * x), np.sin(2.6 * z + 1.1 * x - y)]
    return 128 + 90 * np.stack(waves, axis=-1)


def distances(start: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """How far the walls are from a point inside along rays (..., 3)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ahead = np.where(rays > 0, (HIGH - start) / rays, (LOW - start) / rays)
    return np.nanmin(np.where(ahead > 0, ahead, np.nan), axis=-1)


def seen_along(start: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """The colours (..., 3) that are seen along rays (..., 3) of the scanner frame."""
    return paint(start + rays * distances(start, rays)[..., None])


def scan_of(rows: int = 60, columns: int = 120, *, turn_deg: float = 360.0, **more: object) -> Scan:
    """A scan of the room, with some holes."""
    step = np.radians(turn_deg) / columns
    geometry = SphericalGrid(rows, columns, step, np.radians(110) / rows, 0.0, np.radians(60))
    ranges = distances(np.zeros(3), geometry.rays)
    generator = np.random.default_rng(4)
    ranges[generator.random(ranges.shape) < 0.03] = np.nan
    intensity = generator.uniform(0.1, 0.9, ranges.shape)
    return Scan(geometry, ranges, intensity, name="room", **more)  # type: ignore[arg-type]


def photo_of(camera: CameraModel, pose: Rigid = POSE, name: str = "photo.png") -> Photo:
    """A photograph of the room; black where the lens sees nothing."""
    uv = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1)
    rays = camera.unproject(uv) @ pose.rotation
    seen = np.isfinite(rays).all(axis=-1)
    colors = seen_along(pose.centre, np.where(seen[..., None], rays, [1.0, 0, 0]))
    return Photo(np.rint(np.where(seen[..., None], colors, 0)).astype(np.uint8), camera, name=name)


def registered(
    photo: Photo, pose: Rigid = POSE, *, name: str = "one", given: bool = False, file: Path | None = None
) -> RegisteredPhoto:
    """The photograph with its pose, accepted or given."""
    found = replace(sample_registration(), camera_from_scanner=pose, camera=photo.camera)
    if given:
        found = replace(found, accepted=False, evidence="given", reasons=("given",))
    return RegisteredPhoto(name, photo, found, file)
