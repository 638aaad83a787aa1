"""The simulated pan/tilt unit: a FLIR / Directed Perception unit with its real timing, limits and failures.

Written from the command reference alone, without the driver's parser, so that an error is not made twice.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ladarreg_core.acquisition.simulated.twin import Outbox

RESOLUTION_ARC_S = 46.2857
"""Arc seconds a count, of both axes."""
COUNTS_PER_RAD = 3600 * 180 / math.pi / RESOLUTION_ARC_S
_LIMITS = {"P": (-13_090, 13_090), "T": (-3_620, 2_410)}  # about 168 deg to both sides; 46.5 deg down, 31 up
_SPEED, _MIN_SPEED, _MAX_SPEED = 3_000, 60, 8_000  # counts/s
_ACCELERATION = 12_000  # counts/s^2
_THINKS_S = 0.004
_RESET_S = 4.0
_BANNER = b"\r\n### PTU CONTROLLER, v2.13.0(D46C), (C)1991-2010 FLIR Systems ###\r\nInitializing...\r\n!T!T!P!P*\r\n"
_COMMAND = re.compile(r"([A-Z]{1,4})([-+]?\d+)?$")


@dataclass(slots=True)
class _Move:
    """A movement of one axis by a trapezoid of speed."""

    begun_s: float
    start: float
    end: float
    speed: float
    acceleration: float

    def at(self, time_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the position (N,) at times (N,)."""
        distance = abs(self.end - self.start)
        ramp = min(self.speed / self.acceleration, math.sqrt(distance / self.acceleration))
        top = self.acceleration * ramp
        cruise = (distance - top * ramp) / top if top else 0.0
        whole = 2 * ramp + cruise
        t = np.clip(time_s - self.begun_s, 0, whole)
        rising = 0.5 * self.acceleration * np.minimum(t, ramp) ** 2
        level = top * np.clip(t - ramp, 0, cruise)
        left = np.clip(t - ramp - cruise, 0, ramp)
        falling = top * left - 0.5 * self.acceleration * left**2
        way = math.copysign(1.0, self.end - self.start) * (rising + level + falling)
        return np.where(t >= whole, self.end, self.start + way)  # exactly there, wherever it came from

    @property
    def ends_s(self) -> float:
        """Time of arrival."""
        distance = abs(self.end - self.start)
        ramp = min(self.speed / self.acceleration, math.sqrt(distance / self.acceleration))
        top = self.acceleration * ramp
        return self.begun_s + (2 * ramp + (distance - top * ramp) / top if top else 0.0)


@dataclass(slots=True)
class _Axis:
    low: int
    high: int
    user_low: int = -1_000
    user_high: int = 1_000
    speed: float = _SPEED
    acceleration: float = _ACCELERATION
    target: int = 0
    moves: list[_Move] = field(default_factory=list)

    def at(self, time_s: ArrayLike) -> NDArray[np.float64]:
        """Return the position, counts (N,), at times (N,), also past ones."""
        t = np.atleast_1d(np.asarray(time_s, np.float64))
        out = np.zeros(len(t))
        for move in self.moves:
            after = t >= move.begun_s
            out[after] = move.at(t[after])
        return out

    def now(self, time_s: float) -> float:
        """Return the position at a time, counts."""
        return float(self.at(time_s)[0])

    def move(self, target: float, now_s: float) -> None:
        """Begin to move from where it is."""
        self.moves.append(_Move(now_s, self.now(now_s), target, self.speed, self.acceleration))

    def moving(self, now_s: float) -> bool:
        """Return whether it moves."""
        return bool(self.moves) and now_s < self.moves[-1].ends_s and self.moves[-1].start != self.moves[-1].end


