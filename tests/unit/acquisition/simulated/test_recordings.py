"""Recordings without devices: with the truth put in, what was recorded gives the truth."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("embreex", reason="the simulator needs the extra `simulate`")

from ladarreg_core.acquisition.simulated.recordings import Continuous, simulate_mosaic, simulate_sweep
from ladarreg_core.acquisition.simulated.world import Bench
from ladarreg_core.errors import OptionError
from ladarreg_core.frames import Rigid
from ladarreg_core.scanner.grids import AzimuthElevation
from ladarreg_core.simulate.terrestrial import RangeNoise

ANGLES = np.radians(np.linspace(-100, 100, 201))
PANS = np.radians(np.linspace(-40, 40, 33))


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(values**2)))


def test_a_sweep_at_rest_is_true_but_for_the_noise_of_the_ranges() -> None:
    sweep = simulate_sweep("boxes", 1, pans_rad=PANS, tilts_rad=(-0.2, 0.2), angles_rad=ANGLES)
    for number, recorded in enumerate(sweep.sweeps):
        off = recorded.points_in_world(sweep.bench.mount) - sweep.true_points(number)
        along = recorded.ranges_m - sweep.true_ranges_m[number]
        assert np.nanmax(np.abs(np.linalg.norm(off, axis=-1) - np.abs(along))) < 1e-5
        assert 0.001 < rms(along) < 0.01
    wrong = sweep.bench.mount @ Rigid.from_rotvec([0, 0.01, 0])
    assert rms(sweep.sweeps[0].points_in_world(wrong) - sweep.true_points(0)) > 0.01


@pytest.mark.slow
def test_a_sweep_in_motion_is_true_with_its_latency_and_not_without() -> None:
    quiet = RangeNoise(sigma_m=0.0, resolution_m=1e-5)
    moving = Continuous(jitter_s=0.0, latency_s=0.04)
    sweep = simulate_sweep(
        "boxes", 1, pans_rad=PANS, passes=2, continuous=moving, angles_rad=ANGLES, noise=quiet, unit_step_rad=1e-6
    )
    there, back = sweep.sweeps
    assert there.pan_rad[-1] > 0.5 > -0.5 > there.pan_rad[0]
    assert back.pan_rad[0] > 0.5 > -0.5 > back.pan_rad[-1]
    for number, recorded in enumerate(sweep.sweeps):
        true = sweep.true_points(number)
        right = recorded.points_in_world(sweep.bench.mount, latency_s=sweep.latency_s) - true
        assert rms(right) < 0.001
        assert rms(recorded.points_in_world(sweep.bench.mount) - true) > 0.008


@pytest.mark.slow
def test_pieces_of_a_mosaic_agree_in_the_world_by_their_true_poses_only() -> None:
    geometry = AzimuthElevation(70, 100, np.radians(0.55), np.radians(0.55))
    mosaic = simulate_mosaic("office", 2, columns=2, rows=1, overlap=0.5, geometry=geometry)
    first, second = mosaic.pieces
    assert second.read.pan_rad - first.read.pan_rad == pytest.approx(np.radians(27.5))
    seen = first.world_from_scanner.inverse @ second.world_from_scanner @ (
        geometry.rays * second.scan.ranges[..., None]
    )  # fmt: skip
    cells = geometry.cell_of(np.nan_to_num(seen))
    inside = np.isfinite(seen[..., 0]) & (cells >= 0).all(-1) & (cells <= np.array(geometry.shape) - 1).all(-1)
    row, column = np.rint(cells[inside]).astype(int).T
    gap = np.linalg.norm(seen[inside], axis=-1) - first.scan.ranges[row, column]
    assert inside.mean() > 0.3
    assert np.nanmedian(np.abs(gap)) < 0.01
    assert 0.02 < np.degrees(rms(np.array([p.read.pan_rad - np.arctan2(*p.world_from_scanner.rotation[1::-1, 0])
                                          for p in mosaic.pieces]))) < 1.0  # fmt: skip


def test_recordings_in_one_room_differ_by_where_the_unit_stands() -> None:
    stations = [Rigid.identity(), Rigid(np.eye(3), np.array([0.3, 0.2, 0.0]))]
    benches = [Bench("boxes", 1, room_from_world=station) for station in stations]
    assert benches[0].room is benches[1].room
    here, there = (simulate_sweep(pans_rad=PANS[:3], angles_rad=ANGLES, bench=b).true_points(0) for b in benches)
    floors = [np.nanmin(points[..., 2]) for points in (here, there)]
    assert floors[0] == pytest.approx(floors[1], abs=1e-4)
    assert np.nanpercentile(np.abs(here - there), 99) > 0.1


def test_senseless_arguments_are_refused() -> None:
    with pytest.raises(OptionError, match="two pan angles"):
        simulate_sweep("boxes", 1, pans_rad=[0.0])
    with pytest.raises(OptionError, match="overlap"):
        simulate_mosaic("boxes", 1, overlap=1.0)
    with pytest.raises(OptionError, match="positive"):
        Continuous(line_s=0.0)
