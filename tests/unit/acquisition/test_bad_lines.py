"""Devices behind bad lines: delays, echoes, flipped bits, late answers and restarts are survived, and logged."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from ladarreg_core.acquisition.devices.exchange_log import EXCHANGES, EXCHANGES_BEFORE, ExchangeLog
from ladarreg_core.acquisition.devices.flir_protocol import has_restarted, supply_of
from ladarreg_core.acquisition.devices.flir_unit import HOMING_S, FlirRestartedError, FlirUnit
from ladarreg_core.acquisition.devices.link import Exchange
from ladarreg_core.acquisition.devices.scip_scanner import ScipScanner
from ladarreg_core.acquisition.interfaces import PanTilt
from ladarreg_core.acquisition.plan import Axis, ScannerPlan, UnitPlan
from ladarreg_core.acquisition.runs.run_folder import RunFolder, RunWriter
from ladarreg_core.acquisition.runs.runner import Moved, Paused, PieceKept, Repeated, RunEvent
from ladarreg_core.acquisition.simulated.devices import TwinDevices
from ladarreg_core.acquisition.simulated.flir_twin import FlirTwin
from ladarreg_core.acquisition.simulated.scip_twin import ScipTwin
from ladarreg_core.errors import DeviceError
from testing.devices.bad_line import BadLine, flip, lose
from testing.devices.ptu_peer import PeerUnit
from testing.devices.runs import Devices, pieces_of, same
from testing.devices.simulated_clock import SimulatedClock
from testing.devices.simulated_ports import MemoryPorts, MemoryServer
from testing.devices.wall import wall


@pytest.fixture
def clock() -> SimulatedClock:
    return SimulatedClock()


def at(pan_deg: float, tilt_deg: float) -> PanTilt:
    return PanTilt(math.radians(pan_deg), math.radians(tilt_deg))


def goes_on() -> None:
    pass


class UnitBench:
    def __init__(self, clock: SimulatedClock, **line: object) -> None:
        self.twin = FlirTwin(baud=115_200)
        self.line = BadLine(self.twin, **line)  # type: ignore[arg-type]
        self.server = MemoryServer([self.line], clock=clock)
        self.ports = MemoryPorts(self.server)

    def connect(self) -> FlirUnit:
        return FlirUnit.connect(self.ports, UnitPlan(self.server.addresses[self.line.name], baud=115_200))


class ScannerBench:
    def __init__(self, clock: SimulatedClock, **line: object) -> None:
        self.twin = ScipTwin(wall, seed=3)
        self.line = BadLine(self.twin, **line)  # type: ignore[arg-type]
        self.server = MemoryServer([self.line], clock=clock)
        self.ports = MemoryPorts(self.server)

    def connect(self) -> ScipScanner:
        return ScipScanner.connect(self.ports, ScannerPlan("scip2", self.server.addresses[self.line.name]))


# -- the pan/tilt unit -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("line", [{"delay_s": 0.2}, {"echo": True}, {"delay_s": 0.2, "echo": True}], ids=str)
def test_a_unit_that_is_far_away_or_echoed_is_driven(clock: SimulatedClock, line: dict[str, object]) -> None:
    bench = UnitBench(clock, **line)
    unit = bench.connect()
    for pan, tilt in ((3, -2), (-4, 1)):
        reached = unit.move_to(at(pan, tilt), check=goes_on)
        assert (math.degrees(reached.pan_rad), math.degrees(reached.tilt_rad)) == pytest.approx((pan, tilt), abs=0.02)
        unit.halt()  # its star must not be taken for the answer to what follows
        unit.set_speed(at(10 + pan, 10))
        assert bench.twin._axes["P"].speed == pytest.approx((10 + pan) * 3600 / 46.2857, abs=1)
    assert math.degrees(unit.position().pan_rad) == pytest.approx(-4, abs=0.02)


@pytest.mark.parametrize("damage", [flip, lose])
def test_every_answer_of_a_unit_may_be_damaged_once(clock: SimulatedClock, damage: Callable[[bytes], bytes]) -> None:
    bench = UnitBench(clock)
    unit = bench.connect()
    for target in (at(2, 0), at(-2, 1)):
        bench.line.damage = damage
        unit.start_move(target)
        bench.line.damage = damage
        reached = unit.move_to(target, check=goes_on)
        assert reached.pan_rad == pytest.approx(target.pan_rad, abs=4e-4)
    bench.line.damage = damage
    unit.set_speed(at(12, 12))
    assert bench.line.damaged == 5
    assert damage is flip or any("asked again" in each.remark for each in unit.link.exchanges)


@pytest.mark.parametrize("homing_s", [0.0, 4.0, 30.0])
def test_a_unit_that_restarts_is_waited_for_and_set_up_as_before(clock: SimulatedClock, homing_s: float) -> None:
    bench = UnitBench(clock)
    unit = bench.connect()
    unit.set_speed(at(9, 9))
    unit.move_to(at(5, 0), check=goes_on)
    bench.twin.switch_on(clock.now(), homing_s=homing_s)
    with pytest.raises(FlirRestartedError, match="was reset or lost its power"):
        unit.move_to(at(6, 0), check=goes_on)
    assert not bench.twin._echo
    assert bench.twin._axes["P"].speed == pytest.approx(9 * 3600 / 46.2857, abs=1)
    assert math.degrees(unit.move_to(at(6, 1), check=goes_on).pan_rad) == pytest.approx(6, abs=0.02)


def test_a_unit_that_is_just_switched_on_is_waited_for(clock: SimulatedClock) -> None:
    bench = UnitBench(clock)
    bench.twin.switch_on(clock.now(), homing_s=30.0)
    unit = bench.connect()
    assert clock.now() < HOMING_S
    assert math.degrees(unit.move_to(at(1, 1), check=goes_on).pan_rad) == pytest.approx(1, abs=0.02)
    silent = UnitBench(clock)
    silent.twin.silent = True
    begun = clock.now()
    with pytest.raises(DeviceError, match="no complete answer"):
        silent.connect()
    assert clock.now() - begun < HOMING_S + 5, "not for ever"


def test_a_halt_ends_the_wait_for_a_unit_that_is_silent(clock: SimulatedClock) -> None:
    bench = UnitBench(clock)
    unit = bench.connect()
    bench.twin.silent = True
    clock.after(6.0, unit.halt)
    begun = clock.now()
    with pytest.raises(DeviceError):
        unit.position()
    assert clock.now() - begun < 10


def test_the_unit_of_the_manual_is_driven(clock: SimulatedClock) -> None:
    class Peer:
        """The unit that was written from the manual alone, whose moves end at once, on a port."""

        name, baud = "flir-ptu", 9600

        def __init__(self) -> None:
            self.unit, self._out = PeerUnit(), b""

        def feed(self, data: bytes, now_s: float) -> None:
            self._out += self.unit.answer(data)
            self.unit.position = dict(self.unit.target)

        def due(self, now_s: float) -> bytes:
            out, self._out = self._out, b""
            return out

    peer = Peer()
    server = MemoryServer([peer], clock=clock)
    unit = FlirUnit.connect(MemoryPorts(server), UnitPlan(server.addresses["flir-ptu"], baud=9600))
    assert "Pan-Tilt Controller" in unit.identity.model
    reached = unit.move_to(at(20, -10), check=goes_on)
    assert peer.unit.position == {"P": 389, "T": -194}
    assert math.degrees(reached.pan_rad) == pytest.approx(20, abs=0.03)
    assert unit.supply() == {"volts": 30.0, "celsius": 30.0}


def test_what_a_restart_says_and_what_a_unit_states_of_its_supply() -> None:
    assert has_restarted(b"### PTU CONTROLLER, v2.13.0(D46C), (C)1991-2010 FLIR Systems ###\r\n")
    assert has_restarted(b"!T!T!P!P*\r\n")
    assert not has_restarted(b"* Pan-Tilt Controller v2.13.0(D46C)\r\n")
    assert not has_restarted(b"V * Pan-Tilt Controller v2.13.0(D46C)\r\n")
    assert not has_restarted(b"!P* 300\r\n")
    assert supply_of("Input 30 VDC @ 86 degF") == {"volts": 30.0, "celsius": 30.0}
    assert supply_of("12.1 V, 31 deg C") == {"volts": 12.1, "celsius": 31.0}
    assert supply_of("good") == {}


# -- the line scanner ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("line", [{"delay_s": 0.2}, {"echo": True}, {"delay_s": 0.2, "echo": True}], ids=str)
def test_a_scanner_that_is_far_away_or_echoed_is_read(clock: SimulatedClock, line: dict[str, object]) -> None:
    bench = ScannerBench(clock, **line)
    scanner = bench.connect()
    ahead = np.cos(scanner.identity.angles_rad) > 0.4
    for _ in range(2):
        lines = list(scanner.lines(5, check=goes_on))
        np.testing.assert_allclose(
            lines[0].ranges_m[ahead], 2 / np.cos(scanner.identity.angles_rad[ahead]), atol=0.0006
        )
        for _ in scanner.lines(20, check=goes_on):
            break  # what is under way is not taken for what is asked next
    assert scanner.clock().uncertainty_s < 0.5
    assert len(list(scanner.lines(3, check=goes_on))) == 3


@pytest.mark.parametrize("damage", [flip, lose])
def test_every_answer_of_a_scanner_may_be_damaged_once(clock: SimulatedClock, damage: Callable[[bytes], bytes]) -> None:
    bench = ScannerBench(clock)
    bench.line.damage = damage
    scanner = bench.connect()
    bench.line.damage = damage
    scanner.clock()
    assert bench.line.damaged == 2
    assert len(list(scanner.lines(3, check=goes_on))) == 3


# -- a run -----------------------------------------------------------------------------------------------------------


@pytest.fixture
def lines() -> dict[str, BadLine]:
    return {}


@pytest.fixture
def devices(clock: SimulatedClock, lines: dict[str, BadLine]) -> Iterator[Devices]:
    def serve(twins: list[object]) -> MemoryServer:
        lines.update({twin.name: BadLine(twin) for twin in twins})  # type: ignore[attr-defined, arg-type]
        return MemoryServer([*lines.values()], clock=clock)

    with TwinDevices("boxes", 5, serve=serve) as twins, MemoryPorts(twins.server) as ports:  # type: ignore[arg-type]
        yield Devices(twins, ports)


@pytest.mark.slow
def test_a_night_of_glitches_leaves_the_same_pieces(
    devices: Devices, lines: dict[str, BadLine], clock: SimulatedClock, tmp_path: Path
) -> None:
    plan = devices.plan(pan=Axis(-3, 3, 1))
    whole = RunWriter.begin(tmp_path / "whole", plan)
    assert devices.run(whole, []).go()
    whole.close()
    events: list[RunEvent] = []

    def trouble(event: RunEvent) -> None:
        if isinstance(event, Moved) and not any(isinstance(one, Repeated) for one in events[-3:]):
            lines["scip2"].damage = flip
        if isinstance(event, PieceKept) and event.done == 2:
            lines["flir-ptu"].damage = lose
        if isinstance(event, PieceKept) and event.done == 4:
            devices.twins.unit.switch_on(clock.now(), homing_s=25.0)

    folder = RunWriter.begin(tmp_path / "run", plan)
    assert devices.run(folder, events, trouble).go()
    folder.close()
    assert not any(isinstance(event, Paused) for event in events)
    repeated = [event.reason for event in events if isinstance(event, Repeated)]
    assert any("was reset or lost its power" in reason for reason in repeated)
    assert any("the piece is measured again (1 of 3)" in reason for reason in repeated)
    assert same(pieces_of(tmp_path / "whole"), pieces_of(tmp_path / "run"))
    assert RunFolder.open(tmp_path / "run").closed
    logged = [json.loads(line) for line in (tmp_path / "run" / EXCHANGES).read_text().splitlines()]
    assert {one["device"] for one in logged} == {"the pan/tilt unit", "the line scanner"}
    assert any("has restarted" in one.get("remark", "") for one in logged)
    assert any(one.get("sent", "").startswith("ME") and one["bytes"] for one in logged)
    assert any(one.get("sent") == "PP " and one["received"].startswith("*") for one in logged)
    records = [json.loads(line) for line in (tmp_path / "run" / "run.jsonl").read_text().splitlines()]
    assert all(record["unit"] == {"volts": 30.0, "celsius": 30.0} for record in records)
    clocks = [record["clock"] for record in records]
    assert all(0 < one["uncertainty_s"] < 0.1 for one in clocks)
    assert (np.diff([one["scanner_s"] for one in clocks]) > 0).all()
    # The log is the run's own: it may be replaced.
    RunWriter.begin(tmp_path / "run", plan, force=True).close()


def test_a_fault_that_stays_pauses_the_run(devices: Devices, lines: dict[str, BadLine], tmp_path: Path) -> None:
    events: list[RunEvent] = []

    def see(event: RunEvent) -> None:
        if isinstance(event, Moved):
            devices.twins.scanner.failure = "rubbish"
        if isinstance(event, Paused):
            devices.twins.scanner.failure = None
            run.stop()

    folder = RunWriter.begin(tmp_path / "run", devices.plan(pan=Axis(-1, 1, 1)))
    run = devices.run(folder, events, see, fails=True)
    assert not run.go()
    folder.close()
    assert sum(isinstance(event, Repeated) for event in events) == 3
    (pause,) = [event for event in events if isinstance(event, Paused)]
    assert pause.fault
    assert devices.are_at_rest()


def test_the_log_is_bounded(tmp_path: Path) -> None:
    log = ExchangeLog(tmp_path, most_bytes=2000)
    for number in range(100):
        log.add("the unit", Exchange(0.0, b"PP ", b"* %d\r\n" % number, 0.01))
    log.close()
    log.add("the unit", Exchange(0.0, b"PP ", b"* 1\r\n", 0.01))  # by a thread that has not noticed
    sizes = [(tmp_path / name).stat().st_size for name in (EXCHANGES, EXCHANGES_BEFORE)]
    assert all(0 < size < 2300 for size in sizes)
    assert json.loads((tmp_path / EXCHANGES).read_text().splitlines()[-1])["received"] == "* 99\r\n"
