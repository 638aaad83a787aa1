"""Test of a pose from many starting poses: it must detect ambiguity, and never confirm a wrong pose."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ladarreg_core.errors import DegenerateGeometryError, LadarregError, OptionError
from ladarreg_core.frames import CAMERA_AXES_FROM_SCANNER, Rigid, rotation_from_rotvec
from ladarreg_core.matches import Matches
from ladarreg_core.pose.ambiguity import mirrored
from ladarreg_core.pose.estimate import PoseOptions, solve_pose
from ladarreg_core.pose.multistart import Basin, probe_basin
from ladarreg_core.pose.result import describe_pose
from testing.scenes.pose_case import difference, start_near
from testing.scenes.room import ROOM_CAMERA, room_case


def solved(case, matches=None, **options):
    chosen = PoseOptions(**{"sigma_px": case.sigma_px, "sigma_range_m": case.sigma_range_m, **options})
    return solve_pose(matches or case.matches, case.camera, chosen)


def plane(seed, *, extent_m, distance_m, tilt_rad, count=40, sigma_px=1.0, sigma_range_m=0.002):
    """A plane in front of the camera, its matches with noise, and the true pose."""
    rng = np.random.default_rng([seed, 17])
    flat = np.column_stack([np.zeros(count), rng.uniform(-extent_m, extent_m, (count, 2))])
    points = flat @ rotation_from_rotvec([0, 0, tilt_rad]).T + [distance_m, 0, 0]
    pose = Rigid.from_centre(CAMERA_AXES_FROM_SCANNER, [0.0, 0.3, 0.0])
    ranges = np.linalg.norm(points, axis=1)
    uv = ROOM_CAMERA.project(pose @ points) + rng.normal(size=(count, 2)) * sigma_px
    return Matches(points / ranges[:, None], ranges + rng.normal(size=count) * sigma_range_m, uv), pose


def same(a: Basin, b: Basin) -> bool:
    def key(x):
        return [(p.score, p.starts, p.inliers, *p.pose.matrix.ravel()) for p in x.clusters]

    return a.verdict == b.verdict and a.levels == b.levels and key(a) == key(b)


@pytest.mark.parametrize("outliers", [0.0, 0.3, 0.5])
def test_a_room_has_one_pose_and_a_wide_basin(outliers):
    for seed in range(500, 506):
        case = room_case(seed, outliers=outliers)
        found = probe_basin(solved(case), seed=seed)
        assert found.verdict == "unique", found.describe()
        assert found.size is not None
        assert found.size.angle_rad >= np.deg2rad(20) - 1e-9
        assert "ll starting poses up to " in found.describe()
        assert found.starts == sum(level.starts for level in found.levels) == 32
        assert found.clusters[0].pose.distance_to(case.pose) < 0.02


def test_it_scales_with_the_scene():
    """At a hundredth of the scale the distances of the levels shrink likewise, and the shares stay."""
    case = room_case(1)
    small = Matches(case.rays, case.ranges / 100, case.uv)
    large, little = (
        probe_basin(solved(case, matches, sigma_range_m=sigma))
        for matches, sigma in ((case.matches, 0.015), (small, 0.00015))
    )
    assert [level.returned for level in large.levels] == [level.returned for level in little.levels]
    for a, b in zip(large.levels, little.levels, strict=True):
        assert b.distance_m == pytest.approx(a.distance_m / 100, rel=1e-3)


@settings(max_examples=20)
@given(
    seed=st.integers(0, 10_000),
    extent_m=st.sampled_from([0.1, 0.15, 0.25, 0.4, 0.6]),
    distance_m=st.sampled_from([3.0, 5.0, 9.0]),
    tilt_rad=st.floats(-0.9, 0.9),
    sigma_px=st.sampled_from([0.5, 1.0, 2.0]),
    count=st.sampled_from([12, 40, 150]),
    stated=st.booleans(),
)
def test_a_wrong_pose_of_a_plane_is_never_unique(seed, extent_m, distance_m, tilt_rad, sigma_px, count, stated):
    """Nor is a wrong pose called better than the right one."""
    matches, pose = plane(
        seed, extent_m=extent_m, distance_m=distance_m, tilt_rad=tilt_rad, sigma_px=sigma_px, count=count
    )
    noise = {"sigma_px": sigma_px, "sigma_range_m": 0.002} if stated else {}
    result = solve_pose(matches, ROOM_CAMERA, PoseOptions(**noise))
    found = probe_basin(result, seed=seed)
    step = difference(pose, result.camera_from_scanner)
    sigmas = np.sqrt(step @ np.linalg.solve(result.covariance, step))
    if found.verdict == "unique":
        # with unstated noise its estimate may cost some sigmas; a mirrored pose is degrees away
        assert sigmas < 6 or pose.angle_to(result.camera_from_scanner) < 0.2
    if found.verdict == "failed" and found.other is not None:
        assert pose.angle_to(found.other) < pose.angle_to(result.camera_from_scanner)


def test_a_distant_plane_is_ambiguous_with_its_mirrored_pose():
    for seed in range(8):
        matches, pose = plane(seed, extent_m=0.25, distance_m=9.0, tilt_rad=0.5)
        result = solve_pose(matches, ROOM_CAMERA, PoseOptions(sigma_px=1.0, sigma_range_m=0.002))
        found = probe_basin(result)
        assert found.verdict == "ambiguous"
        assert found.other is not None
        nearer = min((result.camera_from_scanner, found.other), key=pose.angle_to)
        assert nearer.angle_to(pose) < 0.35
        assert result.camera_from_scanner.angle_to(found.other) > 0.3
        assert "off their common plane" in found.describe()


@pytest.mark.parametrize("share", [0.5, 0.4])
def test_repeated_structure_is_ambiguous(share):
    """Half of the matches are shifted by one window of a facade: each half fits a pose of its own exactly."""
    for seed in range(5):
        case = room_case(seed, count=60)
        shifted = Rigid.from_centre(case.pose.rotation, case.pose.centre + np.array([0, 0.9, 0]))
        other = np.arange(60) < round(share * 60)
        uv = np.where(other[:, None], case.camera.project(shifted @ case.matches.points), case.uv)
        result = solved(case, Matches(case.rays, case.ranges, uv))
        found = probe_basin(result)
        assert found.verdict == "ambiguous"
        assert found.other is not None
        assert {round(min(p.distance_to(q) for q in (case.pose, shifted)), 1)
                for p in (found.other, result.camera_from_scanner)} == {0.0}  # fmt: skip
        assert found.other.distance_to(result.camera_from_scanner) == pytest.approx(0.9, abs=0.05)


@pytest.mark.parametrize(("degrees", "metres"), [(1.0, 0.05), (8.0, 0.4), (30.0, 1.5), (170.0, 4.0)])
@pytest.mark.parametrize("outliers", [0.0, 0.4])
def test_a_wrong_pose_fails_and_the_better_one_is_returned(degrees, metres, outliers):
    for seed in range(2):
        case = room_case(seed, count=80, outliers=outliers)
        result = solved(case)
        wrong = start_near(case, seed, degrees, metres)
        stale = replace(result, camera_from_scanner=wrong)
        described = describe_pose(
            wrong, case.matches, result.inliers, case.camera, sigma_px=1.0, sigma_range_m=0.015,
            covariance=result.covariance,
        )  # fmt: skip
        for asked in (stale, described):
            found = probe_basin(asked)
            assert found.verdict == "failed"
            assert found.other is not None
            step = difference(case.pose, found.other)
            assert step @ case.bound() @ step < 36
            assert found.describe().startswith("A better pose lies ")


def test_the_mirrored_pose_of_a_large_plane_fails():
    for seed in range(4):
        matches, pose = plane(seed, extent_m=1.2, distance_m=5.0, tilt_rad=0.5)
        result = solve_pose(matches, ROOM_CAMERA, PoseOptions(sigma_px=1.0, sigma_range_m=0.002))
        assert probe_basin(result).verdict == "unique"
        found = probe_basin(replace(result, camera_from_scanner=mirrored(pose, matches.points)))
        assert found.verdict == "failed"
        assert found.other is not None
        assert found.other.angle_to(pose) < 0.02


def test_an_uncertain_pose_within_its_covariance_does_not_fail():
    """The linear pose is many sigmas of the best pose away from it, but within its own."""
    verdicts = Counter(probe_basin(solved(room_case(seed), method="linear")).verdict for seed in range(12))
    assert verdicts["unique"] >= 11


def test_equal_seeds_give_equal_results():
    result = solved(room_case(3, outliers=0.5))
    assert same(probe_basin(result, seed=4), probe_basin(result, seed=4))
    assert not same(probe_basin(result, seed=4), probe_basin(result, seed=5))
    more = probe_basin(result, starts=100)
    assert [level.starts for level in more.levels] == [25] * 4


def random_result(seed, matches, camera=ROOM_CAMERA):
    pose = Rigid.from_centre(CAMERA_AXES_FROM_SCANNER, np.random.default_rng(seed).normal(size=3) * 0.3)
    return describe_pose(
        pose, matches, np.ones(len(matches), dtype=bool), camera, sigma_px=1.0, sigma_range_m=0.015,
        covariance=1e-4 * np.eye(6),
    )  # fmt: skip


@pytest.mark.slow
@settings(max_examples=30)
@given(
    kind=st.sampled_from(["few", "line", "copies", "one", "wrong", "behind", "far", "tiny", "off the lens"]),
    seed=st.integers(0, 10_000),
    count=st.integers(4, 50),
)
def test_degenerate_matches_get_a_verdict(kind, seed, count):
    rng = np.random.default_rng(seed)
    case = room_case(seed % 50, count=max(count, 4))
    rays, ranges, uv = case.rays.copy(), case.ranges.copy(), case.uv.copy()
    camera = case.camera
    if kind == "few":
        rays, ranges, uv = rays[:4], ranges[:4], uv[:4]
    elif kind == "line":
        points = np.array([4.0, 0.0, 0.0]) + rng.uniform(-1, 1, (count, 1)) * [0.2, 1.0, 0.1]
        ranges = np.linalg.norm(points, axis=1)
        rays, uv = points / ranges[:, None], camera.project(case.pose @ points)
    elif kind == "copies":
        rays, ranges, uv = (np.repeat(a[:4], count, axis=0) for a in (rays, ranges, uv))
    elif kind == "one":
        rays, ranges, uv = (np.repeat(a[:1], count, axis=0) for a in (rays, ranges, uv))
    elif kind == "wrong":
        uv = rng.uniform([0, 0], [767, 511], uv.shape)
    elif kind == "behind":
        rays = rays * [-1, 1, 1]
    elif kind == "far":
        ranges = ranges * 1e6
    elif kind == "tiny":
        ranges = ranges * 1e-6
    else:
        camera = replace(camera, distortion=(-0.6, 0.0, 0.0, 0.0, 0.0))
        uv[: count // 2] += 900
    matches = Matches(rays, ranges, uv)
    found = probe_basin(random_result(seed, matches, camera), seed=seed)
    assert found.verdict in ("unique", "ambiguous", "failed")
    assert found.describe().endswith(".")
    assert all(np.isfinite(p.pose.matrix).all() and np.isfinite(p.score) for p in found.clusters)
    if kind in ("line", "copies", "one", "wrong", "behind"):
        assert found.verdict != "unique", found.describe()
    try:
        result = solve_pose(matches, camera, PoseOptions(sigma_px=1.0, sigma_range_m=0.015))
    except LadarregError:
        return
    if kind == "wrong" and count >= 12:
        assert probe_basin(result, seed=seed).verdict != "unique"


def test_invalid_arguments_are_refused():
    result = solved(room_case(0, count=20))
    for bad in ({"starts": 7}, {"starts": True}, {"starts": 10**9}, {"seed": -1}, {"gate_chi2": float("nan")}):
        with pytest.raises(OptionError):
            probe_basin(result, **bad)
    with pytest.raises(DegenerateGeometryError, match="add matches"):
        probe_basin(random_result(0, room_case(0, count=20).matches.subset([0, 1, 2])))
