"""Runs of a scanner with software of its own, on simulated devices and without real time."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import closing
from functools import partial
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("embreex", reason="the simulator needs the extra `simulate`")

from ladarreg_core.acquisition.connected import connected
from ladarreg_core.acquisition.plan import Axis, Plan, ScannerPlan, UnitPlan
from ladarreg_core.acquisition.run_folder import RunFolder, RunWriter, ScanPiece
from ladarreg_core.acquisition.runner import PieceKept, RunEvent, StraysKept
from ladarreg_core.scanner.grids import AzimuthElevation
from ladarreg_core.twins.devices import SCANNER, TwinDevices
from ladarreg_core.twins.world import FRAME_MOUNT
from testing.devices.simulated_clock import SimulatedClock
from testing.devices.simulated_ports import MemoryPorts, MemoryServer

GEOMETRY = AzimuthElevation(35, 50, np.radians(1.1), np.radians(1.1))


@pytest.fixture
def clock() -> SimulatedClock:
    return SimulatedClock()


@pytest.fixture
def twins(clock: SimulatedClock) -> Iterator[TwinDevices]:
    with TwinDevices("office", 4, serve=partial(MemoryServer, clock=clock), geometry=GEOMETRY) as found:
        found.switch_on(SCANNER)
        yield found


def plan_of(twins: TwinDevices) -> Plan:
    at = twins.addresses
    return Plan(
        UnitPlan(at["flir-ptu"], baud=115_200), ScannerPlan("folder", folder=at[SCANNER], timeout_s=60), "mosaic",
        Axis(-40, 40, 20), Axis(0, 0, 0), mount=FRAME_MOUNT, settle_s=0.1,
    )  # fmt: skip


def run(twins: TwinDevices, home: Path, plan: Plan, see: Callable[[RunEvent], None]) -> RunFolder:
    with (
        closing(RunWriter.begin(home, plan)) as folder,
        connected(plan, ports=lambda: MemoryPorts(twins.server)) as devices,
    ):
        assert devices.run(plan, folder, see).go()
    return RunFolder.open(home)


def test_a_stray_shot_does_not_shift_the_others(twins: TwinDevices, clock: SimulatedClock, tmp_path: Path) -> None:
    """Somebody measures once more while the unit is on its way."""
    events: list[RunEvent] = []
    watched = Path(twins.addresses[SCANNER])

    def measure_again() -> None:
        (last,) = sorted(watched.glob("scan_*.npz"))[-1:]
        (watched / "a_second_shot.npz").write_bytes(last.read_bytes())

    def see(event: RunEvent) -> None:
        events.append(event)
        if isinstance(event, PieceKept) and event.done == 2:
            clock.when(lambda: bool(twins.state()["moving"]), measure_again)

    kept = run(twins, tmp_path / "run", plan_of(twins), see)
    for index in range(5):
        piece = kept.piece(index)
        assert isinstance(piece, ScanPiece)
        key = round(piece.at.pan_rad / 1e-5), round(piece.at.tilt_rad / 1e-5)
        true = twins.bench.scan_frame(piece.at, GEOMETRY, noise_key=key)
        assert np.allclose(piece.scan.points, true.points, atol=1e-4, equal_nan=True), f"piece {index} is another's"
    (strayed,) = [event for event in events if isinstance(event, StraysKept)]
    assert strayed == StraysKept(2, ("a_second_shot.npz",))
    records = [json.loads(line) for line in (tmp_path / "run" / "run.jsonl").read_text().splitlines()]
    (name,) = records[2]["strays"]
    assert name == "stray/002/scanner/a_second_shot.npz"
    assert (tmp_path / "run" / name).is_file()
    with closing(RunWriter.begin(tmp_path / "run", plan_of(twins), force=True)):
        assert not (tmp_path / "run" / name).exists(), "it is set aside with the run that it belongs to"
