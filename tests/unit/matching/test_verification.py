"""Verification: thresholds for coarse scans, chance agreement of wrong poses, and reasons."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise
from math import comb

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import ladarreg_core as lr
from ladarreg_core.frames import rotation_from_rotvec
from ladarreg_core.matching.images.photo_levels import photo_levels, working_camera
from ladarreg_core.matching.images.scan_levels import scan_levels
from ladarreg_core.matching.refine.aligner import Aligner
from ladarreg_core.matching.verify.agreement import Agreement
from ladarreg_core.matching.verify.verification import GateOptions, check_precision, region_markers, verify
from ladarreg_core.registration.register import register
from ladarreg_core.surface.perspective import perspective_view
from testing.scenes.painted_room import PaintedRoom, painted_room
from testing.scenes.thinned_scan import thinned

_RADIUS = 6
_SIDE = 2 * _RADIUS + 1


@pytest.fixture(scope="module")
def room() -> PaintedRoom:
    return painted_room(seed=4)


def aligner_of(scan: lr.Scan, photo: lr.Photo) -> Aligner:
    working = working_camera(scan, photo.camera)
    levels = scan_levels(scan, perspective_view(scan, working))
    return Aligner(levels, photo_levels(photo, working), gate=GateOptions(), seed=0)


def maps_with_peaks(shifts: np.ndarray) -> Agreement:
    """Return an agreement whose blocks peak at these shifts (B, 2), (u, v)."""
    maps = np.zeros((len(shifts), _SIDE, _SIDE))
    maps[np.arange(len(shifts)), shifts[:, 1] + _RADIUS, shifts[:, 0] + _RADIUS] = 1
    none = np.zeros(0, np.intp)
    nothing = np.zeros((0, 2)), np.zeros(0, np.bool_)
    return Agreement(0, _RADIUS, np.zeros((0, _SIDE, _SIDE)), np.zeros((0, 2), np.intp), none, (), *nothing, maps)


@settings(max_examples=15, deadline=None)
@given(st.integers(5, 50), st.integers(0, 2**32 - 1))
def test_the_false_alarm_decreases_with_the_number_of_agreeing_blocks(count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    far = rng.integers(2, _RADIUS + 1, (count, 2)) * rng.choice([-1, 1], (count, 2))
    order = rng.permutation(count)
    alarms = []
    for agreeing in range(count + 1):
        shifts = far.copy()
        shifts[order[:agreeing]] = 0
        alarms.append(maps_with_peaks(shifts).false_alarm(1.5, least_chance=0.25))
    assert alarms[0] == pytest.approx(1)
    assert alarms[-1] == pytest.approx(0.25**count)
    assert all(0 <= after <= before * (1 + 1e-9) for before, after in pairwise(alarms))
    # 0.25 is the lower limit of p; the estimate of the pair itself can only raise it.
    for agreeing, alarm in enumerate(alarms):
        tail = sum(comb(count, k) * 0.25**k * 0.75 ** (count - k) for k in range(agreeing, count + 1))
        assert alarm >= tail * (1 - 1e-9)


def test_agreement_at_another_shift_raises_the_false_alarm() -> None:
    shifts = np.zeros((40, 2), np.int64)
    shifts[:18] = (5, 0)
    rival = maps_with_peaks(shifts).false_alarm(1.5, least_chance=0.25)
    shifts[:18] = np.random.default_rng(0).permutation([(u, v) for u in range(-6, 7) for v in (-6, -4, 4, 6)])[:18]
    assert maps_with_peaks(shifts).false_alarm(1.5, least_chance=0.25) < 1e-4 < 0.1 < rival


def test_without_blocks_the_false_alarm_is_one() -> None:
    assert maps_with_peaks(np.zeros((0, 2), np.int64)).false_alarm(1.5, least_chance=0.25) == 1


@pytest.mark.long
def test_a_coarse_scan_is_accepted_by_few_regions(room: PaintedRoom) -> None:
    result = register(thinned(room.scan, 2), room.photo)
    figures = result.diagnostics["verification"]
    assert figures["windows"] < 45
    assert figures["false_alarm"] <= 1e-6
    assert result.accepted, result.reasons
    assert room.error_px(result.camera_from_scanner) < 1


@pytest.mark.slow
def test_refined_wrong_poses_of_a_coarse_scan_are_never_accepted(room: PaintedRoom) -> None:
    aligner = aligner_of(thinned(room.scan, 2), room.photo)
    mirror = lr.Photo(np.ascontiguousarray(room.photo.pixels[:, ::-1]), room.photo.camera)
    other = aligner_of(thinned(room.scan, 2), mirror)
    rng = np.random.default_rng(11)
    truth, judged = room.camera_from_scanner, 0
    for pair, scale in ((aligner, 0.12), (aligner, 0.05), (other, 0.03)):
        for _ in range(4):
            turn = rotation_from_rotvec(rng.normal(0, scale, 3))
            start = lr.Rigid(turn @ truth.rotation, truth.translation + rng.normal(0, 2 * scale, 3))
            candidate = pair.refine(start)
            if candidate is None:
                continue
            pose = pair.finish(candidate.camera_from_scanner)
            verdict = pair.verify(pose)[0]
            wrong = pair is other or room.error_px(pose) > 2
            judged += wrong
            assert not (wrong and verdict.accepted), (verdict, room.error_px(pose))
    assert judged >= 4


@pytest.mark.slow
def test_the_preliminary_verdict_uses_the_square_root_of_the_bound(room: PaintedRoom) -> None:
    aligner = aligner_of(thinned(room.scan, 2), room.photo)
    _, coarse, fine = aligner.verify(room.camera_from_scanner)
    alarm = coarse.false_alarm(3.0, least_chance=0.25)
    just, short = (GateOptions(false_alarm=(factor * alarm) ** 2) for factor in (1.01, 0.99))
    assert verify(coarse, None, just).accepted
    assert not verify(coarse, None, short).accepted
    assert verify(coarse, fine).by_few


def test_few_regions_with_an_uncertain_pose_are_refused(room: PaintedRoom) -> None:
    aligner = aligner_of(thinned(room.scan, 2), room.photo)
    verdict = aligner.verify(room.camera_from_scanner)[0]
    assert verdict.accepted
    points, camera, pose = aligner.verification_points.points, room.photo.camera, room.camera_from_scanner
    fine, rough = (np.diag([s**2] * 3 + [1e-12] * 3) for s in (0.2 / camera.fx, 3 / camera.fx))
    assert check_precision(verdict, points, camera, pose, fine) is verdict
    refused = check_precision(verdict, points, camera, pose, rough)
    assert not refused.accepted
    assert "px of the photo only" in refused.reasons[0]
    few, many = (replace(verdict, by_few=False, agreeing=count) for count in (44, 45))
    passable = np.diag([(0.95 / camera.fx) ** 2] * 3 + [1e-12] * 3)
    assert not check_precision(verdict, points, camera, pose, passable).accepted
    assert check_precision(few, points, camera, pose, passable) is few
    assert not check_precision(few, points, camera, pose, rough).accepted
    assert check_precision(many, points, camera, pose, rough) is many


def test_region_markers_lie_in_the_photo_and_agree_at_the_true_pose(room: PaintedRoom) -> None:
    aligner = aligner_of(room.scan, room.photo)
    camera = room.photo.camera
    shares = []
    for turn in (0.0, np.deg2rad(1.0)):
        off = lr.Rigid(rotation_from_rotvec([0, turn, 0]) @ room.camera_from_scanner.rotation, np.zeros(3))
        pose = lr.Rigid(off.rotation, off.rotation @ -room.camera_from_scanner.centre)
        regions = region_markers(aligner.agreement_at(pose, 0), aligner.photo.cameras[0], camera)
        assert 12 <= len(regions) <= 300
        assert json.loads(json.dumps(regions)) == [list(region) for region in regions]
        assert camera.contains(np.array([region[:2] for region in regions])).all()
        shares.append(np.mean([agrees for *_, agrees in regions]))
    assert shares[0] > 0.8 > 0.4 > shares[1]
