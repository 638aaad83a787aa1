"""Runs on simulated devices, without real time: pieces kept, faults survived, resumed bit for bit."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from ladarreg_core.acquisition.interfaces import PanTilt
from ladarreg_core.acquisition.line_sweep import LineSweep
from ladarreg_core.acquisition.plan import Axis
from ladarreg_core.acquisition.runs.closure import Closure
from ladarreg_core.acquisition.runs.run_folder import RunFolder, RunWriter
from ladarreg_core.acquisition.runs.runner import Compared, Ended, Paused, PieceKept, Repeated, Resumed, RunEvent
from ladarreg_core.acquisition.simulated.devices import TwinDevices
from ladarreg_core.errors import ExportError, OptionError
from testing.devices.runs import Devices, pieces_of, same
from testing.devices.simulated_clock import SimulatedClock
from testing.devices.simulated_ports import MemoryPorts, MemoryServer

CHECKOUT = Path(__file__).resolve().parents[3]


@pytest.fixture(scope="module")
def clock() -> SimulatedClock:
    return SimulatedClock()


@pytest.fixture(scope="module")
def twins(clock: SimulatedClock) -> Iterator[TwinDevices]:
    with TwinDevices("office", 5, serve=partial(MemoryServer, clock=clock)) as found:
        yield found


@pytest.fixture
def devices(twins: TwinDevices) -> Iterator[Devices]:
    for device in twins.addresses:
        twins.fail(device, "none")
    with MemoryPorts(twins.server) as ports:
        yield Devices(twins, ports)


@pytest.mark.slow
def test_a_sweep_is_kept_and_measures_the_room(devices: Devices, tmp_path: Path) -> None:
    events: list[RunEvent] = []
    folder = RunWriter.begin(tmp_path / "run", devices.plan())
    assert devices.run(folder, events).go()
    folder.close()
    assert devices.are_at_rest()
    kept = [event for event in events if isinstance(event, PieceKept)]
    assert [event.done for event in kept] == list(range(1, 10))
    assert kept[-1].seconds_left == 0
    assert events[-1] == Ended(True, 9, 9)
    run = RunFolder.open(tmp_path / "run")
    assert run.complete
    assert not run.faults
    piece = run.piece(2)
    assert isinstance(piece, LineSweep)
    bench = devices.twins.bench
    truth = bench.true_line(PanTilt(float(piece.pan_rad[0]), 0.0), piece.angles_rad)
    seen = np.isfinite(piece.ranges_m[0])
    assert seen.mean() > 0.9
    assert np.median(np.abs(piece.ranges_m[0][seen] - truth[seen])) < 0.005


@pytest.mark.slow
def test_a_fault_pauses_and_a_resumed_run_is_the_same_bit_for_bit(
    devices: Devices, clock: SimulatedClock, tmp_path: Path
) -> None:
    whole = RunWriter.begin(tmp_path / "whole", devices.plan())
    assert devices.run(whole, []).go()
    whole.close()
    events: list[RunEvent] = []
    rested: list[float] = []

    def go_on() -> None:
        rested.append(clock.now())
        run.resume()

    def break_it(event: RunEvent) -> None:
        if (isinstance(event, PieceKept) and event.done == 3) or isinstance(event, Repeated):
            devices.twins.fail("scip2", "wrong checksum")
        if isinstance(event, Paused):
            clock.when(devices.are_at_rest, go_on)

    folder = RunWriter.begin(tmp_path / "run", devices.plan())
    run = devices.run(folder, events, break_it, fails=True)
    assert run.go()
    folder.close()
    (pause,) = [event for event in events if isinstance(event, Paused)]
    assert pause.fault
    assert "checksum is wrong" in pause.reason
    assert sum(isinstance(event, Repeated) for event in events) == 3
    assert len(rested) == sum(isinstance(event, Resumed) for event in events) == 1
    assert same(pieces_of(tmp_path / "whole"), pieces_of(tmp_path / "run"))


def test_a_unit_does_not_move_on_without_its_scanner(devices: Devices, clock: SimulatedClock, tmp_path: Path) -> None:
    events: list[RunEvent] = []
    folder = RunWriter.begin(tmp_path / "run", devices.plan(pan=Axis(0, 60, 60)))
    before = devices.unit.identity.speed_rad_s
    devices.unit.set_speed(PanTilt(math.radians(10), math.radians(10)))
    unplugged_s: list[float] = []
    rested_s: list[float] = []

    def unplug() -> None:
        devices.twins.fail("scip2", "unplugged")
        unplugged_s.append(clock.now())
        clock.when(lambda: not devices.twins.state()["moving"], lambda: rested_s.append(clock.now()))

    def stop_when_paused(event: RunEvent) -> None:
        if isinstance(event, Paused):
            clock.after(1.0, run.stop)

    run = devices.run(folder, events, stop_when_paused, fails=True)
    # On its way to the second stop, for 6 s.
    clock.when(lambda: bool(events) and devices.twins.state()["pan_deg"] > 1, unplug)
    try:
        assert not run.go()
        (pause,) = [event for event in events if isinstance(event, Paused)]
        assert pause.fault
        assert rested_s[0] - unplugged_s[0] < 0.5
        assert abs(devices.unit.position().pan_rad) < math.radians(50)
    finally:
        devices.twins.fail("scip2", "plugged")
        folder.close()
        devices.unit.set_speed(before)


def test_a_stopped_run_is_at_rest_at_once_and_goes_on_at_the_missing_piece(
    devices: Devices, clock: SimulatedClock, tmp_path: Path
) -> None:
    events: list[RunEvent] = []
    plan = devices.plan(pan=Axis(0, 60, 20))
    folder = RunWriter.begin(tmp_path / "run", plan)

    def stop_soon(event: RunEvent) -> None:
        if isinstance(event, PieceKept):
            clock.after(0.2, run.stop)  # on the way to the next piece

    run = devices.run(folder, events, stop_soon)
    assert not run.go()
    folder.close()
    assert devices.are_at_rest()
    kept = len(RunFolder.open(tmp_path / "run").records)
    assert 0 < kept < 4
    before = {path.name: path.read_bytes() for path in (tmp_path / "run" / "pieces").iterdir()}
    with pytest.raises(OptionError, match="set `resume` to go on"):
        RunWriter.begin(tmp_path / "run", plan)
    with pytest.raises(OptionError, match="differs in pan_deg"):
        RunWriter.begin(tmp_path / "run", devices.plan(pan=Axis(0, 40, 20)), resume=True)
    folder = RunWriter.begin(tmp_path / "run", plan, resume=True)
    with pytest.raises(ExportError, match=r"the run .* is open in another program"):
        RunWriter.begin(tmp_path / "run", plan, resume=True)
    assert devices.run(folder, events).go()
    folder.close()
    assert all((tmp_path / "run" / "pieces" / name).read_bytes() == data for name, data in before.items())


def test_a_run_is_replaced_once_the_new_one_stands_and_nothing_else(devices: Devices, tmp_path: Path) -> None:
    plan, home = devices.plan(pan=Axis(0, 2, 1)), tmp_path / "run"
    folder = RunWriter.begin(home, plan)
    assert devices.run(folder, []).go()
    before = contents(home)
    with pytest.raises(ExportError, match="open in another program"):
        RunWriter.begin(home, plan, force=True)
    assert contents(home) == before
    folder.close()
    for name, said in (
        ("photos/holiday.jpg", r"photos/holiday\.jpg, which its run does not list"),
        ("pieces/001.npz", r"pieces/001\.npz, changed since"),
        ("scan.npz", r"scan\.npz, which its run does not list"),
        ("plan.json", r"plan\.json, changed since"),
    ):
        kept = contents(home)
        (home / name).parent.mkdir(exist_ok=True)
        (home / name).write_bytes(b"of somebody")
        with pytest.raises(OptionError, match=said):
            RunWriter.begin(home, plan, force=True)
        assert contents(home) == kept | {name: b"of somebody"}
        (home / name).unlink()
        for each, data in kept.items():
            (home / each).write_bytes(data)
    folder = RunWriter.begin(home, plan, force=True)
    aside = {name.partition("/")[2]: data for name, data in contents(home).items() if name.startswith(".earlier-run")}
    assert aside.items() >= {name: data for name, data in before.items() if name[0] != "."}.items()
    folder.close()  # not complete
    assert any(home.glob(".earlier-run-*"))
    folder = RunWriter.begin(home, plan, resume=True)
    assert devices.run(folder, []).go()
    folder.close()
    assert not any(home.glob(".earlier-run-*"))
    assert RunFolder.open(home).complete


def contents(folder: Path) -> dict[str, bytes]:
    found = {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    found.pop(".lock", None)
    return found


def test_what_a_crash_leaves_does_not_count(devices: Devices, tmp_path: Path) -> None:
    plan = devices.plan(pan=Axis(0, 3, 1))
    folder = RunWriter.begin(tmp_path / "run", plan)
    assert devices.run(folder, []).go()
    folder.close()
    log = tmp_path / "run" / "run.jsonl"
    lines = log.read_bytes().splitlines(keepends=True)
    log.write_bytes(b"".join(lines[:3]) + lines[3][:20])  # killed while the last record was written
    (tmp_path / "run" / "pieces" / "001.npz").write_bytes(b"damaged")
    found = RunFolder.open(tmp_path / "run")
    assert sorted(found.records) == [0, 2]
    assert found.faults == ["pieces/001.npz is missing or has changed; it does not count"]
    folder = RunWriter.begin(tmp_path / "run", plan, resume=True)
    assert devices.run(folder, []).go()
    folder.close()
    again = RunFolder.open(tmp_path / "run")
    assert again.complete
    assert len(pieces_of(tmp_path / "run")) == 4
    for line in log.read_bytes().splitlines():
        json.loads(line)


@pytest.mark.slow
def test_a_continuous_sweep_follows_the_unit(devices: Devices, tmp_path: Path) -> None:
    plan = devices.plan(pan=Axis(-10, 10, 0.5), continuous=True, passes=2)
    folder = RunWriter.begin(tmp_path / "run", plan)
    assert devices.run(folder, []).go()
    folder.close()
    there, back = pieces_of(tmp_path / "run")
    assert there.track is not None
    assert np.degrees(there.pan_rad[0]) == pytest.approx(-10, abs=1)
    assert np.degrees(there.pan_rad[-1]) == pytest.approx(10, abs=1)
    assert np.degrees(back.pan_rad[-1]) == pytest.approx(-10, abs=1)
    assert 35 < len(there.pan_rad) < 99
    middle = (np.degrees(there.pan_rad) > -8) & (np.degrees(there.pan_rad) < 8)
    np.testing.assert_allclose(np.diff(np.degrees(there.pan_rad[middle])), 0.5, atol=0.35)


@pytest.mark.parametrize("slip_deg", [0.0, 1.5, -1.5, 0.75])
def test_a_sweep_whose_unit_slips_does_not_close(
    devices: Devices, clock: SimulatedClock, tmp_path: Path, slip_deg: float
) -> None:
    found: list[Closure] = []

    def see(event: RunEvent) -> None:
        if isinstance(event, PieceKept) and event.done == 5:
            devices.twins.unit.slip(math.radians(slip_deg), 0.0, clock.now())
        if isinstance(event, Compared):
            found.append(event.closure)

    folder = RunWriter.begin(tmp_path / "run", devices.plan())
    try:
        assert devices.run(folder, [], see).go()
    finally:
        folder.close()
        devices.twins.unit.slip(math.radians(-slip_deg), 0.0, clock.now())
    (closure,) = found
    assert closure.closed == (not slip_deg), closure
    assert RunFolder.open(tmp_path / "run").closed == closure.closed


@pytest.mark.long
def test_a_continuous_sweep_closes_but_for_the_latency(devices: Devices, tmp_path: Path) -> None:
    events: list[RunEvent] = []
    folder = RunWriter.begin(tmp_path / "run", devices.plan(pan=Axis(-10, 10, 0.25), continuous=True, passes=2))
    assert devices.run(folder, events).go()
    folder.close()
    (compared,) = [event for event in events if isinstance(event, Compared)]
    assert compared.closure.closed, compared
