"""The default estimator beyond the pose: intrinsics, line ends, and keeping a better initial pose."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ladarreg_core.errors import OptionError
from ladarreg_core.frames import Rigid, rotation_from_rotvec
from ladarreg_core.matches import Matches, Pick
from ladarreg_core.picks.measure import matches_from_picks
from ladarreg_core.pose.acceptance import AcceptanceOptions
from ladarreg_core.pose.estimate import PoseOptions, estimate_pose, solve_pose
from ladarreg_core.registration.register import RegisterOptions
from testing.scenes.pose_case import difference
from testing.scenes.room import room_case, room_ranges
from testing.scenes.room_lines import LineCase, line_case

STATED = {"sigma_px": 1.0, "sigma_range_m": 0.015}


@pytest.mark.parametrize("stated", [STATED, {}])
@pytest.mark.parametrize("error", [0.03, -0.05])
def test_a_wrong_focal_length_is_found_and_a_correct_one_kept(stated, error):
    case = room_case(11, outliers=0.2)
    given = replace(case.camera, fx=case.camera.fx * (1 + error), fy=case.camera.fy * (1 + error))
    found = estimate_pose(case.rays, case.ranges, case.uv, given, **stated)
    assert found.accepted
    assert abs(found.camera.fx - case.camera.fx) < 4 * found.camera_sigmas["focal_px"]
    assert found.camera_sigmas["focal_px"] < 0.01 * case.camera.fx
    assert found.camera_from_scanner.distance_to(case.pose) < 0.02
    assert any("focal length" in reason for reason in found.reasons)

    right = estimate_pose(case.rays, case.ranges, case.uv, case.camera, **stated)
    assert right.camera is case.camera
    assert right.camera_sigmas == {}

    fixed = estimate_pose(case.rays, case.ranges, case.uv, given, intrinsics="fixed", **stated)
    assert fixed.camera is given
    assert fixed.camera_from_scanner.distance_to(case.pose) > 0.05


def test_estimated_intrinsics_reduce_the_degrees_of_freedom():
    case = room_case(3)
    fixed = solve_pose(case.matches, case.camera, PoseOptions(**STATED))
    free = solve_pose(case.matches, case.camera, PoseOptions(**STATED, intrinsics="focal_k1"))
    assert set(free.camera_sigmas) == {"focal_px", "k1"}
    n = int(free.inliers.sum())
    np.testing.assert_array_equal(free.inliers, fixed.inliers)
    assert free.chi2_per_dof * (2 * n - 8) <= fixed.chi2_per_dof * (2 * n - 6) + 1e-6
    assert (np.diag(free.covariance) > 0.99 * np.diag(fixed.covariance)).all()
    assert free.sigma_position_m > fixed.sigma_position_m


def test_a_better_initial_pose_is_kept_only_on_request():
    case = room_case(5, count=6, sigma_px=4.0)
    good = Rigid.from_centre(rotation_from_rotvec([1e-4, 0, 0]) @ case.pose.rotation, case.pose.centre)
    stated = {"sigma_px": 4.0, "sigma_range_m": 0.015}
    free = solve_pose(case.matches, case.camera, PoseOptions(**stated), initial=good)
    kept = solve_pose(case.matches, case.camera, PoseOptions(**stated, keep_better_start=True), initial=good)
    assert free.camera_from_scanner.distance_to(case.pose) > 0.02
    assert kept.camera_from_scanner.distance_to(good) < 1e-12
    assert any("kept" in reason for reason in kept.reasons)
    many = room_case(5, count=100)
    poor = Rigid.from_centre(rotation_from_rotvec([0.1, 0, 0]) @ case.pose.rotation, case.pose.centre + 0.2)
    found = solve_pose(many.matches, many.camera, PoseOptions(**STATED, keep_better_start=True), initial=poor)
    assert found.camera_from_scanner.distance_to(many.pose) < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_slid_and_swapped_ends_cost_little_accuracy(seed):
    errors = {}
    for name, kind in (("plain", {}), ("slid", {"slid": 3}), ("swapped", {"swapped": 3})):
        case = line_case(seed, lines=10, **kind)
        matches, notes = matches_from_picks(case.scan, case.picks, camera=case.camera)
        assert notes == ()
        result = solve_pose(matches, case.camera, PoseOptions(**STATED))
        assert result.accepted
        step = result.camera_from_scanner
        errors[name] = step.distance_to(case.pose)
        assert errors[name] < 5 * result.sigma_position_m
        if name == "swapped":
            assert result.inliers.mean() > 0.9
            assert any("L1, L2, L3 were drawn in the opposite direction" in reason for reason in result.reasons)
        if name == "slid":
            assert result.inliers.mean() > 0.9
            assert result.matches.across.sum() >= 4
            assert any("only across the line" in reason for reason in result.reasons)
    assert max(errors.values()) < 0.08


def test_lines_and_points_are_solved_in_one_cost():
    lines, points = line_case(4, lines=6), room_case(4, count=30, outliers=0.2)
    drawn, _ = matches_from_picks(lines.scan, lines.picks, camera=lines.camera)
    # the same room seen from the lines' camera
    ranges = points.ranges[points.true]
    seen = lines.camera.project(
        lines.pose @ (points.rays[points.true] * room_ranges(points.rays[points.true])[:, None])
    )
    inside = lines.camera.contains(seen)
    uv = seen + np.random.default_rng(4).normal(size=seen.shape)
    found = Matches(points.rays[points.true][inside], ranges[inside], uv[inside])
    both = Matches.joined([drawn, found])
    assert len(both) == len(drawn) + len(found)
    assert both.pick_ids == drawn.pick_ids + found.pick_ids
    results = [solve_pose(m, lines.camera, PoseOptions(**STATED)) for m in (drawn, found, both)]
    sigmas = [result.sigma_position_m for result in results]
    assert sigmas[2] < min(sigmas[:2])
    together = sum(np.linalg.inv(result.covariance) for result in results[:2])
    np.testing.assert_allclose(np.diag(np.linalg.inv(together)), np.diag(results[2].covariance), rtol=0.15)
    assert results[2].camera_from_scanner.distance_to(lines.pose) < 4 * sigmas[2]


def _with_line_beside_its_edge(case: LineCase, px: float) -> tuple[Pick, ...]:
    """Return the lines of a case, the third of which is drawn this far beside its edge in the photo."""
    line = case.picks[2]
    along = line.photo[1] - line.photo[0]
    across = np.array([-along[1], along[0]]) / np.linalg.norm(along)
    return (*case.picks[:2], replace(line, photo=line.photo + px * across), *case.picks[3:])


def test_a_line_that_the_others_miss_is_named():
    """It hides in the scatter that it causes itself; were it accepted, the scatter between the lines would show it."""
    case = line_case(14, lines=6)
    drawn, _ = matches_from_picks(case.scan, _with_line_beside_its_edge(case, 15.0), camera=case.camera)
    solved = {
        chance: solve_pose(drawn, case.camera, PoseOptions(acceptance=AcceptanceOptions(least_left_out_chance=chance)))
        for chance in (1e-3, 0.0)
    }
    assert not solved[1e-3].accepted
    assert any("misses match L3 by more than their scatter" in reason for reason in solved[1e-3].reasons)
    assert solved[0.0].accepted
    off_m = solved[0.0].camera_from_scanner.distance_to(case.pose)
    assert 0.05 < off_m < 3 * solved[0.0].sigma_position_m


@pytest.mark.long
@pytest.mark.parametrize(("make", "count"), [(room_case, 10), (line_case, 6)], ids=["points", "lines"])
def test_the_sigma_of_few_matches_of_unknown_noise_holds(make, count):
    """48 poses with 6 parameters each: the mean square has a standard deviation of .08 if the sigmas are right."""
    distances = []
    for seed in range(48):
        case = make(seed, count=count) if make is room_case else make(seed, lines=count)
        drawn = case.matches if make is room_case else matches_from_picks(case.scan, case.picks, camera=case.camera)[0]
        result = solve_pose(drawn, case.camera, PoseOptions(intrinsics="fixed"))
        if result.accepted:
            off = difference(case.pose, result.camera_from_scanner)
            distances.append(off @ np.linalg.solve(result.covariance, off))
    assert len(distances) >= 45
    assert np.sqrt(np.mean(distances) / 6) < 1.15


@pytest.mark.parametrize("stated", [STATED, {}])
@pytest.mark.parametrize("share", [0.5, 0.42])
def test_matches_shared_by_two_poses_are_not_accepted(share, stated):
    case = room_case(8, count=120)
    turn = rotation_from_rotvec([0, 0.12, 0])
    elsewhere = Rigid.from_centre(turn @ case.pose.rotation, case.pose.centre + np.array([0, 0.4, 0]))
    seen = case.camera.project(elsewhere @ (case.rays * room_ranges(case.rays)[:, None]))
    rng = np.random.default_rng(8)
    kept = np.flatnonzero(case.camera.contains(seen))[:60]
    other = rng.permutation(60) < round(share * 60)
    uv = np.where(other[:, None], seen[kept] + rng.normal(size=(60, 2)), case.uv[kept])
    result = estimate_pose(case.rays[kept], case.ranges[kept], uv, case.camera, **stated)
    assert not result.accepted
    assert any("second pose" in reason or "needed" in reason for reason in result.reasons)


@pytest.mark.parametrize("bad", ["f", None, 3, "auto "])
def test_invalid_intrinsics_are_refused(bad):
    with pytest.raises(OptionError, match="intrinsics is"):
        PoseOptions(intrinsics=bad)
    with pytest.raises(OptionError, match="use of lines"):
        RegisterOptions(lines=bad)
