"""Photos that fit more than one pose: repeated patterns, repeated walls, and scenes that do not repeat."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import pytest

import ladarreg_core as lr
from ladarreg_core.frames import Rigid, look_along, rotation_about, rotation_from_rotvec
from ladarreg_core.matching.auto_options import AutoOptions
from ladarreg_core.matching.search.ambiguity import KnownPoses, ambiguity_sentence
from ladarreg_core.matching.verify.verification import GateOptions
from ladarreg_core.registration.register import RegisterOptions, register
from ladarreg_core.scanner.grids import AzimuthElevation
from ladarreg_core.surface.remap import look_up
from testing.scenes.kept import kept
from testing.scenes.painted_room import PaintedRoom, painted_room, paintings
from testing.scenes.panorama import Panorama, panorama

_WALL_M = 4.0
_DOOR_M = 0.8
_DOOR_DEPTH_M = 0.15
_PIXELS_A_METRE = 190.0


@dataclass(frozen=True)
class Wall:
    """A wall as seen by a scanner and a camera."""

    scan: lr.Scan
    photo: lr.Photo
    camera_from_scanner: lr.Rigid

    def error_px(self, pose: lr.Rigid) -> float:
        """Median displacement of the wall in the photo."""
        points = self.scan.points[self.scan.valid][::23].astype(float)
        true = self.photo.camera.project(self.camera_from_scanner @ points)
        off = np.hypot(*(true - self.photo.camera.project(pose @ points))[self.photo.camera.contains(true)].T)
        return float(np.median(off))


@kept
def wall(seed: int, *, period_m: float, doors: str = "none") -> Wall:
    """Make a wall painted the same every `period_m`; with `doors` it has a recess in each period."""
    picture = paintings(seed)
    rng = np.random.default_rng(seed)

    def seen(origin: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        distance = (_WALL_M - origin[0]) / rays[:, 0]
        y = origin[1] + distance * rays[:, 1]
        if doors == "recessed":
            behind = (_WALL_M + _DOOR_DEPTH_M - origin[0]) / rays[:, 0]
            open_at = np.mod(origin[1] + behind * rays[:, 1], period_m) < _DOOR_M
            distance = np.where((np.mod(y, period_m) < _DOOR_M) & open_at, behind, distance)
            y = origin[1] + distance * rays[:, 1]
        z = origin[2] + distance * rays[:, 2]
        at = np.stack([np.mod(y, period_m), z + 2.5], axis=-1) * _PIXELS_A_METRE
        color = look_up(picture, at[:, :1].astype(np.float32), at[:, 1:].astype(np.float32))[:, 0]
        return distance, color

    geometry = AzimuthElevation(260, 440, np.deg2rad(0.11), np.deg2rad(0.11))
    distance, color = seen(np.zeros(3), geometry.rays.reshape(-1, 3))
    ranges = distance + rng.normal(0, 0.003, len(distance))
    laser = color[:, 0] * (1 + rng.normal(0, 0.05, len(color))) * (2.5 / distance) ** 2
    scan = lr.Scan(geometry, ranges.reshape(geometry.shape), laser.reshape(geometry.shape))
    centre = np.array([0.1, -0.3, 0.05])
    pose = lr.Rigid.from_centre(look_along(np.array([4.0, 0.1, 0.0]) - centre), centre)
    camera = lr.Camera.from_focal(480, 340, 700.0)
    v, u = np.mgrid[:680, :960]
    uv = (np.stack([u, v], axis=-1).reshape(-1, 2) + 0.5) / 2 - 0.5
    _, color = seen(centre, camera.unproject(uv) @ pose.rotation)
    fine = cv2.resize(color.reshape(680, 960, 3), (480, 340), interpolation=cv2.INTER_AREA)
    fine = np.clip(fine + rng.normal(0, 0.01, fine.shape), 0, 1)
    return Wall(scan, lr.Photo((255 * fine ** (1 / 2.2)).astype(np.uint8), camera), pose)


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "period_m", "doors"), [(1, 0.7, "none"), (2, 1.1, "recessed")])
def test_a_wall_that_repeats_is_ambiguous(seed: int, period_m: float, doors: str) -> None:
    made = wall(seed, period_m=period_m, doors=doors)
    result = register(made.scan, made.photo)
    assert not result.accepted
    assert "ambiguous" in result.reasons[0], result.reasons
    assert [step.detail["found"] for step in result.steps if step.name == "second minimum"] == [True]


def test_an_initial_pose_selects_the_repetition() -> None:
    made = wall(1, period_m=0.7)
    truth = made.camera_from_scanner
    result = register(made.scan, made.photo, initial=lr.Rigid(truth.rotation, truth.translation + 0.02))
    assert result.accepted, result.reasons
    assert made.error_px(result.camera_from_scanner) < 1


def test_thresholds_of_the_search_for_a_second_pose_decide() -> None:
    made = wall(1, period_m=0.7)
    unlike = RegisterOptions(auto=AutoOptions(gate=GateOptions(second_correlation=10.0)))
    assert register(made.scan, made.photo, options=unlike).accepted
    truth = made.camera_from_scanner
    near = lr.Rigid(truth.rotation, truth.translation + 0.02)
    never_sure = RegisterOptions(auto=AutoOptions(gate=GateOptions(sure_fraction=1.1)))
    assert not register(made.scan, made.photo, initial=near, options=never_sure).accepted


def test_a_wall_that_does_not_repeat_has_no_second_minimum() -> None:
    made = wall(1, period_m=5.2)
    result = register(made.scan, made.photo)
    assert [step.detail["found"] for step in result.steps if step.name == "second minimum"] == [False]
    assert result.accepted, result.reasons
    assert made.error_px(result.camera_from_scanner) < 1


@pytest.fixture(scope="module")
def repeating() -> Panorama:
    return panorama((3, 3, 3))


@pytest.mark.slow
def test_a_photo_of_repeating_walls_is_not_accepted(repeating: Panorama) -> None:
    result = lr.register(repeating.scan, repeating.photo)
    assert not result.accepted
    assert result.evidence == "none"
    assert any("ambiguous" in reason for reason in result.reasons), result.reasons


def test_an_initial_pose_selects_one_of_similar_walls(repeating: Panorama) -> None:
    truth = repeating.camera_from_scanner
    rough = Rigid(rotation_from_rotvec([0.01, 0.03, -0.01]) @ truth.rotation, truth.translation + 0.05)
    result = lr.register(repeating.scan, repeating.photo, initial=rough)
    assert result.accepted, result.reasons
    assert repeating.error_px(result.camera_from_scanner) < 1


@pytest.mark.slow
def test_different_walls_are_distinguished() -> None:
    made = panorama((3, 4, 5))
    result = lr.register(made.scan, made.photo)
    assert result.accepted, result.reasons
    assert made.error_px(result.camera_from_scanner) < 1
    views = [step.detail["view"] for step in result.steps if step.name == "channels"]
    assert len(views) >= 3


@pytest.fixture(scope="module")
def room() -> PaintedRoom:
    return painted_room(seed=2)


def test_known_poses_distinguish_equal_and_different_poses(room: PaintedRoom) -> None:
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


def test_the_sentence_states_distance_and_angle() -> None:
    first = Rigid.identity()
    second = Rigid.from_centre(rotation_about("z", np.deg2rad(60)), [0.3, 0.4, 0.0])
    assert "0.50 m and 60.0 deg" in ambiguity_sentence(first, second)
