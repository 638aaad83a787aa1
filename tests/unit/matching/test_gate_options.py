"""Every threshold of image verification changes a verdict."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import ladarreg_core as lr
from ladarreg_core.frames import Rigid, rotation_from_rotvec
from ladarreg_core.matching.search.ambiguity import KnownPoses, _differ, _peaks, competes
from ladarreg_core.matching.verify.agreement import Agreement
from ladarreg_core.matching.verify.verification import (
    COARSE_GATE,
    GateOptions,
    Verification,
    check_precision,
    interpolated_gate,
    region_markers,
    rests_on_number,
    unsure_gate,
    verify,
)
from testing.scenes.painted_room import painted_room

_RADIUS = 7
_SIDE = 2 * _RADIUS + 1


def maps(level: int, agreeing: int, others: int = 0) -> Agreement:
    """Return an agreement of regions whose peaks lie one level pixel from zero shift, and of others far off."""
    rng = np.random.default_rng(0)
    peaks = rng.normal(0, 0.1, (agreeing + others, _SIDE, _SIDE))
    peaks[:agreeing, _RADIUS, _RADIUS + 1] = 2
    k = np.arange(others)
    peaks[agreeing + k, k % _SIDE, np.where(k % 2, 0, _SIDE - 1)] = 2
    count = len(peaks)
    grid = np.column_stack([np.arange(count), np.zeros(count, np.intp)])
    members = tuple(np.array([i]) for i in range(count))
    uv, visible = np.tile([50.0, 50.0], (count, 1)), np.ones(count, np.bool_)
    return Agreement(level, _RADIUS, peaks, grid, np.full(count, 9), members, uv, visible, peaks)


def accepted(agreeing: int, others: int = 0, **thresholds: float) -> bool:
    return verify(maps(1, agreeing, others), maps(0, agreeing, others), GateOptions(**thresholds)).accepted


@pytest.mark.parametrize(
    "stricter",
    [{"fraction": 1.1}, {"contrast": 1e3}, {"near_px": 1.0}, {"fine_near_px": 0.5}, {"fine_fraction": 1.1},
     {"far_px": 100.0}],
)  # fmt: skip
def test_a_stricter_threshold_refuses_many_regions(stricter: dict[str, float]) -> None:
    assert accepted(60)
    assert not accepted(60, **stricter)


@pytest.mark.parametrize("looser", [{"many": 40}, {"few_fraction": 0.6}])
def test_a_looser_threshold_accepts_fewer_regions(looser: dict[str, float]) -> None:
    assert not accepted(40, 20)
    assert accepted(40, 20, **looser)


@pytest.mark.parametrize(
    "stricter", [{"false_alarm": 0.0}, {"fewest_fraction": 1.1}, {"fewest_contrast": 1e3}, {"least_chance": 1.0}]
)
def test_few_regions_are_accepted_only_beyond_chance(stricter: dict[str, float]) -> None:
    assert accepted(20)
    assert not accepted(20, **stricter)


@pytest.mark.parametrize(
    ("agreeing", "accepting", "refusing"),
    [
        (24, {"few": 24}, {"few": 25}),
        (30, {}, {"few_contrast": 1e3}),
        (24, {"few": 20}, {"few": 20, "least_regions": 30}),
    ],
)
def test_regions_where_chance_is_not_ruled_out(
    agreeing: int, accepting: dict[str, float], refusing: dict[str, float]
) -> None:
    assert accepted(agreeing, false_alarm=0.0, **accepting)
    assert not accepted(agreeing, false_alarm=0.0, **refusing)


def test_no_number_of_regions_of_an_interpolated_scan_suffices() -> None:
    gate = interpolated_gate(GateOptions())
    for agreeing in (20, 60, 200):
        verdict = verify(maps(1, agreeing), maps(0, agreeing), gate)
        assert not verdict.accepted
        assert rests_on_number(verdict, gate)
    assert interpolated_gate(COARSE_GATE).own_false_alarm == 0, "of a thermal image nothing decides instead"


def test_the_precision_of_a_pose_on_few_regions() -> None:
    verdict = verify(maps(1, 20), maps(0, 20))
    assert verdict.by_few
    camera, points = lr.Camera.from_focal(480, 340, 700.0), np.array([[0.0, 0.0, 4.0], [0.5, 0.2, 5.0]])
    covariance = np.diag([(0.5 / 700) ** 2] * 3 + [1e-12] * 3)
    asked = verdict, points, camera, Rigid.identity(), covariance
    assert check_precision(*asked).accepted
    assert not check_precision(*asked, GateOptions(most_sigma_px=0.1)).accepted
    asked = replace(verdict, by_few=False), *asked[1:]
    assert check_precision(*asked, GateOptions(most_sigma_px=0.1)).accepted
    assert not check_precision(*asked, GateOptions(few_sigma_px=0.1)).accepted
    asked = replace(verdict, by_few=False, agreeing=200), *asked[1:]
    assert check_precision(*asked, GateOptions(few_sigma_px=0.1, coarse_sigma_px=0.1)).accepted
    refused = check_precision(*asked, GateOptions(coarse_sigma_px=0.1), coarse=True)
    assert not refused.accepted
    assert "the scan is coarse: the pose is known to 0.5 px" in refused.reasons[0]
    assert check_precision(*asked, GateOptions(few_sigma_px=0.1), coarse=True).accepted
    refused = check_precision(*asked, GateOptions(any_sigma_px=0.1))
    assert not refused.accepted
    assert "Give a camera file" in refused.reasons[0]
    strict = region_markers(maps(0, 20), camera, camera, GateOptions(fine_near_px=0.5))
    assert [agrees for *_, agrees in strict] == [False] * 20


def test_two_poses_that_count_as_the_same() -> None:
    room = painted_room(seed=2)
    pose = room.camera_from_scanner
    turned = Rigid(rotation_from_rotvec([0.0, 0.01, 0.0]) @ pose.rotation, pose.translation)  # 6 px
    usual, strict = GateOptions(), GateOptions(same_pose_px=1.0)
    for gate, different in ((usual, False), (strict, True)):
        known = KnownPoses(room.scan, room.photo.camera, gate)
        known.add(pose)
        assert known.differ(pose, turned) == different
        assert (known.different_from(turned) is not None) == different
    known = KnownPoses(room.scan, room.photo.camera)
    assert not _differ(known, pose, turned, usual)
    assert _differ(known, pose, turned, GateOptions(same_angle_rad=0.005))


@pytest.mark.parametrize("stricter", [{"second_fraction": 0.9}, {"second_count": 0.9}])
def test_a_second_pose_competes_relative_to_the_first(stricter: dict[str, float]) -> None:
    own = Verification(100, 80, 0.8, 3.0, 0.7, 1e-9, True, ())
    other = replace(own, agreeing=56, fraction=0.68, accepted=False)
    assert competes(other, own, GateOptions())
    assert not competes(other, own, GateOptions(**stricter))
    assert competes(replace(other, accepted=True), own, GateOptions(**stricter))


def test_a_second_pose_competes_more_easily_beside_one_that_is_not_sure() -> None:
    own = Verification(100, 55, 0.55, 3.0, 0.5, 1e-9, True, ())
    other = replace(own, agreeing=40, fraction=0.41, accepted=False)
    usual, unsure = GateOptions(), unsure_gate(GateOptions())
    assert not competes(other, own, usual)
    assert competes(other, own, unsure)
    assert unsure.second_correlation < usual.second_correlation
    assert unsure_gate(GateOptions(second_fraction=0.5)).second_fraction == 0.5


@pytest.mark.parametrize("stricter", [{"second_peak": 1.5}, {"second_overlap": 0.9}])
def test_shifts_at_which_a_second_pose_is_sought(stricter: dict[str, float]) -> None:
    height, width, period = 60, 80, 20
    rng = np.random.default_rng(0)
    image = np.tile(rng.normal(size=(height, period, 5)), (1, width // period, 1)).astype(np.float32)
    v, u = (grid.reshape(-1) for grid in np.mgrid[5:55, 5:75])
    uv = np.column_stack([u, v]).astype(float)
    usual = _peaks(image[v, u], uv, image, GateOptions())
    assert all(du % period == 0 and dv == 0 for du, dv in usual)
    assert len(usual) == 2
    assert _peaks(image[v, u], uv, image, GateOptions(**stricter)) == []
