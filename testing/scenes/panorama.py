"""A half-open room of flat painted walls around the scanner, for scans much wider than a photo."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ladarreg_core.camera import Camera
from ladarreg_core.frames import Rigid, look_along, rotation_about
from ladarreg_core.photo import Photo
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import SphericalGrid
from ladarreg_core.surface.remap import look_up
from testing.scenes.painted_room import paintings

_WALL_M = 3.0
_WALL_RAD = np.deg2rad(60)
_BAY_M = 0.25


@dataclass(frozen=True)
class Panorama:
    scan: Scan
    photo: Photo
    camera_from_scanner: Rigid

    def error_px(self, pose: Rigid) -> float:
        """Median displacement of the scan's visible cells in the photo."""
        points = self.scan.points[self.scan.valid][::23].astype(float)
        true = self.photo.camera.project(self.camera_from_scanner @ points)
        off = np.hypot(*(true - self.photo.camera.project(pose @ points))[self.photo.camera.contains(true)].T)
        return float(np.median(np.nan_to_num(off, nan=np.inf)))


def panorama(wall_seeds: tuple[int, ...]) -> Panorama:
    """Make the room: one wall of 60 degrees for each seed, which paints it; the photo is taken of the middle one."""
    pictures = [paintings(seed) for seed in wall_seeds]
    middle = len(wall_seeds) // 2
    step = np.deg2rad(0.11)
    columns = int(len(wall_seeds) * _WALL_RAD / step)
    geometry = SphericalGrid(300, columns, step, step, 0.0, 149.5 * step)
    rays = geometry.rays.reshape(-1, 3)
    distance, color = _shoot(np.zeros(3), rays, pictures, middle)
    rng = np.random.default_rng(5)
    ranges = distance + rng.normal(0, 0.003, len(distance))
    laser = color[:, 0] * (1 + rng.normal(0, 0.05, len(color))) * (2.5 / distance) ** 2
    scan = Scan(geometry, ranges.reshape(300, columns), laser.reshape(300, columns))

    pose = Rigid.from_centre(look_along([1.0, 0.12, 0.02]), [0.1, -0.3, 0.05])
    camera = Camera.from_focal(480, 340, 520.0)
    v, u = np.mgrid[:680, :960]
    uv = (np.stack([u, v], axis=-1).reshape(-1, 2) + 0.5) / 2 - 0.5
    _, color = _shoot(pose.centre, camera.unproject(uv) @ pose.rotation, pictures, middle)
    fine = color.reshape(340, 2, 480, 2, 3).mean(axis=(1, 3)) + rng.normal(0, 0.01, (340, 480, 3))
    pixels = (255 * np.clip(fine, 0, 1) ** (1 / 2.2)).astype(np.uint8)
    return Panorama(scan, Photo(pixels, camera), pose)


def _shoot(
    origin: np.ndarray, rays: np.ndarray, pictures: list[np.ndarray], middle: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the distance (N,) and colour (N, 3) of the wall that each ray meets; every wall has two shallow bays."""
    best, color = np.full(len(rays), np.inf), np.zeros((len(rays), 3), np.float32)
    for number, picture in enumerate(pictures):
        turn = rotation_about("z", (middle - number) * _WALL_RAD)  # the wall's own axes: X away from the scanner
        start, along = origin @ turn, rays @ turn
        for depth, low, high in ((_WALL_M - _BAY_M, -1.2, -0.7), (_WALL_M - _BAY_M, 0.5, 0.9), (_WALL_M, -9.0, 9.0)):
            with np.errstate(divide="ignore", invalid="ignore"):
                t = (depth - start[0]) / along[:, 0]
                y, z = start[1] + t * along[:, 1], start[2] + t * along[:, 2]
            hit = (t > 0) & (t < best) & (y > low) & (y < high)
            hit &= np.abs(y) <= _WALL_M * np.tan(_WALL_RAD / 2) + 1e-6
            if not hit.any():
                continue
            best[hit] = t[hit]
            at = np.mod(np.stack([y[hit] + 4, z[hit] + 4], axis=-1) * 190 + (0 if depth == _WALL_M else 311), 1023)
            color[hit] = look_up(picture, at[:, :1].astype(np.float32), at[:, 1:].astype(np.float32))[:, 0]
    missed = ~np.isfinite(best)
    best[missed], color[missed] = 9.0, 0.3
    return best, color
