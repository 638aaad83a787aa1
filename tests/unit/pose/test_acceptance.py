"""Every threshold of acceptance on match statistics changes a verdict."""

from __future__ import annotations

from dataclasses import replace

import pytest

from ladarreg_core.errors import OptionError
from ladarreg_core.pose.acceptance import AcceptanceOptions
from ladarreg_core.pose.estimate import PoseOptions, solve_pose
from ladarreg_core.pose.multistart import confirm, probe_basin
from ladarreg_core.results.registration import PoseResult
from testing.scenes.pose_case import Case
from testing.scenes.room import ROOM_CAMERA, plane_case, repeated_case, room_case


def solved(case: Case, *, check_ambiguity: bool = True, **thresholds: float) -> PoseResult:
    options = PoseOptions(
        sigma_px=case.sigma_px,
        sigma_range_m=case.sigma_range_m,
        intrinsics="fixed",
        acceptance=AcceptanceOptions(**thresholds),
        check_ambiguity=check_ambiguity,
    )
    return solve_pose(case.matches, case.camera, options)


def mirrored_wall() -> Case:
    case = plane_case(0, extent_m=1.2, distance_m=5.0)
    return replace(case, uv=[ROOM_CAMERA.width - 1, 0] + case.uv * [-1, 1])


def ambiguous_plane() -> Case:
    for seed in range(500, 540):
        case = plane_case(seed, extent_m=0.25, distance_m=6.0, count=16, sigma_px=0.5)
        if has_second_pose(solved(case)):
            return case
    raise AssertionError("no case has a second pose")


def has_second_pose(result: PoseResult) -> bool:
    return bool(result.diagnostics["second_minimum"])


@pytest.mark.parametrize(
    "thresholds",
    [
        {"least_surplus": 60},
        {"least_share": 0.95},
        {"most_chi2_per_dof": 0.1},
        {"most_log10_chance": -1e6},
        {"most_angle_rad": 1e-6},
        {"most_position_of_range": 1e-6},
        {"least_aspect": 10.0},
        {"critical_leverage": -1.0, "most_growth": 1.0},
    ],
    ids=lambda thresholds: next(iter(thresholds)),
)
def test_a_stricter_threshold_refuses_a_good_pose(thresholds: dict[str, float]) -> None:
    case = room_case(0, count=60, outliers=0.2)
    assert solved(case).accepted
    assert not solved(case, **thresholds).accepted


@pytest.mark.parametrize("alone", [{"critical_leverage": -1.0}, {"most_growth": 1.0}])
def test_a_critical_match_needs_leverage_and_growth(alone: dict[str, float]) -> None:
    assert solved(room_case(0, count=60, outliers=0.2), **alone).accepted


@pytest.mark.parametrize("thresholds", [{"plane_share": 1.1}, {"plane_tolerance": 1e-9}])
def test_a_plane_seen_from_behind(thresholds: dict[str, float]) -> None:
    assert any("from behind" in reason for reason in solved(mirrored_wall()).reasons)
    assert not any("from behind" in reason for reason in solved(mirrored_wall(), **thresholds).reasons)


def test_the_second_pose_of_a_plane() -> None:
    case = ambiguous_plane()
    for found in ({}, {"many_inliers": 0}, {"planar_relief": 0.0}):
        assert has_second_pose(solved(case, **found))
    for none in (
        {"second_pose_margin": -1e6},
        {"second_pose_sigmas": 1e6},
        {"many_inliers": 0, "planar_relief": 0.0},
    ):
        assert not has_second_pose(solved(case, **none))


def test_the_rivals_among_outliers() -> None:
    few, many = repeated_case(0, share=0.25), repeated_case(0, share=0.4)
    assert solved(few).accepted
    assert has_second_pose(solved(few, rival_share=0.2))
    assert has_second_pose(solved(many))
    assert solved(many, rival_share=1.5).accepted
    assert solved(many, least_rivals=50).accepted


def test_the_share_of_returning_starts() -> None:
    result = solved(room_case(0, outliers=0.4))
    assert probe_basin(result).verdict == "unique"
    assert probe_basin(result, options=AcceptanceOptions(least_return_share=1.1)).verdict == "failed"


@pytest.mark.parametrize("make", [lambda seed: repeated_case(seed, share=0.34), lambda seed: room_case(seed, count=14)])
def test_one_search_from_many_starts_decides_like_the_quick_search_and_that_one(make) -> None:
    for seed in range(500, 512):
        case = make(seed)
        twice, once = solved(case), solved(case, check_ambiguity=False)
        options = PoseOptions()
        assert not has_second_pose(once)
        assert "no second pose explains the matches" not in once.reasons
        once = confirm(once, options).result
        assert once.accepted == confirm(twice, options).result.accepted
        assert has_second_pose(once) == (not once.accepted)


def test_rivals_at_the_limit_are_not_lost_in_refinement() -> None:
    case = repeated_case(501, share=0.34)  # 20 rivals of 40 inliers, of which refinement loses one
    once = solved(case, check_ambiguity=False)
    assert once.accepted
    assert confirm(once).verdict == "ambiguous"


def test_acceptance_must_be_options() -> None:
    with pytest.raises(OptionError, match="AcceptanceOptions"):
        PoseOptions(acceptance={"least_surplus": 3})