class FlirTwin:
    """The simulated unit.

    Failures on request: `silent` answers nothing, `rubbish` answers noise, `late_s` delays every answer, `stuck` ends
    every movement halfway; `hit_limit` reports a limit unasked and stops; `slip` loses steps; `misreads` has the next
    answer to a query, by its name, be off by so many counts; `twice` sends the next answer two times.

    Args:
        baud: bits a second of its port.
        seed: seeds its noise.
        moved: called with the time when a movement begins, also one of no length, and whether it will arrive; again
            when it is halted.
    """

    name = "flir-ptu"

    def __init__(self, *, baud: int = 9600, seed: int = 0, moved: Callable[[float, bool], None] | None = None) -> None:
        self.baud = baud
        self._moved = moved
        self.silent = self.rubbish = self.stuck = False
        self.misreads: dict[str, int] = {}
        self.twice = False
        self.late_s = 0.0
        self.halted_at_s: float | None = None
        self._slips: list[tuple[float, NDArray[np.float64]]] = []
        self._axes = {name: _Axis(*limits) for name, limits in _LIMITS.items()}
        self._outbox = Outbox(baud)
        self._received = ""
        self._free_s = self._deaf_until_s = 0.0
        self._verbose = self._echo = True
        self._immediate = True
        self._limits: Literal["off", "factory", "user"] = "factory"
        self._rng = np.random.default_rng(seed)

    def angles_at(self, time_s: ArrayLike) -> NDArray[np.float64]:
        """Return pan and tilt, rad (N, 2), at times (N,), also past ones."""
        angles = np.stack([self._axes[name].at(time_s) / COUNTS_PER_RAD for name in "PT"], axis=-1)
        for since_s, angle in self._slips:
            angles[np.atleast_1d(np.asarray(time_s)) >= since_s] += angle
        return angles

    def moving(self, now_s: float) -> bool:
        """Return whether an axis moves."""
        return any(axis.moving(now_s) for axis in self._axes.values())

    @property
    def rest_s(self) -> float:
        """When both axes come, or came, to rest."""
        return max((axis.moves[-1].ends_s for axis in self._axes.values() if axis.moves), default=0.0)

    def hit_limit(self, axis: str, now_s: float) -> None:
        """Report a limit that nobody asked for, and stop."""
        self.stop(now_s)
        self._outbox.send(f"!{axis}\r\n".encode(), now_s)

    def slip(self, pan_rad: float, tilt_rad: float, now_s: float) -> None:
        """Lose steps: from now on it is elsewhere than it says."""
        self._slips.append((now_s, np.array([pan_rad, tilt_rad])))

    def switch_on(self, now_s: float, *, homing_s: float = 0.0) -> None:
        """Regain power after a loss: modes reset, axes homed; it sends its banner, and is deaf while it homes."""
        self._verbose = self._echo = self._immediate = True
        self._limits = "factory"
        for name, axis in self._axes.items():
            self._axes[name] = _Axis(axis.low, axis.high)
        self._received, self._deaf_until_s = "", now_s + homing_s
        begun, found = _BANNER.split(b"Initializing...\r\n")
        self._outbox.send(begun + b"Initializing...\r\n", now_s)
        self._outbox.send(found, now_s + homing_s)

    @property
    def range_deg(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Lowest pan and tilt and highest pan and tilt, deg: what it cannot move beyond."""
        low, high = (
            tuple(math.degrees(getattr(self._axes[name], end) / COUNTS_PER_RAD) for name in "PT")
            for end in ("low", "high")
        )
        return (low[0], low[1]), (high[0], high[1])

    @property
    def speeds_deg_s(self) -> tuple[float, float]:
        """Slowest and fastest speed of an axis, deg/s."""
        return math.degrees(_MIN_SPEED / COUNTS_PER_RAD), math.degrees(_MAX_SPEED / COUNTS_PER_RAD)

    def set_speed(self, deg_s: float) -> None:
        """Set the speed of the next movements of both axes, deg/s."""
        for axis in self._axes.values():
            axis.speed = min(max(math.radians(deg_s) * COUNTS_PER_RAD, _MIN_SPEED), _MAX_SPEED)

    def go_to(self, letter: str, angle_rad: float, now_s: float) -> None:
        """Move the axis `P` or `T`, as another controller of the same axes has it; not beyond its limits."""
        axis = self._axes[letter]
        axis.target = min(max(round(angle_rad * COUNTS_PER_RAD), axis.low), axis.high)
        self._begin(now_s)

    def feed(self, data: bytes, now_s: float) -> None:
        """Receive bytes from the host."""
        for byte in data if now_s >= self._deaf_until_s else b"":
            if chr(byte) in " \r\n":
                if self._received:
                    self._obey(self._received, now_s)
                self._received = ""
            else:
                self._received = (self._received + chr(byte).upper())[-64:]

    def due(self, now_s: float) -> bytes:
        """Return the bytes that it has sent by now."""
        return self._outbox.due(now_s)

    def _obey(self, text: str, now_s: float) -> None:
        if self._echo:
            self._outbox.send(f"{text} ".encode(), now_s)
        begun = max(now_s, self._free_s) if text != "H" else now_s
        self._free_s = begun + _THINKS_S
        match = _COMMAND.match(text)
        if match is None:
            self._answer("! Illegal command", begun)
            return
        name, value = match.group(1), None if match.group(2) is None else int(match.group(2))
        answer, ready_s = self._do(name, value, begun)
        self._free_s = max(self._free_s, ready_s)
        self._answer(answer, ready_s)

    def _answer(self, text: str, at_s: float) -> None:
        if self.silent:
            return
        data = f"{text}\r\n".encode()
        if self.rubbish:
            data = self._rng.integers(0, 256, len(data) + 3).astype(np.uint8).tobytes()
        for _ in range(1 + self.twice):
            self._outbox.send(data, at_s + _THINKS_S + self.late_s)
        self.twice = False

    def _do(self, name: str, value: int | None, now_s: float) -> tuple[str, float]:
        """Return the answer to a command and when it is ready."""
        modes = {"FT": ("_verbose", False), "FV": ("_verbose", True), "ED": ("_echo", False), "EE": ("_echo", True),
                 "I": ("_immediate", True), "S": ("_immediate", False), "LE": ("_limits", "factory"),
                 "LD": ("_limits", "off"), "LU": ("_limits", "user")}  # fmt: skip
        if name in modes and value is None:
            setattr(self, *modes[name])
            return "*", now_s
        if name == "CI":  # the axes are controlled by position, which says nothing about when a movement begins
            return "*", now_s
        if name == "H":
            self.stop(now_s)
            return "*", now_s
        if name == "A":
            self._begin(now_s)
            return "*", max([now_s, *(axis.moves[-1].ends_s for axis in self._axes.values() if axis.moves)])
        if name == "V":
            return "* Pan-Tilt Controller v2.13.0(D46C), (C)1991-2010 FLIR Systems", now_s
        if name == "O":
            return "* Input 30 VDC @ 86 degF", now_s
        if name == "L":
            said = {"off": "DISABLED", "factory": "ENABLED (factory limits)", "user": "ENABLED (user limits)"}
            return f"* {'Limit bounds are ' if self._verbose else ''}{said[self._limits]}", now_s
        if name == "R":
            for axis in self._axes.values():
                axis.moves.clear()
                axis.target = 0
            return "!T!T!P!P*", now_s + _RESET_S
        if name[0] in "PT" and (len(name) == 2 or name[1:] in ("NU", "XU")):
            return self._do_axis(name[0], name[1:], value, now_s)
        return "! Illegal command", now_s

    def _do_axis(self, letter: str, what: str, value: int | None, now_s: float) -> tuple[str, float]:
        axis = self._axes[letter]
        if value is None:
            shown = {
                "P": round(axis.now(now_s)), "O": axis.target, "S": round(axis.speed), "D": round(axis.speed),
                "A": round(axis.acceleration), "R": RESOLUTION_ARC_S, "N": axis.low, "X": axis.high,
                "U": _MAX_SPEED, "L": _MIN_SPEED, "B": _MIN_SPEED, "NU": axis.user_low, "XU": axis.user_high,
            }.get(what)  # fmt: skip
            if shown is None:
                return "! Illegal command", now_s
            shown += self.misreads.pop(letter + what, 0)
            side = "Pan" if letter == "P" else "Tilt"
            return f"* Current {side} value is {shown}" if self._verbose else f"* {shown}", now_s
        if what in "PO":
            target = value if what == "P" else round(axis.now(now_s)) + value
            low, high = (axis.user_low, axis.user_high) if self._limits == "user" else (axis.low, axis.high)
            if self._limits != "off" and not low <= target <= high:
                return f"! {'Maximum' if target > high else 'Minimum'} allowable position exceeded", now_s
            axis.target = target
            if self._immediate:
                self._begin(now_s)
            return "*", now_s
        if what == "S":
            if not _MIN_SPEED <= value <= _MAX_SPEED:
                return "! Speed cannot exceed limits", now_s
            axis.speed = value
            return "*", now_s
        if what == "A":
            axis.acceleration = max(1, value)
            return "*", now_s
        return "! Illegal command", now_s

    def _begin(self, now_s: float) -> None:
        for axis in self._axes.values():
            here = axis.now(now_s)
            end: float = axis.target
            if self.stuck:
                end = here + (axis.target - here) / 2
            if not axis.moves or axis.moves[-1].end != end:
                axis.move(end, now_s)
        if self._moved:
            self._moved(now_s, not self.stuck)

    def stop(self, now_s: float) -> None:
        """Stop both axes."""
        halted = self.moving(now_s)
        for axis in self._axes.values():
            if axis.moving(now_s):
                here = axis.now(now_s)
                axis.moves.append(_Move(now_s, here, here, axis.speed, axis.acceleration))
            axis.target = round(axis.now(now_s))
        self.halted_at_s = now_s
        if self._moved and halted:
            self._moved(now_s, False)
