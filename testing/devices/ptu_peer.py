"""A pan/tilt unit that speaks ASCII, and a reader of its replies, written from the published manuals alone.

Nothing here is taken from `ladarreg_core`: what the driver, its twin and this module have in common is the document.

Source: Directed Perception, 'Pan-Tilt Unit (Model PTU-D46) User's Manual', version 2.14.0, chapter 4, and that of the
PTU-D300, version 2.18.0 (4.3.4, 4.3.5).
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field

CR = b"\r"
DELIMITERS = b" \r"
"""4.2: a delimiter is a space or a carriage return."""
_AXES = {"P": "Pan", "T": "Tilt"}


@dataclass
class PeerUnit:
    """The controller of the manual: bytes in, bytes out. Moves end at once; time is not part of the protocol."""

    position: dict[str, int] = field(default_factory=lambda: {"P": 0, "T": 0})
    target: dict[str, int] = field(default_factory=lambda: {"P": 0, "T": 0})
    speed: dict[str, int] = field(default_factory=lambda: {"P": 1000, "T": 1000})
    resolution: dict[str, str] = field(default_factory=lambda: {"P": "185.142857", "T": "185.142857"})
    least: dict[str, int] = field(default_factory=lambda: {"P": -3090, "T": -907})
    most: dict[str, int] = field(default_factory=lambda: {"P": 3090, "T": 604})
    slowest: dict[str, int] = field(default_factory=lambda: {"P": 57, "T": 57})
    fastest: dict[str, int] = field(default_factory=lambda: {"P": 2902, "T": 2902})
    limits: bool = True
    echo: bool = True
    terse: bool = False
    immediate: bool = True
    _held: bytes = b""

    def answer(self, data: bytes) -> bytes:
        """Return the replies to all commands that are complete, with the echo if it is on."""
        out = b""
        for byte in data:
            one = bytes([byte])
            if self.echo:
                out += one
            if one not in DELIMITERS:
                self._held += one
                continue
            command, self._held = self._held.decode("ascii").upper(), b""
            if command:
                out += self._execute(command).encode("ascii") + CR
        return out

    def _execute(self, command: str) -> str:
        simple = {"FT": ("terse", True), "FV": ("terse", False), "EE": ("echo", True), "ED": ("echo", False),
                  "LE": ("limits", True), "LD": ("limits", False), "I": ("immediate", True), "CI": ("immediate", True),
                  "S": ("immediate", False)}  # fmt: skip
        if command in simple:
            name, value = simple[command]
            setattr(self, name, value)
            return "*"
        if command == "H":
            self.target = dict(self.position)
            return "*"
        if command == "A":
            self.position = dict(self.target)
            return "*"
        if command == "R":
            self.position = {"P": 0, "T": 0}
            self.target = dict(self.position)
            return "!T!T!P!P*"
        if command == "V":
            return "* Pan-Tilt Controller v2.12.1d1(C14/E), (C)2003 Directed Perception, Inc., All Rights Reserved"
        if command == "O":
            return "* Input 30 VDC @ 86 degF"
        if command == "L":
            state = "ENABLED (soft limits enabled)" if self.limits else "DISABLED"
            return f"* Limit bounds are {state}"
        found = re.fullmatch(r"([PT])([PSRNXUL])([+-]?\d+)?", command)
        if found is None:
            return "! Illegal command"
        axis, what, number = found[1], found[2], found[3]
        if number is None:
            return self._query(axis, what)
        if what == "P":
            return self._move(axis, int(number))
        if what == "S":
            return self._hurry(axis, int(number))
        return "! Illegal argument"

    def _query(self, axis: str, what: str) -> str:
        name = _AXES[axis]
        value, words = {
            "P": (str(self.position[axis]), f"Current {name} position is {{}}"),
            "S": (str(self.speed[axis]), f"Target {name} speed is {{}} positions/sec"),
            "R": (self.resolution[axis], "{} seconds arc per position"),
            "N": (str(self.least[axis]), f"Minimum {name} position is {{}}"),
            "X": (str(self.most[axis]), f"Maximum {name} position is {{}}"),
            "U": (str(self.fastest[axis]), f"Maximum {name} speed is {{}} positions/sec"),
            "L": (str(self.slowest[axis]), f"Minimum {name} speed is {{}} positions/sec"),
        }[what]
        return f"* {value}" if self.terse else f"* {words.format(value)}"

    def _move(self, axis: str, position: int) -> str:
        for bound, word, beyond in (
            (self.most[axis], "Maximum", position > self.most[axis]),
            (self.least[axis], "Minimum", position < self.least[axis]),
        ):
            if self.limits and beyond:
                return f"! {word} allowable {_AXES[axis]} position is {bound}"
        self.target[axis] = position
        return "*"

    def _hurry(self, axis: str, speed: int) -> str:
        if not self.slowest[axis] <= speed <= self.fastest[axis]:
            return f"! {_AXES[axis]} speed is beyond its bounds"
        self.speed[axis] = speed
        return "*"


@dataclass(frozen=True)
class PeerAnswer:
    """A reply without its echo."""

    done: bool
    """`*`; else `!` and why."""
    text: str
    hits: tuple[str, ...] = ()
    """Axes whose limits were hit, which is said unasked."""

    @property
    def number(self) -> float | None:
        """The one number that a query in terse mode is answered by; None if it is another text."""
        return float(self.text) if re.fullmatch(r"[+-]?\d+(\.\d+)?", self.text) else None


def read(line: bytes) -> PeerAnswer | None:
    """Return what a line says, given without its carriage return; None if it is no reply."""
    try:
        text = line.decode("ascii")
    except UnicodeDecodeError:
        return None
    # 4.3.5: '!P' and '!T' come unasked, before whatever else is said.
    unasked = re.match(r"\s*((?:![PT])*)", text)
    assert unasked is not None
    hits = tuple(re.findall(r"!([PT])", unasked[1]))
    rest = text[unasked.end() :].lstrip()
    if rest[:1] not in ("*", "!") or not rest:
        return None
    return PeerAnswer(rest[0] == "*", rest[1:].strip(), hits)
