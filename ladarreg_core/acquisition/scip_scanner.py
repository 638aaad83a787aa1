"""A line scanner that speaks SCIP 2, such as Hokuyo's."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Generator, Mapping

import numpy as np

from ladarreg_core.acquisition.devices import Check, ClockReading, LineScannerIdentity, ScanLine
from ladarreg_core.acquisition.link import Link
from ladarreg_core.acquisition.plan import ScannerPlan
from ladarreg_core.acquisition.ports import Ports
from ladarreg_core.acquisition.scip_protocol import (
    CLOCK_MS,
    MOST_LINES,
    SETTLING,
    STOP,
    UNKNOWN,
    LineRequest,
    RawLine,
    ScipError,
    is_acknowledgement,
    parse_clock,
    parse_fields,
    parse_line,
    parse_status,
    reply_length,
)
from ladarreg_core.errors import DeviceError

_ANSWER_S = 1.5
_FIRST_LINE_S = 3.0
_QUIET_S = 0.15
_CLOCK_READINGS = 8
_OFF_BEAT = 0.05  # of the turns between two lines: a motor is not perfect, and a busy scanner leaves lines out
_STAMP_S = 0.003
_COMPARISON_HOLDS_S, _DRIFT = 10.0, 2e-4  # two clocks that run freely
_SETTLING_S, _ASKED_AGAIN_S = 5.0, 0.2
_FIELDS = ("DMIN", "DMAX", "ARES", "AMIN", "AMAX", "AFRT", "SCAN")
_MOST_RPM = 60_000
_MM = 0.001


class ScipScanner:
    """A line scanner that is connected, with its laser off; use `connect`."""

    def __init__(self, link: Link) -> None:
        self._link = link
        self._host_minus_clock_s: float | None = None
        self._doubt_s, self._compared_at_s = np.inf, -np.inf
        self._has_clock = True
        self._set_up()
        self._steps, self.identity = self._identify()

    @staticmethod
    def connect(ports: Ports, plan: ScannerPlan) -> ScipScanner:
        """Connect to a scanner, switch its laser off and ask what it is.

        Raises:
            DeviceError: if the port cannot be opened, or what answers is no such scanner.
        """
        link = Link(ports.open(plan.port, plan.baud, stop=STOP, name="line scanner"), device="the line scanner")
        try:
            scanner = ScipScanner(link)
        except BaseException:
            link.close()
            raise
        link.when_connected(scanner._set_up)
        return scanner

    @property
    def link(self) -> Link:
        """The link, with its latest exchanges."""
        return self._link

    def lines(self, count: int, *, check: Check) -> Generator[ScanLine]:
        """Switch the laser on, measure a bounded number of lines, and switch it off, whatever happens.

        Raises:
            DeviceError: if a line is missing, late or damaged; the laser is off then.
            Cancelled: if `check` raises it; the laser is off then.
        """
        try:
            if self._has_clock and time.monotonic() - self._compared_at_s > _COMPARISON_HOLDS_S:
                self._compared(1)
            while count > 0:
                part = min(count, MOST_LINES)
                yield from self._part(part, check)
                count -= part
            parse_status(self._ask(b"QT\n"), b"QT\n")
        except BaseException:
            self.laser_off()
            self._settle()
            raise

    def clock(self) -> ClockReading:
        """Return how the scanner's clock relates to the host's, from the quickest of several exchanges.

        Raises:
            DeviceError: if the scanner does not answer as specified.
        """
        return self._compared(_CLOCK_READINGS)

    def _compared(self, readings: int) -> ClockReading:
        parse_status(self._ask(b"TM0\n"), b"TM0\n", allowed=("00", "02"))
        found = []
        try:
            for _ in range(readings):
                begun = time.monotonic()
                clock_ms = parse_clock(self._ask(b"TM1\n"), b"TM1\n")
                ended = time.monotonic()
                middle = (begun + ended) / 2
                found.append(ClockReading(middle - self._unwrapped(clock_ms, middle), (ended - begun) / 2 + 0.0005))
        finally:
            parse_status(self._ask(b"TM2\n"), b"TM2\n", allowed=("00", "03"))
        best = min(found, key=lambda reading: reading.uncertainty_s)
        self._host_minus_clock_s, self._doubt_s = best.host_minus_scanner_s, best.uncertainty_s
        self._compared_at_s = time.monotonic()
        return best

    def laser_off(self) -> None:
        """Switch the laser off at once; may be called from any thread, and never raises."""
        with contextlib.suppress(DeviceError):  # the port is lost, which every later use says
            self._link.urgent(STOP)

    def close(self) -> None:
        """Switch the laser off and disconnect."""
        self.laser_off()
        self._link.close()

    def _part(self, count: int, check: Check) -> Generator[ScanLine]:
        """Yield lines of one request."""
        requested_s = time.monotonic()
        request = LineRequest(*self._steps, count=count, with_intensity=self.identity.has_intensity, single=False)
        # The request itself switches the laser on, and its end off.
        received = self._link.exchange(request.sent, complete=reply_length, deadline_s=_ANSWER_S, check=check)
        if is_acknowledgement(received, request):
            parse_status(received, request.sent)
        else:
            raise ScipError("the line scanner did not acknowledge the request for lines; check the cable")
        before: ScanLine | None = None
        for left in reversed(range(count)):
            deadline = _FIRST_LINE_S if before is None else _ANSWER_S
            raw = parse_line(self._link.receive(complete=reply_length, deadline_s=deadline, check=check), request)
            if raw.left != left:
                raise ScipError(
                    f"{left - raw.left} lines are missing: the scanner announced {raw.left} more where {left} are due; "
                    "lower the load of this computer or of the connection"
                )
            now = time.monotonic()
            line = self._line(raw, now)
            self._require_in_time(line, requested_s, now)
            if before is not None:
                self._require_order(before, line)
            if not self._has_clock:
                self._host_minus_clock_s = now - line.time_s  # good enough to see the clock wrap
            yield line
            before = line

    def _line(self, raw: RawLine, received_s: float) -> ScanLine:
        mm = raw.distance_mm
        least, most = self.identity.least_range_m, self.identity.most_range_m
        ranges = (mm * _MM).astype(np.float32)
        ranges[(mm * _MM < least) | (mm * _MM > most)] = np.nan  # error codes, and no echo
        intensity = None if raw.intensity is None else raw.intensity.astype(np.float32)
        return ScanLine(ranges, intensity, self._unwrapped(raw.time_ms, received_s))

    def _require_in_time(self, line: ScanLine, requested_s: float, received_s: float) -> None:
        """Refuse a line that was not measured between its request and its arrival, by the host's clock."""
        if self._host_minus_clock_s is None:
            return
        at_s, period = line.time_s + self._host_minus_clock_s, self.identity.line_period_s
        doubt_s = self._doubt_s + _STAMP_S + _DRIFT * (received_s - self._compared_at_s)
        if not requested_s - period - doubt_s < at_s < received_s + doubt_s:
            early, late = 1000 * (requested_s - at_s), 1000 * (at_s - received_s)
            raise ScipError(
                f"the line scanner's time stamp lies {early:.0f} ms before the line's request; check the cable"
                if early > 0
                else f"the line scanner's time stamp lies {late:.0f} ms after the line's arrival; check the cable"
            )

    def _require_order(self, before: ScanLine, line: ScanLine) -> None:
        """Refuse lines that are no whole number of turns apart: repeated ones, and stamps that were damaged."""
        step, period = line.time_s - before.time_s, self.identity.line_period_s
        turns = round(step / period)
        if turns < 1 or abs(step - turns * period) > _OFF_BEAT * turns * period + _STAMP_S:
            raise ScipError(
                f"the line scanner's time stamps are {1000 * step:.0f} ms apart where {1000 * period:.0f} ms are due; "
                "check the cable"
            )

    def _unwrapped(self, clock_ms: int, host_s: float) -> float:
        """Return the scanner's clock without the jumps at which it wraps, s, as it was about `host_s`."""
        here, wrap_s = clock_ms * _MM, CLOCK_MS * _MM
        if self._host_minus_clock_s is not None:
            here += round((host_s - self._host_minus_clock_s - here) / wrap_s) * wrap_s
        return here

    def _set_up(self) -> None:
        """Switch the laser off, wait until all that was under way has come, and see that it answers."""
        self.laser_off()
        self._settle()
        parse_status(self._ask(b"QT\n"), b"QT\n")

    def _settle(self) -> None:
        """Let pass what the scanner still sends after it was told to stop."""
        with contextlib.suppress(DeviceError):
            self._link.exchange(b"", complete=lambda data: False, deadline_s=_QUIET_S)

    def _identify(self) -> tuple[tuple[int, int], LineScannerIdentity]:
        version, limits = self._fields(b"VV\n"), self._fields(b"PP\n")
        if limits != self._fields(b"PP\n"):  # what its checksums let through
            raise ScipError("the line scanner states other parameters when it is asked again; check the cable")
        missing = [name for name in _FIELDS if not limits.get(name, "").isdigit()]
        if missing:
            raise ScipError(f"the line scanner does not state {', '.join(missing)}; it is not supported")
        least, most, turn, first, last, front, rpm = (int(limits[name]) for name in _FIELDS)
        if not (0 <= first <= front <= last < turn and 0 <= least < most and 0 < rpm <= _MOST_RPM):
            raise ScipError(
                f"the line scanner states steps {first} to {last} with {front} ahead of {turn} a turn, {least} to "
                f"{most} mm and {rpm} turns a minute, which no scanner has; check the cable"
            )
        has_intensity = self._knows(LineRequest(front, front, with_intensity=True))
        self._has_clock = self._status(b"TM2\n", ("00", "03", *UNKNOWN)) not in UNKNOWN
        model = ", ".join(version[name] for name in ("VEND", "PROD", "FIRM", "SERI") if version.get(name))
        steps = np.arange(first, last + 1)
        period = 60.0 / rpm
        return (first, last), LineScannerIdentity(
            model or "line scanner",
            np.asarray((steps - front) * (2 * np.pi / turn), np.float64),
            least * _MM,
            most * _MM,
            period,
            (last - first) / turn * period,
            has_intensity,
        )

    def _knows(self, request: LineRequest) -> bool:
        """Return whether a request is known; without the laser it is refused by 10 where it is."""
        return self._status(request.sent, ("00", "10", *UNKNOWN)) not in UNKNOWN

    def _status(self, sent: bytes, allowed: tuple[str, ...]) -> str:
        """Return the status of the answer to a command; a scanner that checks itself is asked again for a while."""
        until = time.monotonic() + _SETTLING_S
        while True:
            patient = time.monotonic() < until
            status, _ = parse_status(self._ask(sent), sent, allowed=(*allowed, *SETTLING) if patient else allowed)
            if status not in SETTLING:
                return status
            time.sleep(_ASKED_AGAIN_S)

    def _fields(self, sent: bytes) -> Mapping[str, str]:
        return parse_fields(self._ask(sent), sent)

    def _ask(self, sent: bytes) -> bytes:
        return self._link.exchange(sent, complete=reply_length, deadline_s=_ANSWER_S)
