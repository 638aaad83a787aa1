"""A photo that fits two places of a scan is never accepted, and one that fits a single place of it is."""

from __future__ import annotations

import numpy as np
import pytest

import ladarreg_core as lr
from ladarreg_core.frames import Rigid, rotation_about, rotation_from_rotvec
from ladarreg_core.matching.ambiguity import KnownPoses, ambiguity_sentence
from tests.scenes.painted_room import PaintedRoom, painted_room
from tests.scenes.panorama import Panorama, panorama


@pytest.fixture(scope="module")
def repeating() -> Panorama:
    return panorama((3, 3, 3))


def test_a_photo_of_repeating_walls_is_not_accepted(repeating: Panorama) -> None:
    result = lr.register(repeating.scan, repeating.photo)
    assert not result.accepted
    assert result.evidence == "none"
    assert any("ambiguous" in reason for reason in result.reasons), result.reasons


def test_a_rough_pose_tells_which_of_alike_places_is_meant(repeating: Panorama) -> None:
    truth = repeating.camera_from_scanner
    rough = Rigid(rotation_from_rotvec([0.01, 0.03, -0.01]) @ truth.rotation, truth.translation + 0.05)
    result = lr.register(repeating.scan, repeating.photo, initial=rough)
    assert result.accepted, result.reasons
    assert repeating.error_px(result.camera_from_scanner) < 1


def test_walls_that_differ_are_told_apart() -> None:
    made = panorama((3, 4, 5))
    result = lr.register(made.scan, made.photo)
    assert result.accepted, result.reasons
    assert made.error_px(result.camera_from_scanner) < 1
    views = [step.detail["view"] for step in result.steps if step.name == "channels"]
    assert len(views) >= 3


@pytest.fixture(scope="module")
def room() -> PaintedRoom:
    return painted_room(seed=2)


def test_the_same_place_is_kept_once_and_others_are_told(room: PaintedRoom) -> None:
    places, pose = KnownPoses(room.scan, room.photo.camera), room.camera_from_scanner
    assert not places
    assert not places.covers_start(pose)
    places.add(pose)
    near = Rigid(rotation_from_rotvec([0.002, 0.003, 0.001]) @ pose.rotation, pose.translation)
    off = Rigid(rotation_from_rotvec([0.0, 0.03, 0.0]) @ pose.rotation, pose.translation)
    away = Rigid(rotation_from_rotvec([0.0, 0.2, 0.0]) @ pose.rotation, pose.translation)
    behind = Rigid(rotation_about("y", np.pi) @ pose.rotation, pose.translation)
    assert places.different_from(near) is None
    assert places.covers_start(off)
    assert places.different_from(off) is pose
    for elsewhere in (away, behind):
        assert not places.covers_start(elsewhere)
        assert places.different_from(elsewhere) is pose


def test_the_words_say_how_far_apart() -> None:
    first = Rigid.identity()
    second = Rigid.from_centre(rotation_about("z", np.deg2rad(60)), [0.3, 0.4, 0.0])
    assert "0.50 m and 60.0 deg" in ambiguity_sentence(first, second)
