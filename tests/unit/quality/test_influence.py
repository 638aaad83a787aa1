from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ladarreg_core.camera import Camera
from ladarreg_core.errors import DegenerateGeometryError
from ladarreg_core.matches import Matches
from ladarreg_core.pose.estimate import PoseOptions, solve_pose
from ladarreg_core.quality.influence import INFLUENTIAL_COOK, influence
from testing.scenes.pose_case import difference
from testing.scenes.room import room_case

LENS = Camera(768, 512, 974.0, 974.0, 383.5, 255.5, (0.12, -0.05, 0.001, -0.002))


def solved(matches, case, *, gate_chi2=1e6, **options):
    chosen = PoseOptions(sigma_px=case.sigma_px, sigma_range_m=case.sigma_range_m, gate_chi2=gate_chi2, **options)
    return solve_pose(matches, case.camera, chosen, initial=case.pose)


def without(matches, name):
    return matches.subset([k for k, other in enumerate(matches.pick_ids) if other != name])


@pytest.mark.parametrize("count", [12, 40])
@pytest.mark.parametrize(("seed", "baseline_m"), [(41, 0.0), (42, 0.5), (43, 1.5)])
def test_the_predicted_shift_agrees_with_solving_again(seed, baseline_m, count):
    case = room_case(seed, count=count, baseline_m=baseline_m, camera=LENS if seed == 43 else room_case(0).camera)
    weights = np.random.default_rng(seed).uniform(0.3, 3, count)
    matches = replace(case.matches, weights=weights)
    result = solved(matches, case)
    found = influence(result)
    order = np.argsort(found.cook)
    assert order[-1] == found.most_influential
    for k in (order[-1], order[-2], order[count // 2]):
        again = solved(without(matches, matches.pick_ids[k]), case).camera_from_scanner
        step = difference(again, result.camera_from_scanner)
        moved = [case.camera.project(pose @ case.matches.points) for pose in (again, result.camera_from_scanner)]
        # To first order: within 5 %, or a hundredth of the pose's own standard deviations.
        cook = step @ np.linalg.solve(result.covariance, step) / 6
        assert np.sqrt(found.cook[k]) == pytest.approx(np.sqrt(cook), rel=0.05, abs=0.01)
        sigma = np.sqrt(np.diag(result.covariance))
        for value, part in ((found.angle_rad[k], np.s_[:3]), (found.position_m[k], np.s_[3:])):
            assert value == pytest.approx(np.linalg.norm(step[part]), rel=0.05, abs=0.01 * np.linalg.norm(sigma[part]))
        shift = np.median(np.linalg.norm(moved[0] - moved[1], axis=1))
        assert found.pixels[k] == pytest.approx(shift, rel=0.1, abs=0.01)


def test_the_samples_of_a_line_are_removed_together():
    case = room_case(7, count=30)
    ids = tuple("a line" if k % 3 == 0 else f"point {k}" for k in range(30))
    matches = replace(case.matches, pick_ids=ids)
    result = solved(matches, case)
    found = influence(result)
    assert np.ptp(found.cook[::3]) == 0
    step = difference(solved(without(matches, "a line"), case).camera_from_scanner, result.camera_from_scanner)
    assert found.position_m[0] == pytest.approx(np.linalg.norm(step[3:]), rel=0.05)
    assert found.angle_rad[0] == pytest.approx(np.linalg.norm(step[:3]), rel=0.05)
    alone = influence(solved(case.matches, case))
    assert alone.cook[0] != pytest.approx(found.cook[0], rel=0.1)


def test_a_wrong_match_far_from_the_others_is_most_influential():
    """Inliers cluster in one part of the photo; one match elsewhere, 20 px off, rotates the whole pose."""
    case = room_case(11, count=300)
    near = np.argsort(np.linalg.norm(case.uv - (200, 150), axis=1))[:14]
    far = int(np.argmax(np.linalg.norm(case.uv - (200, 150), axis=1)))
    chosen = [*near.tolist(), far]
    uv = case.uv[chosen]
    uv[-1] += (14, -14)
    matches = Matches(case.rays[chosen], case.ranges[chosen], uv)
    found = influence(solved(matches, case))
    assert found.most_influential == 14
    assert found.cook[14] > 10 * INFLUENTIAL_COOK
    assert found.summary().startswith("Removing match 15 shifts the camera by ")
    assert found.summary().endswith(" px in the photo): check it.")
    good = influence(solved(case.matches, case))
    assert good.summary().startswith("No match is very influential")


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10_000), count=st.integers(16, 60))
def test_outliers_have_no_influence(seed, count):
    case = room_case(seed, count=count, outliers=0.25)
    result = solved(case.matches, case, gate_chi2=9.21)
    found = influence(result)
    for values in (found.position_m, found.angle_rad, found.pixels, found.cook):
        assert (values[~result.inliers] == 0).all()
        assert (values[result.inliers] > 0).all()
    assert (influence(result).cook == found.cook).all()


def test_an_indispensable_match_has_infinite_influence():
    """Three points determine a pose, two do not; a copy of a point is dispensable."""
    case = room_case(3, count=20)
    matches = case.matches.subset([0, 1, 1, 2, *range(4, 20)])
    matches = replace(matches, pick_ids=tuple(map(str, range(20))))
    inliers = np.arange(len(matches)) < 4
    found = influence(replace(solved(matches, case), inliers=inliers))
    assert np.isinf(found.cook[[0, 3]]).all()
    assert np.isfinite(found.cook[[1, 2]]).all()
    assert "The pose depends on match" in found.summary()


def test_a_pose_of_another_method_is_first_refined_by_least_squares():
    case = room_case(19, count=80)
    linear = solve_pose(case.matches, case.camera, PoseOptions(method="linear", sigma_px=1.0, sigma_range_m=0.015))
    robust = influence(solved(case.matches.subset(linear.inliers), case))
    np.testing.assert_allclose(influence(linear).position_m[linear.inliers], robust.position_m, rtol=1e-2, atol=1e-6)


def test_too_few_inliers_are_named():
    case = room_case(5, count=20)
    result = solved(case.matches, case)
    few = np.zeros(20, dtype=np.bool_)
    for count in (0, 3):
        few[:count] = True
        with pytest.raises(DegenerateGeometryError, match=f"^{count} matches agree with the pose"):
            influence(replace(result, inliers=few))
    same = Matches(np.tile(case.rays[:1], (6, 1)), np.tile(case.ranges[:1], 6), np.tile(case.uv[:1], (6, 1)))
    with pytest.raises(DegenerateGeometryError, match="do not determine a pose"):
        influence(replace(result, matches=same, inliers=np.ones(6, dtype=np.bool_)))
