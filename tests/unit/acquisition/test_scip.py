"""The line scanner's protocol by laws, and its driver against the simulated scanner behind a real port."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ladarreg_core.acquisition.plan import ScannerPlan
from ladarreg_core.acquisition.ports import Ports
from ladarreg_core.acquisition.scip_clock import ClockSample, LineTimes, ScannerClock
from ladarreg_core.acquisition.scip_protocol import (
    CLOCK_MS,
    LineRequest,
    ScipError,
    ScipNotReadyError,
    ScipParameters,
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
from ladarreg_core.twins.scip_twin import URG_04LX, UTM_30LX, ScipFailure, ScipModel, ScipTwin
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


@pytest.mark.parametrize(
    ("sent", "status", "said"),
    [
        (b"GE0000001001\n", b"10", "laser is off"),
        (b"GE0000001001\n", b"01", "a start step that is no number"),
        (b"BM\n", b"01", "its laser does not work"),
        (b"BM\n", b"02", "on already"),
        (b"TM1\n", b"04", "clock is not being compared"),
        (b"QT\n", b"01", "the status 01, which the protocol does not have for this command"),
        (b"ME0000001001001\n", b"07", "a number of lines that is no number"),
        (b"GE0000001001\n", b"07", "does not have for this command"),
        (b"BM\n", b"0E", "does not know the command"),
        (b"BM\n", b"0I", "firmware is being updated"),
        (b"BM\n", b"60", "fault of its hardware"),
        (b"QT\n", b"30", "fault of its own"),
    ],
)
def test_what_a_status_says_depends_on_the_command(sent: bytes, status: bytes, said: str) -> None:
    reply = sent + status + bytes([checksum(status)]) + b"\n\n"
    with pytest.raises(ScipError, match=said) as refused:
        parse_status(reply, sent)
    assert not isinstance(refused.value, ScipNotReadyError)


def test_a_scanner_that_verifies_itself_is_not_broken() -> None:
    for sent, status in ((b"ME0000001001001\n", b"21"), (b"ME0000001001001\n", b"98"), (b"GD0000001001\n", b"98")):
        with pytest.raises(ScipNotReadyError, match="does not measure yet"):
            parse_status(sent + status + bytes([checksum(status)]) + b"\n\n", sent)


def test_lines_are_never_requested_without_end_nor_acknowledged_so() -> None:
    for count in (0, 100, -1):
        with pytest.raises(OptionError, match="1 to 99"):
            LineRequest(0, 10, count=count, single=False)
    request = LineRequest(0, 10, count=7, single=False)
    for echo in (request.sent, request.sent.replace(b"07\n", b"00\n")):
        reply = echo + b"00" + bytes([checksum(b"00")]) + b"\n\n"
        if echo == request.sent:
            assert parse_status(reply, request.sent) == ("00", [])
        else:
            with pytest.raises(ScipError, match="answered"):
                parse_status(reply, request.sent)
    assert all(LineRequest(0, 10, count=n, single=False).sent[-3:-1] == f"{n:02d}".encode() for n in range(1, 100))


def fields_reply(*fields: bytes, sent: bytes = b"PP\n") -> bytes:
    return sent + b"00P\n" + b"".join(each + b";" + bytes([checksum(each)]) + b"\n" for each in fields) + b"\n"


def test_fields() -> None:
    # As real scanners state them, with their own checksums.
    real = b"PP\n00P\nMODL:URG-04LX(Hokuyo Automatic Co.,Ltd.);N\nDMIN:20;4\nDMAX:5600;_\nARES:1024;\\\nAMIN:44;7\n"
    real += b"AMAX:725;o\nAFRT:384;6\nSCAN:600;e\n\n"
    assert ScipParameters.of(parse_fields(real, b"PP\n")) == ScipParameters(20, 5600, 1024, 44, 725, 384, 600)
    assert parse_fields(fields_reply(b"DMIN: 20"), b"PP\n") == {"DMIN": "20"}
    for fields, said in (
        ((b"DMIN:20", b"DMIN:30"), "the field DMIN twice in one answer"),
        ((b"DMIN:2\xb2",), "where a field is due"),
        ((b"DMIN:2\x00",), "where a field is due"),
        ((b"DMI:20",), "where a field is due"),
    ):
        with pytest.raises(ScipError, match=said):
            parse_fields(fields_reply(*fields), b"PP\n")
    with pytest.raises(ScipError, match="checksum"):
        parse_fields(fields_reply(b"DMIN:20").replace(b"20", b"21"), b"PP\n")


GOOD = {"DMIN": "23", "DMAX": "60000", "ARES": "1440", "AMIN": "0", "AMAX": "1080", "AFRT": "540", "SCAN": "2400"}


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"AFRT": "1081"}, "AFRT 1081, AMIN 0, AMAX 1080, which no scanner has"),
        ({"AMIN": "600"}, "AFRT 540, AMIN 600, AMAX 1080"),
        ({"DMAX": "0"}, "DMIN 23, DMAX 0"),
        ({"DMAX": "300000"}, "DMAX 300000"),
        ({"ARES": "1439"}, "ARES 1439"),
        ({"ARES": "0"}, "ARES 0"),
        ({"AMAX": "1440"}, "AMAX 1440, ARES 1440"),
        ({"AMAX": "0", "AFRT": "0"}, "AMIN 0, AMAX 0"),
        ({"SCAN": "0"}, "SCAN 0"),
        ({"SCAN": "24000"}, "SCAN 24000"),
        ({"SCAN": "9" * 5000}, "does not state SCAN in numbers"),
        ({"DMIN": "\u0663"}, "does not state DMIN in numbers"),
        ({"DMIN": "-5"}, "does not state DMIN in numbers"),
    ],
)
def test_absurd_parameters_are_refused_in_a_sentence(changed: dict[str, str], said: str) -> None:
    assert ScipParameters.of(GOOD).most_mm == 60_000
    with pytest.raises(ScipError, match=said):
        ScipParameters.of(GOOD | changed)


class TestClock:
    """Comparing clocks and the times of lines, without any device."""

    @staticmethod
    def compared(offset_ms: float, *, at_s: float = 100.0) -> ScannerClock:
        clock = ScannerClock()
        clock.compare([ClockSample(at_s, at_s + 0.002, int(offset_ms + (at_s + 0.001) * 1000) % CLOCK_MS)])
        return clock

    @staticmethod
    def times(clock: ScannerClock) -> LineTimes:
        return LineTimes(clock, period_s=0.025, asked_s=101.0)

    @given(st.integers(0, CLOCK_MS - 1), st.floats(0, 0.5))
    def test_lines_in_step_are_accepted_wherever_the_clock_wraps(self, offset_ms: int, waited_s: float) -> None:
        times = self.times(self.compared(offset_ms))
        found = []
        for k in range(30):
            begun = 101.0 + waited_s + k * 0.025
            stamp = int(offset_ms + begun * 1000) % CLOCK_MS
            found.append(times.accept(stamp, arrived_s=begun + 0.03 + (0.4 if k % 7 == 0 else 0)))
        np.testing.assert_allclose(np.diff(found), 0.025, atol=0.0011)

    @pytest.mark.parametrize("off_ms", [-300, -60, -8, 8, 60, 300, 1 << 20])
    def test_a_stamp_that_is_off_is_refused_and_poisons_nothing(self, off_ms: int) -> None:
        clock = self.compared(5000)
        first = self.times(clock)
        if abs(off_ms) > 20:  # the first line has no line before it, but the clock of the host
            with pytest.raises(ScipError, match=r"before it was asked for|after it arrived"):
                first.accept((5000 + 101_010 + off_ms) % CLOCK_MS, arrived_s=101.04)
        times = self.times(clock)
        times.accept(5000 + 101_010, arrived_s=101.04)
        with pytest.raises(ScipError, match=r"before it was|after it|ms apart"):
            times.accept((5000 + 101_035 + off_ms) % CLOCK_MS, arrived_s=101.065)
        again = self.times(clock)
        assert again.accept(5000 + 101_035, arrived_s=101.065) == pytest.approx(106.035)

    def test_turns_that_are_left_out_are_whole(self) -> None:
        times = self.times(self.compared(0))
        times.accept(101_010, arrived_s=101.04)
        assert times.accept(101_085, arrived_s=101.12) == pytest.approx(101.085)
        with pytest.raises(ScipError, match="38 ms apart"):
            times.accept(101_123, arrived_s=101.16)

    def test_steps_that_are_each_a_little_long_are_noticed(self) -> None:
        times = self.times(self.compared(0))

        def measure() -> None:
            for k in range(60):
                times.accept(101_010 + 27 * k, arrived_s=101.1 + 0.027 * k)

        with pytest.raises(ScipError, match="ms apart"):
            measure()

    def test_clocks_that_contradict_each_other(self) -> None:
        clock = self.compared(0)
        with pytest.raises(ScipError, match=r"differs by 0.50 s between two readings"):
            clock.compare([ClockSample(101, 101.002, 101_001), ClockSample(101.1, 101.103, 101_601)])
        clock = self.compared(0)
        with pytest.raises(ScipError, match="switched off and on"):
            clock.compare([ClockSample(160, 160.002, 17)])
        assert not clock.is_fresh(160, for_s=60)
        assert clock.compare([ClockSample(161, 161.002, 1017)]).host_minus_scanner_s == pytest.approx(159.984)


class TestTwin:
    """Commands that the driver does not send, by the bytes of the specification."""

    @staticmethod
    def answers(twin: ScipTwin, sent: bytes, *, at_s: float, for_s: float = 0.3) -> list[bytes]:
        twin.feed(sent, at_s)
        came = b"".join(twin.due(at_s + t) for t in np.arange(0, for_s, 0.004))
        return came.split(b"\n\n")[:-1]

    def test_distances_of_two_characters(self) -> None:
        twin = ScipTwin(wall, model=URG_04LX)
        assert len(self.answers(twin, b"BM\n", at_s=0.5)) == 1
        (reply,) = self.answers(twin, b"GS0380038801\n", at_s=1.0)
        echo, status, _, data = reply.split(b"\n")
        assert (echo, status) == (b"GS0380038801", b"00P")
        assert checksum(data[:-1]) == data[-1]
        assert decoded(data[:-1], 2).tolist() == pytest.approx([2000] * 9, abs=2)
        acknowledged, first, last = self.answers(twin, b"MS0384038401002\n", at_s=2.0, for_s=0.5)
        assert acknowledged.endswith(b"\n00P")
        assert [each[:17] for each in (first, last)] == [b"MS0384038401001\n9", b"MS0384038401000\n9"]
        assert not twin.laser_on
        assert self.answers(twin, b"GE0384038401\n", at_s=3.0)[0].split(b"\n")[1][:2] == b"0E"

    def test_a_reset_sets_its_clock_to_zero(self) -> None:
        twin = ScipTwin(wall, seed=5)
        assert twin.clock_ms(10.0) > 20
        assert self.answers(twin, b"TM1\n", at_s=9.0)[0].split(b"\n")[1] == b"04" + bytes([checksum(b"04")])
        twin.feed(b"TM0\n", 9.5)
        twin.feed(b"BM\nRS\n", 10.0)
        assert not twin.laser_on
        assert twin.clock_ms(10.005) <= 10
        assert self.answers(twin, b"TM1\n", at_s=11.0)[-1].split(b"\n")[1][:2] == b"04"

    def test_a_request_without_a_number_does_not_end(self) -> None:
        twin = ScipTwin(wall)
        replies = self.answers(twin, b"MD0540054001000\n", at_s=1.0, for_s=3.0)
        assert len(replies) > 100
        assert twin.asked_without_end
        twin.feed(b"QT\n", 4.1)
        assert not twin.laser_on


class Bench:
    def __init__(self, server: TwinServer, twin: ScipTwin, ports: Ports) -> None:
        self.server, self.twin, self.ports = server, twin, ports

    def connect(self) -> ScipScanner:
        return ScipScanner.connect(self.ports, ScannerPlan("scip2", self.server.addresses["scip2"]))

    def await_darkness(self) -> bool:
        until = time.monotonic() + 5
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


def test_a_scanner_that_is_never_ready_is_said_to_be(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ladarreg_core.acquisition.scip_scanner._READY_S", 0.0)
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


def test_parameters_that_differ_when_asked_again_are_refused(bench: Bench) -> None:
    bench.twin.failure = "parameters"
    assert bench.twin.model.most_mm == 60_000
    with pytest.raises(DeviceError, match="stated DMAX 59000 first and 60000 when asked again"):
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


def test_what_is_no_distance_is_no_return() -> None:
    """Error codes below the least distance, and what lies beyond the largest one; few send more than 65,535."""
    request, stamp = LineRequest(0, 5, with_intensity=False), encoded(1, 4)
    head = request.sent + b"00P\n" + stamp + bytes([checksum(stamp)]) + b"\n"

    def reply(*values: int) -> bytes:
        data = b"".join(encoded(value, 3) for value in values)
        return head + data + bytes([checksum(data)]) + b"\n\n"

    raw = parse_line(reply(0, 22, 23, 60_000, 60_001, 65_535), request)
    ranges = ScipParameters.of(GOOD).ranges_m(raw.distance_mm)
    np.testing.assert_allclose(ranges, [np.nan, np.nan, 0.023, 60.0, np.nan, np.nan], rtol=1e-6)
    far = reply(0, 22, 23, 60_000, 60_001, 65_536)
    with pytest.raises(ScipError, match="65536 mm"):
        parse_line(far, request)
    assert parse_line(far, request, most_mm=80_000).distance_mm[-1] == 65_536


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
