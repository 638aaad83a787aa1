"""The bench: measurements from the true position of the unit, noise by key, the motion by time."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

pytest.importorskip("embreex", reason="the simulator needs the extra `simulate`")

from ladarreg_core.acquisition.interfaces import PanTilt
from ladarreg_core.acquisition.simulated.world import Angles, Bench
from ladarreg_core.camera import Camera
from ladarreg_core.errors import OptionError
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.frames import Rigid
from ladarreg_core.scanner.grids import AzimuthElevation, PinholeGrid
from ladarreg_core.scanner.pan_tilt import pan_tilt_pose, rays_of_line
from ladarreg_core.simulate.ray_cast import RayCaster
from ladarreg_core.simulate.terrestrial import RangeNoise, echoes_along

ANGLES = np.radians(np.linspace(-135, 135, 541))
STATION = Rigid.from_rotvec([0, 0, 0.7], [0.4, -0.3, 0.1])
HERE = PanTilt(0.9, -0.2)
QUIET = RangeNoise(sigma_m=0.0, resolution_m=1e-5)


@cache
def bench() -> Bench:
    return Bench("boxes", 1, room_from_world=STATION, noise=QUIET)


def seen_from_room(points: FloatArray) -> FloatArray:
    """Return by how much surfaces seen from the room's origin are nearer than points (N, 3) of the room."""
    world, length = bench().room, np.linalg.norm(points, axis=-1)
    _, ranges = echoes_along(world, RayCaster(world.triangles), np.zeros_like(points), points / length[:, None])
    return np.asarray(length - ranges)


def lies_on_surfaces(points_room: FloatArray) -> bool:
    # Other surfaces may hide a point, but nothing may be seen through the one that it lies on.
    nearer = seen_from_room(points_room)
    return bool((nearer > -1e-3).all() and (np.abs(nearer) < 1e-3).mean() > 0.7)


def test_points_of_a_line_lie_on_the_surfaces_of_the_room() -> None:
    ranges, _ = bench().scan_line(HERE, ANGLES, noise_key=(0,))
    kept = np.isfinite(ranges)
    pose = STATION @ pan_tilt_pose(HERE.pan_rad, HERE.tilt_rad, unit_from_scanner=bench().mount)
    points = pose @ (rays_of_line(ANGLES) * ranges[:, None])[kept]
    assert kept.mean() > 0.9
    assert lies_on_surfaces(points)
    assert not lies_on_surfaces((STATION @ pan_tilt_pose(HERE.pan_rad, HERE.tilt_rad)) @ (STATION.inverse @ points))


def test_points_of_a_frame_lie_on_the_surfaces_of_the_room() -> None:
    b, geometry = bench(), AzimuthElevation(60, 90, 0.01, 0.01)
    scan = b.scan_frame(HERE, geometry, noise_key=(0,))
    points = (STATION @ b.frame_pose(HERE)) @ (geometry.rays * scan.ranges[..., None]).reshape(-1, 3)
    assert lies_on_surfaces(points[np.isfinite(points[:, 0])])


def test_every_ray_of_a_moving_line_is_measured_from_its_own_position() -> None:
    pan, tilt = np.linspace(0, 1, len(ANGLES)), np.linspace(-0.3, 0.3, len(ANGLES))
    moving = bench().true_line((pan, tilt), ANGLES)
    for k in (0, 200, 540):
        alone = bench().true_line(PanTilt(float(pan[k]), float(tilt[k])), ANGLES[k : k + 1])
        assert moving[k] == pytest.approx(alone[0], abs=1e-5)


@pytest.mark.slow
def test_the_noise_depends_on_seed_and_key_alone() -> None:
    noisy = [Bench("boxes", 1), Bench("boxes", 1, clock=lambda: 1e6)]
    lines = [b.scan_line(HERE, ANGLES, noise_key=(-3, 4)) for b in noisy]
    assert np.array_equal(lines[0], lines[1], equal_nan=True)
    other, _ = noisy[0].scan_line(HERE, ANGLES, noise_key=(-3, 5))
    error = other - lines[0][0]
    assert 0.001 < np.nanstd(error[np.abs(error) < 0.05]) < 0.01
    assert not np.array_equal(Bench("boxes", 2).mount.matrix, noisy[0].mount.matrix)


def test_the_motion_that_was_published_for_a_time_stays() -> None:
    now = [0.0]
    b = Bench("boxes", 1, clock=lambda: now[0])

    def turning(times: FloatArray) -> Angles:
        return np.minimum(times, 2.0), 0 * times

    assert b.pose_at(-5.0) == PanTilt(0.0, 0.0)
    b.publish_motion(turning, from_s=0.0, rest_s=2.0)
    assert b.moving
    now[0] = 1.0
    b.place_unit(PanTilt(1.0, 0.1))  # halted
    assert not b.moving
    pan, tilt = b.angles_at([0.5, 0.99, 1.0, 7.0])
    assert pan == pytest.approx([0.5, 0.99, 1.0, 1.0])
    assert tilt == pytest.approx([0, 0, 0.1, 0.1])


def test_a_photograph_is_taken_from_the_camera_on_the_unit() -> None:
    b, camera = bench(), Camera.from_focal(64, 48, 50.0)
    picture = b.photograph(HERE, camera, noise_key=(1,))
    assert picture.shape == (48, 64, 3)
    assert picture.std() > 10
    assert np.array_equal(picture, b.photograph(HERE, camera, noise_key=(1,)))
    scan = b.scan_frame(HERE, PinholeGrid(camera), noise_key=(1,))
    assert np.isfinite(scan.ranges).mean() > 0.9


def test_an_unknown_scene_is_refused() -> None:
    with pytest.raises(OptionError, match="scene"):
        Bench("moon", 1)
