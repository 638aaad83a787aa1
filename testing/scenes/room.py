"""The room: matches on the walls, the floor and three boxes of a room, 2 to 6 m away.

They lie in the view of a 768 x 512 camera with f = 974 px (50 degrees across the diagonal), with 1 px and 15 mm of
noise and half a metre between scanner and camera.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ladarreg_core.camera import Camera
from ladarreg_core.frames import CAMERA_AXES_FROM_SCANNER, Rigid, rotation_from_rotvec
from testing.scenes.pose_case import Case

ROOM_CAMERA = Camera.from_focal(768, 512, 974.0)
ROOM_WALLS = (np.array([-1.0, -2.4, -1.2]), np.array([5.6, 2.4, 1.5]))
ROOM_BOXES = (
    (np.array([2.2, -0.9, -1.2]), np.array([2.7, -0.35, -0.1])),
    (np.array([2.9, 0.3, -1.2]), np.array([3.6, 1.2, 0.15])),
    (np.array([4.3, -1.2, -1.2]), np.array([5.0, -0.2, 0.8])),
)


def room_ranges(rays: np.ndarray) -> np.ndarray:
    """Return the distance (N,) to the first surface of the room along unit rays (N, 3) from its origin."""
    with np.errstate(divide="ignore"):
        inverse = 1 / np.where(np.abs(rays) < 1e-12, 1e-12, rays)
    ranges = np.maximum(inverse * ROOM_WALLS[0], inverse * ROOM_WALLS[1]).min(axis=1)
    for low, high in ROOM_BOXES:
        near = np.minimum(inverse * low, inverse * high).max(axis=1)
        far = np.maximum(inverse * low, inverse * high).min(axis=1)
        ranges = np.where((near < far) & (near > 0), np.minimum(ranges, near), ranges)
    return ranges


def room_case(
    seed: int,
    *,
    count: int = 200,
    outliers: float = 0.0,
    baseline_m: float = 0.5,
    direction: tuple[float, float, float] | None = None,
    sigma_px: float = 1.0,
    sigma_range_m: float = 0.015,
    camera: Camera = ROOM_CAMERA,
) -> Case:
    """Return matches in the room; the camera is `baseline_m` away, by default in a random direction, mostly
    sideways."""
    rng = np.random.default_rng([seed, count, int(outliers * 100)])
    way = rng.normal(size=3) * [0.4, 1.0, 0.5] if direction is None else np.array(direction)
    centre = way / np.linalg.norm(way) * baseline_m
    # It looks at the middle of the scan, within a few degrees.
    pan = np.arctan2(centre[1], 4.0 - centre[0])
    turn = rotation_from_rotvec(rng.normal(size=3) * np.deg2rad(3)) @ rotation_from_rotvec([0, -pan, 0])
    pose = Rigid.from_centre(turn @ CAMERA_AXES_FROM_SCANNER, centre)
    kept: list[np.ndarray] = []
    while sum(map(len, kept)) < count:
        tangents = rng.uniform(-1.1, 1.1, (4 * count, 2)) * [
            camera.width / 2 / camera.fx,
            camera.height / 2 / camera.fy,
        ]
        rays = np.column_stack([np.ones(len(tangents)), -tangents])
        rays /= np.linalg.norm(rays, axis=1)[:, None]
        ranges = room_ranges(rays)
        seen = camera.contains(camera.project(pose @ (rays * ranges[:, None]))) & (ranges > 2) & (ranges < 6)
        kept.append(rays[seen])
    rays = np.concatenate(kept)[:count]
    ranges = room_ranges(rays)
    uv = camera.project(pose @ (rays * ranges[:, None])) + rng.normal(size=(count, 2)) * sigma_px
    wrong = rng.permutation(count) < round(outliers * count)
    uv[wrong] = rng.uniform([0, 0], [camera.width - 1, camera.height - 1], (int(wrong.sum()), 2))
    return Case(
        rays, ranges + rng.normal(size=count) * sigma_range_m, uv, camera, pose, ~wrong, sigma_px, sigma_range_m
    )


def plane_case(
    seed: int,
    *,
    extent_m: float,
    distance_m: float,
    count: int = 40,
    sigma_px: float = 1.0,
    sigma_range_m: float = 0.002,
) -> Case:
    """Return matches on a square plane of twice the extent, rotated by half a radian, with a baseline of 30 cm."""
    rng = np.random.default_rng([seed, count, 17])
    flat = np.column_stack([np.zeros(count), rng.uniform(-extent_m, extent_m, (count, 2))])
    points = flat @ rotation_from_rotvec([0, 0, 0.5]).T + [distance_m, 0, 0]
    pose = Rigid.from_centre(CAMERA_AXES_FROM_SCANNER, [0.0, 0.3, 0.0])
    ranges = np.linalg.norm(points, axis=1)
    uv = ROOM_CAMERA.project(pose @ points) + rng.normal(size=(count, 2)) * sigma_px
    measured = ranges + rng.normal(size=count) * sigma_range_m
    everyone = np.ones(count, dtype=np.bool_)
    return Case(points / ranges[:, None], measured, uv, ROOM_CAMERA, pose, everyone, sigma_px, sigma_range_m)


def repeated_case(seed: int, *, share: float, count: int = 60, spacing_m: float = 0.9) -> Case:
    """Return a room case in which a share of the matches belongs to a second, displaced pose."""
    case = room_case(seed, count=count)
    beside = Rigid.from_centre(case.pose.rotation, case.pose.centre + np.array([0, spacing_m, 0]))
    astray = np.arange(count) < round(share * count)
    points = case.rays * room_ranges(case.rays)[:, None]
    noise = case.uv - case.camera.project(case.pose @ points)
    uv = np.where(astray[:, None], case.camera.project(beside @ points) + noise, case.uv)
    return replace(case, uv=uv, true=~astray)
