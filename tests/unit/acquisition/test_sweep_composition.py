"""Sweeps become one scan: every point on the room's surfaces, in order, folds dropped, nothing lost uncounted."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ladarreg_core.acquisition.composition.sweep_composition import SweepComposition, compose_sweeps
from ladarreg_core.acquisition.line_sweep import LineSweep, UnitTrack
from ladarreg_core.acquisition.mount_fields import base_from_value
from ladarreg_core.errors import ShapeError
from ladarreg_core.formats.scans.npz import read_npz, write_npz_xyz
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grid_order import is_scan_grid, order_of
from testing.scenes.box_room import MOUNT, WIDE_LINE, in_motion, off_surface, stop_and_go

STEP = np.radians(1.5)
HALF_TURN = np.arange(-90.0, 90.1, 1.5)
FULL_TURN = np.arange(-180.0, 180.0, 1.5)
PART = np.arange(-40.0, 61.0, 1.5)


def returns(*sweeps: LineSweep) -> int:
    return int(sum(np.isfinite(sweep.ranges_m).sum() for sweep in sweeps))


def flipped_surfaces(scan: Scan) -> float:
    """The share of quads with four returns that are folded over, as seen from the scan's centre."""
    rays, valid = scan.rays.astype(np.float64), scan.valid
    right, down = np.diff(rays, axis=1)[:-1], np.diff(rays, axis=0)[:, :-1]
    whole = valid[:-1, :-1] & valid[1:, :-1] & valid[:-1, 1:] & valid[1:, 1:]
    return float(np.mean(((np.cross(right, down) * rays[:-1, :-1]).sum(-1) < 0)[whole]))


def assert_sound(composed: SweepComposition, *sweeps: LineSweep) -> None:
    scan = composed.scan
    assert returns(*sweeps) == scan.valid.sum() + composed.folded + composed.repeated
    np.testing.assert_allclose(off_surface(scan.points[scan.valid].reshape(-1, 3)), 0, atol=2e-6)
    assert not order_of(scan.rays)
    assert is_scan_grid(scan.rays) or not scan.valid.any(axis=0).all()
    assert flipped_surfaces(scan) < (3e-3 if composed.columns_are_lines else 0.01)
    np.testing.assert_array_equal(composed.sweep_of_cell >= 0, scan.valid)


@pytest.mark.parametrize("pans_deg", [HALF_TURN, FULL_TURN, PART], ids=["half", "full", "part"])
@pytest.mark.parametrize("tilt_deg", [0.0, 15.0])
@pytest.mark.parametrize("downwards", [False, True])
def test_one_pan_sweep_has_a_column_for_each_line(pans_deg: np.ndarray, tilt_deg: float, downwards: bool) -> None:
    pans = np.radians(pans_deg[::-1] if downwards else pans_deg)
    sweep = stop_and_go(pans, np.radians(tilt_deg), lost=0.03)
    composed = compose_sweeps([sweep], MOUNT)
    assert composed.columns_are_lines
    assert_sound(composed, sweep)


def test_half_a_turn_of_a_wide_line_is_a_panorama_all_around() -> None:
    composed = compose_sweeps([stop_and_go(np.radians(HALF_TURN))], MOUNT)
    longitudes = np.arctan2(*composed.scan.points[composed.scan.valid].T[1::-1])
    assert np.histogram(longitudes, bins=36, range=(-np.pi, np.pi))[0].min() > 0
    assert composed.scan.shape[1] == round(360 / 1.5)


def test_a_full_turn_has_as_many_columns_as_lines() -> None:
    assert compose_sweeps([stop_and_go(np.radians(FULL_TURN))], MOUNT).scan.shape[1] == len(FULL_TURN)


def test_folds_behind_a_nearer_surface_are_dropped_and_counted() -> None:
    sweep = stop_and_go(np.radians(FULL_TURN), mount=MOUNT)
    aside = type(MOUNT)(MOUNT.rotation, np.array([0.02, 0.25, 0.0]))
    far = stop_and_go(np.radians(FULL_TURN), mount=aside)
    composed = compose_sweeps([far], aside)
    assert composed.folded > compose_sweeps([sweep], MOUNT).folded > 0
    assert_sound(composed, far)


def test_cells_without_a_return_have_the_ray_of_what_is_around_them() -> None:
    sweep = stop_and_go(np.radians(FULL_TURN))
    whole = compose_sweeps([sweep], MOUNT).scan
    lost = sweep.ranges_m.copy()
    lost[::7, 20:150:9] = np.nan
    scan = compose_sweeps(
        [LineSweep(lost, sweep.intensity, sweep.angles_rad, sweep.pan_rad, sweep.tilt_rad)], MOUNT
    ).scan
    gone = whole.valid & ~scan.valid
    apart = np.linalg.norm(scan.rays - whole.rays, axis=-1)[gone]
    assert gone.sum() > 200
    assert np.median(apart) < 0.1 * STEP


