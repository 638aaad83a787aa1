"""A pan/tilt head that is moved by ONVIF, such as a network camera's."""

from __future__ import annotations

import contextlib
import math
import threading
from dataclasses import dataclass, replace

from ladarreg_core.acquisition.clock import REAL_CLOCK, Clock
from ladarreg_core.acquisition.devices.move_wait import Approach, await_arrival, limits_of, refuse_beyond
from ladarreg_core.acquisition.devices.onvif_link import OnvifLink, Post, post
from ladarreg_core.acquisition.devices.onvif_protocol import (
    DEGREES,
    GENERIC,
    SPEED_DEGREES,
    PtzNode,
    PtzProfile,
    Range,
    Vector,
    absolute_move,
    device_model,
    of_profile,
    ptz_nodes,
    ptz_profiles,
    ptz_status,
    stop,
)
from ladarreg_core.acquisition.interfaces import Check, PanTilt, UnitIdentity
from ladarreg_core.acquisition.plan import UnitPlan
from ladarreg_core.acquisition.twin_address import is_twin, resolved_twin
from ladarreg_core.errors import Cancelled, DeviceError, OptionError

RESOLUTION_DEG = 0.05
"""Finest step of a head: ONVIF has no statement of it, and this is what is taken for reached."""
_NEAR_DEG = 0.3  # heads are built for cameras, and many stop some tenths of a degree off
_SPEED_DEG_S = 10.0  # of forecasts, where the plan sets none
_HALT_S = 1.0
_STEP_DEG = 0.001  # positions closer than this are one


@dataclass(frozen=True, slots=True)
class _Place:
    """Where a head is, degrees as it counts them but left and up positive, to `_STEP_DEG`; `number`
    distinguishes readings while it moves."""

    pan_deg: float
    tilt_deg: float
    moves: bool
    number: int


