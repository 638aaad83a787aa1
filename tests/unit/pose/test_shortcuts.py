"""Shortcuts of the estimator give what the plain computation gives."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest

from ladarreg_core.camera import Camera
from ladarreg_core.foundations.arrays import median
from ladarreg_core.matches import Matches
from ladarreg_core.pose import noise
from ladarreg_core.pose.acceptance import DEFAULT_ACCEPTANCE, count_distinct, find_critical_match
from ladarreg_core.pose.estimators import intrinsics
from ladarreg_core.pose.estimators.bundle import (
    Descent,
    Evaluation,
    States,
    adjust_ranges,
    information_matrix,
    rotations_from_rotvecs,
)
from ladarreg_core.pose.estimators.gnc import geman_mcclure
from ladarreg_core.pose.estimators.measurements import Measurements
from testing.scenes.pose_case import start_near
from testing.scenes.room import ROOM_CAMERA, room_case

BARREL = Camera(768, 512, 700.0, 710.0, 383.5, 255.5, (-0.28, 0.11, 1e-3, -7e-4, 0.0))


@pytest.mark.parametrize("count", [1, 2, 3, 8, 141])
def test_the_median_is_that_of_numpy(count: int) -> None:
    values = np.random.default_rng(count).normal(size=count)
    before = values.copy()
    assert median(values) == np.median(values)
    assert (values == before).all()


@pytest.mark.parametrize("camera", [ROOM_CAMERA, BARREL], ids=["ideal", "barrel"])
def test_measurements_with_other_noise_are_those_made_with_it(camera: Camera) -> None:
    case = room_case(0, count=30, camera=camera)
    rng = np.random.default_rng(1)
    m = case.matches
    weighted = Matches(
        m.rays, m.ranges, m.uv, weights=rng.uniform(0.1, 3, 30), range_weights=rng.uniform(0.1, 3, 30),
        directions=np.tile([0.6, 0.8], (30, 1)), across=rng.random(30) < 0.5,
    )  # fmt: skip
    made = Measurements.of(weighted, camera, sigma_px=2.0, sigma_range_m=0.4)  # some ranges reach their lower bound
    scaled = Measurements.of(weighted, camera, sigma_px=0.5, sigma_range_m=0.01).with_noise(
        px_factor=4.0, range_factor=40.0
    )
    assert made.correlated
    assert scaled.correlated
    for each in fields(Measurements):
        if each.name not in ("fronts", "correlated"):
            np.testing.assert_allclose(getattr(scaled, each.name), getattr(made, each.name), rtol=1e-12)


def test_an_undistorted_camera_needs_no_undistortion() -> None:
    """The tangents by division are those by the general way, here of a distortion too small to matter."""
    case = room_case(3, count=40)
    c = case.camera
    almost = Camera(c.width, c.height, c.fx, c.fy, c.cx, c.cy, (1e-14, 0.0, 0.0, 0.0))
    plain, general = (Measurements.of(case.matches, k, sigma_px=1.0, sigma_range_m=0.01) for k in (c, almost))
    assert not plain.correlated
    np.testing.assert_allclose(plain.xy, general.xy, atol=1e-12)
    np.testing.assert_allclose(plain.information, general.information, rtol=1e-10)


def test_one_state_moves_as_it_does_among_others() -> None:
    """A step of one state, whose small matrices are made of Python's numbers, is that of a batch."""
    case = room_case(5, count=60)
    measured = Measurements.of(case.matches, case.camera, sigma_px=1.0, sigma_range_m=0.015)
    starts = [start_near(case, seed, 10.0, 0.5) for seed in range(3)]
    batch = Descent.start(measured, States.of(starts, measured))
    alone = [Descent.start(measured, States.of([start], measured)) for start in starts]
    cost = geman_mcclure(50.0)
    for _ in range(6):
        for descent in (batch, *alone):
            descent.step(cost)
    for k, descent in enumerate(alone):
        np.testing.assert_allclose(descent.states.rotations[0], batch.states.rotations[k], atol=1e-9)
        np.testing.assert_allclose(descent.states.centres[0], batch.states.centres[k], atol=1e-9)
        np.testing.assert_allclose(descent.damping[0], batch.damping[k])


@pytest.mark.parametrize("length", [0.0, 1e-9, 0.3, 3.1])
def test_one_rotation_is_that_of_many(length: float) -> None:
    w = length * np.array([0.6, -0.64, 0.48])
    many = rotations_from_rotvecs(np.stack([w, w]))
    np.testing.assert_allclose(rotations_from_rotvecs(w[None])[0], many[0], atol=1e-15)


