from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ladarreg_core.frames import Rigid
from ladarreg_core.matches import Matches
from ladarreg_core.pose.cross_validation import assign_folds, choose_intrinsics, worse_when_held_out
from ladarreg_core.pose.estimate import PoseOptions, solve_pose
from ladarreg_core.pose.noise import estimate_noise
from testing.scenes.pose_case import start_near
from testing.scenes.room import ROOM_CAMERA, room_case

SIGMA = {"sigma_px": 1.0, "sigma_range_m": 0.015}


def scaled(factor):
    return replace(ROOM_CAMERA, fx=974 * factor, fy=974 * factor)


def chosen(case, given, *, stated=True, **options):
    result = solve_pose(case.matches, given, PoseOptions(intrinsics="fixed", **(SIGMA if stated else {})))

    def noise(pose, camera, inliers):
        return estimate_noise(
            pose, case.matches.subset(inliers), camera, stated_range_m=0.015, most_px=4.0, most_range_m=0.12
        )

    return choose_intrinsics(
        case.matches, given, result.camera_from_scanner, result.inliers,
        sigma_px=result.sigma_px, sigma_range_m=result.sigma_range_m, noise=None if stated else noise, **options,
    )  # fmt: skip


def rolled_back(case, start, **options):
    result = solve_pose(case.matches, case.camera, PoseOptions(intrinsics="fixed", **SIGMA), initial=start)
    return worse_when_held_out(
        case.matches, case.camera, start, result.camera_from_scanner, result.inliers, **SIGMA, **options
    )


@given(st.lists(st.sampled_from("abcdefghijklm"), min_size=1, max_size=40), st.integers(0, 99))
def test_folds_keep_picks_together_and_have_similar_sizes(ids, seed):
    group, fold = assign_folds(ids, seed=seed)
    picks = sorted(set(ids))
    of_pick = {name: {int(f) for f, other in zip(fold, ids, strict=True) if other == name} for name in picks}
    assert all(len(folds) == 1 for folds in of_pick.values())
    sizes = np.bincount([next(iter(folds)) for folds in of_pick.values()])
    assert len(sizes) == min(5, len(picks))
    assert np.ptp(sizes) <= 1
    assert len(np.unique(group)) == len(picks)
    assert (assign_folds(ids, seed=seed)[1] == fold).all()


@settings(max_examples=15)
@given(
    seed=st.integers(0, 100_000), outliers=st.floats(0, 0.5), stated=st.booleans(), count=st.sampled_from([12, 60, 200])
)
def test_a_correct_camera_is_kept(seed, outliers, stated, count):
    choice = chosen(room_case(seed, count=count, outliers=outliers), ROOM_CAMERA, stated=stated)
    assert choice.fit is None
    assert choice.intrinsics == "fixed"


@settings(max_examples=5)
@given(seed=st.integers(0, 100_000), factor=st.sampled_from([0.9, 0.97, 1.03, 1.1]), stated=st.booleans())
def test_a_wrong_focal_length_is_found(seed, factor, stated):
    case = room_case(seed, outliers=0.3)
    choice = chosen(case, scaled(factor), stated=stated)
    fit = choice.fit
    assert fit is not None
    assert abs(fit.camera.focal_px - 974) < 4.5 * fit.sigmas["focal_px"]
    assert fit.pose.distance_to(case.pose) < 0.04  # as given and fixed: .1 to .5 m
    assert fit.sigma_px == pytest.approx(1.0, rel=0.2)
    words = choice.describe()
    assert words[0].startswith(f"The focal length was estimated as 9{words[0].split(' as 9')[1][:2]}")
    assert words[0].endswith(f" px (given: {974 * factor:.1f} px).")


@pytest.mark.slow
@pytest.mark.parametrize("stated", [True, False])
def test_unstated_distortion_is_found(stated):
    positions = []
    for seed in (71, 72):
        case = room_case(seed, outliers=0.2, camera=replace(ROOM_CAMERA, distortion=(-0.1, 0.0, 0.0, 0.0)))
        choice = chosen(case, ROOM_CAMERA, stated=stated)
        assert choice.intrinsics == "focal_k1"
        assert abs(choice.fit.values["k1"] + 0.1) < 4 * choice.fit.sigmas["k1"]
        positions.append(choice.fit.pose.distance_to(case.pose))
        assert chosen(case, ROOM_CAMERA, stated=stated, most="fixed").trials == ()
    assert np.median(positions) < 0.012