class OnvifUnit:
    """A head that is connected and halted; use `connect`.

    Angles are positive to the left and upward, as in the picture of a camera that is mounted as its maker has it; the
    plan's signs turn an axis.
    """

    def __init__(self, link: OnvifLink, plan: UnitPlan) -> None:
        self._link, self._signs = link, plan.signs
        self._halting = threading.Lock()
        self._halts = self._readings = 0
        self._speed_deg_s: float | None = None
        self._profile, self._node = _movable(link)
        self.halt()
        self._to = DEGREES if DEGREES in self._node.positions else GENERIC
        self._full = _full_range(self._node, plan)
        self._place()  # it must say where it is
        ranges = _limits(self._full, plan)
        lowest, highest = limits_of(ranges, self._signs)
        step, speed = (PanTilt(math.radians(deg), math.radians(deg)) for deg in (RESOLUTION_DEG, _SPEED_DEG_S))
        self.identity = UnitIdentity(
            device_model(link.ask("device", "GetDeviceInformation")), step,
            lowest, highest, speed,
        )  # fmt: skip
        if plan.speed_deg_s is not None:
            radians = math.radians(plan.speed_deg_s)
            self.set_speed(PanTilt(radians, radians))

    @staticmethod
    def connect(
        plan: UnitPlan, *, clock: Clock = REAL_CLOCK, send: Post = post, password: str | None = None
    ) -> OnvifUnit:
        """Connect to a head, halt it and ask what it is.

        Args:
            plan: of the unit; `port` is the URL of the device service.
            clock: what time is measured by.
            send: sends requests; by default over the network.
            password: None: from the environment.

        Raises:
            DeviceError: if it does not answer, refuses, cannot be moved to positions, or does not state them.
            OptionError: if the plan asks for what it cannot do.
        """
        url = resolved_twin(plan.port) if is_twin(plan.port) else plan.port
        return OnvifUnit(OnvifLink(url, plan.user, clock=clock, send=send, password=password), plan)

    @property
    def link(self) -> OnvifLink:
        """The link, with its latest exchanges."""
        return self._link

    def position(self) -> PanTilt:
        """Return where it is.

        Raises:
            DeviceError: if it does not answer as specified.
        """
        return self._angles(self._place())

    def start_move(self, target: PanTilt) -> None:
        """Start to move.

        Raises:
            OptionError: if the target is beyond the limits; nothing has been sent then.
            Cancelled: if `halt` was called meanwhile.
            DeviceError: if it does not answer, or refuses.
        """
        self._start(*self._target_deg(target))

    def move_to(self, target: PanTilt, *, check: Check) -> PanTilt:
        """Move, await the end of the movement, and return the position read back.

        It has arrived once it does not say that it moves, and reads the target twice, or stands still for a while
        within .3 deg of it.

        Raises:
            OptionError: if the target is beyond the limits; nothing has been sent then.
            Cancelled: if `check` raises it, or `halt` is called; the head is halted then.
            DeviceError: if it stands still elsewhere, states an error, or does not answer; the head is halted then.
        """
        pan, tilt = self._target_deg(target)
        halts = self._halts
        try:
            self._start(pan, tilt)

            def distance(now: _Place) -> float:
                return math.inf if now.moves else _apart(now, pan, tilt)

            def travel_s(now: _Place) -> float:
                return _apart(now, pan, tilt) / (self._speed_deg_s or _SPEED_DEG_S)

            approach = Approach(self._place, distance, self._angles, RESOLUTION_DEG, _NEAR_DEG, travel_s)
            found = await_arrival(
                approach, target, clock=self._link.clock, round_trip=self._link.round_trip, check=check,
                halted=lambda: self._halts != halts,
            )  # fmt: skip
        except BaseException:
            self.halt()
            raise
        return self._angles(found)

    def set_speed(self, speed: PanTilt) -> None:
        """Set the speed of movements, rad/s; of both axes, the faster one's.

        Raises:
            OptionError: if the head has no speeds in degrees a second, or not this one.
        """
        wanted = math.degrees(max(abs(speed.pan_rad), abs(speed.tilt_rad)))
        low, high = self._node.speeds.get(SPEED_DEGREES, (math.inf, math.inf))
        if not low <= wanted <= high:
            has = f"from {low:g} to {high:g} deg/s" if math.isfinite(low) else "by parts of its full speed alone"
            raise OptionError(f"the pan/tilt unit does not move at {wanted:.3g} deg/s: it does {has}; change the speed")
        self._speed_deg_s = wanted
        self.identity = replace(self.identity, speed_rad_s=PanTilt(math.radians(wanted), math.radians(wanted)))

    def supply(self) -> dict[str, float]:
        """Return nothing: a head states nothing about its supply."""
        return {}

    def require_present(self) -> None:
        """Raise `DeviceError` if the last exchange found nobody; without an exchange."""
        self._link.require_present()

    def halt(self) -> None:
        """Stop at once, whatever else waits for the head; may be called from any thread, and never raises."""
        with self._halting:
            self._halts += 1
        with contextlib.suppress(DeviceError):  # nobody answers, which every later use says
            self._link.ask("ptz", "Stop", stop(self._profile.token), tries=2, deadline_s=_HALT_S)

    def close(self) -> None:
        """Halt; there is no connection to close."""
        self.halt()

    def _start(self, pan_deg: float, tilt_deg: float) -> None:
        halts = self._halts
        to = Vector(-pan_deg, tilt_deg, DEGREES)
        if self._to == GENERIC:
            ranges = zip((to.x, to.y), self._full, self._node.positions[GENERIC], strict=True)
            x, y = (_scaled(value, full, generic) for value, full, generic in ranges)
            to = Vector(x, y, GENERIC)
        self._link.ask("ptz", "AbsoluteMove", absolute_move(self._profile.token, to, speed_deg_s=self._speed_deg_s))
        if self._halts != halts:  # on another connection the halt may have come first
            self.halt()
            raise Cancelled

    def _place(self) -> _Place:
        status = ptz_status(self._link.ask("ptz", "GetStatus", of_profile(self._profile.token)), self._profile.space)
        if status.error:
            raise DeviceError(
                f"the pan/tilt unit states an error: {status.error}; look after it, switch it off and on, and resume"
            )
        at = status.position
        if at is None or at.space not in (DEGREES, GENERIC):
            where = "states no position" if at is None else f"states its position in {at.space or 'no space'}"
            raise DeviceError(f"the pan/tilt unit {where}; it cannot be read back, and such a head cannot be used")
        x, y = at.x, at.y
        if at.space == GENERIC:
            generics = self._node.positions.get(GENERIC, ((-1.0, 1.0), (-1.0, 1.0)))
            x, y = (
                _scaled(value, generic, full) for value, generic, full in zip((x, y), generics, self._full, strict=True)
            )
        moves = bool(status.moves)
        self._readings += moves
        pan = (-x + 180) % 360 - 180
        return _Place(_rounded(pan), _rounded(y), moves, self._readings)

    def _target_deg(self, target: PanTilt) -> tuple[float, float]:
        refuse_beyond(target, self.identity.lowest, self.identity.highest, spare_rad=self.identity.resolution_rad)
        pan, tilt = (
            sign * math.degrees(angle)
            for sign, angle in zip(self._signs, (target.pan_rad, target.tilt_rad), strict=True)
        )
        return pan, tilt

    def _angles(self, at: _Place) -> PanTilt:
        pan, tilt = (sign * math.radians(deg) for sign, deg in zip(self._signs, (at.pan_deg, at.tilt_deg), strict=True))
        return PanTilt(pan, tilt)