def test_a_gap_between_the_stops_stays_empty() -> None:
    sweep = stop_and_go(np.radians(np.concatenate([PART[:20], PART[40:]])))
    composed = compose_sweeps([sweep], MOUNT)
    scan = composed.scan
    ahead = scan.ranges[scan.shape[0] // 2]
    assert np.isnan(ahead).sum() >= 20
    np.testing.assert_allclose(np.linalg.norm(scan.rays, axis=-1), 1, atol=1e-6)
    assert_sound(composed, sweep)


def test_several_tilts_share_a_spherical_grid() -> None:
    sweeps = [stop_and_go(np.radians(FULL_TURN), np.radians(tilt), lost=0.02) for tilt in (-20, 0, 20)]
    composed = compose_sweeps(sweeps, MOUNT)
    assert not composed.columns_are_lines
    assert_sound(composed, *sweeps)
    assert set(np.unique(composed.sweep_of_cell)) == {-1, 0, 1, 2}
    assert composed.scan.valid.mean() > 0.9


def test_a_line_that_lies_flat_and_nods_is_a_scan_too() -> None:
    flat = type(MOUNT).from_rotvec([0.01, 0.0, 0.02], [0.05, 0, 0.04])
    line = np.radians(np.arange(-60, 60.1, 1.5))
    parts = [stop_and_go([0.0], tilt, mount=flat, angles_rad=line) for tilt in np.radians(np.arange(-30, 30, 1.5))]
    sweep = LineSweep(
        np.concatenate([p.ranges_m for p in parts]), None, line, np.zeros(len(parts)),
        np.concatenate([p.tilt_rad for p in parts]),
    )  # fmt: skip
    composed = compose_sweeps([sweep], flat)
    assert_sound(composed, sweep)
    assert composed.scan.notes


def test_each_ray_of_a_moving_unit_has_the_position_of_its_own_time() -> None:
    there, back = in_motion(-1.6, 1.6, latency_s=0.04), in_motion(1.6, -1.6, latency_s=0.04)
    assert_sound(compose_sweeps([there], MOUNT, latency_s=0.04), there)
    assert_sound(compose_sweeps([there, back], MOUNT, latency_s=0.04), there, back)
    wrong = compose_sweeps([there], MOUNT).scan
    assert np.percentile(off_surface(wrong.points[wrong.valid]), 90) > 2e-3


def test_the_scan_survives_its_file(tmp_path: Path) -> None:
    scan = compose_sweeps([stop_and_go(np.radians(HALF_TURN), lost=0.1)], MOUNT).scan
    write_npz_xyz(tmp_path / "scan.npz", scan)
    again = read_npz(tmp_path / "scan.npz")
    np.testing.assert_allclose(again.points, scan.points, atol=1e-6)
    np.testing.assert_allclose(again.rays, scan.rays, atol=1e-6)
    assert all("no intensity" in note for note in again.notes)  # these lines have none


def test_live_points_are_those_of_the_scan() -> None:
    sweep = stop_and_go(np.radians(PART))
    live = sweep.points_in_world(MOUNT, slice(3, 4))
    assert live.shape == (1, len(WIDE_LINE), 3)
    np.testing.assert_allclose(off_surface(live[0]), 0, atol=1e-6)


def test_what_does_not_fit_is_refused() -> None:
    sweep = stop_and_go(np.radians(PART))
    with pytest.raises(ShapeError, match="each line a position"):
        LineSweep(sweep.ranges_m, None, sweep.angles_rad, sweep.pan_rad[1:], sweep.tilt_rad)
    with pytest.raises(ShapeError, match="do not rise"):
        UnitTrack(np.array([0.0, 1.0, 1.0]), np.zeros(3), np.zeros(3))
    with pytest.raises(ShapeError, match="no line"):
        compose_sweeps([], MOUNT)
    nothing = LineSweep(np.full_like(sweep.ranges_m, np.nan), None, sweep.angles_rad, sweep.pan_rad, sweep.tilt_rad)
    for sweeps in ([nothing], [nothing, nothing]):
        with pytest.raises(ShapeError, match="no return"):
            compose_sweeps(sweeps, MOUNT)


def test_the_jitter_of_readings_is_removed_where_the_unit_cruises() -> None:
    sweep = in_motion(-1.6, 1.6, jitter_s=0.005, seed=3)
    off = off_surface(sweep.points_in_world(MOUNT).reshape(-1, 3))
    assert np.nanpercentile(off, 80) < 1.5e-3  # .2 rad/s times 5 ms at 2 m is 2 mm
    track = UnitTrack(np.linspace(0, 10, 200), np.sin(np.linspace(0, 1.5, 200)), np.zeros(200))
    assert track.steadied() is track  # it never cruises


@pytest.mark.parametrize(
    ("angles_deg", "in_columns"),
    [((180, 0, 0), True), ((180, 0, 90), True), ((4, -7, 20), True), ((-175, 6, -40), True), ((90, 0, 0), False)],
)
def test_the_scan_of_a_unit_that_hangs_or_leans_is_level(angles_deg: tuple[float, ...], in_columns: bool) -> None:
    sweep, level = stop_and_go(np.radians(HALF_TURN), lost=0.03), base_from_value(list(angles_deg))
    stands, hangs = compose_sweeps([sweep], MOUNT), compose_sweeps([sweep], MOUNT, level)
    assert hangs.columns_are_lines == in_columns
    assert returns(sweep) == hangs.scan.valid.sum() + hangs.folded + hangs.repeated
    assert not order_of(hangs.scan.rays)  # the top row is up, the left column left
    assert flipped_surfaces(hangs.scan) < (0.01 if in_columns else 0.03)
    in_unit = hangs.scan.points[hangs.scan.valid] @ level.rotation
    np.testing.assert_allclose(off_surface(in_unit.reshape(-1, 3)), 0, atol=4e-6)
    if in_columns:  # the same returns, in other places of the grid
        expected = stands.scan.points[stands.scan.valid]
        np.testing.assert_allclose(np.sort(in_unit, axis=0), np.sort(expected, axis=0), atol=4e-6)
        high = hangs.scan.rays[:, hangs.scan.valid.any(axis=0), 2]
        assert np.nanmean(high[0]) > np.nanmean(high[-1])
