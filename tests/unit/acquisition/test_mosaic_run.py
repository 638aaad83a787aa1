"""Runs of a scanner with software of its own, on simulated devices and without real time."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("embreex", reason="the simulator needs the extra `simulate`")

from ladarreg_core.acquisition.composition.panorama import compose
from ladarreg_core.acquisition.interfaces import Read, read_here
from ladarreg_core.acquisition.plan import Axis, Plan, ScannerPlan, UnitPlan
from ladarreg_core.acquisition.runs.closure import Closure
from ladarreg_core.acquisition.runs.connected import connected
from ladarreg_core.acquisition.runs.run_folder import RunFolder, RunWriter, ScanPiece
from ladarreg_core.acquisition.runs.runner import Compared, PieceKept, RunEvent, StraysKept
from ladarreg_core.acquisition.simulated.devices import SCANNER, TwinDevices
from ladarreg_core.acquisition.simulated.world import FRAME_MOUNT
from ladarreg_core.formats.isolated import IsolatedReaders
from ladarreg_core.scanner.grids import AzimuthElevation
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


def run(
    twins: TwinDevices, home: Path, plan: Plan, see: Callable[[RunEvent], None], read: Read = read_here
) -> RunFolder:
    with (
        closing(RunWriter.begin(home, plan)) as folder,
        connected(plan, ports=lambda: MemoryPorts(twins.server), read=read) as devices,
    ):
        assert devices.run(plan, folder, see).go()
    return RunFolder.open(home)


@pytest.mark.slow
@pytest.mark.parametrize(("slip_deg", "closes"), [((0.0, 0.0), True), ((1.5, 0.0), False), ((0.0, -1.5), False)])
def test_a_unit_that_slips_in_mid_run_does_not_close(
    twins: TwinDevices, clock: SimulatedClock, tmp_path: Path, slip_deg: tuple[float, float], closes: bool
) -> None:
    found: list[Closure] = []

    def see(event: RunEvent) -> None:
        if isinstance(event, PieceKept) and event.done == 3:
            twins.unit.slip(*np.radians(slip_deg), clock.now())
        if isinstance(event, Compared):
            found.append(event.closure)

    kept = run(twins, tmp_path / "run", plan_of(twins), see)
    (closure,) = found
    assert closure.closed == kept.closed == closes
    if closes:
        assert closure.apart is not None
        assert closure.apart < 0.01
        assert compose(tmp_path / "run").accepted
        return
    assert closure.slip_deg is not None
    assert np.allclose(closure.slip_deg, slip_deg, atol=0.6), "half a cell of this coarse scanner"
    made = compose(tmp_path / "run")
    assert not made.accepted
    assert closure.sentence() in made.reasons
    # Resumed, the run looks once more whether it closes.
    twins.unit.slip(*-np.radians(slip_deg), clock.now())
    with (
        closing(RunWriter.begin(tmp_path / "run", plan_of(twins), resume=True)) as folder,
        connected(folder.plan, ports=lambda: MemoryPorts(twins.server)) as devices,
    ):
        assert devices.run(folder.plan, folder, see).go()
    assert found[-1].closed
    assert RunFolder.open(tmp_path / "run").closed


@pytest.mark.slow
def test_files_of_the_watched_folder_can_be_read_in_other_processes(twins: TwinDevices, tmp_path: Path) -> None:
    decoded: list[str] = []

    def read(reader: Callable[[Path], Any], path: Path) -> Any:
        decoded.append(reader.__name__)
        return readers.run(reader, path)

    with closing(IsolatedReaders()) as readers:
        kept = run(twins, tmp_path / "run", plan_of(twins), lambda event: None, read)
    assert kept.complete
    assert set(decoded) == {"read_scan"}
    assert len(decoded) >= 2 * len(kept.records), "looked at in the folder, and read from the copy"


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
