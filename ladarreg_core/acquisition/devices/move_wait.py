"""Awaits the end of a movement by reading positions again and again: units do not say when they have arrived."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

from ladarreg_core.acquisition.clock import Clock
from ladarreg_core.acquisition.devices.link import RoundTrip
from ladarreg_core.acquisition.interfaces import Check, PanTilt
from ladarreg_core.errors import Cancelled, DeviceError, OptionError

_POLL_S = 0.03
_STUCK_S, _STUCK_TRIPS = 1.5, 4  # without a change of position, and round trips on top of it
_SPARE_S = 10.0  # on top of thrice the time that a move should take
_STILL_READINGS = 2  # alike, in a row
_Reading = TypeVar("_Reading")


@dataclass(frozen=True, slots=True)
class Approach(Generic[_Reading]):
    """What a movement is judged by; distances in the unit of the readings."""

    read: Callable[[], _Reading]
    """Reads where the unit is; equal readings mean that it stands still."""
    distance: Callable[[_Reading], float]
    """How far a reading is from the target; infinite while the unit says that it moves."""
    position: Callable[[_Reading], PanTilt]
    """Turns a reading into angles."""
    there: float
    """Distance at which it has arrived once it stands still."""
    near: float
    """Distance at which it has arrived if it comes no closer: a unit may be coarser than its target."""
    travel_s: Callable[[_Reading], float]
    """How long the movement from a reading should take."""


def await_arrival(
    approach: Approach[_Reading], target: PanTilt, *, clock: Clock, round_trip: RoundTrip, check: Check,
    halted: Callable[[], bool], watch: Callable[[], None] = lambda: None,
) -> _Reading:  # fmt: skip
    """Return the reading at which a unit stands at its target.

    Args:
        approach: what the movement is judged by.
        target: where it is to go, for messages.
        clock: what time is measured by.
        round_trip: how long the unit takes to answer.
        check: called often; may raise `Cancelled`.
        halted: whether the unit was halted meanwhile.
        watch: called after each reading that does not end the wait; may raise `DeviceError`.

    Raises:
        Cancelled: if `check` raises it, or the unit was halted.
        DeviceError: if it stands still elsewhere, or does not arrive in time.
    """
    begun = moved = clock.now()
    last, still = approach.read(), 0
    travel_s = approach.travel_s(last)
    while True:
        check()
        if halted():
            raise Cancelled
        now = approach.read()
        off = approach.distance(now)
        if now != last:
            last, moved, still = now, clock.now(), 0
        elif off <= approach.there:
            still += 1
            if still >= _STILL_READINGS:
                return now
        watch()
        now_s = clock.now()
        if off > approach.there and now_s - moved > _STUCK_S + _STUCK_TRIPS * round_trip.longest_s:
            if off <= approach.near:
                return now
            raise DeviceError(
                f"the pan/tilt unit stands still at {in_words(approach.position(now))} on its way to "
                f"{in_words(target)}; it is halted: remove what blocks it, check its power, and resume"
            )
        if now_s - begun > 3 * travel_s + _SPARE_S:
            raise DeviceError(
                f"the pan/tilt unit has not reached {in_words(target)} after {now_s - begun:.0f} s, it is at "
                f"{in_words(approach.position(now))} and halted; check its load and speed, and resume"
            )
        clock.sleep(_POLL_S)


def limits_of(
    ranges_deg: tuple[tuple[float, float], tuple[float, float]], signs: tuple[int, int]
) -> tuple[PanTilt, PanTilt]:
    """Return the lowest and the highest position of a unit.

    Args:
        ranges_deg: ends of pan and tilt, degrees as the unit counts them.
        signs: 1 or -1 for each axis: -1 where the unit counts the other way.
    """
    pan, tilt = (sorted(sign * math.radians(end) for end in axis) for sign, axis in zip(signs, ranges_deg, strict=True))
    return PanTilt(pan[0], tilt[0]), PanTilt(pan[1], tilt[1])


def in_words(at: PanTilt) -> str:
    """Return a position for messages."""
    return f"pan {math.degrees(at.pan_rad):.2f}, tilt {math.degrees(at.tilt_rad):.2f} deg"


def refuse_beyond(target: PanTilt, lowest: PanTilt, highest: PanTilt, *, spare_rad: PanTilt) -> None:
    """Refuse a target beyond a unit's limits, or that is not finite.

    Raises:
        OptionError: naming the axis and its limits.
    """
    for axis in ("pan", "tilt"):
        angle, low, high, spare = (getattr(each, f"{axis}_rad") for each in (target, lowest, highest, spare_rad))
        # A limit that is stated in degrees may be a fraction of a step beyond that in steps.
        if not low - 0.51 * spare <= angle <= high + 0.51 * spare:
            raise OptionError(
                f"a {axis} of {math.degrees(angle):.2f} deg is beyond the unit's limits, {math.degrees(low):.2f} to "
                f"{math.degrees(high):.2f} deg; choose a position within them"
            )