def test_the_principal_point_is_estimated_only_on_request():
    true = replace(ROOM_CAMERA, cx=ROOM_CAMERA.cx + 25, distortion=(-0.1, 0.0, 0.0, 0.0))
    case = room_case(3, camera=true)
    assert chosen(case, ROOM_CAMERA).intrinsics != "focal_k1_centre"
    fit = chosen(case, ROOM_CAMERA, most="focal_k1_centre").fit
    assert fit.intrinsics == "focal_k1_centre"
    assert abs(fit.camera.cx - true.cx) < 4 * fit.sigmas["cx"]


def test_undetermined_intrinsics_are_reported_but_not_used():
    """A wall seen nearly face on shows that the focal length is wrong, but barely determines it."""
    found = set()
    for seed in range(3):
        rng = np.random.default_rng(seed)
        points = np.column_stack([rng.uniform(3.9, 4.1, 80), rng.uniform(-1, 1, 80), rng.uniform(-0.8, 0.8, 80)])
        pose = Rigid(np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]), np.array([0.2, 0.0, 0.0]))
        ranges = np.linalg.norm(points, axis=1)
        uv = ROOM_CAMERA.project(pose @ points) + rng.normal(size=(80, 2))
        matches = Matches(points / ranges[:, None], ranges, uv)
        given = scaled(1.5)
        result = solve_pose(matches, given, PoseOptions(intrinsics="fixed", **SIGMA))
        choice = choose_intrinsics(matches, given, result.camera_from_scanner, result.inliers, **SIGMA)
        if choice.fit is not None:
            assert choice.fit.determined
        found |= set(choice.describe()) if choice.fit is None else set()
    assert found
    assert all("The matches suggest other intrinsics (focal length " in words for words in found)
    assert all("kept as given" in words for words in found)


def test_duplicated_matches_do_not_change_the_camera():
    """Forty samples of each of five lines: their shared error is no evidence, however many samples there are."""
    case = room_case(29, count=5)
    rng = np.random.default_rng(0)
    uv = np.repeat(case.uv + rng.normal(size=(5, 2)) * 3, 40, axis=0)
    ids = tuple(np.repeat([f"line {k}" for k in range(5)], 40))
    matches = Matches(np.repeat(case.rays, 40, axis=0), np.repeat(case.ranges, 40), uv, ids)
    everyone = np.ones(200, dtype=np.bool_)
    choice = choose_intrinsics(matches, ROOM_CAMERA, case.pose, everyone, sigma_px=3.0, sigma_range_m=0.015)
    assert choice.fit is None


@pytest.mark.parametrize(("count", "outliers"), [(5, 0.0), (8, 0.3), (20, 0.8)])
def test_few_or_bad_matches_do_not_degrade_a_good_initial_pose(count, outliers):
    """The initial pose is off by .3 px; the matches leave .9 px, or determine nothing."""
    cases = [room_case(seed, count=count, outliers=outliers) for seed in range(500, 512)]
    back = [rolled_back(case, start_near(case, k, 0.02, 0.002)) for k, case in enumerate(cases)]
    assert np.mean(back) >= 0.7


@settings(max_examples=10)
@given(
    seed=st.integers(0, 100_000),
    matches=st.sampled_from([(8, 0.0), (20, 0.2), (200, 0.3)]),
    far=st.sampled_from([(1.0, 0.1), (3.0, 0.3), (20.0, 1.0)]),
)
def test_a_fit_to_good_matches_is_kept_for_any_initial_pose(seed, matches, far):
    case = room_case(seed, count=matches[0], outliers=matches[1])
    assert not rolled_back(case, start_near(case, seed, *far))


def test_the_initial_pose_is_kept_with_too_few_matches_to_hold_out():
    case = room_case(31, count=4)
    assert rolled_back(case, start_near(case, 1, 1.0, 0.1))
