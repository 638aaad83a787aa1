"""Runs against simulated devices behind real ports: pieces kept, faults survived, resumed bit for bit."""

from __future__ import annotations

import ctypes
import json
import math
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ladarreg_core.acquisition.devices import PanTilt
from ladarreg_core.acquisition.flir_unit import FlirUnit
from ladarreg_core.acquisition.line_sweep import LineSweep
from ladarreg_core.acquisition.plan import Axis, Plan, ScannerPlan, UnitPlan
from ladarreg_core.acquisition.ports import Ports
from ladarreg_core.acquisition.run_folder import RunFolder, RunWriter
from ladarreg_core.acquisition.runner import Ended, Paused, PieceKept, Repeated, Resumed, Run, RunEvent
from ladarreg_core.acquisition.scip_scanner import ScipScanner
from ladarreg_core.errors import ExportError, OptionError
from ladarreg_core.twins.devices import TwinDevices
from ladarreg_core.twins.world import LINE_MOUNT

CHECKOUT = Path(__file__).resolve().parents[3]


class Devices:
    """Connected drivers of the simulated devices."""

    def __init__(self, twins: TwinDevices, *, guarded: bool = False) -> None:
        self.twins = twins
        self.ports = Ports(guarded=guarded)
        at = twins.addresses
        self.unit_plan = UnitPlan(at["flir-ptu"], baud=115_200)
        self.scanner_plan = ScannerPlan("scip2", at["scip2"], lines=2)
        self.unit = FlirUnit.connect(self.ports, self.unit_plan)
        self.scanner = ScipScanner.connect(self.ports, self.scanner_plan)

    def plan(self, **changes: Any) -> Plan:
        fields: dict[str, Any] = {"pan": Axis(-4, 4, 1), "tilt": Axis(0, 0, 0), "settle_s": 0.0, **changes}
        return Plan(self.unit_plan, self.scanner_plan, "sweep", mount=LINE_MOUNT, **fields)

    def run(self, folder: RunWriter, events: list[RunEvent], on_event: Any = None, *, fails: bool = False) -> Run:
        def report(event: RunEvent) -> None:
            events.append(event)
            assert fails or not (isinstance(event, Paused) and event.fault), event  # it would wait for ever
            if on_event is not None:
                on_event(event)

        return Run(folder.plan, folder, unit=self.unit, line_scanner=self.scanner, report=report)

    def at_rest(self) -> bool:
        until = time.monotonic() + 5  # tenths of a second, which a benchmark measures
        while time.monotonic() < until:
            state = self.twins.state()
            if not state["moving"] and not state["laser_on"]:
                return True
            time.sleep(0.01)
        return False


@pytest.fixture(scope="module")
def twins() -> Iterator[TwinDevices]:
    with TwinDevices("office", 5) as found:
        yield found


@pytest.fixture
def devices(twins: TwinDevices) -> Iterator[Devices]:
    for device in twins.addresses:
        twins.fail(device, "none")
    found = Devices(twins)
    yield found
    found.ports.close()


def pieces_of(folder: Path) -> list[LineSweep]:
    run = RunFolder.open(folder)
    return [piece for k in sorted(run.records) if isinstance(piece := run.piece(k), LineSweep)]


def same(a: list[LineSweep], b: list[LineSweep]) -> bool:
    return len(a) == len(b) and all(
        np.array_equal(x.ranges_m, y.ranges_m, equal_nan=True) and np.array_equal(x.intensity, y.intensity)
        and np.array_equal(x.pan_rad, y.pan_rad)
        for x, y in zip(a, b, strict=True)
    )  # fmt: skip


def test_a_sweep_is_kept_and_measures_the_room(devices: Devices, tmp_path: Path) -> None:
    events: list[RunEvent] = []
    folder = RunWriter.begin(tmp_path / "run", devices.plan())
    assert devices.run(folder, events).go()
    folder.close()
    assert devices.at_rest()
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


def test_a_fault_pauses_and_a_resumed_run_is_the_same_bit_for_bit(devices: Devices, tmp_path: Path) -> None:
    whole = RunWriter.begin(tmp_path / "whole", devices.plan())
    assert devices.run(whole, []).go()
    whole.close()
    events: list[RunEvent] = []

    rested: list[bool] = []

    def go_on() -> None:
        rested.append(devices.at_rest())
        run.resume()

    def break_it(event: RunEvent) -> None:
        if isinstance(event, PieceKept) and event.done == 3:
            devices.twins.fail("scip2", "wrong checksum")
        if isinstance(event, Paused):
            threading.Thread(target=go_on).start()

    folder = RunWriter.begin(tmp_path / "run", devices.plan())
    run = devices.run(folder, events, break_it, fails=True)
    assert run.go()
    folder.close()
    pauses = [event for event in events if isinstance(event, Paused)]
    assert all(pause.fault for pause in pauses)
    assert any("checksum is wrong" in pause.reason for pause in pauses)  # a busy machine may cause more of them
    assert all(rested)
    assert sum(isinstance(event, Resumed) for event in events) == len(pauses)
    assert same(pieces_of(tmp_path / "whole"), pieces_of(tmp_path / "run"))


