"""Clouds of scanners in simple worlds of boxes, cast analytically: the truth of origin and gridding tests."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
ROOM = np.array([[-5, -4, 0], [6, 5, 3]], dtype=np.float64)
FURNITURE = np.array(
    [
        [[1.0, 1.5, 0.0], [2.2, 2.3, 1.1]],
        [[-4.9, -1.0, 0.0], [-4.2, 1.0, 2.1]],
        [[-2.0, -3.0, 0.0], [-1.2, -2.0, 0.8]],
        [[3.5, -3.2, 0.0], [4.5, -1.0, 0.75]],
        [[2.8, 3.6, 0.0], [3.2, 4.0, 3.0]],
    ]
)
STREET = np.array(
    [
        [[-40, 12, 0], [-8, 30, 14]],
        [[-2, 11, 0], [30, 25, 9]],
        [[-35, -30, 0], [10, -14, 18]],
        [[18, -28, 0], [45, -12, 7]],
        [[-7, 5, 0], [-3, 7, 1.6]],
        [[6, -6, 0], [10, -4, 1.5]],
        [[3, 7, 0], [3.4, 7.4, 6]],
        [[13, 3, 0], [13.3, 3.3, 5]],
    ],
    dtype=np.float64,
)


def dome(step_deg: float = 0.6, *, lowest_deg: float = -60.0) -> Array:
    """Return the rays (N, 3) of a terrestrial scanner, column by column."""
    azimuth = np.radians(np.arange(0, 360, step_deg))
    elevation = np.radians(np.arange(lowest_deg, 90 - step_deg / 2, step_deg))
    return _rays(*np.meshgrid(azimuth, elevation, indexing="ij"))


def spinning(rings: int = 32, columns: int = 1800) -> Array:
    """Return the rays (N, 3) of a spinning scanner with rings from -25 to 15 deg, column by column."""
    azimuth = np.linspace(0, 2 * np.pi, columns, endpoint=False)
    return _rays(*np.meshgrid(azimuth, np.radians(np.linspace(-25, 15, rings)), indexing="ij"))


def of_elevations(elevations_deg: ArrayLike, columns: int) -> Array:
    """Return the rays (N, 3) of a spinning scanner with rings at any elevations, column by column."""
    azimuth = np.linspace(0, 2 * np.pi, columns, endpoint=False)
    return _rays(*np.meshgrid(azimuth, np.radians(elevations_deg), indexing="ij"))


def rosette(count: int, *, field_deg: float = 70.0, seed: int = 0) -> Array:
    """Return the rays (N, 3) around X of a scanner with two counter-rotating prisms, in the order of time."""
    generator = np.random.default_rng(seed)
    time = np.arange(count) / 100_000
    first = 2 * np.pi * 121.7 * time + generator.uniform(0, 6.28)
    second = -2 * np.pi * 77.28 * time + generator.uniform(0, 6.28)
    half = np.tan(np.radians(field_deg / 2)) / 2
    y = half * (np.cos(first) + np.cos(second))
    z = half * (np.sin(first) + np.sin(second))
    rays = np.stack([np.ones(count), y, z], axis=-1)
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def _rays(azimuth: Array, elevation: Array) -> Array:
    level = np.cos(elevation)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=-1).reshape(-1, 3)


def in_room(rays: Array, scanner: ArrayLike = (0.4, -0.6, 1.5), *, noise_m: float = 0.002, seed: int = 1) -> Array:
    """Return the points (N, 3) in the room's coordinates, m."""
    return _hits(np.asarray(scanner, dtype=np.float64), rays, FURNITURE, room=ROOM, noise_m=noise_m, seed=seed)


def in_street(rays: Array, scanner: ArrayLike = (0.0, 0.0, 1.8), *, noise_m: float = 0.01, seed: int = 1) -> Array:
    """Return the points (N, 3) in the street's coordinates, m; rays into the sky and beyond 70 m have none."""
    return _hits(np.asarray(scanner, dtype=np.float64), rays, STREET, room=None, noise_m=noise_m, seed=seed)


def _hits(o: Array, rays: Array, boxes: Array, *, room: Array | None, noise_m: float, seed: int) -> Array:
    with np.errstate(divide="ignore"):
        inverse = 1 / rays
    if room is not None:
        distance = np.maximum((room[0] - o) * inverse, (room[1] - o) * inverse).min(axis=1)
    else:
        distance = np.where(rays[:, 2] < 0, -o[2] * inverse[:, 2], np.inf)
    for low, high in boxes:
        a, b = (low - o) * inverse, (high - o) * inverse
        near, far = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
        hit = (near < far) & (near > 0)
        distance = np.where(hit, np.minimum(distance, near), distance)
    seen = distance < 70
    distance = distance[seen] + np.random.default_rng(seed).normal(0, noise_m, int(seen.sum()))
    return np.asarray(o + distance[:, None] * rays[seen])


def brightness(points: Array) -> NDArray[np.float32]:
    """Return an intensity (N,) that is painted on the surfaces: stripes and checks of several sizes."""
    x, y, z = points.T
    checks = np.sign(np.sin(5 * x + 1) * np.sin(6 * y) * np.sin(7 * z + 0.5))
    blobs = np.sin(1.3 * x + 2.1 * y) + np.sin(2.7 * y - 1.9 * z) + np.sin(3.1 * z + 0.7 * x)
    return np.asarray(100 + 30 * checks + 20 * blobs, dtype=np.float32)
