"""The driver of the pan/tilt unit against the simulated unit, in memory; and behind real ports in real time."""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator

import pytest

from ladarreg_core.acquisition.devices.flir_unit import FlirUnit
from ladarreg_core.acquisition.devices.ports import Ports, PortSource
from ladarreg_core.acquisition.interfaces import PanTilt
from ladarreg_core.acquisition.plan import UnitPlan
from ladarreg_core.acquisition.simulated.flir_twin import COUNTS_PER_RAD, FlirTwin
from ladarreg_core.acquisition.simulated.server import DeviceServer, TwinServer
from ladarreg_core.errors import Cancelled, DeviceError, OptionError
from testing.devices.simulated_clock import SimulatedClock
from testing.devices.simulated_ports import MemoryPorts, MemoryServer


class Bench:
    def __init__(self, server: DeviceServer, twin: FlirTwin, ports: PortSource) -> None:
        self.server, self.twin, self.ports = server, twin, ports

    def connect(self, **plan: object) -> FlirUnit:
        address = self.server.addresses[self.twin.name]
        return FlirUnit.connect(self.ports, UnitPlan(address, baud=self.twin.baud, **plan))  # type: ignore[arg-type]

    def is_still(self) -> bool:
        return not self.twin.moving(self.server.now_s())


@pytest.fixture
def clock() -> SimulatedClock:
    return SimulatedClock()


@pytest.fixture
def bench(clock: SimulatedClock) -> Iterator[Bench]:
    twin = FlirTwin(baud=115_200)
    with MemoryServer([twin], clock=clock) as server, MemoryPorts(server) as ports:
        yield Bench(server, twin, ports)


@pytest.fixture(params=[False, True], ids=["terminal", "socket"])
def real_bench(request: pytest.FixtureRequest) -> Iterator[Bench]:
    twin = FlirTwin(baud=115_200)
    with TwinServer([twin], sockets=request.param) as server, Ports(guarded=False) as ports:
        yield Bench(server, twin, ports)


class Restless(dict[str, int]):
    """Misreads a query again and again, differently each time."""

    def pop(self, key: str, default: int = 0) -> int:  # type: ignore[override]
        if key in self:
            self[key] += 100
        return self.get(key, default)


def goes_on() -> None:
    pass


def at(pan_deg: float, tilt_deg: float) -> PanTilt:
    return PanTilt(math.radians(pan_deg), math.radians(tilt_deg))


def test_it_says_what_it_is_and_moves(bench: Bench) -> None:
    says_what_it_is_and_moves(bench)


@pytest.mark.slow
def test_it_does_so_behind_real_ports(real_bench: Bench) -> None:
    says_what_it_is_and_moves(real_bench)


def says_what_it_is_and_moves(bench: Bench) -> None:
    unit = bench.connect()
    assert "FLIR" in unit.identity.model
    assert math.degrees(unit.identity.highest.tilt_rad) == pytest.approx(30.99, abs=0.05)
    reached = unit.move_to(at(4, -3), check=goes_on)
    assert reached.pan_rad == pytest.approx(math.radians(4), abs=1 / COUNTS_PER_RAD)
    truth = bench.twin.angles_at([bench.server.now_s()])[0]
    assert (reached.pan_rad, reached.tilt_rad) == pytest.approx(tuple(truth), abs=1.01 / COUNTS_PER_RAD)
    halted = bench.twin.halted_at_s
    with pytest.raises(OptionError, match=r"a tilt of 35.00 deg is beyond the unit's limits, -46.54 to 30.99 deg"):
        unit.move_to(at(0, 35), check=goes_on)
    assert bench.twin.halted_at_s == halted, "nothing was sent"


def test_axes_that_turn_the_other_way(bench: Bench) -> None:
    unit = bench.connect(signs=(-1, -1))
    assert math.degrees(unit.identity.highest.tilt_rad) == pytest.approx(46.54, abs=0.05)
    reached = unit.move_to(at(3, 2), check=goes_on)
    assert math.degrees(reached.pan_rad) == pytest.approx(3, abs=0.02)
    assert (bench.twin.angles_at([bench.server.now_s()]) < 0).all()


