"""Lines drawn in the room: eight straight edges of some 400 px on walls and boxes, with the true pose.

They are drawn in both images with 1 px of noise at every end (the scan side counts in photo pixels too), on a scan of
15 mm noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from ladarreg_core.camera import Camera
from ladarreg_core.frames import CAMERA_AXES_FROM_SCANNER, Rigid, rotation_from_rotvec
from ladarreg_core.matches import Pick
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation
from testing.scenes.room import ROOM_BOXES, ROOM_CAMERA, ROOM_WALLS, room_ranges

_STEP_RAD = np.deg2rad(0.11)
_GEOMETRY = AzimuthElevation(350, 500, _STEP_RAD, _STEP_RAD)
_LENGTH_PX = (300.0, 500.0)
_TRIALS, _LOOKED_AT, _PATIENCE = 400, 10, 40


@dataclass(frozen=True)
class LineCase:
    """Drawn lines with their true pose."""

    scan: Scan
    picks: tuple[Pick, ...]
    camera: Camera
    pose: Rigid
    sigma_px: float
    sigma_range_m: float


@cache
def _true_ranges() -> np.ndarray:
    return room_ranges(_GEOMETRY.rays.reshape(-1, 3)).reshape(_GEOMETRY.shape)


def line_case(
    seed: int,
    *,
    lines: int = 8,
    baseline_m: float = 0.5,
    sigma_px: float = 1.0,
    sigma_range_m: float = 0.015,
    slid: int = 0,
    swapped: int = 0,
    camera: Camera = ROOM_CAMERA,
) -> LineCase:
    """Return lines drawn in the room; in the photo, some are shifted along themselves, some have their ends swapped."""
    rng = np.random.default_rng([seed, lines, 77])
    way = rng.normal(size=3) * [0.3, 1.0, 0.3]
    centre = way / np.linalg.norm(way) * baseline_m
    pan = np.arctan2(centre[1], 4.0 - centre[0])
    turn = rotation_from_rotvec(rng.normal(size=3) * np.deg2rad(3)) @ rotation_from_rotvec([0, -pan, 0])
    pose = Rigid.from_centre(turn @ CAMERA_AXES_FROM_SCANNER, centre)
    scan = Scan(_GEOMETRY, _true_ranges() + rng.normal(size=_GEOMETRY.shape) * sigma_range_m, np.ones(_GEOMETRY.shape))
    picks: list[Pick] = []
    edges = _straight_edges(rng, pose, camera, lines)
    for rays, uv in edges:
        k = len(picks)
        if k < slid:  # drawn along the same edge, between other points
            along = (uv[1] - uv[0]) * rng.uniform(0.05, 0.2, (2, 1)) * [[1.0], [-1.0]]
            uv = uv + along
        uv = uv + rng.normal(size=(2, 2)) * sigma_px
        if slid <= k < slid + swapped:
            uv = uv[::-1]
        picks.append(Pick(f"L{k + 1}", "line", rays, uv))
    return LineCase(scan, tuple(picks), camera, pose, sigma_px, sigma_range_m)


def _straight_edges(
    rng: np.random.Generator, pose: Rigid, camera: Camera, lines: int
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return pairs of rays whose connecting surface is straight and entirely in the photo, with their pixels."""
    found: list[tuple[np.ndarray, np.ndarray]] = []
    s = np.linspace(0, 1, 17)[:, None]
    tries = 0
    while len(found) < lines:
        # boxes and walls alternately, so that edges are near and far; otherwise where the camera hardly sees either
        on_box = (len(found) + tries // _PATIENCE) % 2 == 1
        tries += 1
        low, high = ROOM_BOXES[rng.integers(len(ROOM_BOXES))] if on_box else ROOM_WALLS
        ends = rng.uniform(low, high, (_TRIALS, 2, 3))
        axis = int(rng.integers(3))
        ends[..., axis] = low[axis] if (on_box or axis == 2) else high[axis]  # the visible side
        uv = camera.project(pose @ ends)
        length = np.linalg.norm(uv[:, 1] - uv[:, 0], axis=1)
        fits = camera.contains(uv).all(axis=1) & (length >= _LENGTH_PX[0]) & (length <= _LENGTH_PX[1])
        for k in np.flatnonzero(fits)[:_LOOKED_AT].tolist():
            points = ends[k, 0] + s * (ends[k, 1] - ends[k, 0])
            ranges = np.linalg.norm(points, axis=1)
            rays = points / ranges[:, None]
            if np.abs(room_ranges(rays) - ranges).max() < 1e-6:
                found.append((rays[[0, -1]], uv[k]))
                tries = 0
                break
    return found
