"""A FLIR / Directed Perception pan/tilt unit."""

from __future__ import annotations

import contextlib
import math
import threading
from dataclasses import replace
from functools import partial

from ladarreg_core.acquisition.devices.axis_readings import AxisReadings
from ladarreg_core.acquisition.devices.flir_protocol import (
    STOP,
    FlirError,
    FlirReply,
    command,
    has_restarted,
    limits_hit,
    parse_reply,
    reply_length,
    supply_of,
)
from ladarreg_core.acquisition.devices.link import QUIET_FIRST_S, TRIES, Link, NoAnswerError, RoundTrip, twice_alike
from ladarreg_core.acquisition.devices.move_wait import Approach, await_arrival, refuse_beyond
from ladarreg_core.acquisition.devices.ports import PortSource
from ladarreg_core.acquisition.interfaces import Check, PanTilt, UnitIdentity
from ladarreg_core.acquisition.plan import UnitPlan
from ladarreg_core.errors import DeviceError, OptionError

HOMING_S = 35.0
"""How long a unit that was switched on may take to find its zeros, during which it answers nothing: up to 30 s."""
_ANSWER_S = 1.0
_CONNECT_S = 2.0
_ARC_SECONDS = math.radians(1 / 3600)
_REACHED_COUNTS = 1
_QUIET_S, _QUIET_IN_DOUBT_S, _LONGEST_TALK_S = 0.1, 0.3, 1.0
_RESTARTED = (
    "the pan/tilt unit was reset or lost its power for a moment; it has found its zeros again and is set up as before: "
    "check its power supply"
)
_MAX_TURNS_RAD = 4 * math.pi  # from the zero of an axis to its limit
_AXES = (("P", "pan"), ("T", "tilt"))


class FlirRestartedError(FlirError):
    """The unit was reset or lost its power; it has found its zeros again, and is set up as before."""


