"""Frames of a scanner at rest in a room, quick to read, and matches with a photograph that was taken beside it."""

from __future__ import annotations

import io
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from ladarreg_core.formats import read_photo
from ladarreg_core.frames import Rigid, look_along
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation
from ladarreg_core.simulate.sample import sample_folder
from testing.scenes.box_room import distances

PHOTO, CAMERA = (sample_folder() / name for name in ("photo.png", "camera.json"))


@cache
def frame(seed: int, *, scale: float = 1.0) -> bytes:
    """An NPZ file of half of the cells of a grid; those of another scale do not fit the others."""
    geometry = AzimuthElevation(50, 70, 0.015, 0.015)
    ranges = scale * distances(np.zeros(3), geometry.rays)
    ranges[np.random.default_rng(seed).random(ranges.shape) < 0.5] = np.nan
    light = (40 + 30 * (np.indices(ranges.shape).sum(axis=0) // 5 % 2)).astype(np.float32)
    scan = Scan(geometry, ranges, light, name="frame")
    kept = io.BytesIO()
    np.savez(kept, xyz=scan.points, intensity=light, rays=scan.rays.astype(np.float32))
    return kept.getvalue()


def elsewhere() -> bytes:
    """A scan that is no frame of that standpoint."""
    return frame(9, scale=1.7)


def write_frames(folder: Path, count: int) -> list[Path]:
    """Write `sweep0.npz` and so on, and return their paths."""
    paths = [folder / f"sweep{seed}.npz" for seed in range(count)]
    for seed, path in enumerate(paths):
        path.write_bytes(frame(seed))
    return paths


def room_matches() -> list[dict[str, Any]]:
    """Points of the room as a camera beside the scanner sees them, too few for a pose, as fields of `add_pick`."""
    camera = read_photo(PHOTO, camera=CAMERA).camera
    camera_from_scanner = Rigid.from_centre(look_along([1, 0.05, 0]), np.array([-0.3, -0.2, 0.1]))
    rays = np.array([[1, y, z] for y in (-0.3, 0.2) for z in (-0.2, -0.05, 0.15)])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    uv = camera.project(camera_from_scanner @ (rays * distances(np.zeros(3), rays)[:, None])).tolist()
    return [{"kind": "point", "scan": [ray], "photo_uv": [at]} for ray, at in zip(rays.tolist(), uv, strict=True)]
