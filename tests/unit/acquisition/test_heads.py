"""The drivers of heads with Pelco-D and ONVIF against simulated ones, in memory; and behind a real port and network."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ladarreg_core.acquisition.devices.link import NoAnswerError
from ladarreg_core.acquisition.devices.onvif_unit import OnvifUnit
from ladarreg_core.acquisition.devices.pelco_unit import PelcoUnit
from ladarreg_core.acquisition.devices.ports import Ports
from ladarreg_core.acquisition.interfaces import PanTilt
from ladarreg_core.acquisition.line_sweep import LineSweep
from ladarreg_core.acquisition.plan import Axis, Plan, ScannerPlan, UnitPlan
from ladarreg_core.acquisition.plan_reading import plan_from_fields
from ladarreg_core.acquisition.runs.connected import Unit, identified
from ladarreg_core.acquisition.simulated.devices import TwinDevices
from ladarreg_core.acquisition.simulated.flir_twin import FlirTwin
from ladarreg_core.acquisition.simulated.onvif_twin import OnvifServer, OnvifTwin
from ladarreg_core.acquisition.simulated.pelco_twin import PelcoTwin
from ladarreg_core.acquisition.simulated.world import LINE_MOUNT
from ladarreg_core.errors import Cancelled, DeviceError, OptionError
from testing.devices.runs import recorded_pieces
from testing.devices.simulated_clock import SimulatedClock
from testing.devices.simulated_ports import MemoryPorts, MemoryServer

HEADS = ("pelco-d", "onvif")
_TRIP_S = 0.02


class HeadBench:
    """A simulated head in memory, on a simulated clock, and its driver."""

    def __init__(self, kind: str, clock: SimulatedClock, **head: Any) -> None:
        self.kind, self.clock = kind, clock
        self.unit = FlirTwin()
        self.twin: Any = PelcoTwin(self.unit, **head) if kind == "pelco-d" else OnvifTwin(self.unit, **head)
        self.is_there = True
        self.server = MemoryServer([self.twin] if kind == "pelco-d" else [], clock=clock)
        self.ports = MemoryPorts(self.server)

    def connect(self, *, password: str = "", **plan: Any) -> Unit:
        if self.kind == "onvif":
            where = UnitPlan("http://head.example/onvif/device_service", "onvif", **plan)
            return OnvifUnit.connect(where, clock=self.clock, send=self._send, password=password)
        return PelcoUnit.connect(self.ports, UnitPlan("memory:pelco-d", "pelco-d", **plan))

    def pull(self) -> None:
        """Pull the cable."""
        self.is_there = False
        if self.kind == "pelco-d":
            self.server.unplug("pelco-d")

    def _send(self, url: str, body: bytes, deadline_s: float) -> tuple[int, bytes]:
        self.clock.sleep(_TRIP_S)
        answered = self.twin.answer(body, self.clock.now()) if self.is_there else None
        if answered is None:
            self.clock.sleep(deadline_s)
            raise NoAnswerError(f"the pan/tilt unit at {url} does not answer (timed out)")
        return answered

    def truth_deg(self) -> tuple[float, float]:
        pan, tilt = self.unit.angles_at([self.clock.now()])[0]
        return math.degrees(pan), math.degrees(tilt)

    def is_still(self) -> bool:
        return not self.unit.moving(self.clock.now())


@pytest.fixture
def clock() -> SimulatedClock:
    return SimulatedClock()


@pytest.fixture(params=HEADS)
def bench(request: pytest.FixtureRequest, clock: SimulatedClock) -> HeadBench:
    return HeadBench(request.param, clock)


def goes_on() -> None:
    pass


def at(pan_deg: float, tilt_deg: float) -> PanTilt:
    return PanTilt(math.radians(pan_deg), math.radians(tilt_deg))


def deg(where: PanTilt) -> tuple[float, float]:
    return math.degrees(where.pan_rad), math.degrees(where.tilt_rad)


def test_it_moves_left_and_up_and_reads_back_where_it_is(bench: HeadBench) -> None:
    unit = bench.connect()
    for wanted in ((30.0, -12.0), (-75.25, 20.5), (0.0, 0.0), (0.3, 0.0)):
        reached = unit.move_to(at(*wanted), check=goes_on)
        assert bench.truth_deg() == pytest.approx(wanted, abs=0.01), "positive is to the left and upward"
        assert deg(reached) == pytest.approx(bench.truth_deg(), abs=0.006)
        assert bench.is_still()
        assert deg(unit.position()) == pytest.approx(deg(reached))
    assert unit.supply() == {}
    unit.require_present()


def test_axes_that_turn_the_other_way(bench: HeadBench) -> None:
    unit = bench.connect(signs=(-1, -1))
    assert deg(unit.move_to(at(20, 10), check=goes_on)) == pytest.approx((20, 10), abs=0.02)
    assert bench.truth_deg() == pytest.approx((-20, -10), abs=0.02)


@pytest.mark.parametrize("kind", HEADS)
def test_a_target_beyond_the_range_is_refused_before_it_moves(kind: str, clock: SimulatedClock) -> None:
    bench = HeadBench(kind, clock)
    unit = bench.connect(range_deg=((-100.0, 100.0), (-20.0, 30.0)))
    assert deg(unit.identity.lowest) == pytest.approx((-100, -20))
    with pytest.raises(OptionError, match=r"a tilt of 30.50 deg is beyond the unit's limits, -20.00 to 30.00 deg"):
        unit.move_to(at(0, 30.5), check=goes_on)
    with pytest.raises(OptionError, match="beyond the unit's limits"):
        unit.move_to(at(math.nan, 0), check=goes_on)
    assert bench.truth_deg() == (0, 0)


def test_a_halt_in_between_ends_the_movement(bench: HeadBench) -> None:
    unit = bench.connect()
    clock = bench.clock
    begun = clock.now()

    def stop() -> None:
        if clock.now() - begun > 0.8:
            raise Cancelled

    with pytest.raises(Cancelled):
        unit.move_to(at(120, 0), check=stop)
    assert bench.is_still()
    assert 0 < bench.truth_deg()[0] < 100

    def halt() -> None:
        if bench.unit.moving(clock.now()):
            unit.halt()

    with pytest.raises(Cancelled):
        unit.move_to(at(-120, 0), check=halt)
    assert bench.is_still()
    assert deg(unit.move_to(at(1, 0), check=goes_on)) == pytest.approx((1, 0), abs=0.02)


def test_one_that_gets_stuck_is_halted_and_said_to_be(bench: HeadBench) -> None:
    unit = bench.connect()
    bench.unit.stuck = True
    with pytest.raises(DeviceError, match=r"stands still at pan 20\.\d\d, tilt 0.00 deg on its way to pan 40\.00"):
        unit.move_to(at(40, 0), check=goes_on)
    assert bench.is_still()


def test_one_that_stops_short_by_a_little_has_arrived_where_it_says(bench: HeadBench) -> None:
    """Heads are built for cameras: what counts is that the angle that is kept is the one read back."""
    unit = bench.connect()
    bench.unit.stuck = True  # it goes half of the way
    reached = unit.move_to(at(0.5, 0), check=goes_on)
    assert deg(reached) == pytest.approx((0.25, 0), abs=0.01)
    assert bench.truth_deg() == pytest.approx((0.25, 0), abs=0.01)


@pytest.mark.parametrize("failure", ["silent", "rubbish"])
def test_one_that_fails_is_said_to_and_asked_again(bench: HeadBench, failure: str) -> None:
    unit = bench.connect()
    setattr(bench.twin, failure, True)
    begun = bench.clock.now()
    with pytest.raises(DeviceError, match="the pan/tilt unit"):
        unit.position()
    bench.clock.after(0.3, lambda: setattr(bench.twin, failure, False))
    assert deg(unit.position()) == (0, 0), "it was asked again"
    assert bench.clock.now() - begun < 15


def test_one_whose_cable_is_pulled_is_lost(bench: HeadBench) -> None:
    unit = bench.connect()
    bench.pull()
    with pytest.raises(DeviceError):
        unit.move_to(at(10, 0), check=goes_on)
    with pytest.raises(DeviceError):
        unit.require_present()
    unit.halt()
    unit.close()


# -- Pelco-D -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("responds", "baud"), [(False, 2400), (True, 2400), (True, 9600)])
def test_heads_that_acknowledge_and_those_that_do_not(clock: SimulatedClock, responds: bool, baud: int) -> None:
    bench = HeadBench("pelco-d", clock, responds=responds, baud=baud, address=77)
    unit = bench.connect(address=77, baud=baud)
    for wanted in ((2.5, 1.0), (-170.0 + 5, 29.0)):
        assert deg(unit.move_to(at(*wanted), check=goes_on)) == pytest.approx(wanted, abs=0.02)


def test_a_head_at_another_address_does_not_answer(clock: SimulatedClock) -> None:
    bench = HeadBench("pelco-d", clock, address=3)
    with pytest.raises(
        DeviceError, match=r"no complete answer .* the address 1, be wired .* its position .opcode 0x51"
    ):
        bench.connect()


def test_a_speed_cannot_be_set_by_pelco_d(clock: SimulatedClock) -> None:
    with pytest.raises(OptionError, match="leave 'speed_deg_s' out"):
        HeadBench("pelco-d", clock).connect(speed_deg_s=5.0)


# -- ONVIF -------------------------------------------------------------------------------------------------------------


def test_a_password_is_needed_where_there_are_users(clock: SimulatedClock) -> None:
    bench = HeadBench("onvif", clock, user="operator", password="s3cret&")
    with pytest.raises(
        DeviceError, match=r"NotAuthorized .*set 'user' of the plan's unit, and its password in LADARREG"
    ):
        bench.connect()
    with pytest.raises(DeviceError, match="NotAuthorized"):
        bench.connect(user="operator", password="wrong")
    unit = bench.connect(user="operator", password="s3cret&")
    assert deg(unit.move_to(at(3, 2), check=goes_on)) == pytest.approx((3, 2), abs=0.02)
    clock.jump(3600)
    assert deg(unit.position()) == pytest.approx((3, 2), abs=0.02), "signed in its own time, also after an hour"


def test_neither_password_nor_digest_is_logged(clock: SimulatedClock) -> None:
    bench = HeadBench("onvif", clock, user="operator", password="s3cret&")
    unit = bench.connect(user="operator", password="s3cret&")
    logged = []
    unit.link.log_to(lambda device, exchange: logged.append(exchange.request))
    unit.position()
    assert any(request.startswith(b"GetStatus") for request in logged)
    assert not any(word in request for request in logged for word in (b"s3cret", b"Digest", b"Nonce"))


def test_one_without_degrees_needs_its_range_stated(clock: SimulatedClock) -> None:
    bench = HeadBench("onvif", clock, has_degrees=False)
    with pytest.raises(OptionError, match=r"states no degrees; give its range, from its data sheet, as 'range_deg'"):
        bench.connect()
    low, high = bench.unit.range_deg
    unit = bench.connect(range_deg=((low[0], high[0]), (low[1], high[1])))
    reached = unit.move_to(at(33.3, -7.7), check=goes_on)
    assert bench.truth_deg() == pytest.approx((33.3, -7.7), abs=0.01)
    assert deg(reached) == pytest.approx((33.3, -7.7), abs=0.02)
    with pytest.raises(OptionError, match=r"does not move at 5 deg/s: it does by parts of its full speed alone"):
        unit.set_speed(at(5, 5))


def test_a_speed_is_set_in_degrees(clock: SimulatedClock) -> None:
    bench = HeadBench("onvif", clock)
    unit = bench.connect(speed_deg_s=4.0)
    assert deg(unit.identity.speed_rad_s) == pytest.approx((4, 4))
    begun = clock.now()
    unit.move_to(at(20, 0), check=goes_on)
    assert clock.now() - begun == pytest.approx(5, abs=0.7)
    with pytest.raises(OptionError, match=r"does not move at 500 deg/s: it does from"):
        unit.set_speed(at(500, 500))


# -- behind a real port and over a real network ------------------------------------------------------------------------


@pytest.fixture(scope="module")
def devices() -> Iterator[TwinDevices]:
    with TwinDevices() as twins:
        yield twins


@pytest.mark.parametrize("kind", HEADS)
def test_it_is_identified_where_it_stands(devices: TwinDevices, kind: str) -> None:
    found = identified(devices.addresses[kind]) if kind == "onvif" else None
    if found is None:
        with Ports(guarded=False) as ports:
            unit = PelcoUnit.connect(ports, UnitPlan(devices.addresses[kind], "pelco-d", devices.pelco.baud))
            assert "Pelco-D head at address 1" in unit.identity.model
        return
    assert (found.kind, found.baud) == ("onvif", None)
    assert "simulated ONVIF head" in found.identity.model  # type: ignore[attr-defined]


@pytest.mark.slow
@pytest.mark.parametrize("kind", HEADS)
def test_a_sweep_by_each_head(devices: TwinDevices, kind: str, tmp_path: Path) -> None:
    unit = UnitPlan(devices.addresses[kind], kind, devices.pelco.baud)  # type: ignore[arg-type]
    scanner = ScannerPlan("scip2", devices.addresses["scip2"])
    plan = Plan(unit, scanner, "sweep", Axis(-1, 1, 1), Axis(0, 0, 0), LINE_MOUNT, settle_s=0.0)
    pieces = recorded_pieces(plan.as_fields(), tmp_path / "run")
    pans = [float(np.degrees(piece.pan_rad).mean()) for piece in pieces if isinstance(piece, LineSweep)]
    assert pans == pytest.approx([-1, 0, 1], abs=0.02)
    logged = (tmp_path / "run" / "exchanges.jsonl").read_text()
    assert "the pan/tilt unit" in logged


def test_a_head_that_is_not_there_is_said_not_to_be() -> None:
    with OnvifServer(OnvifTwin(FlirTwin()), lambda: 0.0) as server:
        url = server.url
    with pytest.raises(DeviceError, match=r"at http://127.0.0.1:\d+/onvif/device_service does not answer"):
        OnvifUnit.connect(UnitPlan(url, "onvif"))


# -- in the plan -------------------------------------------------------------------------------------------------------


def plan_of(unit: dict[str, Any], **others: Any) -> Plan:
    fields = {
        "version": 1, "unit": unit, "scanner": {"kind": "scip2", "port": "/dev/ttyACM0"}, "mode": "sweep",
        "pan_deg": [-10, 10, 1], "mount": {"xyz_m": [0, 0, 0], "rpy_deg": [90, 0, 0]}, **others,
    }  # fmt: skip
    return plan_from_fields(fields)


@pytest.mark.parametrize(
    "unit",
    [
        {"kind": "pelco-d", "port": "/dev/ttyUSB0", "baud": 2400, "signs": [1, -1], "address": 12,
         "range_deg": [[-170.0, 170.0], [-30.0, 60.0]]},
        {"kind": "onvif", "port": "http://10.0.0.4/onvif/device_service", "signs": [1, 1], "user": "admin",
         "speed_deg_s": 12.0},
    ],
)  # fmt: skip
def test_a_plan_names_a_head(unit: dict[str, Any]) -> None:
    plan = plan_of(unit)
    assert plan.as_fields()["unit"] == unit
    assert plan_from_fields(plan.as_fields()).unit == plan.unit


@pytest.mark.parametrize(
    ("unit", "others", "said"),
    [
        ({"kind": "pelco-d", "port": "COM1", "speed_deg_s": 3}, {}, "'speed_deg_s' cannot be set at a head with"),
        ({"kind": "pelco-d", "port": "COM1", "address": 300}, {}, "'address' of 'unit' is 300"),
        ({"kind": "pelco-d", "port": "COM1", "user": "a"}, {}, "'unit' of kind 'pelco-d' has an unknown key"),
        ({"kind": "pelco-d", "port": "COM1", "range_deg": [[10, -10], [0, 1]]}, {}, "lowest and highest pan"),
        ({"kind": "onvif", "port": "10.0.0.4"}, {}, "it must be the URL of its device service"),
        ({"kind": "onvif", "port": "http://h/", "baud": 9600}, {}, "'unit' of kind 'onvif' has an unknown key"),
        ({"kind": "onvif", "port": "http://h/"}, {"continuous": True}, "'continuous' reads positions while"),
        ({"kind": "visca", "port": "COM1"}, {}, "must be 'flir-ptu' or 'pelco-d' or 'onvif'"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_a_head_is_said(unit: dict[str, Any], others: dict[str, Any], said: str) -> None:
    with pytest.raises(OptionError, match=said):
        plan_of(unit, **others)
