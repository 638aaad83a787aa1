"""Warnings of the failures of thesis 3.4, and none for good matches."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ladarreg_core.camera import Camera
from ladarreg_core.errors import CameraError, OptionError
from ladarreg_core.frames import Rigid, rotation_about
from ladarreg_core.matches import Matches
from ladarreg_core.quality.stereo_limits import stereo_cautions
from ladarreg_core.thesis.estimators.starts import picture_roll
from ladarreg_core.thesis.estimators.stereo import StereoPairs
from testing.scenes.room import room_case

BIG = Camera.from_focal(1400, 1400, 974.0)
SAME_POSITION, AHEAD, ROLLED = "same position", "hardly beside", "rolled"


def warnings(case, **options) -> str:
    return " | ".join(stereo_cautions(case.matches, case.camera, **options))


def rolled(seed: int, roll_rad: float, *, outliers: float = 0.0, baseline_m: float = 0.8):
    """A room case whose camera is rolled about its optical axis, clockwise for positive angles."""
    case = room_case(seed, count=60, baseline_m=baseline_m, outliers=outliers)
    R = rotation_about("z", roll_rad).T
    pose = Rigid(R @ case.pose.rotation, R @ case.pose.translation)
    rng = np.random.default_rng(seed)
    uv = BIG.project(pose @ case.matches.points) + rng.normal(size=(60, 2))
    uv[~case.true] = rng.uniform(0, 1399, (int((~case.true).sum()), 2))
    return Matches(case.rays, case.ranges, uv), pose


@pytest.mark.parametrize("outliers", [0.0, 0.3])
def test_a_good_case_has_no_warning(outliers):
    for seed in range(600, 610):
        case = room_case(seed, outliers=outliers, baseline_m=0.7, direction=(0.2, 1.0, -0.3))
        assert warnings(case) == ""
        assert warnings(case, pose=case.pose) == ""


@pytest.mark.parametrize("outliers", [0.0, 0.3])
@pytest.mark.parametrize("baseline_m", [0.0, 0.05])
def test_a_zero_baseline_is_recognised(baseline_m, outliers):
    for seed in range(620, 628):
        case = room_case(seed, baseline_m=baseline_m, outliers=outliers)
        assert SAME_POSITION in warnings(case)
        assert SAME_POSITION in warnings(case, pose=case.pose)
        assert "robust" in warnings(case)


def test_a_larger_noise_needs_a_larger_baseline():
    case = room_case(630, baseline_m=0.5, direction=(0, 1, 0))
    assert warnings(case, pose=case.pose, sigma_px=1.0) == ""
    assert SAME_POSITION in warnings(case, pose=case.pose, sigma_px=5.0)


def test_a_forward_step_is_no_baseline():
    case = room_case(631, baseline_m=0.6, direction=(1, 0.1, 0))
    assert AHEAD in warnings(case)
    assert "in front of" in warnings(case)
    assert "behind" in warnings(room_case(632, baseline_m=0.6, direction=(-1, 0.1, 0)))


@given(seed=st.integers(0, 10_000), roll=st.floats(-np.pi, np.pi), outliers=st.sampled_from([0.0, 0.3]))
@settings(max_examples=40)
def test_the_roll_is_estimated_from_the_matches(seed, roll, outliers):
    matches, pose = rolled(seed, roll, outliers=outliers)
    pairs = StereoPairs.of(matches, BIG)
    true = pairs.parameters(pose)[5]
    found = picture_roll(pairs.laser, pairs.color, pairs.depth)
    assert found is not None
    assert abs(np.angle(np.exp(1j * (found - true)))) < np.deg2rad(15)


@pytest.mark.parametrize("outliers", [0.0, 0.3])
def test_a_large_roll_is_reported_and_a_small_one_is_not(outliers):
    for seed in range(640, 646):
        for degrees in (-90, -35, 0, 5, 35, 90, 180):
            matches, pose = rolled(seed, np.deg2rad(degrees), outliers=outliers)
            for known in (None, pose):
                text = " | ".join(stereo_cautions(matches, BIG, pose=known))
                assert (ROLLED in text) == (abs(degrees) > 20), (seed, degrees, text)
    assert "deg clockwise" in " ".join(stereo_cautions(rolled(640, 0.6)[0], BIG))


def test_the_roll_refers_to_the_view():
    matches, pose = rolled(650, np.deg2rad(90))
    turned_view = Rigid(pose.rotation, np.zeros(3))
    assert ROLLED not in " | ".join(stereo_cautions(matches, BIG, view_from_scanner=turned_view))
    upright, _ = rolled(650, 0.0)
    assert ROLLED in " | ".join(stereo_cautions(upright, BIG, view_from_scanner=turned_view))


def test_random_matches_have_no_roll():
    rng = np.random.default_rng(0)
    xy = rng.uniform(-0.5, 0.5, (2, 2, 100))
    assert picture_roll(xy[0], xy[1], rng.uniform(2, 6, 100)) is None
    assert picture_roll(xy[0, :, :3], xy[1, :, :3], np.ones(3)) is None
    same = np.zeros((2, 30))
    assert picture_roll(same, same, np.ones(30)) is None


def test_few_clustered_and_flat_matches_are_reported():
    case = room_case(660, direction=(0, 1, 0))
    assert "range: 8" in " ".join(stereo_cautions(case.matches.subset(np.arange(8)), case.camera))
    near = np.linalg.norm(case.uv - [384, 256], axis=1) < 90
    assert "cover only" in " ".join(stereo_cautions(case.matches.subset(near), case.camera))
    rng = np.random.default_rng(0)
    wall = np.column_stack([np.full(60, 4.0), *rng.uniform(-1.2, 1.2, (2, 60))])
    ranges = np.linalg.norm(wall, axis=1)
    flat = Matches(wall / ranges[:, None], ranges, case.camera.project(case.pose @ wall))
    assert "near one plane" in " ".join(stereo_cautions(flat, case.camera))


def test_empty_and_invalid_input():
    case = room_case(670, count=40)
    empty = Matches.none()
    assert "range: 0" in stereo_cautions(empty, case.camera)[0]
    ranges, uv = case.ranges.copy(), case.uv.copy()
    ranges[:3], uv[3:6] = [np.nan, -1.0, np.inf], np.nan
    assert stereo_cautions(Matches(case.rays, ranges, uv), case.camera, pose=case.pose) == stereo_cautions(
        case.matches.subset(np.arange(6, 40)), case.camera, pose=case.pose
    )
    copies = case.matches.subset(np.zeros(40, int))
    assert all("\n" not in line for line in stereo_cautions(copies, case.camera))
    behind = Matches(-case.rays, case.ranges, case.uv)
    assert all("\n" not in line for line in stereo_cautions(behind, case.camera))
    for sigma in (0.0, np.nan, True, "1"):
        with pytest.raises(OptionError, match="sigma_px"):
            stereo_cautions(case.matches, case.camera, sigma_px=sigma)
    with pytest.raises(CameraError):
        stereo_cautions(case.matches, None)
    with pytest.raises(OptionError, match="pose"):
        stereo_cautions(case.matches, case.camera, pose=np.eye(4))