def test_a_halt_in_between_ends_the_movement(bench: Bench, clock: SimulatedClock) -> None:
    unit = bench.connect()
    clock.after(0.3, unit.halt)
    begun = clock.now()
    with pytest.raises(Cancelled):
        unit.move_to(at(90, 0), check=goes_on)
    assert bench.is_still()
    assert clock.now() - begun < 0.5
    assert math.degrees(unit.position().pan_rad) < 45
    assert math.degrees(unit.move_to(at(1, 0), check=goes_on).pan_rad) == pytest.approx(1, abs=0.02)


@pytest.mark.slow
def test_a_halt_from_another_thread_ends_the_movement(real_bench: Bench) -> None:
    unit = real_bench.connect()
    moves = threading.Event()

    def halt() -> None:
        moves.wait()
        unit.halt()

    def note() -> None:
        if not real_bench.is_still():
            moves.set()

    halting = threading.Thread(target=halt)
    halting.start()
    with pytest.raises(Cancelled):
        unit.move_to(at(90, 0), check=note)
    halting.join()
    assert math.degrees(unit.position().pan_rad) < 89
    assert real_bench.is_still(), "it has answered since"


def test_a_cancelled_movement_is_halted(bench: Bench, clock: SimulatedClock) -> None:
    unit = bench.connect()
    begun = clock.now()

    def stop() -> None:
        if clock.now() - begun > 0.2:
            raise Cancelled

    with pytest.raises(Cancelled):
        unit.move_to(at(90, 0), check=stop)
    assert bench.is_still()


def test_a_unit_that_gets_stuck_or_hits_a_limit_is_halted(bench: Bench, clock: SimulatedClock) -> None:
    unit = bench.connect()
    bench.twin.stuck = True
    with pytest.raises(
        DeviceError, match=r"stands still at pan 5.\d\d, .* on its way to pan 10.00.*remove what blocks it"
    ):
        unit.move_to(at(10, 0), check=goes_on)
    bench.twin.stuck = False
    clock.after(0.3, lambda: bench.twin.hit_limit("T", clock.now()))
    with pytest.raises(DeviceError, match=r"hit its tilt limit though"):
        unit.move_to(at(60, 0), check=goes_on)
    assert bench.is_still()


@pytest.mark.parametrize("failure", ["silent", "rubbish"])
def test_a_unit_that_answers_nothing_or_rubbish_is_an_error(bench: Bench, failure: str) -> None:
    unit = bench.connect()
    setattr(bench.twin, failure, True)
    with pytest.raises(DeviceError, match="the pan/tilt unit"):
        unit.move_to(at(3, 0), check=goes_on)
    bench.twin.silent = bench.twin.rubbish = False
    assert unit.move_to(at(2, 0), check=goes_on)


def test_a_cable_that_is_pulled_and_put_back_is_noticed_and_survived(bench: Bench, clock: SimulatedClock) -> None:
    unit = bench.connect()
    bench.server.unplug(bench.twin.name)
    clock.after(0.5, lambda: bench.server.plug(bench.twin.name))
    assert math.degrees(unit.move_to(at(2, 0), check=goes_on).pan_rad) == pytest.approx(2, abs=0.02)
    bench.server.unplug(bench.twin.name)
    with pytest.raises(DeviceError, match="disappeared"):
        unit.position()


@pytest.mark.slow
def test_a_real_port_that_is_pulled_and_put_back_is_noticed_and_survived(real_bench: Bench) -> None:
    unit, server = real_bench.connect(), real_bench.server
    server.unplug(real_bench.twin.name)
    server.plug(real_bench.twin.name)  # under another name of the system, or with the connection lost
    assert math.degrees(unit.move_to(at(2, 0), check=goes_on).pan_rad) == pytest.approx(2, abs=0.02)
    server.unplug(real_bench.twin.name)
    with pytest.raises(DeviceError, match="disappeared"):
        unit.position()


def test_the_speed_of_the_plan_is_set(bench: Bench, clock: SimulatedClock) -> None:
    unit = bench.connect(speed_deg_s=6.0)
    assert math.degrees(unit.identity.speed_rad_s.pan_rad) == pytest.approx(6.0)
    unit.start_move(PanTilt(math.radians(12), 0))
    begun = clock.now()
    assert clock.wait_until(bench.is_still, 10)
    assert clock.now() - begun == pytest.approx(2, abs=0.2)  # at its usual speed it takes .4 s
    unit.close()


