"""What the parsers of both devices make of damaged replies: row `parsers` of the acquisition benchmark.

Replies are made by the book, damaged, and given to the parser as the link would give them. A judge that was written
from the protocols alone (`benchmarks.acquisition.oracle`) says what each reply means. A parser fails if it raises
anything but its own error, accepts what the judge refuses, reads another value, or refuses what is whole.

What the judge cannot tell from the truth passed every check that one reply allows. The checks between replies are then
tried with the drivers' own code: the order of lines and of their time stamps, clocks and parameters asked for again, a
second reading of a position. Left over may be only values of lines whose every sum of six bits is right, and positions
hardly off where the unit is.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from benchmarks.acquisition import oracle as oracle
from benchmarks.shared.bars import Row
from ladarreg_core.acquisition.devices import flir_protocol, scip_protocol
from ladarreg_core.acquisition.devices.flir_unit import FlirUnit
from ladarreg_core.acquisition.devices.link import Link
from ladarreg_core.acquisition.devices.scip_clock import ClockSample, LineTimes, ScannerClock
from ladarreg_core.acquisition.serial_port import Port
from ladarreg_core.errors import DeviceError

REPLIES, QUICK_REPLIES = 100_000, 4_000
_SEED = 18
_PERIOD_MS = 25
_TURN_OFF_MS = 5
_CLOCK_OFF_MS = 10
_NEAR_COUNTS = 1  # of a unit at rest
_RANDOM = np.random.Generator
Damage = Callable[[bytes, bytes, _RANDOM], bytes]
"""Given a reply, another one, and random numbers: the damaged reply."""


@dataclass(frozen=True, slots=True)
class Reply:
    """A reply by the book, and what it says."""

    device: str
    sent: bytes
    data: bytes
    says: object
    parse: Callable[[bytes], object]
    judge: Callable[[bytes], object]
    error: type[DeviceError]


@dataclass
class Count:
    """What became of the replies of a class."""

    replies: int = 0
    refused: int = 0
    as_sent: int = 0
    other: int = 0
    """Accepted with a value other than the one sent, which nothing in the reply betrays."""
    found_later: int = 0
    """Of these the ones that a check between replies refuses or mends."""
    faults: list[str] = field(default_factory=list)

    def said(self) -> str:
        """Return the counts in words."""
        other = f", {self.other} other, of these {self.found_later} found between replies" if self.other else ""
        faults = f"; FAULTS {len(self.faults)}: {self.faults[0]}" if self.faults else ""
        return f"{self.replies} replies: {self.refused} refused, {self.as_sent} as sent{other}{faults}"


def _bit(data: bytes, other: bytes, random: _RANDOM) -> bytes:
    out = bytearray(data)
    for _ in range(int(random.integers(1, 4))):
        out[int(random.integers(len(out)))] ^= 1 << int(random.integers(8))
    return bytes(out)


def _lost(data: bytes, other: bytes, random: _RANDOM) -> bytes:
    at, length = int(random.integers(len(data))), int(random.integers(1, 4))
    return data[:at] + data[at + length :]


def _doubled(data: bytes, other: bytes, random: _RANDOM) -> bytes:
    at, length = int(random.integers(len(data))), int(random.choice([1, 1, 2, 66]))
    return data[: at + length] + data[at:]


def _swapped(data: bytes, other: bytes, random: _RANDOM) -> bytes:
    out, at = bytearray(data), int(random.integers(len(data) - 1))
    to = at + 1 if random.random() < 0.5 else int(random.integers(len(data)))
    out[at], out[to] = out[to], out[at]
    return bytes(out)


def _truncated(data: bytes, other: bytes, random: _RANDOM) -> bytes:
    """A beginning or an end, mostly with the end of a reply."""
    at = int(random.integers(len(data)))
    kept = data[:at] if random.random() < 0.7 else data[at:]
    return kept + (b"\n\n" if random.random() < 0.7 else b"")


def _spliced(data: bytes, other: bytes, random: _RANDOM) -> bytes:
    """The beginning of one reply and the end of another, or one after the other."""
    if random.random() < 0.2:
        return other + data
    lines, others = data.split(b"\n"), other.split(b"\n")
    if random.random() < 0.5:  # whole lines, whose sums are right
        return b"\n".join(lines[: int(random.integers(len(lines)))] + others[int(random.integers(len(others))) :])
    return data[: int(random.integers(len(data)))] + other[int(random.integers(len(other))) :]


def _noise(data: bytes, other: bytes, random: _RANDOM) -> bytes:
    length = int(random.integers(0, 80))
    letters = np.frombuffer(b"0123456789*!PT HMEGD;:\r\n" if random.random() < 0.6 else bytes(range(256)), np.uint8)
    return random.choice(letters, length).astype(np.uint8).tobytes() + (b"\n\n" if random.random() < 0.5 else b"\r\n")


def _forged(data: bytes, other: bytes, random: _RANDOM) -> bytes:
    """Changed, with its checksum set right; an answer of a unit has none, and gets another character."""
    lines = data.split(b"\n")
    summed = [k for k, line in enumerate(lines) if k > 0 and len(line) > 1]
    if len(lines) < 2 or lines[1] not in (b"00P", b"99b"):
        out = bytearray(data)
        out[int(random.integers(len(out)))] = int(random.integers(32, 127))
        return bytes(out)
    k = int(random.choice([0, *summed, *summed[1:2] * 3]))
    line = bytearray(lines[k])
    end = len(line) if k == 0 else len(line) - 1
    line[int(random.integers(end))] = int(random.integers(48, 112))
    if k:
        is_field = line[4:5] == b":" and line[-2:-1] == b";"
        line[-1] = (sum(line[: -2 if is_field else -1]) & 63) + 48
    lines[k] = bytes(line)
    return b"\n".join(lines)


def _whole(data: bytes, other: bytes, random: _RANDOM) -> bytes:
    return data


CLASSES: dict[str, Damage] = {
    "whole": _whole, "random bytes": _noise, "bits flipped": _bit, "bytes lost": _lost, "bytes doubled": _doubled,
    "bytes swapped": _swapped, "truncated": _truncated, "spliced": _spliced, "forged": _forged,
}  # fmt: skip


def _summed(text: bytes) -> bytes:
    return text + bytes([sum(text) % 64 + 48])


def _coded(value: int, characters: int) -> bytes:
    return bytes(value // 64**k % 64 + 48 for k in reversed(range(characters)))


def scip_reply(random: _RANDOM) -> Reply:
    """Return a reply of the line scanner: a line, fields or its clock."""
    kind = random.choice(["line", "line", "line", "fields", "clock"])
    if kind == "clock":
        value = int(random.integers(1 << 24))
        data = b"TM1\n00P\n" + _summed(_coded(value, 4)) + b"\n\n"
        return Reply("scanner", b"TM1\n", data, value, lambda d: scip_protocol.parse_clock(d, b"TM1\n"),
                     lambda d: oracle.scip_clock(d, b"TM1\n"), scip_protocol.ScipError)  # fmt: skip
    if kind == "fields":
        fields = {"MODL": "UTM-30LX(Hokuyo Automatic Co., Ltd.)", "DMIN": str(random.integers(1, 99)),
                  "DMAX": str(random.integers(4000, 90_000)), "ARES": "1440", "AMIN": "0", "AMAX": "1080",
                  "AFRT": "540", "SCAN": "2400"}  # fmt: skip
        rows = []
        for name, value in fields.items():
            text = f"{name}:{value}".encode()
            rows.append(text + b";" + _summed(text)[-1:])
        data = b"\n".join([b"PP", b"00P", *rows]) + b"\n\n"
        return Reply("scanner", b"PP\n", data, fields, lambda d: dict(scip_protocol.parse_fields(d, b"PP\n")),
                     lambda d: oracle.scip_fields(d, b"PP\n"), scip_protocol.ScipError)  # fmt: skip
    first, rays = int(random.integers(0, 1000)), int(random.integers(1, 60))
    several, intensity = bool(random.random() < 0.7), bool(random.random() < 0.7)
    count = int(random.integers(1, 100)) if several else 1
    request = scip_protocol.LineRequest(
        first, first + rays - 1, count=count, with_intensity=intensity, single=not several
    )
    left = int(random.integers(count)) if several else 0
    each = 2 if intensity else 1
    values = random.integers(0, 60_000, (rays, each)).tolist()
    stamp = int(random.integers(1 << 24))
    coded = b"".join(_coded(int(v), 3) for ray in values for v in ray)
    blocks = [coded[k : k + 64] for k in range(0, len(coded), 64)]
    echo = request.sent[:-3] + f"{left:02d}".encode() if several else request.sent[:-1]
    rows = [echo, b"99b" if several else b"00P", *(_summed(text) for text in (_coded(stamp, 4), *blocks))]

    def parse(data: bytes) -> oracle.Line:
        line = scip_protocol.parse_line(data, request)
        columns = [line.distance_mm] if line.intensity is None else [line.distance_mm, line.intensity]
        return oracle.Line(line.time_ms, tuple(map(tuple, np.stack(columns, axis=-1).tolist())), line.left)

    says = oracle.Line(stamp, tuple(map(tuple, values)), left)
    data = b"\n".join(rows) + b"\n\n"
    return Reply("scanner", request.sent, data, says, parse,
                 lambda d: oracle.scip_line(d, request.sent, several=several, intensity=intensity),
                 scip_protocol.ScipError)  # fmt: skip


def flir_reply(random: _RANDOM) -> Reply:
    """Return an answer of the unit to a query: terse or verbose, with or without echo, halts and limits before it."""
    axis = str(random.choice(["P", "T"]))
    sent = f"{axis}P ".encode()
    value = int(random.integers(-13_090, 13_091))
    side = "Pan" if axis == "P" else "Tilt"
    echo, before = (
        str(random.choice(["", "", f"{axis}P "])),
        str(random.choice(["", "", "!P\r\n", "!T", "*\r\n", "H *\r\n"])),
    )
    words = "" if random.random() < 0.7 else f"Current {side} position is "
    if echo and before == "!T":
        before = "!T\r\n"
    data = f"{before}{echo}* {words}{value}\r\n".encode()
    return Reply("unit", sent, data, value, lambda d: flir_protocol.parse_reply(d, sent).counts(sent),
                 lambda d: oracle.flir_value(d, sent), flir_protocol.FlirError)  # fmt: skip


def measure(
    replies: int, *, seed: int = _SEED, parse: Callable[[Reply, bytes], object] | None = None
) -> dict[str, Count]:
    """Return what becomes of replies, by device and class.

    Args:
        replies: how many, in equal parts.
        seed: of all that is random.
        parse: reads a reply in the parser's place, for a control.
    """
    found: dict[str, Count] = {}
    misread: list[tuple[Count, Reply, int]] = []
    for k, (make, device) in enumerate(((scip_reply, "scanner"), (flir_reply, "unit"))):
        for number, (name, damage) in enumerate(CLASSES.items()):
            random, count = np.random.default_rng((seed, k, number)), Count()
            for _ in range(math.ceil(replies / (2 * len(CLASSES)))):
                reply = make(random)
                _judge(count, reply, damage(reply.data, make(random).data, random), misread, parse)
            found[f"{device}, {name}"] = count
    _read_again(misread)
    return found


def _judge(
    count: Count, reply: Reply, data: bytes, misread: list[tuple[Count, Reply, int]],
    parse: Callable[[Reply, bytes], object] | None,
) -> None:  # fmt: skip
    meant = reply.judge(data)
    try:
        read = _as_the_link_does(reply, data) if parse is None else parse(reply, data)
    except reply.error:
        read = None
    except Exception as error:  # that there is none is what is measured
        count.faults.append(f"{type(error).__name__} for {data[:60]!r}")
        read = None
    count.replies += 1
    if read != meant:
        what = "accepted" if meant is None else "refused" if read is None else "misread"
        count.faults.append(f"{what} {data[:60]!r}")
    if read is None:
        count.refused += 1
    elif read == reply.says:
        count.as_sent += 1
    else:
        count.other += 1
        if reply.device == "unit" and isinstance(read, int):
            misread.append((count, reply, read))
        else:
            _hold_against_others(count, reply.says, read)


def _as_the_link_does(reply: Reply, data: bytes) -> object:
    if reply.device == "unit":
        length = flir_protocol.reply_length(data, reply.sent)
    else:
        length = scip_protocol.reply_length(data)
    return reply.parse(data[:length]) if length else None  # incomplete: the link waits, and gives up


def _hold_against_others(count: Count, says: object, read: object) -> None:
    """Hold what a damaged reply of the scanner says against the replies before and after it."""
    if isinstance(read, dict):
        count.found_later += 1  # parameters are asked twice, and must be the same
        return
    clock = ScannerClock()
    if isinstance(read, int) and isinstance(says, int):
        off_ms = abs((read - says + (1 << 23)) % (1 << 24) - (1 << 23))
        try:
            clock.compare([ClockSample(10.0, 10.002, says), ClockSample(10.002, 10.004, read)])
        except scip_protocol.ScipError:
            count.found_later += 1
            return
        if off_ms > _CLOCK_OFF_MS:
            count.faults.append(f"accepted a clock {off_ms} ms off")
        return
    assert isinstance(read, oracle.Line)
    assert isinstance(says, oracle.Line)
    if read.left != says.left:
        count.found_later += 1  # lines are counted down one by one
        return
    if read.time_ms == says.time_ms:
        return
    before = (says.time_ms - _PERIOD_MS) % (1 << 24)
    clock.compare([ClockSample(10.0, 10.001, before)])
    times = LineTimes(clock, period_s=_PERIOD_MS / 1000, asked_s=10.0)
    times.accept(before, arrived_s=10.030)
    try:
        times.accept(read.time_ms, arrived_s=10.055)
        times.accept((says.time_ms + _PERIOD_MS) % (1 << 24), arrived_s=10.080)
    except scip_protocol.ScipError:
        count.found_later += 1
        return
    off_ms = abs(read.time_ms - says.time_ms)
    if not oracle.in_time(read.time_ms, before, _PERIOD_MS) or off_ms > _TURN_OFF_MS:
        count.faults.append(f"accepted a time stamp {off_ms} ms off")


def _read_again(misread: list[tuple[Count, Reply, int]]) -> None:
    """Have the driver read positions whose first answer was damaged to another number."""
    port = _Answers()
    unit = FlirUnit(Link(port, device="the pan/tilt unit"), (1, 1))
    for count, reply, value in misread:
        assert isinstance(reply.says, int)
        port.counts = reply.says
        unit.position()
        unit.position()  # twice the same: it is at rest
        port.misread = value
        try:
            read = round(unit.position().pan_rad / unit.identity.resolution_rad.pan_rad)
        except DeviceError:
            count.found_later += 1
            continue
        if read == reply.says:
            count.found_later += 1
        elif abs(read - reply.says) > _NEAR_COUNTS:
            count.faults.append(f"the driver took {read} for {reply.says}")


class _Answers(Port):
    """A unit at rest that answers at once; its next answer to a query for the pan may be a wrong number."""

    address = "a unit at rest"

    def __init__(self) -> None:
        self.counts = 0
        self.misread: int | None = None
        self._out = b""

    def write(self, data: bytes) -> None:
        for name in data.decode("ascii").split():
            known = {"PR": "46.2857", "TR": "46.2857", "PN": "-13090", "PX": "13090", "TN": "-3620", "TX": "2410",
                     "PS": "3000", "TS": "3000", "TP": "0", "V": "a unit", "L": "ON"}  # fmt: skip
            value = known.get(name, "")
            if name == "PP":
                value = str(self.counts if self.misread is None else self.misread)
                self.misread = None
            self._out += f"* {value}".rstrip().encode() + b"\r\n"

    def read(self, timeout_s: float) -> bytes:
        out, self._out = self._out, b""
        if not out:
            time.sleep(min(timeout_s, 0.001))
        return out

    def reopen(self) -> None:
        """Do nothing: it is never lost."""

    def close(self) -> None:
        """Do nothing."""


def trusting(reply: Reply, data: bytes) -> object:
    """Read a reply as a parser would that looks at no checksum, echo or form: the control."""
    if reply.device == "unit":
        digits = "".join(c for c in data.decode("latin-1").partition("*")[2] if c.isdigit() or c == "-")
        return int(digits)
    if not isinstance(reply.says, oracle.Line):
        return reply.judge(data)
    rows = data.strip(b"\n").split(b"\n")
    coded = b"".join(row[:-1] for row in rows[3:])
    values = [int.from_bytes(coded[k : k + 3]) for k in range(0, len(coded), 3)]
    return oracle.Line(0, tuple((value,) for value in values), 0)


def parsers_rows(quick: bool, show: Callable[[str], None]) -> list[Row]:
    """Return the rows of both parsers by class of damage, and of the control."""
    replies = QUICK_REPLIES if quick else REPLIES
    rows = []
    for name, count in measure(replies).items():
        show(f"{name}: {count.said()}")
        whole = count.as_sent == count.replies if name.endswith("whole") else True
        rows.append(
            Row(f"parsers: {name}", "typed errors, nothing accepted that a check refuses", count.said(),
                not count.faults and whole)
        )  # fmt: skip
    faults = sum(len(count.faults) for count in measure(replies // 10, parse=trusting).values())
    rows.append(Row("parsers: control, trusting", "faults", f"{faults} of {replies // 10}", faults > 0))
    return rows
