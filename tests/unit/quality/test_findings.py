"""Findings: each level has its stated cost, and a good pose has none."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ladarreg_core.camera import Camera
from ladarreg_core.frames import Rigid, rotation_from_rotvec
from ladarreg_core.matches import Matches
from ladarreg_core.pose.estimate import PoseOptions, solve_pose
from ladarreg_core.pose.estimators.bundle import States, information_matrix
from ladarreg_core.pose.estimators.measurements import Measurements
from ladarreg_core.pose.result import describe_pose
from ladarreg_core.quality.conditioning import assess_conditioning
from ladarreg_core.quality.findings import COST, LEVELS, findings
from ladarreg_core.quality.lens_check import check_lens
from testing.scenes.room import ROOM_CAMERA, room_case

SEEDS = st.integers(0, 10_000)
WIDE = Camera(768, 512, 420.0, 421.0, 380.0, 250.0, (-0.12, 0.03, 1e-3, -5e-4))


def solved(case, *, camera=None, **options):
    stated = options or {"sigma_px": case.sigma_px, "sigma_range_m": case.sigma_range_m}
    initial = case.pose if "simplex" in options.get("method", "") else None
    how = PoseOptions(intrinsics="fixed", **stated)
    return solve_pose(case.matches, camera or case.camera, how, initial=initial)


def part(case, chosen):
    return replace(case, rays=case.rays[chosen], ranges=case.ranges[chosen], uv=case.uv[chosen], true=case.true[chosen])


def findings_by_name(result):
    return {finding.name: finding for finding in findings(result)}


def at_truth(case, *, keep=None, pose=None, camera=None, covariance=None):
    """The case's matches at its true pose, all of them inliers, with the bound as covariance."""
    matches = case.matches if keep is None else case.matches.subset(keep)
    return describe_pose(
        pose or case.pose, matches, np.ones(len(matches), bool), camera or case.camera,
        sigma_px=case.sigma_px, sigma_range_m=case.sigma_range_m,
        covariance=np.linalg.inv(case.bound()) if covariance is None else covariance,
    )  # fmt: skip


def test_a_good_pose_has_no_poor_finding():
    rng = np.random.default_rng(5)
    unlucky = 0  # one good pose in some hundred has, by chance, suspiciously many outliers
    for seed in range(20):
        case = room_case(seed, count=int(rng.integers(48, 201)), baseline_m=rng.uniform(0, 1))
        found = findings(solved(case) if seed % 2 else solved(case, seed=1))
        names = [finding.name for finding in found]
        assert len(set(names)) == len(names) == 11
        assert not [finding for finding in found if finding.level == "poor"]
        fair = {finding.name for finding in found if finding.level == "fair"}
        assert fair <= {"conditioning", "inliers"}
        unlucky += "inliers" in fair
    assert unlucky <= 1


def anywhere(pose, camera, count, reach, rng):
    """Matches all over the photo, from near to far around a distance."""
    uv = rng.uniform(0, np.array(camera.size) - 1, (count, 2))
    depth = reach * 2.8 ** rng.uniform(-0.5, 0.5, (count, 1))
    points = pose.inverse @ (camera.unproject(uv) * depth)
    ranges = np.linalg.norm(points, axis=1)
    return Matches(points / ranges[:, None], ranges, uv)


def sigma_position(matches, case):
    measured = Measurements.of(matches, case.camera, sigma_px=case.sigma_px, sigma_range_m=case.sigma_range_m)
    H = information_matrix(measured, States.of([case.pose], measured))[0]
    return np.linalg.inv(H)[3:, 3:].trace() ** 0.5