def hang(seconds: float) -> None:
    """Hold the interpreter, so that no thread of this program runs."""
    if sys.platform == "win32":
        ctypes.PyDLL("kernel32").Sleep(round(1e3 * seconds))
    else:
        ctypes.PyDLL(None).usleep(round(1e6 * seconds))


def test_a_program_that_hangs_for_a_moment_goes_on_by_itself(twins: TwinDevices, tmp_path: Path) -> None:
    """The guard has stopped the devices meanwhile: the piece is measured again, whatever was under way."""
    devices = Devices(twins, guarded=True)
    try:
        plan = devices.plan(pan=Axis(-2, 2, 2))
        whole = RunWriter.begin(tmp_path / "whole", plan)
        assert devices.run(whole, []).go()
        whole.close()
        events: list[RunEvent] = []

        def hang_twice(event: RunEvent) -> None:
            if isinstance(event, PieceKept) and event.done < 3:
                hang(1.2)

        folder = RunWriter.begin(tmp_path / "run", plan)
        assert devices.run(folder, events, hang_twice).go()
        folder.close()
    finally:
        devices.ports.close()
    assert {event.index for event in events if isinstance(event, Repeated)} == {1, 2}
    assert same(pieces_of(tmp_path / "whole"), pieces_of(tmp_path / "run"))


def test_a_unit_does_not_move_on_without_its_scanner(devices: Devices, tmp_path: Path) -> None:
    events: list[RunEvent] = []
    folder = RunWriter.begin(tmp_path / "run", devices.plan(pan=Axis(0, 60, 60)))
    before = devices.unit.identity.speed_rad_s
    devices.unit.set_speed(PanTilt(math.radians(10), math.radians(10)))
    run = devices.run(folder, events, fails=True)
    thread = threading.Thread(target=run.go)
    thread.start()
    try:
        while not events or not devices.twins.state()["moving"]:  # on its way to the second stop, for 6 s
            time.sleep(0.01)
        devices.twins.fail("scip2", "unplugged")
        assert devices.at_rest()
        while not isinstance(events[-1], Paused):
            time.sleep(0.01)
        assert events[-1].fault
        assert abs(devices.unit.position().pan_rad) < math.radians(50)
    finally:
        devices.twins.fail("scip2", "plugged")
        run.stop()
        thread.join()
        folder.close()
        devices.unit.set_speed(before)


def test_a_stopped_run_is_at_rest_at_once_and_goes_on_at_the_missing_piece(devices: Devices, tmp_path: Path) -> None:
    events: list[RunEvent] = []
    plan = devices.plan(pan=Axis(0, 60, 20))
    folder = RunWriter.begin(tmp_path / "run", plan)

    def stop_soon(event: RunEvent) -> None:
        if isinstance(event, PieceKept):
            threading.Timer(0.2, run.stop).start()  # on the way to the next piece

    run = devices.run(folder, events, stop_soon)
    assert not run.go()
    folder.close()
    assert devices.at_rest()
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


PROGRAM = """
    import sys
    from ladarreg_core.acquisition.plan import read_plan
    from ladarreg_core.acquisition.ports import Ports
    from ladarreg_core.acquisition.flir_unit import FlirUnit
    from ladarreg_core.acquisition.scip_scanner import ScipScanner
    from ladarreg_core.acquisition.run_folder import RunWriter
    from ladarreg_core.acquisition.runner import PieceKept, Run
    plan = read_plan(sys.argv[1])
    with Ports() as ports:
        unit, scanner = FlirUnit.connect(ports, plan.unit), ScipScanner.connect(ports, plan.scanner)
        folder = RunWriter.begin(sys.argv[2], plan, resume=sys.argv[3] == "resume")
        run = Run(plan, folder, unit=unit, line_scanner=scanner, report=lambda event: (
            isinstance(event, PieceKept) and print(event.record.index, flush=True)))
        run.go()
"""


@pytest.mark.skipif(sys.platform == "win32", reason="needs SIGKILL")
def test_a_killed_run_keeps_every_piece_that_it_reported(twins: TwinDevices, tmp_path: Path) -> None:
    from textwrap import dedent

    from ladarreg_core.acquisition.plan import write_plan

    devices = Devices(twins)
    plan = devices.plan(pan=Axis(-3, 3, 1))
    devices.ports.close()
    write_plan(tmp_path / "plan.json", plan)

    def begun(how: str) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [sys.executable, "-c", dedent(PROGRAM), str(tmp_path / "plan.json"), str(tmp_path / "run"), how],
            stdout=subprocess.PIPE, text=True, cwd=CHECKOUT,
        )  # fmt: skip

    program = begun("new")
    assert program.stdout is not None
    reported = [int(program.stdout.readline()) for _ in range(3)]
    time.sleep(0.05)
    program.send_signal(signal.SIGKILL)
    killed = time.monotonic()
    while (state := twins.state()) and (state["moving"] or state["laser_on"]) and time.monotonic() < killed + 1:
        time.sleep(0.01)
    assert not state["moving"]
    assert not state["laser_on"]
    program.wait()
    assert set(reported) <= set(RunFolder.open(tmp_path / "run").records)
    time.sleep(0.5)  # the guard lets go of the ports
    assert begun("resume").wait(60) == 0
    assert RunFolder.open(tmp_path / "run").complete
    assert math.isfinite(float(np.nanmean(pieces_of(tmp_path / "run")[0].ranges_m)))
