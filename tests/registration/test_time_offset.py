"""The time offset of a rig's camera: found where the rig moves, and not claimed where it stands."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import ladarreg_core as lr
from ladarreg_core.camera import Camera
from ladarreg_core.frames import Rigid, rotation_from_rotvec
from ladarreg_core.photo import TimedPhoto
from ladarreg_core.registration.rig.time_offset import estimate_time_offset, paired_at
from testing.scenes.camera_rig import Motion, mounted, moving_rig

pytestmark = pytest.mark.timeout(1200)
CAMERA = mounted(Camera.from_focal(480, 320, 330.0), yaw_deg=3, pitch_deg=-2, centre=(0.2, 0.15, -0.1))
PERIOD, OFFSET = 0.1, 0.17
AFTER = [round(PERIOD * k, 6) for k in range(-2, 6)]
MOTIONS = [Motion(14, 1.5), Motion(-16, 2.0), Motion(10, -1.0), Motion(-8, 3.0)]


def rough() -> Rigid:
    truth = CAMERA.camera_from_scanner
    turn = rotation_from_rotvec(np.radians([0.5, -0.6, 0.4]))
    return Rigid.from_centre(turn @ truth.rotation, truth.centre + np.array([0.03, -0.03, 0.02]))


@pytest.fixture(scope="module")
def moving() -> list[lr.RigPair]:
    pytest.importorskip("embreex")
    return moving_rig(CAMERA, MOTIONS, after_s=AFTER, offset_s=OFFSET, seed=5)


@pytest.mark.long
def test_the_offset_of_a_moving_rig_is_found_and_its_pose_is_that_of_one_moment(moving: list[lr.RigPair]) -> None:
    options = lr.RigOptions(estimate_time_offset=True, candidates_per_pair=1, refined=1)
    result = lr.register_rig(moving, initial=rough(), options=options)
    offset = result.time_offset
    assert offset is not None
    assert offset.known, offset.sentence
    assert offset.sigma_s < PERIOD / 2
    assert abs(offset.seconds - OFFSET) < 3 * offset.sigma_s
    assert result.reasons[-1].startswith("Photographs are stamped +0.1")
    pose = result.camera_from_scanner
    assert pose is not None
    assert np.degrees(pose.angle_to(CAMERA.camera_from_scanner)) < 0.5


@pytest.mark.long
def test_of_a_rig_that_stands_nothing_is_claimed(moving: list[lr.RigPair]) -> None:
    still = [
        replace(pair, taken=tuple(TimedPhoto(after, pair.photo) for after in AFTER)) for pair in moving
    ]  # fmt: skip
    found = estimate_time_offset(still, [rough()])
    assert not found.known
    assert found.seconds == 0
    assert "the rig stands" in found.sentence


@pytest.mark.long
def test_an_offset_beyond_the_photographs_is_said_so(moving: list[lr.RigPair]) -> None:
    """Of photographs that were all taken too early, the last one agrees best."""
    early = [replace(pair, taken=pair.taken[:4]) for pair in moving]
    found = estimate_time_offset(early, [rough()])
    assert not found.known


def test_photographs_before_and_after_are_needed() -> None:
    scan = lr.Scan.from_points(np.random.default_rng(0).normal(size=(200, 3)) * [1, 1, 0.2] + [5, 0, 0])
    photo = lr.Photo.from_array(np.zeros((32, 48, 3), np.uint8), focal_px=40.0)
    later = lr.Photo.from_array(np.full((32, 48, 3), 9, np.uint8), focal_px=40.0)
    alone = lr.RigPair("a", scan, photo)
    assert "no photographs before and after" in estimate_time_offset([alone, alone], [rough()]).sentence
    assert paired_at(alone, 0.3) is alone
    two = lr.RigPair("b", scan, photo, taken=(TimedPhoto(0.0, photo), TimedPhoto(0.1, later)))
    assert paired_at(two, 0.08).photo is later
    assert "too few photographs" in estimate_time_offset([two, two], [rough()]).sentence
