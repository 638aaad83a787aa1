"""Viewing directions from the scanner, and how densely a scan samples a photo."""

from __future__ import annotations

import numpy as np
import pytest

import ladarreg_core as lr
from ladarreg_core.frames import look_along, rotation_from_rotvec
from ladarreg_core.matching.images.views import (
    MIN_RETURNS_IN_PHOTO,
    direction_towards_overlap,
    scan_density,
    viewing_directions,
)
from ladarreg_core.registration.register import register
from ladarreg_core.scanner.grids import PinholeGrid
from ladarreg_core.surface.perspective import perspective_view
from testing.scenes.painted_room import PaintedRoom, painted_room
from testing.scenes.thinned_scan import thinned


@pytest.fixture(scope="module")
def room() -> PaintedRoom:
    return painted_room(seed=3)


def test_cells_without_rays_are_ignored(room: PaintedRoom) -> None:
    lens = lr.Camera(width=50, height=40, fx=50, fy=50, cx=25, cy=20, distortion=(-2.0, 0, 0, 0))
    scan = lr.Scan(PinholeGrid(lens), np.full((40, 50), 3.0), np.ones((40, 50)))
    assert len(viewing_directions(scan, lr.Camera.from_focal(100, 80, 90.0))) >= 1
    # A view without any cell is empty, not undefined.
    away = lr.Rigid(look_along(np.array([-1.0, 0.0, 0.0])), np.zeros(3))
    view = perspective_view(scan, lr.Camera.from_focal(64, 48, 90.0), view_from_scanner=away)
    assert np.isfinite(view.cells).all()
    assert not view.inside.any()


def test_the_view_is_directed_at_the_overlap(room: PaintedRoom) -> None:
    camera = lr.Camera.from_focal(160, 120, 520.0)
    rolled_view = rotation_from_rotvec([0, 0, 1.2]) @ look_along(np.array([1.0, 0.15, 0.0]))
    pose = lr.Rigid.from_centre(rolled_view, np.array([0.0, 0.9, 0.0]))
    turn = viewing_directions(room.scan, camera, initial=pose)[0]
    np.testing.assert_allclose(turn.translation, 0)
    points = room.scan.points[room.scan.valid].astype(float)
    seen = points[camera.contains(camera.project(pose @ points))]
    view = perspective_view(room.scan, camera, view_from_scanner=turn)
    assert camera.contains(view.project(seen)).mean() > 0.8
    assert direction_towards_overlap(room.scan, camera, pose, view=view) is None
    along_axis = perspective_view(room.scan, camera, view_from_scanner=lr.Rigid(rolled_view, np.zeros(3)))
    assert camera.contains(along_axis.project(seen)).mean() < 0.5
    again = direction_towards_overlap(room.scan, camera, pose, view=along_axis)
    assert again is not None
    np.testing.assert_allclose(again.rotation, turn.rotation)
    assert abs(again.rotation[0] @ rolled_view[1]) < 1e-6  # the roll is that of the photo
    away = lr.Rigid(np.diag([-1.0, 1.0, -1.0]) @ rolled_view, np.zeros(3))
    assert direction_towards_overlap(room.scan, camera, away) is None


@pytest.mark.parametrize("start", ["none", pytest.param("truth", marks=pytest.mark.long)])
@pytest.mark.slow
def test_a_sparse_scan_is_refused_for_that_reason(room: PaintedRoom, start: str) -> None:
    sparse = thinned(room.scan, 10)
    result = register(sparse, room.photo, initial=room.camera_from_scanner if start == "truth" else None)
    assert not result.accepted
    assert result.reasons[0].startswith("The scan is too sparse for this photo: 1 point per "), result.reasons


@pytest.mark.parametrize("step", [1, 2, 5])
def test_density_counts_the_returns_in_the_image(room: PaintedRoom, step: int) -> None:
    scan, camera = thinned(room.scan, step), room.photo.camera
    behind = lr.Rigid(np.diag([-1.0, 1.0, -1.0]) @ room.camera_from_scanner.rotation, np.zeros(3))
    density = scan_density(scan, camera, [behind, room.camera_from_scanner])
    assert density is not None
    uv = camera.project(room.camera_from_scanner @ scan.points[scan.valid].astype(float))
    assert density.points == int(camera.contains(uv).sum())
    assert density.too_sparse == (density.points < MIN_RETURNS_IN_PHOTO)
    assert scan_density(scan, camera, [behind]) is None
