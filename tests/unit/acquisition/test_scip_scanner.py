"""The driver of the line scanner against the simulated scanner, in memory; and behind a real port in real time."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from ladarreg_core.acquisition.devices.ports import Ports, PortSource
from ladarreg_core.acquisition.devices.scip_protocol import (
    ScipError,
)
from ladarreg_core.acquisition.devices.scip_scanner import ScipScanner
from ladarreg_core.acquisition.plan import ScannerPlan
from ladarreg_core.acquisition.simulated.scip_twin import URG_04LX, UTM_30LX, ScipFailure, ScipTwin
from ladarreg_core.acquisition.simulated.server import DeviceServer, TwinServer
from ladarreg_core.errors import Cancelled, DeviceError
from testing.devices.simulated_clock import SimulatedClock
from testing.devices.simulated_ports import MemoryPorts, MemoryServer
from testing.devices.wall import wall


class Bench:
    def __init__(self, server: DeviceServer, twin: ScipTwin, ports: PortSource) -> None:
        self.server, self.twin, self.ports = server, twin, ports

    def connect(self) -> ScipScanner:
        return ScipScanner.connect(self.ports, ScannerPlan("scip2", self.server.addresses["scip2"]))

    def await_darkness(self) -> bool:
        """Return whether the laser is off, at the latest when the bytes have come that are on their way."""
        until = self.ports.clock.now() + 30
        while self.twin.laser_on and self.ports.clock.now() < until:
            self.ports.clock.sleep(0.005)
        return not self.twin.laser_on


@pytest.fixture
def clock() -> SimulatedClock:
    return SimulatedClock()


@pytest.fixture
def bench(request: pytest.FixtureRequest, clock: SimulatedClock) -> Iterator[Bench]:
    twin = ScipTwin(wall, model=getattr(request, "param", UTM_30LX), seed=3)
    with MemoryServer([twin], clock=clock) as server, MemoryPorts(server) as ports:
        yield Bench(server, twin, ports)


@pytest.fixture
def real_bench() -> Iterator[Bench]:
    twin = ScipTwin(wall, seed=3)
    with TwinServer([twin]) as server, Ports(guarded=False) as ports:
        yield Bench(server, twin, ports)


def goes_on() -> None:
    pass


@pytest.mark.parametrize("bench", [UTM_30LX, URG_04LX], indirect=True, ids=["utm", "urg"])
def test_lines_are_what_was_measured(bench: Bench) -> None:
    lines_are_what_was_measured(bench)


def test_they_are_so_behind_a_real_port(real_bench: Bench) -> None:
    lines_are_what_was_measured(real_bench)


def lines_are_what_was_measured(bench: Bench) -> None:
    scanner, model = bench.connect(), bench.twin.model
    identity = scanner.identity
    assert model.product in identity.model
    assert identity.has_intensity == model.has_intensity
    assert len(identity.angles_rad) == model.last - model.first + 1
    assert identity.line_period_s == pytest.approx(model.period_s)
    lines = list(scanner.lines(4, check=goes_on))
    ahead = np.cos(identity.angles_rad) > 0.4
    for number, line in enumerate(lines):
        np.testing.assert_allclose(line.ranges_m[ahead], 2 / np.cos(identity.angles_rad[ahead]), atol=0.0006)
        assert np.isnan(line.ranges_m[np.cos(identity.angles_rad) < 0]).all()
        if model.has_intensity:
            assert line.intensity is not None
            assert (line.intensity == 1000 + number).all()
        else:
            assert line.intensity is None
    steps = np.diff([line.time_s for line in lines])
    np.testing.assert_allclose(steps, model.period_s, atol=0.0015)
    assert bench.await_darkness()


def test_the_clock_is_unwrapped_and_compared_with_the_hosts(bench: Bench) -> None:
    bench.twin._clock_start_ms = (1 << 24) - 1000 - bench.server.now_s() * 1000  # it wraps within the next second
    scanner = bench.connect()
    before = scanner.clock()
    lines = [line for _ in range(4) for line in scanner.lines(10, check=goes_on)]
    times = np.array([line.time_s for line in lines])
    assert (np.diff(times) > 0).all()
    assert times[-1] - times[0] < 10
    after = scanner.clock()
    assert (
        abs(after.host_minus_scanner_s - before.host_minus_scanner_s)
        < before.uncertainty_s + after.uncertainty_s + 0.002
    )


@pytest.mark.parametrize(
    ("failure", "said"),
    [
        ("wrong checksum", "checksum is wrong"),
        ("lost line", "1 lines are missing"),
        ("truncated", "where .* are due|incomplete"),
        ("silent", "no complete answer"),
        ("rubbish", "the line scanner"),
    ],
)
def test_failures_are_noticed_and_the_laser_is_off(bench: Bench, failure: str, said: str) -> None:
    scanner = bench.connect()
    bench.twin.failure, bench.twin.fails_after_lines = failure, 2  # type: ignore[assignment]
    got: list[object] = []
    with pytest.raises(DeviceError, match=said):
        got.extend(scanner.lines(6, check=goes_on))
    assert bench.await_darkness()
    bench.twin.failure = None
    assert len(list(scanner.lines(2, check=goes_on))) == 2


def test_lines_that_only_other_checks_find_wrong_are_refused(bench: Bench) -> None:
    scanner = bench.connect()
    failures: dict[ScipFailure, str] = {
        "doubled line": "sent a line twice",
        "wrong echo": "answered",
        "endless": "answered|acknowledge",
        "wrong status": "status .* is not one",
        "stamp checksum": "checksum of the line scanner's time stamp",
        "wrong stamp": "after it arrived|ms apart",
    }
    for failure, said in failures.items():
        bench.twin.failure = failure
        bench.twin.fails_after_lines = 0 if failure == "endless" else 1
        with pytest.raises(DeviceError, match=said):
            list(scanner.lines(3, check=goes_on))
        assert bench.await_darkness()
        assert bench.twin.failure is None, "it did fail"
    assert len(list(scanner.lines(2, check=goes_on))) == 2
    assert not bench.twin.asked_without_end


def test_the_stamp_of_the_only_line_is_checked(bench: Bench) -> None:
    scanner = bench.connect()
    for off_ms, said in ((-20_000, "before it was asked for"), (20_000, "after it arrived")):
        bench.twin.failure, bench.twin.stamp_off_ms = "wrong stamp", off_ms
        with pytest.raises(DeviceError, match=said):
            list(scanner.lines(1, check=goes_on))
        assert bench.await_darkness()
    assert len(list(scanner.lines(1, check=goes_on))) == 1


def test_a_scanner_that_is_not_ready_is_asked_again(bench: Bench) -> None:
    bench.twin.failure, bench.twin.fails_after_lines = "checks itself", 1
    scanner = bench.connect()
    assert scanner.identity.has_intensity
    bench.twin.failure, bench.twin.fails_after_lines = "checks itself", 2
    assert len(list(scanner.lines(1, check=goes_on))) == 1
    bench.twin.failure, bench.twin.fails_after_lines = "interrupted", 2
    lines = list(scanner.lines(5, check=goes_on))
    assert len(lines) == 5
    assert (np.diff([line.time_s for line in lines]) > 0).all()
    assert bench.await_darkness()


def test_a_scanner_that_is_never_ready_is_said_to_be(bench: Bench) -> None:
    bench.twin.failure, bench.twin.fails_after_lines = "checks itself", 1000
    with pytest.raises(DeviceError, match=r"does not measure yet \(98\).*switch it off and on"):
        bench.connect()


@pytest.mark.parametrize("bench", [replace(UTM_30LX, tells_time=False)], indirect=True)
def test_a_scanner_that_does_not_tell_the_time(bench: Bench) -> None:
    scanner = bench.connect()
    bench.twin._clock_start_ms = (1 << 24) - 200 - bench.server.now_s() * 1000  # it wraps while lines are measured
    assert (np.diff([line.time_s for line in scanner.lines(12, check=goes_on)]) > 0).all()
    bench.twin.failure, bench.twin.fails_after_lines = "wrong stamp", 1
    with pytest.raises(DeviceError, match="time stamp"):
        list(scanner.lines(3, check=goes_on))
    with pytest.raises(ScipError, match="does not know the command"):
        scanner.clock()


def test_parameters_that_differ_are_asked_again(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    bench.twin.failure = "parameters"
    assert bench.twin.model.most_mm == 60_000
    bench.connect().close()  # once may be a damaged answer
    stated = iter(range(59_000, 60_000))

    def restless(name: bytes, now_s: float) -> list[tuple[str, str]]:
        fields = ScipTwin._fields(bench.twin, name, now_s)
        return [(key, str(next(stated)) if key == "DMAX" else value) for key, value in fields]

    monkeypatch.setattr(bench.twin, "_fields", restless)
    with pytest.raises(DeviceError, match="stated DMAX 59002 first and 59003 when asked again"):
        bench.connect()


def test_a_failure_to_switch_the_laser_off_is_followed_by_a_stop(bench: Bench) -> None:
    scanner = bench.connect()
    lines = scanner.lines(1, check=goes_on)
    next(lines)
    # The twin keeps its laser on and does not answer the QT at the end: the next bytes that it obeys switch it off.
    bench.twin.laser_on, bench.twin.failure, bench.twin.fails_after_lines = True, "silent", 0
    stops = len([each for each in scanner.link.exchanges if each.request == b"\nQT\n"])
    with pytest.raises(DeviceError, match="no complete answer"):
        next(lines)
    assert len([each for each in scanner.link.exchanges if each.request == b"\nQT\n"]) > stops
    assert bench.await_darkness()


def test_the_laser_is_off_after_a_cancel_a_break_and_a_call_from_elsewhere(bench: Bench, clock: SimulatedClock) -> None:
    scanner = bench.connect()
    asked = iter(range(1000))

    def stop() -> None:
        if next(asked) > 30:
            raise Cancelled

    with pytest.raises(Cancelled):
        list(scanner.lines(99, check=stop))
    assert bench.await_darkness()
    for _ in scanner.lines(99, check=goes_on):
        break
    assert bench.await_darkness()
    clock.after(0.3, scanner.laser_off)
    with pytest.raises(DeviceError):
        list(scanner.lines(99, check=goes_on))
    assert bench.await_darkness()


@pytest.mark.slow
def test_another_thread_switches_the_laser_off(real_bench: Bench) -> None:
    scanner = real_bench.connect()
    lines = scanner.lines(99, check=goes_on)
    next(lines)
    thread = threading.Thread(target=scanner.laser_off)
    thread.start()
    thread.join()
    with pytest.raises(DeviceError):
        list(lines)
    assert real_bench.await_darkness()
