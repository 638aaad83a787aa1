"""Wrong poses of a pair: the false alarm that is stated holds, mirror images, and the verdict that rests on them."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

import ladarreg_core as lr
from ladarreg_core.frames import Rigid, rotation_from_rotvec
from ladarreg_core.matching.images.pair import PairLevels
from ladarreg_core.matching.images.photo_levels import PhotoLevels, photo_levels, working_camera
from ladarreg_core.matching.images.views import viewing_directions
from ladarreg_core.matching.refine.aligner import Aligner
from ladarreg_core.matching.verify.verification import (
    GateOptions,
    Verification,
    beside_wrong_poses,
    coarse_gate,
    rests_on_number,
)
from ladarreg_core.matching.wrong_poses import (
    MIRRORED,
    TURNED,
    WrongPoses,
    correlation_gain,
    mirrored_photo,
    verdict_beside_wrong_poses,
    wrong_poses,
    wrong_poses_decide,
)
from ladarreg_core.simulate.outdoor_case import OutdoorCase
from testing.scenes.painted_room import PaintedRoom, painted_room
from testing.scenes.simulated import outdoors

_COUNT = TURNED + MIRRORED
_GATE = GateOptions()


@pytest.fixture(scope="module")
def street() -> OutdoorCase:
    pytest.importorskip("embreex", reason="the simulator needs the extra `simulate`")
    return outdoors("street", lidar="64 lines", seed=701)


@pytest.fixture(scope="module")
def elsewhere() -> OutdoorCase:
    pytest.importorskip("embreex", reason="the simulator needs the extra `simulate`")
    return outdoors("street", lidar="64 lines", seed=703)


@pytest.fixture(scope="module")
def room() -> PaintedRoom:
    return painted_room(seed=4)


def aligner_of(scan: lr.Scan, photo: lr.Photo, pose: Rigid) -> Aligner:
    pair = PairLevels(scan, photo)
    direction = viewing_directions(scan, pair.working, initial=pose)[0]
    return Aligner(pair.view(direction, "both"), pair.photo, gate=coarse_gate(_GATE), seed=0)


def finished(aligner: Aligner, start: Rigid) -> Rigid:
    candidate = aligner.refine(start)
    assert candidate is not None
    return aligner.finish(candidate.camera_from_scanner)


def few_regions(**figures: float) -> Verification:
    """Return the verdict on a pose that lacks nothing but agreeing regions."""
    usual = Verification(25, 22, 0.88, 3.2, 0.7, 0.02, False, ("Too few image regions agree: 22.",))
    return replace(usual, **figures)  # type: ignore[arg-type]


@pytest.mark.parametrize("tried", [1, 8])
@pytest.mark.parametrize("skewed", [False, True])
def test_the_stated_false_alarm_holds(tried: int, *, skewed: bool) -> None:
    rng = np.random.default_rng(3)

    def drawn(count: int) -> np.ndarray:
        # a gain is a mean over at least eight blocks, whose own distribution may be as skewed as an exponential one
        blocks = rng.exponential(0.05, (count, 30)) if skewed else rng.normal(0.05, 0.05, (count, 30))
        return np.asarray(blocks.mean(axis=1))

    alarms = np.array([WrongPoses(drawn(_COUNT)).false_alarm(drawn(tried).max(), tried=tried) for _ in range(4000)])
    for rate in (0.1, 0.03):
        allowed = rate + 3 * np.sqrt(rate / len(alarms))
        assert (alarms <= rate).mean() <= (1.6 if skewed else 1.0) * allowed
    if not skewed and tried == 1:
        assert (alarms <= 0.1).mean() >= 0.08, "the bound is not looser than it must be"


def test_the_false_alarm_falls_with_the_gain_and_grows_with_the_number_of_tries() -> None:
    wrong = WrongPoses(np.random.default_rng(1).normal(0.03, 0.01, _COUNT))
    alarms = [wrong.false_alarm(gain, tried=1) for gain in np.linspace(0, 0.2, 30)]
    assert all(after < before for before, after in pairwise(alarms))
    assert alarms[-1] < 1e-9
    one, many = (wrong.false_alarm(0.08, tried=tried) for tried in (1, 20))
    assert many == pytest.approx(20 * one)
    assert wrong.false_alarm(0.0, tried=20) == 1


def test_a_null_that_was_not_measured_accepts_nothing() -> None:
    for gains in (np.zeros(0), np.full(_COUNT, 0.03), np.linspace(0, 0.02, 10)):
        assert WrongPoses(gains).false_alarm(0.9, tried=1) == 1


def test_the_mirror_image_is_that_of_a_mirrored_camera(room: PaintedRoom) -> None:
    levels = photo_levels(room.photo, working_camera(room.scan, room.photo.camera))
    mirror = mirrored_photo(levels)
    for own, other in zip(levels.cameras, mirror.cameras, strict=True):
        ray = np.array([0.2, -0.1, 1.0])
        (u, v), (u_mirror, v_mirror) = own.project(ray), other.project(ray * (-1, 1, 1))
        assert (own.width - 1 - u, v) == pytest.approx((u_mirror, v_mirror))
    sines = np.array([1, 1, -1, 1, -1], np.float32)  # a mirrored edge at t lies at pi - t
    # The noise is estimated from a sample of the pixels, others in the mirror image.
    np.testing.assert_allclose(mirror.channels[0], sines * levels.channels[0][:, ::-1], atol=8e-3)
    again: PhotoLevels = mirrored_photo(mirror)
    assert again.cameras == levels.cameras
    np.testing.assert_array_equal(again.planes[1][0], levels.planes[1][0])


@pytest.mark.long
def test_the_true_pose_of_a_sparse_scan_stands_out(street: OutdoorCase) -> None:
    truth = street.camera_from_scanner
    aligner = aligner_of(street.scan, street.photo, truth)
    pose = finished(aligner, truth)
    wrong, gain = wrong_poses(aligner, pose), correlation_gain(aligner.agreement_at(pose, 0))
    assert _COUNT - 4 <= len(wrong.gains) <= _COUNT
    assert gain > 2 * wrong.highest
    assert wrong.false_alarm(gain, tried=20) < 1e-6


@pytest.mark.long
@pytest.mark.parametrize("tries", [1, pytest.param(3, marks=pytest.mark.long)])
def test_wrong_poses_do_not_stand_out_from_others(street: OutdoorCase, elsewhere: OutdoorCase, tries: int) -> None:
    rng, alarms = np.random.default_rng(8), []
    truth = street.camera_from_scanner
    aligner = aligner_of(street.scan, elsewhere.photo, truth)
    for _ in range(tries):
        turn = rotation_from_rotvec(rng.normal(0, 0.05, 3))
        pose = finished(aligner, Rigid.from_centre(turn @ truth.rotation, truth.centre))
        gain = correlation_gain(aligner.agreement_at(pose, 0))
        alarms.append(wrong_poses(aligner, pose).false_alarm(gain, tried=1))
    assert min(alarms) > 1e-3


@pytest.mark.long
def test_equal_pairs_have_equal_wrong_poses(street: OutdoorCase) -> None:
    truth = street.camera_from_scanner
    first, second = (wrong_poses(aligner_of(street.scan, street.photo, truth), truth).gains for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_few_regions_are_accepted_beside_wrong_poses_only() -> None:
    verdict = few_regions()
    asked = {"highest": 0.5, "count": 23, "options": _GATE}
    found = beside_wrong_poses(verdict, false_alarm=1e-5, **asked)  # type: ignore[arg-type]
    assert found.accepted
    assert not found.by_few
    assert found.as_dict()["false_alarm"] == 1e-5
    assert found.as_dict()["wrong_poses"] == 23
    assert "23 wrong poses" in found.reasons[0]
    assert "1e-05" in found.reasons[0]
    for refused in (
        beside_wrong_poses(verdict, false_alarm=1.1e-3, **asked),  # type: ignore[arg-type]
        beside_wrong_poses(verdict, false_alarm=1e-5, highest=0.64, count=23, options=_GATE),
    ):
        assert not refused.accepted
        assert refused.false_alarm == verdict.false_alarm
        assert refused.reasons[0] == verdict.reasons[0]
        assert "stand out" in refused.reasons[1]
    assert beside_wrong_poses(verdict, false_alarm=1e-5, highest=0.5, count=0, options=_GATE) == verdict


@pytest.mark.parametrize(
    "looser",
    [{"own_false_alarm": 1e-2, "alarm": 5e-3}, {"own_margin": 1.2, "highest": 0.75}],
)
def test_thresholds_beside_wrong_poses(looser: dict[str, float]) -> None:
    figures = {"false_alarm": looser.pop("alarm", 1e-5), "highest": looser.pop("highest", 0.5)}
    judged = [
        beside_wrong_poses(few_regions(), **figures, count=23, options=options).accepted
        for options in (_GATE, GateOptions(**looser))
    ]
    assert judged == [False, True]


@pytest.mark.parametrize(
    "lacking",
    [{"windows": 11}, {"fraction": 0.49}, {"contrast": 1.8}, {"fine_fraction": 0.34}, {"fine_fraction": None},
     {"accepted": True}],
)  # fmt: skip
def test_wrong_poses_replace_nothing_but_the_number_of_regions(lacking: dict[str, float]) -> None:
    assert rests_on_number(few_regions(), _GATE)
    assert not rests_on_number(few_regions(**lacking), _GATE)
    assert rests_on_number(few_regions(accepted=True, by_few=True), _GATE)


@pytest.mark.slow
def test_wrong_poses_decide_on_coarse_scans_only(street: OutdoorCase) -> None:
    aligner = aligner_of(street.scan, street.photo, street.camera_from_scanner)
    assert wrong_poses_decide(few_regions(), aligner)
    aligner.gate = GateOptions(own_false_alarm=0)
    assert not wrong_poses_decide(few_regions(), aligner)
    aligner.gate, aligner.scan = _GATE, replace(aligner.scan, coarse=False)
    assert not wrong_poses_decide(few_regions(), aligner)


@pytest.mark.long
def test_the_verdict_states_its_false_alarm(street: OutdoorCase) -> None:
    truth = street.camera_from_scanner
    aligner = aligner_of(street.scan, street.photo, truth)
    aligner.gate = replace(aligner.gate, few=1000, many=1000, false_alarm=0)
    pose = finished(aligner, truth)
    verdict, _, fine = aligner.verify(pose)
    assert not verdict.accepted
    assert wrong_poses_decide(verdict, aligner)
    alone, wrong = verdict_beside_wrong_poses(verdict, fine, aligner, pose, tried=1)
    among, again = verdict_beside_wrong_poses(verdict, fine, aligner, pose, tried=20, known=wrong)
    assert again is wrong, "they are those of the pair, whichever pose is judged"
    assert alone.accepted
    assert alone.as_dict()["wrong_poses"] > 16
    assert among.false_alarm == pytest.approx(20 * alone.false_alarm)


@pytest.mark.long
def test_a_given_pose_with_few_regions_is_judged_beside_wrong_poses() -> None:
    pytest.importorskip("embreex", reason="the simulator needs the extra `simulate`")
    case = outdoors("courtyard", lidar="40 lines", seed=910)
    truth = case.camera_from_scanner
    check = lr.verify_pose(case.scan, case.photo, truth)
    assert check.outcome == "verified"
    assert check.verification is not None
    assert check.verification.wrong_poses > 0
    assert check.verification.agreeing < GateOptions().many
    turned = Rigid.from_centre(rotation_from_rotvec(np.radians([1.5, 1.0, 0.0])) @ truth.rotation, truth.centre)
    assert lr.verify_pose(case.scan, case.photo, turned).outcome == "contradicted"
