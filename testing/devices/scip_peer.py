"""A line scanner of SCIP 2, and a reader of its replies, written from the published protocol alone.

Nothing here is taken from `ladarreg_core`: what the driver, its twin and this module have in common is the document.

Source: Hokuyo Automatic Co., 'Communication Protocol Specification for SCIP2.0 Standard', C-42-03320B, and the wiki of
`urgnetwork` (scip_capture, scip_status, scip_mode). The document describes `MD` and `GD`; that `ME` and `GE` are the
same with pairs of distance and intensity, three characters each, is from the design notes.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

LF = b"\n"
CLOCK = 1 << 24
"""The time stamp has four characters of six bits, and counts milliseconds."""


class NotThisReplyError(Exception):
    """The bytes are no reply to the command."""


def check_character(text: bytes) -> bytes:
    """Section 7: the lower 6 bits of the sum of the bytes, plus 30H."""
    total = 0
    for byte in text:
        total = (total + byte) % 64
    return bytes([total + 0x30])


def to_characters(value: int, count: int) -> bytes:
    """Section 6: groups of six bits, the upper ones first, each plus 30H."""
    out = bytearray()
    for _ in range(count):
        out.insert(0, 0x30 + value % 64)
        value //= 64
    assert value == 0, "too large for so many characters"
    return bytes(out)


def from_characters(text: bytes) -> int:
    value = 0
    for byte in text:
        if not 0x30 <= byte <= 0x6F:
            raise NotThisReplyError(f"{byte:#x} encodes nothing")
        value = value * 64 + byte - 0x30
    return value


def checked(text: bytes) -> bytes:
    return text + check_character(text) + LF


def blocks(data: bytes) -> bytes:
    """Section 8.1: blocks of 64 characters, and what remains, each with its sum."""
    return b"".join(checked(data[at : at + 64]) for at in range(0, len(data), 64))


@dataclass
class PeerScanner:
    """The sensor of the document: bytes of a command line in, bytes of all of its replies out."""

    measure: Callable[[int], Sequence[tuple[int, int]]]
    """Distance (mm) and intensity of every step, for the n-th scan."""
    first_step: int = 0
    last_step: int = 1080
    front_step: int = 540
    steps_in_turn: int = 1440
    nearest_mm: int = 20
    farthest_mm: int = 60_000
    rpm: int = 2400
    knows_intensity: bool = True
    clock_ms: int = 0
    laser_on: bool = False
    adjusting: bool = False
    scans: int = 0
    identity: dict[str, str] = field(
        default_factory=lambda: {
            "VEND": "Hokuyo Automatic Co.,Ltd.", "PROD": "SOKUIKI Sensor UST-20LX", "FIRM": "1.20(02/Feb./2015)",
            "PROT": "SCIP 2.0", "SERI": "H0614967",
        }
    )  # fmt: skip

    def answer(self, line: bytes) -> bytes:
        """Return the replies to one command, given without its line feed."""
        command, _, words = line.partition(b";")
        if words and (len(words) > 16 or not re.fullmatch(rb"[A-Za-z0-9 ._+@]*", words)):
            return self._status(line, b"0G" if len(words) > 16 else b"0H")
        symbol, rest = command[:2], command[2:]
        if self.adjusting and symbol != b"TM":
            return b""  # section 8.6: nothing else is accepted until the mode is terminated
        known: dict[bytes, Callable[[bytes, bytes], bytes]] = {
            b"VV": self._version, b"PP": self._parameters, b"BM": self._beam, b"QT": self._quit, b"RS": self._reset,
            b"TM": self._time, b"GD": self._once, b"MD": self._several,
        }  # fmt: skip
        if self.knows_intensity:
            known |= {b"GE": self._once, b"ME": self._several}
        if symbol not in known:
            return self._status(line, b"0E")
        return known[symbol](line, rest)

    def _status(self, echo: bytes, status: bytes) -> bytes:
        return echo + LF + checked(status) + LF

    def _named(self, echo: bytes, lines: Sequence[tuple[str, str]]) -> bytes:
        out = echo + LF + checked(b"00")
        for name, value in lines:
            text = f"{name}:{value}".encode("ascii")
            # The wiki: the semicolon is not included in the sum.
            out += text + b";" + check_character(text) + LF
        return out + LF

    def _version(self, echo: bytes, rest: bytes) -> bytes:
        return self._named(echo, list(self.identity.items()))

    def _parameters(self, echo: bytes, rest: bytes) -> bytes:
        return self._named(echo, [
            ("MODL", "UST-20LX(Hokuyo Automatic Co., Ltd.)"), ("DMIN", str(self.nearest_mm)),
            ("DMAX", str(self.farthest_mm)), ("ARES", str(self.steps_in_turn)), ("AMIN", str(self.first_step)),
            ("AMAX", str(self.last_step)), ("AFRT", str(self.front_step)), ("SCAN", str(self.rpm)),
        ])  # fmt: skip

    def _beam(self, echo: bytes, rest: bytes) -> bytes:
        status = b"02" if self.laser_on else b"00"
        self.laser_on = True
        return self._status(echo, status)

    def _quit(self, echo: bytes, rest: bytes) -> bytes:
        self.laser_on = False
        return self._status(echo, b"00")

    def _reset(self, echo: bytes, rest: bytes) -> bytes:
        self.laser_on, self.clock_ms = False, 0
        return self._status(echo, b"00")

    def _time(self, echo: bytes, rest: bytes) -> bytes:
        if rest == b"0":
            status = b"02" if self.adjusting else b"00"
            self.adjusting, self.laser_on = True, False
            return self._status(echo, status)
        if rest == b"2":
            status = b"00" if self.adjusting else b"03"
            self.adjusting = False
            return self._status(echo, status)
        if rest != b"1":
            return self._status(echo, b"01")
        if not self.adjusting:
            return self._status(echo, b"04")
        return echo + LF + checked(b"00") + checked(to_characters(self.clock_ms % CLOCK, 4)) + LF

    def _fault(self, numbers: Sequence[bytes]) -> bytes:
        """Return the status of what is wrong with start, end, cluster (and interval, count); empty if nothing is."""
        for number, status in zip(numbers, (b"01", b"02", b"03", b"06", b"07"), strict=False):
            if not number.isdigit():
                return status
        start, end = int(numbers[0]), int(numbers[1])
        if end > self.last_step:
            return b"04"
        return b"05" if end < start else b""

    def _data(self, symbol: bytes, start: int, end: int, cluster: int) -> bytes:
        steps = list(self.measure(self.scans))[start : end + 1]
        self.scans += 1
        out = b""
        for at in range(0, len(steps), max(cluster, 1)):
            distance, intensity = min(steps[at : at + max(cluster, 1)])
            out += to_characters(distance, 3) + (to_characters(intensity, 3) if symbol[1:] == b"E" else b"")
        return checked(to_characters(self.clock_ms % CLOCK, 4)) + blocks(out)

    def _once(self, echo: bytes, rest: bytes) -> bytes:
        numbers = rest[:4], rest[4:8], rest[8:10]
        if len(rest) != 10:
            return self._status(echo, b"0C")
        if fault := self._fault(numbers):
            return self._status(echo, fault)
        if not self.laser_on:
            return self._status(echo, b"10")
        return echo + LF + checked(b"00") + self._data(echo[:2], *map(int, numbers)) + LF

    def _several(self, echo: bytes, rest: bytes) -> bytes:
        numbers = rest[:4], rest[4:8], rest[8:10], rest[10:11], rest[11:13]
        if len(rest) != 13:
            return self._status(echo, b"0C")
        if fault := self._fault(numbers):
            return self._status(echo, fault)
        self.laser_on = True
        out = self._status(echo, b"00")
        for remaining in reversed(range(int(numbers[4]))):
            self.clock_ms += (int(numbers[3]) + 1) * 60_000 // self.rpm
            echoed = echo[:13] + f"{remaining:02d}".encode("ascii") + echo[15:]
            out += echoed + LF + checked(b"99") + self._data(echo[:2], *map(int, numbers[:3])) + LF
        self.laser_on = False
        return out


@dataclass(frozen=True)
class PeerReply:
    """One reply, as the document lays it out."""

    echo: bytes
    status: bytes
    stamp_ms: int | None = None
    named: tuple[tuple[str, str], ...] = ()
    values: tuple[int, ...] = ()


def split(stream: bytes) -> tuple[list[bytes], bytes]:
    """Return the replies of a stream, each up to its two line feeds, and what is not complete yet."""
    *whole, rest = stream.split(LF + LF)
    return whole, rest


def read(reply: bytes) -> PeerReply:
    """Return what one reply says, given without the two line feeds that end it.

    Raises:
        NotThisReplyError: if its layout or one of its sums is not that of the document.
    """
    echo, *lines = reply.split(LF)
    if not lines or len(lines[0]) != 3:
        raise NotThisReplyError("no status")
    status = _with_sum(lines[0])
    lines = lines[1:]
    if echo[:2] in (b"VV", b"PP", b"II") and status == b"00":
        named = []
        for line in lines:
            text, mark, total = line[:-2], line[-2:-1], line[-1:]
            if mark != b";" or total != check_character(text) or b":" not in text:
                raise NotThisReplyError("a line without its sum")
            name, _, value = text.decode("ascii").partition(":")
            named.append((name, value))
        return PeerReply(echo, status, named=tuple(named))
    if not lines:
        return PeerReply(echo, status)
    stamp = _with_sum(lines[0])
    if len(stamp) != 4:
        raise NotThisReplyError("a time stamp has four characters")
    data = b""
    for number, line in enumerate(lines[1:]):
        block = _with_sum(line)
        if len(block) > 64 or (number < len(lines) - 2 and len(block) != 64):
            raise NotThisReplyError("a block of another length")
        data += block
    width = 2 if echo[1:2] == b"S" else 3
    if len(data) % width:
        raise NotThisReplyError("a part of a value")
    values = tuple(from_characters(data[at : at + width]) for at in range(0, len(data), width))
    return PeerReply(echo, status, from_characters(stamp), values=values)


def _with_sum(line: bytes) -> bytes:
    text, total = line[:-1], line[-1:]
    if not text or total != check_character(text):
        raise NotThisReplyError("a wrong sum")
    return text