class FlirUnit:
    """A unit that is connected and halted; use `connect`.

    Angles are positive to the left and upward; the plan's signs turn an axis that is mounted the other way round.
    """

    def __init__(self, link: Link, signs: tuple[int, int], *, patience_s: float = HOMING_S) -> None:
        self._link, self._signs, self._clock = link, signs, link.clock
        self._halts = self._halts_answered = 0
        self._halting, self._asking = threading.Lock(), threading.RLock()
        self._limits_hit: tuple[str, ...] = ()
        self._in_doubt = self._setting_up = self._restarted = False
        self._round_trip = RoundTrip()
        self._states_supply = True
        self._axes: list[AxisReadings] = []
        self._fastest_counts_s = 0.0
        self._set_up(patience_s)
        self._counts_at_limits: list[tuple[int, int]] = []
        self._step_rad: list[float] = []
        self.identity = self._identify()

    @staticmethod
    def connect(ports: PortSource, plan: UnitPlan, *, patience_s: float = HOMING_S) -> FlirUnit:
        """Connect to a unit, halt it, ask what it is, and set the plan's speed.

        Args:
            ports: opens the port.
            plan: of the unit.
            patience_s: how long it may be silent, since it may still be finding its zeros.

        Raises:
            DeviceError: if the port cannot be opened, or what answers is no such unit.
            OptionError: if the unit refuses the plan's speed.
        """
        port = ports.open(plan.port, plan.baud, stop=STOP, name="pan/tilt unit")
        link = Link(port, device="the pan/tilt unit", clock=ports.clock)
        try:
            unit = FlirUnit(link, plan.signs, patience_s=patience_s)
            if plan.speed_deg_s is not None:
                speed = math.radians(plan.speed_deg_s)
                unit.set_speed(PanTilt(speed, speed))
        except BaseException:
            link.close()
            raise
        link.when_connected(unit._set_up_again)
        return unit

    @property
    def link(self) -> Link:
        """The link, with its latest exchanges."""
        return self._link

    def position(self) -> PanTilt:
        """Return where it is.

        Raises:
            DeviceError: if it does not answer as specified.
        """
        return self._angles(self._positions())

    def start_move(self, target: PanTilt) -> None:
        """Start to move.

        Raises:
            OptionError: if the target is beyond the limits; nothing has been sent then.
            DeviceError: if the unit does not answer as specified.
        """
        wanted = self._target_counts(target)
        for axis in self._axes:
            axis.may_move()
        for (letter, _), counts in zip(_AXES, wanted, strict=True):
            self._asked(command(f"{letter}P", counts))

    def move_to(self, target: PanTilt, *, check: Check) -> PanTilt:
        """Move, await the end of the movement, and return the position read back.

        Raises:
            OptionError: if the target is beyond the limits; nothing has been sent then.
            Cancelled: if `check` raises it, or `halt` is called; the unit is halted then.
            DeviceError: if it stands still elsewhere, hits a limit, or does not answer; the unit is halted then.
        """
        wanted = self._target_counts(target)
        halts = self._halts
        try:
            self.start_move(target)
            return self._angles(self._await(wanted, halts, check))
        except OptionError:
            raise
        except BaseException:
            self.halt()
            raise

    def set_speed(self, speed: PanTilt) -> None:
        """Set the speed of both axes, rad/s.

        Raises:
            OptionError: if the unit refuses it.
        """
        for (letter, axis), value, step in zip(_AXES, (speed.pan_rad, speed.tilt_rad), self._step_rad, strict=True):
            counts_s = max(1, round(abs(value) / step))
            self._fastest_counts_s = max(self._fastest_counts_s, counts_s)
            try:
                self._asked(command(f"{letter}S", counts_s))
            except FlirRestartedError:
                raise
            except FlirError as error:
                raise OptionError(
                    f"the pan/tilt unit does not {axis} at {math.degrees(value):.3g} deg/s; choose another ({error})"
                ) from error
        self.identity = replace(self.identity, speed_rad_s=speed)

    def supply(self) -> dict[str, float]:
        """Return what the unit states about its supply and temperature, `volts` and `celsius`, as far as it does."""
        if not self._states_supply:
            return {}
        try:
            found = supply_of(self._asked(command("O")).text)
        except FlirRestartedError:
            raise
        except FlirError:  # it does not have the query
            found = {}
        self._states_supply = bool(found)
        return found

    def require_present(self) -> None:
        """Raise `DeviceError` if the port is lost; without an exchange."""
        self._link.require_present()

    def halt(self) -> None:
        """Stop at once, whatever else waits for the unit; may be called from any thread, and never raises."""
        with self._halting:
            self._halts += 1
        with contextlib.suppress(DeviceError):  # the port is lost, which every later use says
            self._link.urgent(STOP)

    def close(self) -> None:
        """Halt and disconnect."""
        self.halt()
        self._link.close()

    def _set_up(self, patience_s: float) -> bool:
        """Halt; set terse answers without echo, immediate moves and limits. Return whether the unit has restarted.

        A unit that was just switched on talks first, and answers nothing until it has found its zeros; one that was
        left in the middle of a command answers that.
        """
        begun, halts, tries = self._clock.now(), self._halts, 0
        self._setting_up, self._restarted = True, False
        try:
            while True:
                tries += 1
                self._link.urgent(STOP)
                self._settle(_QUIET_S if self._round_trip.longest_s else QUIET_FIRST_S)
                try:
                    for name in ("FT", "ED", "CI", "I"):
                        self._ask(command(name), deadline_s=_CONNECT_S)
                    break
                except (FlirError, NoAnswerError) as error:
                    silent = isinstance(error, NoAnswerError)
                    waits = (silent or self._restarted) and self._clock.now() - begun < patience_s
                    if self._halts != halts or not (waits or (tries < TRIES and not silent)):
                        raise
            if self._limits_are() == "off":
                self._asked(command("LE"))
            restarted = self._restarted
        finally:
            self._setting_up = self._restarted = False
        self._limits_hit = ()  # a reset reports them, too
        for axis in self._axes:
            axis.forget()
        if restarted:
            self._link.remark("the unit has restarted, and found its zeros")
        return restarted

    def _set_up_again(self) -> bool:
        """Set up as before: a unit that lost its power has forgotten its speed, too. Return whether it restarted."""
        restarted = self._set_up(HOMING_S)
        self.set_speed(self.identity.speed_rad_s)
        return restarted

    def _identify(self) -> UnitIdentity:
        model = self._asked(command("V")).text
        self._step_rad = [self._asked_twice(f"{letter}R") * _ARC_SECONDS for letter, _ in _AXES]
        if not all(1e-7 < step < 0.1 for step in self._step_rad):
            raise FlirError(
                f"the pan/tilt unit states steps of {', '.join(f'{math.degrees(s):.3g}' for s in self._step_rad)} deg, "
                "which no unit has; check the baud rate"
            )
        of_user = "U" if self._limits_are() == "user" else ""
        self._counts_at_limits = []
        for (letter, axis), step in zip(_AXES, self._step_rad, strict=True):
            low, high = (self._asked_twice(f"{letter}{end}", whole=True) for end in "NX")
            if of_user:
                inner = [self._asked_twice(f"{letter}{end}{of_user}", whole=True) for end in "NX"]
                low, high = max(low, inner[0]), min(high, inner[1])
            if not (low < high and max(abs(low), abs(high)) * step <= _MAX_TURNS_RAD):
                raise FlirError(f"the pan/tilt unit states {axis} limits of {low:g} to {high:g} counts; reset the unit")
            self._counts_at_limits.append((int(low), int(high)))
        self._axes = [
            AxisReadings(f"{letter}P", partial(self._counts, f"{letter}P"), limits=limits, clock=self._clock)
            for (letter, _), limits in zip(_AXES, self._counts_at_limits, strict=True)
        ]
        counts_s = [self._asked_twice(f"{letter}S", whole=True) for letter, _ in _AXES]
        self._fastest_counts_s = max(self._fastest_counts_s, *counts_s)
        speeds = [count * step for count, step in zip(counts_s, self._step_rad, strict=True)]
        ends = [self._angles([axis[k] for axis in self._counts_at_limits]) for k in (0, 1)]
        return UnitIdentity(
            " ".join(model.split())[:120],
            PanTilt(*self._step_rad),
            PanTilt(min(e.pan_rad for e in ends), min(e.tilt_rad for e in ends)),
            PanTilt(max(e.pan_rad for e in ends), max(e.tilt_rad for e in ends)),
            PanTilt(*speeds),
        )

    def _target_counts(self, target: PanTilt) -> list[int]:
        """Return the counts of a position.

        Raises:
            OptionError: if it is not finite or beyond the limits.
        """
        refuse_beyond(target, self.identity.lowest, self.identity.highest, spare_rad=PanTilt(*self._step_rad))
        wanted = zip(self._signs, _pair(target), self._step_rad, self._counts_at_limits, strict=True)
        return [min(max(round(sign * angle / step), low), high) for sign, angle, step, (low, high) in wanted]

    def _await(self, wanted: list[int], halts: int, check: Check) -> list[int]:
        """Return the counts once the unit stands at the target."""

        def travel_s(now: list[int]) -> float:
            speeds = _pair(self.identity.speed_rad_s)
            ways = zip(now, wanted, self._step_rad, speeds, strict=True)
            return max(abs(a - b) * step / max(speed, 1e-4) for a, b, step, speed in ways)

        approach = Approach(
            self._positions, lambda now: max(abs(a - b) for a, b in zip(now, wanted, strict=True)), self._angles,
            _REACHED_COUNTS, _REACHED_COUNTS, travel_s,
        )  # fmt: skip
        return await_arrival(
            approach, self._angles(wanted), clock=self._clock, round_trip=self._round_trip, check=check,
            halted=lambda: self._halts != halts, watch=self._refuse_limits,
        )  # fmt: skip

    def _refuse_limits(self) -> None:
        if hit := self._limits_hit:
            self._limits_hit = ()
            raise DeviceError(
                f"the pan/tilt unit reports that it hit its {' and '.join(dict.fromkeys(hit))} limit though the target "
                "lies within; it is halted: reset the unit, so that it finds its zero again, and resume"
            )

    def _asked_twice(self, query: str, *, whole: bool = False) -> float:
        """Return what a unit states about itself, twice in a row the same: answers have no checksum."""
        sent = command(query)

        def value() -> float:
            reply = self._asked(sent)
            return reply.counts(sent) if whole else reply.number(sent)

        last, again = twice_alike(value)
        if last != again:
            raise FlirError(
                f"the pan/tilt unit answered {last:g} to {query} and {again:g} when it was asked again; check "
                "the cable, and that no other program uses the port"
            )
        return again

    def _limits_are(self) -> str:
        """Return whether the unit enforces limits: `on`, `off`, or `user` for those that its user has set."""
        try:
            words = self._asked(command("L")).text.upper()
        except FlirRestartedError:
            raise
        except FlirError:  # it does not have the query, and always enforces its limits
            return "on"
        return "off" if "OFF" in words or "DISABLE" in words else "user" if "USER" in words else "on"

    def _positions(self) -> list[int]:
        return [axis.position(self._fastest_counts_s) for axis in self._axes]

    def _counts(self, query: str) -> int:
        """Return what a query reads; a silent unit may be finding its zeros after a restart, and is waited for."""
        sent = command(query)
        try:
            return self._link.retried(lambda: self._ask(sent).counts(sent), unless=FlirRestartedError)
        except NoAnswerError:
            if self._setting_up or self._halts != self._halts_answered:
                raise
            if self._set_up_again():
                raise FlirRestartedError(_RESTARTED) from None
            raise

    def _asked(self, sent: bytes) -> FlirReply:
        """Return the reply to a command that does the same when it is sent again."""
        return self._link.retried(lambda: self._ask(sent), unless=FlirRestartedError)

    def _angles(self, counts: list[int]) -> PanTilt:
        pan, tilt = (sign * n * step for sign, n, step in zip(self._signs, counts, self._step_rad, strict=True))
        return PanTilt(pan, tilt)

    def _ask(self, sent: bytes, *, deadline_s: float = _ANSWER_S) -> FlirReply:
        with self._asking:
            if self._in_doubt or self._halts != self._halts_answered:
                # The answer to a halt, or one that came too late, would be taken for the one to this command.
                self._halts_answered = self._halts
                self._settle(_QUIET_IN_DOUBT_S if self._in_doubt else _QUIET_S)
            self._in_doubt = True
            begun = self._clock.now()
            received = self._link.exchange(sent, complete=lambda data: reply_length(data, sent), deadline_s=deadline_s)
            self._round_trip.took(self._clock.now() - begun)
            unasked = self._link.take_unasked()
            self._restarted |= has_restarted(unasked + received)
            if self._restarted and not self._setting_up:
                self._set_up_again()
                raise FlirRestartedError(_RESTARTED)  # where it was moving to is in doubt
            reply = parse_reply(received, sent)
            self._in_doubt = False
            self._limits_hit += limits_hit(unasked) + reply.limits_hit
            return reply

    def _settle(self, quiet_s: float = _QUIET_S) -> None:
        """Discard what the unit still sends, except limits that it reports; wait longer if it is far away."""
        until, passed = self._clock.now() + _LONGEST_TALK_S, b""
        quiet_s = min(self._round_trip.quiet_s(quiet_s), _LONGEST_TALK_S)
        with contextlib.suppress(DeviceError):  # it is quiet, or the port is lost, which the next command says
            while self._clock.now() < until:
                passed += self._link.exchange(b"", complete=bool, deadline_s=quiet_s)
        passed += self._link.take_unasked()
        self._restarted |= has_restarted(passed)
        self._limits_hit += limits_hit(passed)


def _pair(at: PanTilt) -> tuple[float, float]:
    return at.pan_rad, at.tilt_rad