def test_a_speed_that_the_unit_does_not_reach_is_refused(bench: Bench) -> None:
    with pytest.raises(OptionError, match="choose another"):
        bench.connect(speed_deg_s=1000.0)


def test_a_unit_is_set_up_whatever_state_it_was_left_in(bench: Bench) -> None:
    """Moves that wait for a command to begin, limits off, in the middle of a command, and just switched on."""
    twin = bench.twin
    twin.feed(b"S LD PP-20", 0.0)
    assert twin._limits == "off"
    unit = bench.connect()
    assert twin._limits == "factory"
    assert not twin._echo
    assert not twin._verbose
    assert math.degrees(unit.move_to(at(1, 0), check=goes_on).pan_rad) == pytest.approx(1, abs=0.02)
    bench.server.unplug(twin.name)
    twin.switch_on(bench.server.now_s() + 0.1)  # it talks when it is plugged in, of limits, too
    bench.server.plug(twin.name)
    assert math.degrees(unit.move_to(at(2, 1), check=goes_on).tilt_rad) == pytest.approx(1, abs=0.02)
    assert math.degrees(unit.identity.speed_rad_s.pan_rad) == pytest.approx(twin._axes["P"].speed * 46.2857 / 3600)


def test_limits_of_the_user_are_kept(bench: Bench) -> None:
    bench.twin.feed(b"LU ", 0.0)
    unit = bench.connect()
    assert math.degrees(unit.identity.highest.pan_rad) == pytest.approx(12.86, abs=0.01)
    with pytest.raises(OptionError, match=r"beyond the unit's limits, -12.86 to 12.86"):
        unit.move_to(at(13, 0), check=goes_on)
    assert bench.twin._limits == "user"


@pytest.mark.parametrize("query", ["PR", "TX", "PS"])
def test_a_unit_that_contradicts_itself_is_refused(bench: Bench, query: str) -> None:
    bench.twin.misreads[query] = 100
    bench.connect().close()  # once may be a flipped bit
    bench.twin.misreads = Restless({query: 100})
    with pytest.raises(DeviceError, match=rf"answered \S+ to {query} and \S+ when it was asked again"):
        bench.connect()


def test_readings_that_no_movement_explains(bench: Bench) -> None:
    unit = bench.connect()
    here = unit.move_to(at(2, 0), check=goes_on)
    bench.twin.misreads["PP"] = 4_000
    assert unit.position() == here, "read again"
    bench.twin.misreads["TP"] = -3  # it is at rest
    assert unit.position() == here
    bench.twin._axes["P"].move(-5_000, bench.server.now_s() - 60)  # it is there indeed: it was pushed, or reset
    assert math.degrees(unit.position().pan_rad) == pytest.approx(-5_000 * 46.2857 / 3600, abs=0.05)


def test_a_query_that_is_not_answered_once_is_asked_again(bench: Bench, clock: SimulatedClock) -> None:
    unit = bench.connect()
    here = unit.move_to(at(2, -1), check=goes_on)
    bench.twin.late_s = 1.1
    clock.after(0.5, lambda: setattr(bench.twin, "late_s", 0.0))
    assert unit.position() == here
    clock.after(0.2, lambda: setattr(bench.twin, "silent", True))  # on its way
    clock.after(1.5, lambda: setattr(bench.twin, "silent", False))
    assert unit.move_to(at(20, 0), check=goes_on).pan_rad == pytest.approx(at(20, 0).pan_rad, abs=1e-3)


def test_answers_that_come_late_or_twice_are_not_taken_for_others(bench: Bench) -> None:
    unit = bench.connect()
    unit.move_to(at(2, -1), check=goes_on)
    bench.twin.twice = True
    first = unit.position()
    assert unit.position() == first
    bench.twin.late_s = 1.1
    with pytest.raises(DeviceError, match="no complete answer"):
        unit.position()
    bench.twin.late_s = 0.0
    for _ in range(3):
        found = unit.position()
        assert (math.degrees(found.pan_rad), math.degrees(found.tilt_rad)) == pytest.approx((2, -1), abs=0.02)
    unit.halt()
    with pytest.raises(OptionError, match="choose another"):  # the star of the halt is not taken for its success
        unit.set_speed(PanTilt(math.radians(1000), math.radians(1000)))