@given(
    seed=SEEDS,
    count=st.integers(20, 80),
    share=st.floats(0.05, 1),
    place=st.tuples(st.floats(0, 1), st.floats(0, 1)),
    camera=st.sampled_from([ROOM_CAMERA, WIDE]),
)
@settings(max_examples=15)
def test_the_cost_is_relative_to_as_many_matches_all_over_the_photo(seed, count, share, place, camera):
    case = room_case(seed, count=100, camera=camera)
    size = np.array(camera.size) * np.sqrt(share)
    middle = size / 2 + (np.array(camera.size) - size) * place
    chosen = np.argsort((np.abs(case.uv - middle) / size).max(axis=1))[:count]
    clustered = case.matches.subset(chosen)
    reach = np.median(np.linalg.norm(case.pose @ clustered.points, axis=1))
    rng = np.random.default_rng(seed)
    well = [sigma_position(anywhere(case.pose, camera, count, reach, rng), case) for _ in range(9)]
    result = at_truth(case, keep=chosen)
    found = assess_conditioning(result)
    assert found.position_cost == pytest.approx(sigma_position(clustered, case) / np.median(well), rel=0.25)
    level = LEVELS[sum(max(found.position_cost, found.picture_cost) >= cost for cost in COST)]
    assert findings_by_name(result)["conditioning"].level == level
    noisier = assess_conditioning(replace(result, sigma_px=3 * result.sigma_px, sigma_range_m=3 * result.sigma_range_m))
    assert noisier.position_cost == pytest.approx(found.position_cost, rel=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_a_poor_layout_is_named_with_advice(seed):
    case = room_case(seed, count=900)
    points = case.rays * case.ranges[:, None]
    corner = part(case, np.flatnonzero((case.uv < (300, 200)).all(axis=1))[:60])
    wall = part(case, np.flatnonzero(points[:, 0] > 5.5)[:60])
    found = findings_by_name(solved(corner))
    assert found["spread"].level == "poor"
    assert "corners" in found["spread"].what_to_do
    found = findings_by_name(solved(wall))
    assert found["depth"].level == "poor"
    assert found["relief"].level == "fair"
    assert found["conditioning"].level == "poor"
    assert found["conditioning"].values["position_cost"] > 4
    for count, level in ((8, "poor"), (9, "fair"), (14, "fair"), (23, "fair"), (24, "good")):
        few = findings_by_name(at_truth(case, keep=np.arange(count)))["matches"]
        assert (few.level, few.values["different"]) == (level, count)


def test_a_drawn_line_counts_as_its_ends_or_as_the_root_of_its_samples():
    case = room_case(1, count=45)
    pairs = findings_by_name(at_truth(replace_ids(case, tuple(f"line {k // 2}" for k in range(45)))))["matches"]
    assert (pairs.values["as_points"], pairs.values["picks"], pairs.level) == (45, 23, "good")
    ids = tuple(f"line {k // 9}" for k in range(45))
    found = findings_by_name(at_truth(replace_ids(case, ids)))["matches"]
    assert (found.values["different"], found.values["as_points"], found.values["picks"]) == (45, 15, 5)
    assert found.level == "fair"
    across = replace(case.matches, directions=np.tile([[1.0, 0.0]], (45, 1)), across=np.ones(45, bool))
    halves = findings_by_name(replace(at_truth(case), matches=across))["matches"]
    assert halves.values["as_points"] == 22


def replace_ids(case, ids):
    class Named:
        matches = replace(case.matches, pick_ids=ids)
        pose, camera = case.pose, case.camera
        sigma_px, sigma_range_m = case.sigma_px, case.sigma_range_m
        bound = staticmethod(case.bound)

    return Named()


def test_a_narrow_bundle_of_rays_determines_roll_worst():
    rng = np.random.default_rng(0)
    uv = np.array([383.5, 255.5]) + rng.uniform(-25, 25, (200, 2))
    rays = room_case(0).camera.unproject(uv)
    pose = room_case(0, baseline_m=0.0, count=8).pose
    points = pose.inverse @ (rays * rng.uniform(0.5, 40, (200, 1)))
    ranges = np.linalg.norm(points, axis=1)
    result = describe_pose(
        pose, Matches(points / ranges[:, None], ranges, uv), np.ones(200, bool), ROOM_CAMERA,
        sigma_px=1.0, sigma_range_m=0.001, covariance=np.eye(6) * 1e-8,
    )  # fmt: skip
    assert "rolling" in assess_conditioning(result).worst_motion
    assert "middle" in findings_by_name(result)["conditioning"].what_to_do


@given(seed=SEEDS, count=st.integers(14, 200), off=st.sampled_from([0.0, 0.03, -0.03]), stated=st.booleans())
@settings(max_examples=24)
def test_a_wrong_focal_length_is_found_and_a_correct_one_is_not(seed, count, off, stated):
    count = count if off == 0 else max(count, 80)
    case = room_case(seed, count=count, camera=Camera.from_focal(768, 512, 974.0))
    result = solved(case, camera=Camera.from_focal(768, 512, 974.0 / (1 + off)), **({} if stated else {"seed": 1}))
    lens = findings_by_name(result).get("lens")
    if off == 0:
        assert lens is None or lens.level == "good"
        return
    check = check_lens(result)
    assert lens.level == "poor"
    assert check.kind == "focal"
    assert np.sign(check.change) == np.sign(off)
    if not stated:  # with stated noise, rejection removes the residuals that show the error
        assert check.change == pytest.approx(off, abs=4 * check.sigma)
    assert "camera file" in lens.what_to_do


def test_unmodelled_distortion_is_found():
    bent = Camera(768, 512, 974.0, 974.0, 383.5, 255.5, (-0.12, 0.0, 0.0, 0.0))
    for seed in range(4):
        lens = findings_by_name(solved(room_case(seed, camera=bent), camera=ROOM_CAMERA, seed=1))["lens"]
        assert lens.level == "poor"
        assert findings_by_name(solved(room_case(seed, camera=bent), seed=1))["lens"].level == "good"


def test_lack_of_parallax_affects_stereo_methods_only():
    case = room_case(5, count=60, baseline_m=0.0)
    for method in ("robust", "linear"):
        disparity = findings_by_name(solved(case, method=method))["disparity"]
        assert disparity.level == "good"
        assert disparity.what_to_do == ""
        assert "loses nothing" in disparity.sentence
    stereo = findings_by_name(solved(room_case(5, count=60, baseline_m=0.03), method="stereo_simplex"))["disparity"]
    assert stereo.level == "poor"
    assert "'robust'" in stereo.what_to_do
    ahead = room_case(5, count=60, baseline_m=0.6, direction=(1.0, 0.0, 0.0))
    assert findings_by_name(solved(ahead, method="stereo_simplex"))["baseline"].level == "poor"
    assert findings_by_name(solved(ahead))["baseline"].level == "good"


@given(seed=SEEDS, pixels=st.floats(3, 40), way=st.sampled_from([1.0, -1.0]))
@settings(max_examples=12)
def test_a_common_shift_is_found_with_its_direction(seed, pixels, way):
    case = room_case(seed, count=80)
    turned = rotation_from_rotvec([0, way * pixels / ROOM_CAMERA.focal_px, 0]) @ case.pose.rotation
    found = findings_by_name(at_truth(case, pose=Rigid.from_centre(turned, case.pose.centre)))["bias"]
    assert found.level == "poor"
    assert ("px left" if way > 0 else "px right") in found.sentence
    assert abs(found.values["u_px"]) == pytest.approx(pixels, rel=0.15, abs=1)
    assert findings_by_name(at_truth(case))["bias"].level == "good"


def test_outliers_are_named():
    case = room_case(8, count=60, outliers=0.3)
    found = findings_by_name(solved(case))["inliers"]
    assert found.level == "fair"
    assert set(found.values["disagreeing"]) >= {str(k + 1) for k in np.flatnonzero(~case.true)}
    assert f"and {len(found.values['disagreeing']) - 5} more" in found.sentence


def test_every_registration_has_findings_in_plain_words():
    case = room_case(3, count=30)
    behind = Rigid.from_centre(rotation_from_rotvec([0, np.pi, 0]) @ case.pose.rotation, case.pose.centre)
    nothing = Matches.none()
    same = Matches(np.tile(case.rays[:1], (20, 1)), np.tile(case.ranges[:1], 20), np.tile(case.uv[:1], (20, 1)))
    good = at_truth(case)
    odd = [
        describe_pose(
            case.pose, nothing, np.zeros(0, bool), case.camera, sigma_px=1.0, sigma_range_m=0.015, covariance=np.eye(6)
        ),
        describe_pose(
            case.pose, same, np.ones(20, bool), case.camera, sigma_px=1.0, sigma_range_m=0.015, covariance=np.eye(6)
        ),
        at_truth(case, pose=behind, covariance=np.eye(6)),
        replace(good, inliers=np.zeros(30, bool)),
        replace(good, inliers=np.arange(30) < 3),
        replace(good, inliers=np.arange(30) < 4),
        replace(good, covariance=np.full((6, 6), np.nan), residuals_px=np.full((30, 2), np.nan)),
        replace(good, covariance=np.zeros((6, 6)), diagnostics={"method": 7, "planarity": "odd"}),
    ]
    for result in odd:
        for finding in findings(result):
            assert finding.level in LEVELS
            assert (finding.what_to_do == "") == (finding.level == "good"), finding
            assert not {"nan", "inf"} & set(finding.sentence.replace("(", " ").split()), finding
            assert "\n" not in finding.sentence
    assert findings_by_name(odd[0])["matches"].level == findings_by_name(odd[1])["matches"].level == "poor"
    assert "do not determine" in findings_by_name(odd[1])["conditioning"].sentence
