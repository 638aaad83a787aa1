"""Time of a z-buffered texture, compared with its lower bound and with a simpler method that leaks.

Run it as `python -m benchmarks.texture`.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np

from ladarreg_core.camera import Camera
from ladarreg_core.frames import CAMERA_AXES_FROM_SCANNER, Rigid
from ladarreg_core.photo import Photo
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation
from ladarreg_core.surface.mesh.grid_mesh import scan_mesh
from ladarreg_core.surface.texture.registered_texture import texture_scan
from ladarreg_core.surface.visibility.visible_points import project_scan

SIDE = 1000
STEP_RAD = 0.0008
ROUNDS = 7
BUDGET_MS = 150
PHOTOS = ((768, 512, 700.0), (1000, 1000, 1200.0), (1920, 1080, 1700.0), (4000, 3000, 3600.0))
POSE = Rigid.from_centre(CAMERA_AXES_FROM_SCANNER, (0.1, -0.4, 0.1))


def room(noise_m: float = 0.003) -> Scan:
    """A wall, a floor and a box in front of them: a million cells, nearly all with a return."""
    geometry = AzimuthElevation(SIDE, SIDE, STEP_RAD, STEP_RAD)
    rays = geometry.rays
    ranges = 4.0 / rays[..., 0]
    with np.errstate(divide="ignore"):
        ranges = np.minimum(ranges, np.where(rays[..., 2] < 0, -1.2 / rays[..., 2], np.inf))
    front = rays * (2.5 / rays[..., 0])[..., None]
    box = (np.abs(front[..., 1] - 0.1) < 0.4) & (np.abs(front[..., 2]) < 0.5)
    ranges = np.where(box, 2.5 / rays[..., 0], ranges)
    ranges += np.random.default_rng(0).normal(size=ranges.shape) * noise_m
    scan = Scan(geometry, ranges, np.ones(ranges.shape))
    _ = scan.points  # every user of a scan needs them
    return scan


def photo_of(width: int, height: int, focal_px: float) -> Photo:
    small = np.random.default_rng(1).integers(0, 256, (30, 40, 3)).astype(np.uint8)
    return Photo(np.asarray(cv2.resize(small, (width, height)), np.uint8), Camera.from_focal(width, height, focal_px))


def point_buffer_texture(scan: Scan, photo: Photo, pose: Rigid) -> np.ndarray[Any, Any]:
    """Texture by a point z-buffer: each point occludes only what lies behind it in its own pixel."""
    points = pose @ scan.points.reshape(-1, 3)
    uv = photo.camera.project(points)
    inside = photo.camera.contains(uv)
    pixel = np.rint(uv[inside]).astype(np.intp)
    place = pixel[:, 1] * photo.camera.width + pixel[:, 0]
    depth = points[inside, 2]
    buffer = np.full(photo.camera.width * photo.camera.height, np.inf, dtype=np.float32)
    np.minimum.at(buffer, place, depth)
    result = np.zeros((len(points), 3), np.uint8)
    seen = depth <= buffer[place] * 1.01
    result[np.flatnonzero(inside)[seen]] = photo.pixels.reshape(-1, 3)[place[seen]]
    return result.reshape(*scan.shape, 3)


def best_ms(work: Callable[[], object], rounds: int = ROUNDS) -> float:
    times = []
    for _ in range(rounds):
        gc.collect()
        started = time.perf_counter()
        work()
        times.append(time.perf_counter() - started)
    return min(times) * 1e3


def main() -> None:
    print(f"{SIDE * SIDE / 1e6:.0f} Mpoint, best of {ROUNDS}, ms; budget {BUDGET_MS} ms for the texture")
    print(
        f"{'photo':>12} {'remap alone':>12} {'point buffer':>13} {'visibility':>11} {'texture':>8} {'first time':>11}"
    )
    for width, height, focal_px in PHOTOS:
        photo, scan = photo_of(width, height, focal_px), room()
        first = best_ms(lambda: texture_scan(scan, photo, POSE), rounds=1)  # noqa: B023 - called at once
        u, v = np.moveaxis(np.nan_to_num(project_scan(scan, photo.camera, POSE).uv, nan=-9), -1, 0).copy()
        alone = best_ms(lambda: cv2.remap(photo.pixels, u, v, cv2.INTER_LINEAR))  # noqa: B023
        naive = best_ms(lambda: point_buffer_texture(scan, photo, POSE), rounds=2)  # noqa: B023
        visible = best_ms(lambda: project_scan(scan, photo.camera, POSE))  # noqa: B023
        covariance = np.diag([1e-8] * 3 + [1e-6] * 3)
        texture = best_ms(lambda: texture_scan(scan, photo, POSE, covariance=covariance))  # noqa: B023
        size = f"{width} x {height}"
        print(f"{size:>12} {alone:12.0f} {naive:13.0f} {visible:11.0f} {texture:8.0f} {first:11.0f}")
    scan = room()
    full = best_ms(lambda: scan_mesh(scan), rounds=3)
    print(f"mesh of {len(scan_mesh(scan).faces)} triangles: {full:.0f} ms; its edges are found once per scan")


if __name__ == "__main__":
    main()
