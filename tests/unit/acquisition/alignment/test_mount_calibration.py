"""The mount from surfaces that a sweep sees twice: right within its covariance, silent about what no sweep shows."""

from __future__ import annotations

import numpy as np
import pytest

from ladarreg_core.acquisition.alignment.mount_calibration import calibrate_mount
from ladarreg_core.acquisition.alignment.mount_result import MountCalibration
from ladarreg_core.acquisition.line_sweep import LineSweep
from ladarreg_core.frames import Rigid, rotation_about, rotvec_from_rotation
from testing.scenes import box_room
from testing.scenes.box_room import MOUNT, in_motion, stop_and_go

OFF = Rigid.from_rotvec(np.radians([0.4, -0.3, 0.2]), [0.02, -0.005, 0.03])
GIVEN = Rigid.from_rotvec(rotvec_from_rotation(OFF.rotation.T @ MOUNT.rotation), MOUNT.translation - OFF.translation)
LINE = np.radians(np.arange(-135.0, 135.1, 1.0))
PANS = np.radians(np.arange(-180.0, 180.0, 3.0))
SIGMA_M = 0.004


def error(found: MountCalibration, true: Rigid = MOUNT) -> np.ndarray:
    """What is left of each parameter, in the calibration's own axes."""
    left = true @ found.unit_from_scanner.inverse
    axes = rotation_about("y", -found.tilt_rad)
    return np.concatenate([axes @ left.translation, axes @ rotvec_from_rotation(left.rotation)])


def sweeps(*tilts_deg: float, seed: int, **options: float) -> list[LineSweep]:
    return [
        stop_and_go(PANS, np.radians(tilt), angles_rad=LINE, sigma_m=SIGMA_M, lost=0.02, seed=10 * seed + i, **options)
        for i, tilt in enumerate(tilts_deg)
    ]


@pytest.mark.slow
def test_sweeps_at_three_tilts_determine_all_six_within_their_covariance() -> None:
    found = calibrate_mount(sweeps(-20, 0, 20, seed=1), GIVEN)
    assert found.accepted
    assert all(found.determined)
    off = error(found)
    assert np.abs(off[:3]).max() < 1e-3
    assert np.degrees(np.abs(off[3:]).max()) < 0.03
    assert off @ np.linalg.solve(found.covariance, off) < 22.5  # 99.9 % of chi^2 with 6
    assert found.sigma_range_m == pytest.approx(SIGMA_M, rel=0.05)
    assert found.held_out_after_m < found.held_out_before_m


@pytest.mark.slow
def test_a_pan_only_sweep_keeps_what_it_cannot_show() -> None:
    found = calibrate_mount(sweeps(25, seed=2), GIVEN)
    assert found.accepted
    assert found.determined == (True, True, False, True, True, False)
    assert np.isinf(found.sigma[[2, 5]]).all()
    assert np.isfinite(found.sigma[[0, 1, 3, 4]]).all()
    (reason,) = found.reasons
    assert "height along the pan axis" in reason
    assert "yaw" in reason
    given, off = error(MountCalibrationOf(GIVEN, found)), error(found)
    np.testing.assert_allclose(off[[2, 5]], given[[2, 5]], atol=2e-4)  # but for the order of large rotations
    seen = np.flatnonzero(found.determined)
    assert off[seen] @ np.linalg.solve(found.covariance[np.ix_(seen, seen)], off[seen]) < 18.5
    assert np.abs(off[:2]).max() < 5e-3


def test_a_level_pan_only_sweep_says_what_would_help() -> None:
    found = calibrate_mount(sweeps(0, seed=4), GIVEN)
    off = error(found)
    assert not any(found.determined[i] for i in (0, 1, 2, 3, 5))
    seen = np.flatnonzero(found.determined)
    assert (np.abs(off[seen]) < 3 * found.sigma[seen]).all()
    assert "-45 deg" in found.reasons[-1] or not found.accepted


@pytest.mark.long
def test_furniture_that_was_moved_between_sweeps_does_not_move_the_mount(monkeypatch: pytest.MonkeyPatch) -> None:
    passes = sweeps(-20, 0, 20, seed=5)
    monkeypatch.setattr(box_room, "BOARD", box_room.BOARD + np.array([0, 0, 0.012]))
    monkeypatch.setattr(box_room, "PILLAR", box_room.PILLAR + np.array([0.012, 0.012, 0]))
    passes[2:] = sweeps(0, 0, 20, seed=5)[2:]
    found = calibrate_mount(passes, GIVEN)
    assert found.accepted
    off = error(found)
    seen = np.flatnonzero(found.determined)
    assert {0, 2, 3, 4, 5} <= set(seen)
    assert np.abs(off[[0, 2]]).max() < 2e-4  # .34 mm if the moved planes count
    assert off[seen] @ np.linalg.solve(found.covariance[np.ix_(seen, seen)], off[seen]) < 22.5


class MountCalibrationOf:
    """The given mount in the axes of a calibration."""

    def __init__(self, mount: Rigid, found: MountCalibration) -> None:
        self.unit_from_scanner, self.tilt_rad = mount, found.tilt_rad


@pytest.mark.long
def test_passes_in_both_directions_determine_the_latency() -> None:
    passes = [
        in_motion(
            *ends, tilt_rad=tilt, latency_s=0.04, rate_rad_s=0.3, period_s=0.1, angles_rad=LINE, sigma_m=SIGMA_M, seed=i
        )
        for i, (ends, tilt) in enumerate((e, t) for t in (-0.3, 0.3) for e in ((-2.4, 2.4), (2.4, -2.4)))
    ]
    found = calibrate_mount(passes, GIVEN)
    assert found.accepted
    assert found.parameters[-1] == "latency"
    assert found.latency_s == pytest.approx(0.04, abs=0.002)
    off = np.append(error(found), 0.04 - found.latency_s)
    assert off @ np.linalg.solve(found.covariance, off) < 24.3


def test_a_line_of_half_a_turn_sees_nothing_twice_and_keeps_the_mount() -> None:
    narrow = [stop_and_go(PANS[20:100], angles_rad=np.radians(np.arange(-60, 60.1, 1.0)), sigma_m=SIGMA_M)]
    found = calibrate_mount(narrow, GIVEN)
    assert not found.accepted
    assert found.unit_from_scanner is GIVEN
    assert "seen twice" in found.reasons[0]
    assert np.isinf(found.sigma).all()


def test_a_mount_that_does_not_help_is_not_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    from ladarreg_core.acquisition.alignment import mount_calibration

    wrong = Rigid.from_rotvec([0.0, 0.01, 0.0], [0.02, 0, 0])
    fit = mount_calibration._fit

    def spoilt(*args: object, **options: object) -> object:
        state, planes, solved = fit(*args, **options)  # type: ignore[arg-type]
        return mount_calibration._State(wrong @ state.mount, state.latency_s), planes, solved

    monkeypatch.setattr(mount_calibration, "_fit", spoilt)
    found = calibrate_mount(sweeps(-20, 20, seed=3), MOUNT)
    assert not found.accepted
    assert found.unit_from_scanner is MOUNT
    assert "not fitted to" in found.reasons[0]
    assert found.held_out_after_m > found.held_out_before_m
