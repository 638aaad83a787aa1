"""Initial poses without matched corners, from the correlation of the whole image."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from ladarreg_core.frames import Rigid, rotation_from_rotvec
from ladarreg_core.matching.images.photo_levels import PhotoLevels, photo_levels, working_camera
from ladarreg_core.matching.images.scan_levels import ScanLevels, scan_levels
from ladarreg_core.matching.search.grid_search import MAX_STARTS, likely_poses
from ladarreg_core.surface.perspective import perspective_view
from testing.scenes.painted_room import PaintedRoom, painted_room

_BASIN_PX = 40.0


SEEN = {21: 0.2, 22: 0.6, 23: 0.4}
"""Baselines, m, by the seed of the room."""


@cache
def room_of(seed: int) -> PaintedRoom:
    return painted_room(seed, baseline_m=SEEN[seed])


@cache
def levels_of(seed: int) -> tuple[ScanLevels, PhotoLevels]:
    room = room_of(seed)
    working = working_camera(room.scan, room.photo.camera)
    return scan_levels(room.scan, perspective_view(room.scan, working)), photo_levels(room.photo, working)


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEN)
def test_the_best_pose_lies_in_the_basin(seed: int) -> None:
    room = room_of(seed)
    found = likely_poses(*levels_of(seed))
    assert 1 <= len(found) <= MAX_STARTS
    assert room.error_px(found[0].camera_from_scanner) < _BASIN_PX
    assert [place.score for place in found] == sorted((place.score for place in found), reverse=True)


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEN)
def test_search_around_an_initial_pose(seed: int) -> None:
    room = room_of(seed)
    rng = np.random.default_rng(seed)
    turn, shift = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    truth = room.camera_from_scanner
    angle, distance = np.deg2rad(rng.uniform(3, 5)), rng.uniform(0.2, 0.35)
    rough = Rigid.from_centre(rotation_from_rotvec(angle * turn) @ truth.rotation, truth.centre + distance * shift)
    found = likely_poses(*levels_of(seed), around=rough)
    errors = [room.error_px(place.camera_from_scanner) for place in found]
    assert min(errors[:2]) < _BASIN_PX, errors
    assert all(np.degrees(place.camera_from_scanner.angle_to(rough)) < 15 for place in found)


def test_starts_lie_in_different_basins() -> None:
    room = room_of(22)
    found = likely_poses(*levels_of(22))
    points = room.scan.points[room.scan.valid][::97].astype(float)
    pixels = [room.photo.camera.project(place.camera_from_scanner @ points) for place in found]
    for k, one in enumerate(pixels):
        for other in pixels[:k]:
            assert np.nanmedian(np.hypot(*(one - other).T)) > 10


def test_equal_inputs_give_equal_poses() -> None:
    one, other = (likely_poses(*levels_of(23)) for _ in "ab")
    assert [p.camera_from_scanner.matrix.tobytes() for p in one] == [
        p.camera_from_scanner.matrix.tobytes() for p in other
    ]


def test_a_view_without_returns_gives_no_pose() -> None:
    scan, photo = levels_of(21)
    empty = replace(scan, ranges=np.full_like(scan.ranges, np.nan))
    assert likely_poses(empty, photo) == []
    behind = Rigid(rotation_from_rotvec([0, np.pi, 0]) @ scan.view.view_from_scanner.rotation, np.zeros(3))
    assert likely_poses(scan, photo, around=behind) == []
