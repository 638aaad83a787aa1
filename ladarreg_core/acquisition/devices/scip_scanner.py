"""A line scanner that speaks SCIP 2, such as Hokuyo's."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Generator
from functools import partial
from typing import TypeVar

import numpy as np

from ladarreg_core.acquisition.devices.link import QUIET_FIRST_S, Link, RoundTrip, twice_alike
from ladarreg_core.acquisition.devices.ports import PortSource
from ladarreg_core.acquisition.devices.scip_clock import ClockSample, LineTimes, ScannerClock
from ladarreg_core.acquisition.devices.scip_protocol import (
    MAX_LINES,
    STOP,
    LineRequest,
    RawLine,
    ScipError,
    ScipNotReadyError,
    ScipParameters,
    answers_another,
    is_acknowledgement,
    parse_clock,
    parse_fields,
    parse_line,
    parse_status,
    reply_length,
    without_local_echo,
)
from ladarreg_core.acquisition.devices.scip_status import UNKNOWN_COMMAND
from ladarreg_core.acquisition.interfaces import Check, ClockReading, LineScannerIdentity, ScanLine
from ladarreg_core.acquisition.plan import ScannerPlan
from ladarreg_core.errors import DeviceError

_T = TypeVar("_T")
_ANSWER_S = 1.5
_FIRST_LINE_S = 3.0
_READY_S = 10.0  # for which a scanner may say that it does not measure yet
_ASK_AGAIN_S = 0.3
_NAP_S = 0.02
_QUIET_S, _LONGEST_QUIET_S = 0.15, 1.5
_CLOCK_READINGS = 8
_COMPARED_FOR_S = 60.0  # for which a comparison of the clocks holds
_MM = 0.001


class ScipScanner:
    """A line scanner that is connected, with its laser off; use `connect`."""

    def __init__(self, link: Link) -> None:
        self._link, self._host_clock = link, link.clock
        self._round_trip, self._asked_s = RoundTrip(), 0.0
        self._clock, self._tells_time = ScannerClock(), True
        self._set_up()
        self._parameters, self.identity = self._identify()

    @staticmethod
    def connect(ports: PortSource, plan: ScannerPlan) -> ScipScanner:
        """Connect to a scanner, switch its laser off and ask what it is.

        Raises:
            DeviceError: if the port cannot be opened, or what answers is no such scanner.
        """
        port = ports.open(plan.port, plan.baud, stop=STOP, name="line scanner")
        link = Link(port, device="the line scanner", clock=ports.clock)
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

        A scanner that interrupts a request to verify itself is asked again for the lines that are missing.

        Raises:
            DeviceError: if a line is missing, late or damaged; the laser is off then.
            Cancelled: if `check` raises it; the laser is off then.
        """
        try:
            until = self._host_clock.now() + _READY_S
            while count > 0:
                try:
                    for line in self._part(min(count, MAX_LINES), check):
                        yield line
                        count, until = count - 1, self._host_clock.now() + _READY_S
                except ScipNotReadyError:
                    if self._host_clock.now() > until:
                        raise
                    self.laser_off()
                    self._settle()
                    self._wait(_ASK_AGAIN_S, check)
            parse_status(self._ask(b"QT\n"), b"QT\n")
        except BaseException:
            self.laser_off()
            self._settle()
            raise

    def clock(self) -> ClockReading:
        """Return how the scanner's clock relates to the host's, from the quickest of several exchanges.

        Raises:
            DeviceError: if the scanner does not answer as specified, or its clock jumped since it was last compared.
        """
        self._asked(b"TM0\n", partial(parse_status, allowed=("00", "02")))
        samples = []
        try:
            for _ in range(_CLOCK_READINGS):
                clock_ms = self._asked(b"TM1\n", parse_clock)
                samples.append(ClockSample(self._asked_s, self._host_clock.now(), clock_ms))
        finally:
            self._asked(b"TM2\n", partial(parse_status, allowed=("00", "03")))
        return self._clock.compare(samples)

    @property
    def last_clock(self) -> ClockReading | None:
        """How the clocks related when they were compared last; None if that no longer holds."""
        return self._clock.reading

    def require_present(self) -> None:
        """Raise `DeviceError` if the port is lost; without an exchange."""
        self._link.require_present()

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
        if self._tells_time and not self._clock.is_fresh(self._host_clock.now(), for_s=_COMPARED_FOR_S):
            self.clock()
        steps = self._parameters.first_step, self._parameters.last_step
        request = LineRequest(*steps, count=count, with_intensity=self.identity.has_intensity, single=False)
        asked_s = self._host_clock.now()
        # The request itself switches the laser on, and its end off.
        received = self._ask(request.sent, check)
        if not is_acknowledgement(received, request):
            raise ScipError("the line scanner did not acknowledge the request for lines; check the cable")
        parse_status(received, request.sent)
        if self._tells_time and not self._clock.is_fresh(asked_s, for_s=2 * _COMPARED_FOR_S):
            raise ScipNotReadyError("the line scanner was connected anew while it was asked for lines; resume")
        times = LineTimes(self._clock, period_s=self.identity.line_period_s, asked_s=asked_s)
        for left in reversed(range(count)):
            deadline = _FIRST_LINE_S if left == count - 1 else _ANSWER_S
            received = self._link.receive(complete=reply_length, deadline_s=deadline, check=check)
            raw = parse_line(received, request, most_mm=self._parameters.most_mm)
            arrived_s = self._host_clock.now()
            self._require_next(raw, left, times)
            if not self._clock.is_fresh(arrived_s, for_s=2 * _COMPARED_FOR_S):  # it does not tell the time
                self._clock.compare([ClockSample(asked_s, arrived_s, raw.time_ms)])
            yield self._line(raw, times.accept(raw.time_ms, arrived_s=arrived_s))

    def _require_next(self, raw: RawLine, left: int, times: LineTimes) -> None:
        """Refuse lines that are missing or doubled."""
        if raw.left == left + 1 and times.repeats(raw.time_ms):
            raise ScipError(
                "the line scanner sent a line twice; check the cable, or what lies between it and this port"
            )
        if raw.left > left:
            raise ScipError(
                f"the line scanner sent lines out of order: it announced {raw.left} more where {left} are due; check "
                "the cable, and that no other program uses the port"
            )
        if raw.left < left:
            raise ScipError(
                f"{left - raw.left} lines are missing: the scanner announced {raw.left} more where {left} are due; "
                "lower the load of this computer or of the connection"
            )

    def _line(self, raw: RawLine, stamp_s: float) -> ScanLine:
        intensity = None if raw.intensity is None else raw.intensity.astype(np.float32)
        # The stamp is that of step 0, which not all scanners measure.
        first_ray_s = self._parameters.first_step / self._parameters.steps_a_turn * self.identity.line_period_s
        return ScanLine(self._parameters.ranges_m(raw.distance_mm), intensity, stamp_s + first_ray_s)

    def _set_up(self) -> None:
        """Switch the laser off, wait until all that was under way has come, and see that it answers."""
        self.laser_off()
        self._settle()
        self._clock.forget()
        self._asked(b"QT\n", parse_status)

    def _settle(self) -> None:
        """Discard what the scanner still sends after it was stopped; wait longer if it is far away."""
        quiet_s = self._round_trip.quiet_s(_QUIET_S if self._round_trip.longest_s else QUIET_FIRST_S)
        with contextlib.suppress(DeviceError):
            self._link.exchange(b"", complete=lambda data: False, deadline_s=min(quiet_s, _LONGEST_QUIET_S))

    def _identify(self) -> tuple[ScipParameters, LineScannerIdentity]:
        version = self._fields(b"VV\n")
        limits, again = twice_alike(lambda: self._fields(b"PP\n"))
        if limits != again:
            name = next(name for name in (*limits, *again) if limits.get(name) != again.get(name))
            raise ScipError(
                f"the line scanner stated {name} {limits.get(name)} first and {again.get(name)} when asked again; "
                "check the cable"
            )
        found = ScipParameters.of(limits)
        self._tells_time = self._status_when_ready(b"TM2\n", ("00", "03", *UNKNOWN_COMMAND)) not in UNKNOWN_COMMAND
        model = ", ".join(version[name] for name in ("VEND", "PROD", "FIRM", "SERI") if version.get(name))
        steps = np.arange(found.first_step, found.last_step + 1)
        period = 60.0 / found.turns_a_minute
        return found, LineScannerIdentity(
            model or "line scanner",
            np.asarray((steps - found.front_step) * (2 * np.pi / found.steps_a_turn), np.float64),
            found.least_mm * _MM,
            found.most_mm * _MM,
            period,
            (found.last_step - found.first_step) / found.steps_a_turn * period,
            self._has_intensity(found.front_step),
        )

    def _has_intensity(self, step: int) -> bool:
        """Return whether the scanner has the commands with intensity; without the laser it refuses those that it has.

        A scanner that has neither command is refused, and so is one whose answer says nothing about it.
        """
        with_intensity = LineRequest(step, step, with_intensity=True)
        if self._status_when_ready(with_intensity.sent, ("00", "10", *UNKNOWN_COMMAND)) not in UNKNOWN_COMMAND:
            return True
        self._status_when_ready(LineRequest(step, step, with_intensity=False).sent, ("00", "10"))
        return False

    def _status_when_ready(self, sent: bytes, allowed: tuple[str, ...]) -> str:
        """Return the status of an answer, asking again while the scanner does not measure yet."""
        until = self._host_clock.now() + _READY_S
        while True:
            try:
                return self._asked(sent, partial(parse_status, allowed=allowed))[0]
            except ScipNotReadyError:
                if self._host_clock.now() > until:
                    raise
            self._host_clock.sleep(_ASK_AGAIN_S)

    def _fields(self, sent: bytes) -> dict[str, str]:
        return dict(self._asked(sent, parse_fields))

    def _asked(self, sent: bytes, parse: Callable[[bytes, bytes], _T]) -> _T:
        """Return what is read from the answer to a command that does the same when it is sent again."""
        return self._link.retried(lambda: parse(self._ask(sent), sent), unless=ScipNotReadyError, settle=self._settle)

    def _ask(self, sent: bytes, check: Check | None = None) -> bytes:
        """Return the answer to a command; late ones to earlier commands, known by their echo, are dropped."""
        begun = self._asked_s = self._host_clock.now()
        received = self._link.exchange(sent, complete=reply_length, deadline_s=_ANSWER_S, check=check)
        while answers_another(received, sent) and self._host_clock.now() - begun < _ANSWER_S:
            received = self._link.receive(complete=reply_length, deadline_s=_ANSWER_S, check=check)
        self._round_trip.took(self._host_clock.now() - begun)
        return without_local_echo(received, sent)

    def _wait(self, seconds: float, check: Check) -> None:
        until = self._host_clock.now() + seconds
        while self._host_clock.now() < until:
            check()
            self._host_clock.sleep(_NAP_S)
