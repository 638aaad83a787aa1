"""The self-test: synthetic photos agree with their poses, and the report with the trials."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ladarreg_core.camera import Camera
from ladarreg_core.errors import Cancelled, OptionError
from ladarreg_core.foundations.progress import Progress
from ladarreg_core.registration.self_test.report import SelfTest, self_test
from ladarreg_core.registration.self_test.synthetic_photo import random_pose, render_photo, unrelated_photo
from ladarreg_core.registration.self_test.trials import SelfTestOptions, Trial, run_trials
from ladarreg_core.surface.remap import look_up
from ladarreg_core.surface.visibility.visible_points import project_scan
from testing.scenes.painted_room import PaintedRoom, painted_room


@pytest.fixture(scope="module")
def room() -> PaintedRoom:
    return painted_room(seed=5)


def test_a_synthetic_photo_shows_the_scan_at_its_pose(room: PaintedRoom) -> None:
    rng = np.random.default_rng(0)
    camera = room.photo.camera
    pose = random_pose(room.scan, camera, rng)
    checkers = np.indices(room.scan.shape).sum(axis=0) // 12 % 2 == 0
    scan = replace(room.scan, color=np.repeat(np.where(checkers, 40, 220)[..., None], 3, axis=2).astype(np.uint8))
    made = render_photo(scan, camera, pose, rng)
    assert made.camera_from_scanner is pose
    seen = project_scan(scan, camera, pose)
    inside = seen.visible & ~seen.grazing & camera.contains(seen.uv, border=3)
    u, v = (seen.uv[inside][None, :, k] for k in (0, 1))
    shown = look_up(made.photo.pixels[..., 0].astype(np.float32), u, v)[0]
    # the tone curve may fall as well as rise, and the light differs, but the two shades differ at the right positions
    assert inside.sum() > 1000
    assert abs(np.corrcoef(shown, checkers[inside])[0, 1]) > 0.7


def test_what_the_scan_did_not_see_has_no_outline(room: PaintedRoom) -> None:
    rng = np.random.default_rng(1)
    pose = random_pose(room.scan, room.photo.camera, rng)
    made = render_photo(room.scan, room.photo.camera, pose, rng)
    assert 0.2 < made.covered <= 1
    assert made.photo.pixels.std() > 5
    assert (made.photo.pixels.reshape(-1, 3).astype(int) == 128).all(axis=1).mean() < 0.01


def test_an_unrelated_photo_has_other_pixels_and_the_same_size(room: PaintedRoom) -> None:
    for number in range(4):
        other = unrelated_photo(room.photo, number)
        assert other.camera == room.photo.camera
        assert other.pixels.shape == room.photo.pixels.shape
        assert np.abs(other.pixels.astype(int) - room.photo.pixels).mean() > 5


@pytest.mark.slow
def test_the_room_is_registered_and_unrelated_photos_are_refused(room: PaintedRoom) -> None:
    reported: list[Progress] = []
    found = self_test(
        room.scan, room.photo.camera, SelfTestOptions(photos=2, starts=1, wrong=2, seconds=300), report=reported.append
    )
    assert [len(found.of(kind)) for kind in ("right", "start", "wrong")] == [2, 1, 2]
    assert [p.done for p in reported] == list(range(5))
    assert found.accepted_wrongly == 0
    assert all(t.error_px < 1 and t.error_deg < 1 for t in found.of("right") if t.accepted)
    assert found.summary().startswith("With this scan and camera: ")


@pytest.mark.slow
def test_it_ends_in_time_and_can_be_cancelled(room: PaintedRoom) -> None:
    options = SelfTestOptions(photos=500, starts=0, wrong=0, seconds=1)
    assert 1 <= len(list(run_trials(room.scan, room.photo.camera, options))) < 20

    def stop(progress: Progress) -> None:
        raise Cancelled

    with pytest.raises(Cancelled):
        self_test(room.scan, room.photo.camera, options, report=stop)


def trial(kind: str, accepted: bool, px: float = 0.2, off: float = 0.0) -> Trial:
    return Trial(kind, accepted, px, 4 * px / 0.2, 0.06 * px / 0.2, off, 1.0)  # type: ignore[arg-type]


def test_the_summary_agrees_with_the_trials() -> None:
    good = [trial("right", True)] * 19 + [trial("right", False)]
    starts = [trial("start", off != 12, off=off) for off in (3.0, 6.0, 12.0) for _ in range(3)]
    found = SelfTest((*good, *starts, *([trial("wrong", False)] * 10)))
    assert found.summary() == (
        "With this scan and camera: 4 mm, 0.06 deg, 19 of 20 photos registered; starts up to 6 deg off "
        "work; 10 of 10 unrelated photos refused."
    )
    assert found.advice() == ""
    assert found.accepted_wrongly == 0

    astray = SelfTest((trial("right", True, px=9.0), trial("right", True), trial("wrong", True)))
    assert astray.accepted_wrongly == 2
    assert "1 of 2" in astray.summary()
    assert "0 of 1 unrelated photos refused" in astray.summary()
    assert "check every registration by eye" in astray.advice()

    blind = SelfTest(tuple([trial("right", False)] * 4))
    assert "none of 4 photos registered" in blind.summary()
    assert "rough initial pose" in blind.advice()
    assert np.isnan(blind.start_deg)


@pytest.mark.parametrize(
    "options",
    [
        {"photos": -1}, {"photos": 1.5}, {"wrong": True}, {"starts": "3"}, {"seconds": 0}, {"seconds": float("nan")},
        {"seconds": "x"}, {"seed": -1}, {"photos": 0, "starts": 0, "wrong": 0},
    ],
)  # fmt: skip
def test_options_without_meaning_are_refused(options: dict[str, object]) -> None:
    with pytest.raises(OptionError):
        SelfTestOptions(**options)  # type: ignore[arg-type]


@pytest.mark.slow
def test_a_large_camera_is_tried_at_a_smaller_size(room: PaintedRoom) -> None:
    large = Camera.from_focal(room.photo.camera.width * 12, room.photo.camera.height * 12, 12 * room.photo.camera.fx)
    options = SelfTestOptions(photos=1, starts=0, wrong=0)
    (only,) = run_trials(room.scan, large, options)
    assert only.kind == "right"