def _movable(link: OnvifLink) -> tuple[PtzProfile, PtzNode]:
    """Return a profile by which the head can be moved to positions, best in degrees, and its node."""
    profiles = ptz_profiles(link.ask("media", "GetProfiles"))
    nodes = ptz_nodes(link.ask("ptz", "GetNodes"))
    usable = [
        (profile, nodes[profile.node])
        for profile in profiles
        if profile.node in nodes and {DEGREES, GENERIC} & nodes[profile.node].positions.keys()
    ]
    if not usable:
        why = "no media profile with a PTZ configuration" if not profiles else "no absolute positions"
        raise DeviceError(f"the device at {link.address} has {why}; such a head cannot be used")
    return max(usable, key=lambda each: (DEGREES in each[1].positions, each[0].space == DEGREES))


def _full_range(node: PtzNode, plan: UnitPlan) -> tuple[Range, Range]:
    """Return the degrees, X and Y as the head counts them, that its full range spans."""
    if DEGREES in node.positions:
        (left, right), (low, high) = node.positions[DEGREES]
        endless = not (math.isfinite(left) and math.isfinite(right))
        return (-180.0, 180.0) if endless else (left, right), (max(low, -180.0), min(high, 180.0))
    if plan.range_deg is None:
        raise OptionError(
            "the pan/tilt unit has positions in parts of its full range alone, and states no degrees; give its range, "
            "from its data sheet, as 'range_deg' of the plan's unit: lowest and highest pan, lowest and highest tilt"
        )
    (low, high), tilt = plan.range_deg
    return (-high, -low), tilt


def _limits(full: tuple[Range, Range], plan: UnitPlan) -> tuple[Range, Range]:
    """Return the range of pan and tilt, left and up positive, within that of the plan if it has one."""
    (left, right), (low, high) = full
    found = ((-right, -left), (low, high))
    if plan.range_deg is None:
        return found
    pan, tilt = ((max(a[0], b[0]), min(a[1], b[1])) for a, b in zip(found, plan.range_deg, strict=True))
    if not (pan[0] < pan[1] and tilt[0] < tilt[1]):
        raise OptionError(
            f"'range_deg' of the plan's unit does not meet what the unit states, pan {-right:g} to {-left:g} "
            f"and tilt {found[1][0]:g} to {found[1][1]:g} deg; correct it"
        )
    return pan, tilt


def _apart(at: _Place, pan_deg: float, tilt_deg: float) -> float:
    pan = abs((at.pan_deg - pan_deg + 180) % 360 - 180)
    return max(pan, abs(at.tilt_deg - tilt_deg))


def _scaled(value: float, before: Range, after: Range) -> float:
    width = before[1] - before[0]
    return after[0] + ((value - before[0]) / width * (after[1] - after[0]) if width else 0.0)


def _rounded(deg: float) -> float:
    return round(deg / _STEP_DEG) * _STEP_DEG
