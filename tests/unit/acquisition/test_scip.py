"""The line scanner's protocol by laws, and its driver against the simulated scanner behind a real port."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ladarreg_core.acquisition.plan import ScannerPlan
from ladarreg_core.acquisition.ports import Ports
from ladarreg_core.acquisition.scip_protocol import (
    LineRequest,
    ScipError,
    checksum,
    decoded,
    encoded,
    parse_fields,
    parse_line,
    parse_status,
    reply_length,
)
from ladarreg_core.acquisition.scip_scanner import ScipScanner
from ladarreg_core.errors import Cancelled, DeviceError, OptionError
from ladarreg_core.twins.scip_twin import URG_04LX, UTM_30LX, ScipModel, ScipTwin
from ladarreg_core.twins.server import TwinServer


def test_the_examples_of_the_specification() -> None:
    assert decoded(b"1Dh", 3).tolist() == [5432]
    assert decoded(b"CB", 2).tolist() == [1234]
    assert decoded(b"m2@0", 4).tolist() == [16_000_000]
    assert encoded(5432, 3) == b"1Dh"
    assert chr(checksum(b"00")) == "P"
    assert chr(checksum(b"99")) == "b"


@given(st.integers(2, 4).flatmap(lambda n: st.tuples(st.just(n), st.integers(0, (1 << 6 * n) - 1))))
def test_numbers_survive_the_way_there_and_back(case: tuple[int, int]) -> None:
    characters, value = case
    assert decoded(encoded(value, characters), characters).tolist() == [value]
    with pytest.raises(OptionError):
        encoded(1 << (6 * characters), characters)


@given(st.binary(max_size=400), st.booleans())
def test_any_bytes_are_a_line_or_a_typed_error(received: bytes, single: bool) -> None:
    request = LineRequest(0, 9, single=single)
    assert 0 <= reply_length(received) <= len(received)
    for data in (received, received + b"\n\n", request.sent + received + b"\n\n"):
        for parse in (lambda d: parse_line(d, request), lambda d: parse_fields(d, b"VV\n")):
            with contextlib.suppress(ScipError):
                parse(data)


def wall(angles: np.ndarray, times: np.ndarray, number: int) -> tuple[np.ndarray, np.ndarray]:
    """A wall two metres ahead, none behind."""
    with np.errstate(divide="ignore"):
        ranges = np.where(np.cos(angles) > 0.2, 2.0 / np.cos(angles), np.nan)
    return ranges.astype(np.float32), np.full(len(angles), 1000.0 + number, np.float32)


def one_line(request: LineRequest) -> bytes:
    twin = ScipTwin(wall)
    twin.feed(b"BM\n", 0.5)
    twin.due(0.9)
    twin.feed(request.sent, 1.0)
    return b"".join(twin.due(t) for t in np.arange(1, 1.5, 0.005))


def test_every_single_corrupted_byte_is_noticed_unless_nothing_could_tell() -> None:
    """Of all replies in which one byte is changed, none is accepted with other values."""
    request = LineRequest(530, 560)
    whole = one_line(request)
    right = parse_line(whole, request)
    assert right.intensity is not None
    accepted = 0
    for place in range(len(whole)):
        for value in range(256):
            if value == whole[place]:
                continue
            with contextlib.suppress(ScipError):
                found = parse_line(whole[:place] + bytes([value]) + whole[place + 1 :], request)
                assert found.intensity is not None
                accepted += 1
                assert found.time_ms == right.time_ms
                assert (found.distance_mm == right.distance_mm).all()
                assert (found.intensity == right.intensity).all()
    assert accepted == 0
    for cut in range(len(whole)):
        with pytest.raises(ScipError):
            parse_line(whole[:cut], request)


def test_statuses_are_sentences() -> None:
    for status, said in ((b"10", "laser is off"), (b"0E", "does not know"), (b"60", "fault of its hardware")):
        reply = b"BM\n" + status + bytes([checksum(status)]) + b"\n\n"
        with pytest.raises(ScipError, match=said):
            parse_status(reply, b"BM\n")
    with pytest.raises(OptionError, match="1 to 99"):
        LineRequest(0, 10, count=0, single=False)


class Bench:
    def __init__(self, server: TwinServer, twin: ScipTwin, ports: Ports) -> None:
        self.server, self.twin, self.ports = server, twin, ports

    def connect(self) -> ScipScanner:
        return ScipScanner.connect(self.ports, ScannerPlan("scip2", self.server.addresses["scip2"]))

    def await_darkness(self) -> bool:
        until = time.monotonic() + 1
        while self.twin.laser_on and time.monotonic() < until:
            time.sleep(0.005)
        return not self.twin.laser_on


@pytest.fixture
def bench(request: pytest.FixtureRequest) -> Iterator[Bench]:
    model: ScipModel = getattr(request, "param", UTM_30LX)
    twin = ScipTwin(wall, model=model, seed=3)
    with TwinServer([twin]) as server, Ports(guarded=False) as ports:
        yield Bench(server, twin, ports)


def goes_on() -> None:
    pass


@pytest.mark.parametrize("bench", [UTM_30LX, URG_04LX], indirect=True, ids=["utm", "urg"])
def test_lines_are_what_was_measured(bench: Bench) -> None:
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
        ("doubled line", "lines are missing"),
        ("wrong echo", "answered .* to"),
        ("wrong status", "laser is off|status"),
        ("wrong stamp", "time stamp"),
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


@pytest.mark.parametrize("off_ms", [-400, -(1 << 20), 500, 1 << 20])
def test_a_stamp_that_is_not_between_request_and_arrival_is_refused(bench: Bench, off_ms: int) -> None:
    """Also of the first line, which has none before it."""
    scanner, right = bench.connect(), bench.twin.clock_ms
    assert len(list(scanner.lines(1, check=goes_on))) == 1
    asked = 0

    def clock_ms(now_s: float) -> int:
        nonlocal asked
        asked += 1
        return (right(now_s) + (off_ms if asked == 2 else 0)) % (1 << 24)  # the first time it is compared

    bench.twin.clock_ms = clock_ms  # type: ignore[method-assign]
    with pytest.raises(ScipError, match="after the line's arrival" if off_ms > 0 else "before the line's request"):
        list(scanner.lines(3, check=goes_on))
    assert len(list(scanner.lines(3, check=goes_on))) == 3  # a wrong stamp has spoilt nothing


def test_a_scanner_that_checks_itself_is_asked_again(bench: Bench) -> None:
    bench.twin.failure, bench.twin.fails_after_lines = "checks itself", 3
    scanner = bench.connect()
    assert scanner.identity.has_intensity
    bench.twin.failure, bench.twin.fails_after_lines = "checks itself", 3
    with pytest.raises(ScipError, match=r"checks itself after a fault \(25\); wait"):
        list(scanner.lines(3, check=goes_on))
    bench.twin.failure = None
    assert len(list(scanner.lines(3, check=goes_on))) == 3


@pytest.mark.parametrize("second", [False, True])
def test_parameters_that_differ_or_come_twice_are_refused(bench: Bench, second: bool) -> None:
    fields, asked = bench.twin._fields, 0

    def other(name: bytes, now_s: float) -> list[tuple[str, str]]:
        nonlocal asked
        found = fields(name, now_s)
        if name == b"PP":
            asked += 1
            if second:
                return [*found, ("AMAX", "700")]
            return [(key, "700" if key == "AMAX" and asked == 2 else value) for key, value in found]
        return found

    bench.twin._fields = other  # type: ignore[method-assign]
    with pytest.raises(ScipError, match="AMAX twice" if second else "other parameters when it is asked again"):
        bench.connect()


def test_the_laser_is_off_if_only_the_last_command_fails(bench: Bench) -> None:
    scanner = bench.connect()
    lines = scanner.lines(2, check=goes_on)
    next(lines)
    next(lines)
    bench.twin.failure, bench.twin.laser_on = "silent", True  # it has not obeyed
    with pytest.raises(DeviceError, match="no complete answer"):
        next(lines)
    assert bench.await_darkness()


def test_the_laser_is_off_after_a_cancel_a_break_and_a_call_from_elsewhere(bench: Bench) -> None:
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
    threading.Timer(0.3, scanner.laser_off).start()
    with pytest.raises(DeviceError):
        list(scanner.lines(99, check=goes_on))
    assert bench.await_darkness()
