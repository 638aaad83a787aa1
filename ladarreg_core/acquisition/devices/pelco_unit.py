"""A pan/tilt head with absolute positions by Pelco-D."""

from __future__ import annotations

import contextlib
import math
import threading
from functools import partial

from ladarreg_core.acquisition.devices.link import Link, NoAnswerError, RoundTrip
from ladarreg_core.acquisition.devices.move_wait import Approach, await_arrival, limits_of, refuse_beyond
from ladarreg_core.acquisition.devices.pelco_protocol import (
    STEPS_PER_DEG,
    Axis,
    parse_position,
    query_position,
    response_end,
    set_position,
    steps_apart,
    stop,
)
from ladarreg_core.acquisition.devices.ports import PortSource
from ladarreg_core.acquisition.interfaces import Check, PanTilt, UnitIdentity
from ladarreg_core.acquisition.plan import UnitPlan
from ladarreg_core.errors import DeviceError, OptionError

WHOLE_RANGE_DEG = ((-180.0, 180.0), (-90.0, 90.0))
"""Range of a head whose plan states none: the protocol has no query for it."""
_ANSWER_S = 0.5
_STEP_RAD = math.radians(1 / STEPS_PER_DEG)
_REACHED, _NEAR = 2, 30  # steps; heads are built for cameras, and many stop some tenths of a degree off
_SPEED_RAD_S = math.radians(10.0)  # for forecasts alone: the protocol neither states nor sets it
_AXES: tuple[Axis, Axis] = ("pan", "tilt")
Steps = tuple[int, int]


class PelcoUnit:
    """A head that is connected and halted; use `connect`.

    Its positions are read back to .01 deg. How exact they are the protocol does not say.
    """

    def __init__(self, link: Link, plan: UnitPlan) -> None:
        self._link, self._clock, self._signs, self._address = link, link.clock, plan.signs, plan.address
        self._asking, self._halting, self._round_trip = threading.RLock(), threading.Lock(), RoundTrip()
        self._halts = 0
        self.halt()
        at = self._steps()
        ranges = WHOLE_RANGE_DEG if plan.range_deg is None else plan.range_deg
        lowest, highest = limits_of(ranges, self._signs)
        self.identity = UnitIdentity(
            f"Pelco-D head at address {self._address}", PanTilt(_STEP_RAD, _STEP_RAD),
            lowest, highest, PanTilt(_SPEED_RAD_S, _SPEED_RAD_S),
        )  # fmt: skip
        link.remark(f"the head is at {self._angles(at)}")

    @staticmethod
    def connect(ports: PortSource, plan: UnitPlan) -> PelcoUnit:
        """Connect to a head, halt it and ask where it is.

        Raises:
            DeviceError: if the port cannot be opened, or no head answers that states its position.
            OptionError: if the plan asks for a speed.
        """
        if plan.speed_deg_s is not None:
            raise OptionError(_NO_SPEED)
        halt = stop(plan.address)
        link = Link(
            ports.open(plan.port, plan.baud, stop=halt, name="pan/tilt unit"),
            device="the pan/tilt unit",
            clock=ports.clock,
        )
        try:
            unit = PelcoUnit(link, plan)
        except NoAnswerError as error:
            link.close()
            raise DeviceError(
                f"{error}. It must be set to Pelco-D and the address {plan.address}, be wired for both directions, and "
                "be of a kind that states its position (opcode 0x51)"
            ) from error
        except BaseException:
            link.close()
            raise
        link.when_connected(unit.halt)
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
        return self._angles(self._steps())

    def start_move(self, target: PanTilt) -> None:
        """Start to move.

        Raises:
            OptionError: if the target is beyond the range; nothing has been sent then.
            DeviceError: if the port is lost.
        """
        self._start(self._target_steps(target))

    def move_to(self, target: PanTilt, *, check: Check) -> PanTilt:
        """Move, await the end of the movement, and return the position read back.

        It has arrived once it reads the target twice, or stands still for a while within .3 deg of it.

        Raises:
            OptionError: if the target is beyond the range; nothing has been sent then.
            Cancelled: if `check` raises it, or `halt` is called; the head is halted then.
            DeviceError: if it stands still elsewhere, or does not answer; the head is halted then.
        """
        wanted, halts = self._target_steps(target), self._halts
        try:
            self._steps()  # opens the port again if it was lost, which sending alone does not
            self._start(wanted)
            approach = Approach(
                self._steps, lambda now: max(map(steps_apart, now, wanted)), self._angles, _REACHED, _NEAR,
                lambda now: max(map(steps_apart, now, wanted)) * _STEP_RAD / _SPEED_RAD_S,
            )  # fmt: skip
            found = await_arrival(
                approach, self._angles(wanted), clock=self._clock, round_trip=self._round_trip, check=check,
                halted=lambda: self._halts != halts,
            )  # fmt: skip
        except BaseException:
            self.halt()
            raise
        return self._angles(found)

    def set_speed(self, speed: PanTilt) -> None:
        """Refuse: the head moves to positions at a speed of its own."""
        raise OptionError(_NO_SPEED)

    def supply(self) -> dict[str, float]:
        """Return nothing: the protocol states nothing about the supply."""
        return {}

    def require_present(self) -> None:
        """Raise `DeviceError` if the port is lost; without an exchange."""
        self._link.require_present()

    def halt(self) -> None:
        """Stop at once, whatever else waits for the head; may be called from any thread, and never raises."""
        with self._halting:
            self._halts += 1
        with contextlib.suppress(DeviceError):  # the port is lost, which every later use says
            self._link.urgent(stop(self._address))

    def close(self) -> None:
        """Halt and disconnect."""
        self.halt()
        self._link.close()

    def _start(self, wanted: Steps) -> None:
        with self._asking:
            for axis, steps in zip(_AXES, wanted, strict=True):
                # Whether a head acknowledges it is up to the model: what comes is dropped by the next query.
                self._link.urgent(set_position(axis, self._address, steps))

    def _target_steps(self, target: PanTilt) -> Steps:
        refuse_beyond(target, self.identity.lowest, self.identity.highest, spare_rad=PanTilt(_STEP_RAD, _STEP_RAD))
        pan, tilt = (
            round(sign * angle / _STEP_RAD)
            for sign, angle in zip(self._signs, (target.pan_rad, target.tilt_rad), strict=True)
        )
        return pan, tilt

    def _steps(self) -> Steps:
        pan, tilt = (self._link.retried(partial(self._ask, axis)) for axis in _AXES)
        return pan, tilt

    def _ask(self, axis: Axis) -> int:
        with self._asking:
            begun = self._clock.now()
            received = self._link.exchange(
                query_position(axis, self._address),
                complete=lambda data: response_end(data, axis, self._address),
                deadline_s=_ANSWER_S,
            )
            self._round_trip.took(self._clock.now() - begun)
            return parse_position(received, axis, self._address)

    def _angles(self, steps: Steps) -> PanTilt:
        pan, tilt = (sign * each * _STEP_RAD for sign, each in zip(self._signs, steps, strict=True))
        return PanTilt(pan, tilt)


_NO_SPEED = "the speed of a head with Pelco-D cannot be set; leave 'speed_deg_s' out, it moves at its own"
