"""What a run shows while it goes on: each point once, where it was measured, and no more than can be drawn."""

from __future__ import annotations

import numpy as np

from ladarreg_core.acquisition.line_sweep import LineSweep
from ladarreg_core.acquisition.mount_fields import base_from_value
from ladarreg_core.acquisition.runs.preview import RunPreview
from ladarreg_core.frames import Rigid
from testing.scenes.box_room import MOUNT, stop_and_go


def line(pan_deg: float, rays: int = 2000) -> LineSweep:
    """A level line of a round wall two metres away, brighter to the left."""
    angles = np.linspace(-1, 1, rays)
    light = (100 + 50 * angles).astype(np.float32)
    return LineSweep(
        np.full((1, rays), 2, np.float32), light[None], angles, np.full(1, np.radians(pan_deg)), np.zeros(1)
    )


def test_every_point_comes_once_where_it_was_measured() -> None:
    preview = RunPreview(Rigid.identity(), Rigid.identity(), pieces=400)
    points, gray = preview.take_points()
    assert points.shape == (0, 3)
    total = 0
    for number in range(400):
        preview.add(line(0.2 * number))
        if number % 7 == 0:
            points, gray = preview.take_points()
            total += len(points)
            np.testing.assert_allclose(np.linalg.norm(points, axis=1), 2, rtol=1e-5)
            assert gray.shape == (len(points),)
            assert gray[-1] > gray[-len(points) // 7 if number else 0]  # left is brighter
            azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
            assert abs(azimuth.max() - (np.degrees(1) + 0.2 * number)) < 0.3
    total += len(preview.take_points()[0])
    assert 150_000 < total <= 200_000
    assert preview.take_points()[0].shape == (0, 3)


def test_the_picture_shows_what_was_seen_with_the_left_at_the_left() -> None:
    preview = RunPreview(Rigid.identity(), Rigid.identity(), pieces=1)
    assert not preview.picture().any()
    preview.add(line(0))
    picture = preview.picture()
    level = picture[180]
    assert picture.shape == (360, 720)
    assert level[720 // 2 - 100] > level[720 // 2 + 100] > 0
    assert not level[:200].any()


def test_what_a_hanging_unit_measures_is_shown_upright() -> None:
    sweep = stop_and_go(np.radians(np.arange(-40.0, 41.0, 2.0)))
    clouds = []
    for base in ("upright", "hanging"):
        preview = RunPreview(MOUNT, base_from_value(base), pieces=1)
        preview.add(sweep)
        clouds.append(preview.take_points()[0])
    np.testing.assert_allclose(clouds[1], clouds[0] * [1, -1, -1], atol=1e-6)