def test_an_evaluation_has_the_information_of_its_members() -> None:
    case = room_case(6, count=40, outliers=0.3)
    measured = Measurements.of(case.matches, case.camera, sigma_px=1.0, sigma_range_m=0.015)
    state, seen = adjust_ranges(measured, States.of([case.pose], measured))
    at = Evaluation(measured, state, seen)
    expected = information_matrix(measured, state, members=case.true)[0]
    np.testing.assert_allclose(at.information(case.true), expected, rtol=1e-12)


@pytest.mark.parametrize("seed", range(6))
def test_the_range_noise_is_the_best_of_the_whole_grid(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    case = room_case(seed, count=60, baseline_m=(0.0, 0.2, 1.0)[seed % 3], sigma_range_m=(0.003, 0.05)[seed % 2])
    bounds = {"stated_range_m": 0.015, "most_px": 4.0, "most_range_m": 0.12}
    found = noise.estimate_noise(case.pose, case.matches, case.camera, **bounds)
    monkeypatch.setattr(noise, "_COARSE", 1)
    assert found == pytest.approx(noise.estimate_noise(case.pose, case.matches, case.camera, **bounds), rel=1e-9)


def test_members_are_those_of_a_subset() -> None:
    case = room_case(2, count=60, outliers=0.3)
    bounds = {"stated_range_m": 0.015, "most_px": 4.0, "most_range_m": 0.12}
    some = noise.estimate_noise(case.pose, case.matches, case.camera, members=case.true, **bounds)
    of_subset = noise.estimate_noise(case.pose, case.matches.subset(case.true), case.camera, **bounds)
    assert some == pytest.approx(of_subset, rel=1e-12)


def test_decreases_of_leading_parts_are_those_of_each_part_alone() -> None:
    rng = np.random.default_rng(0)
    A = rng.normal(size=(30, 8)) * 10.0 ** rng.uniform(-3, 3, 8)
    H, g = A.T @ A, A.T @ rng.normal(size=30)
    found = intrinsics._predicted_decreases(H, g, [6, 7, 8])
    assert found == pytest.approx([g[:k] @ np.linalg.solve(H[:k, :k], g[:k]) for k in (6, 7, 8)], rel=1e-6)


def test_undetermined_directions_decrease_nothing() -> None:
    A = np.random.default_rng(1).normal(size=(30, 8))
    A[:, 7] = A[:, 6]  # singular from the eighth on
    H, g = A.T @ A, A.T @ np.random.default_rng(2).normal(size=30)
    six, seven, eight = intrinsics._predicted_decreases(H, g, [6, 7, 8])
    assert six < seven == pytest.approx(eight, rel=1e-6)


def test_picks_are_numbered_in_their_order() -> None:
    case = room_case(0, count=4)
    m = case.matches
    assert m.distinct_picks
    assert m.numbered_picks()[0] == m.pick_ids
    lines = Matches(m.rays, m.ranges, m.uv, ("b", "b", "a", "b"))
    assert not lines.distinct_picks
    names, pick = lines.numbered_picks()
    assert names == ("b", "a")
    assert pick.tolist() == [0, 0, 1, 0]


def test_a_pick_of_several_matches_is_critical_as_a_whole() -> None:
    """Two near points of one pick hold the pose, each alone does not: both together are the critical pick."""
    case = room_case(4, count=24)
    ids = tuple("near" if k >= 20 else f"far {k}" for k in range(24))
    points = case.matches.points.copy()
    points[:20] = [30.0, 0.0, 0.0] + 0.3 * (points[:20] - points[:20].mean(axis=0))
    ranges = np.linalg.norm(points, axis=1)
    matches = Matches(points / ranges[:, None], ranges, case.camera.project(case.pose @ points), ids)
    measured = Measurements.of(matches, case.camera, sigma_px=1.0, sigma_range_m=0.015)
    state, seen = adjust_ranges(measured, States.of([case.pose], measured))
    everyone = np.ones(24, dtype=bool)
    assert find_critical_match(Evaluation(measured, state, seen), matches, everyone, DEFAULT_ACCEPTANCE) == "near"
    alone = Matches(matches.rays, matches.ranges, matches.uv)
    assert find_critical_match(Evaluation(measured, state, seen), alone, everyone, DEFAULT_ACCEPTANCE) is None


def test_matches_are_counted_once() -> None:
    case = room_case(0, count=9)
    twice = Matches.joined([case.matches, case.matches])
    assert count_distinct(twice.points, twice.uv) == 9
    none = Matches.none()
    assert count_distinct(none.points, none.uv) == 0
