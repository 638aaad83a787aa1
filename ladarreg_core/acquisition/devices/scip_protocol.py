"""SCIP 2, the ASCII protocol of Hokuyo's line scanners: commands to bytes, bytes to replies; no I/O.

A reply is the echo of the command, a status of two characters with its checksum, and lines of data, each with its
checksum; an empty line ends it. Numbers are groups of six bits, each plus 0x30, the highest first.

A checksum has six bits, so that one corruption in 64 passes it: echo, status, lengths and value ranges are checked as
well, and the order of time stamps by who has several replies.

Source: the SCIP 2.0 specification.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.acquisition.devices.scip_status import is_passing, status_in_words
from ladarreg_core.errors import DeviceGlitchError, OptionError

STOP = b"\nQT\n"
"""Ends a command that is half sent, and switches the laser off."""
CLOCK_MS = 1 << 24
"""Where the scanner's clock wraps."""
MAX_LINES = 99
"""Largest number of lines of one request."""
_BLOCK = 64
_COUNTED = 13  # characters of a request for several lines before their number
_CHARACTERS = 3
_OFFSET = 0x30
_MAX_STEPS = 9999
_LARGEST_MM = 65_535  # of scanners that do not measure beyond
_MAX_DIGITS = 6
_MM = 0.001
_FIELDS = ("DMIN", "DMAX", "ARES", "AMIN", "AMAX", "AFRT", "SCAN")
_SPEEDS = range(60, 12_001)  # turns a minute
_LONGEST_REPLY = 1 << 17


class ScipError(DeviceGlitchError):
    """A reply of the scanner that is an error, or that its protocol does not have."""


class ScipNotReadyError(ScipError):
    """The scanner does not measure yet: it verifies its laser or motor, and may be asked again."""


@dataclass(frozen=True, slots=True)
class LineRequest:
    """A request for lines: `GE` or `GD` for one, `ME` or `MD` for several."""

    first_step: int
    last_step: int
    count: int = 1
    with_intensity: bool = True
    single: bool = True

    def __post_init__(self) -> None:
        if not 0 <= self.first_step <= self.last_step <= _MAX_STEPS:
            raise OptionError(f"the steps {self.first_step} to {self.last_step} are not within 0 to {_MAX_STEPS}")
        if not 1 <= self.count <= MAX_LINES or (self.single and self.count != 1):
            raise OptionError(f"{self.count} lines cannot be requested at once; ask for 1 to {MAX_LINES}")

    @property
    def sent(self) -> bytes:
        """The command, with its line feed."""
        name = f"{'G' if self.single else 'M'}{'E' if self.with_intensity else 'D'}"
        more = "" if self.single else f"0{self.count:02d}"
        return f"{name}{self.first_step:04d}{self.last_step:04d}01{more}\n".encode("ascii")

    @property
    def rays(self) -> int:
        """Number of rays of a line."""
        return self.last_step - self.first_step + 1


@dataclass(frozen=True, slots=True, eq=False)
class RawLine:
    """A line as the scanner sent it."""

    time_ms: int
    """The scanner's clock, which wraps at `CLOCK_MS`."""
    distance_mm: NDArray[np.int32]
    """(N,); below the scanner's least distance: an error code."""
    intensity: NDArray[np.int32] | None
    """(N,), or None."""
    left: int
    """Lines of the request that are still to come."""


@dataclass(frozen=True, slots=True)
class ScipParameters:
    """What a scanner states about itself in answer to `PP`."""

    least_mm: int
    """Smaller values are error codes."""
    most_mm: int
    """Larger values say that there was no return."""
    steps_a_turn: int
    first_step: int
    last_step: int
    front_step: int
    """The step that looks ahead."""
    turns_a_minute: int

    def ranges_m(self, distance_mm: NDArray[np.int32]) -> NDArray[np.float32]:
        """Return the ranges of a line, (N,) m, NaN where there was no return."""
        ranges = (distance_mm * _MM).astype(np.float32)
        ranges[(distance_mm < max(1, self.least_mm)) | (distance_mm > self.most_mm)] = np.nan
        return ranges

    @staticmethod
    def of(fields: Mapping[str, str]) -> ScipParameters:
        """Return the parameters that fields state.

        Raises:
            ScipError: if one is missing, or no scanner has such parameters.
        """
        missing = [name for name in _FIELDS if not re.fullmatch(rf"[0-9]{{1,{_MAX_DIGITS}}}", fields.get(name, ""))]
        if missing:
            raise ScipError(f"the line scanner does not state {', '.join(missing)} in numbers; it is not supported")
        found = ScipParameters(*(int(fields[name]) for name in _FIELDS))
        absurd = [
            what
            for wrong, what in (
                (not 0 <= found.least_mm < found.most_mm < 1 << (6 * _CHARACTERS), ("DMIN", "DMAX")),
                (not 2 <= found.steps_a_turn <= _MAX_STEPS + 1 or found.steps_a_turn % 2 == 1, ("ARES",)),
                (not 0 <= found.first_step < found.last_step < found.steps_a_turn, ("AMIN", "AMAX", "ARES")),
                (not found.first_step <= found.front_step <= found.last_step, ("AFRT", "AMIN", "AMAX")),
                (found.turns_a_minute not in _SPEEDS, ("SCAN",)),
            )
            if wrong
        ]
        if absurd:
            names = list(dict.fromkeys(name for group in absurd for name in group))
            stated = ", ".join(f"{name} {fields[name]}" for name in names)
            raise ScipError(f"the line scanner states {stated}, which no scanner has; check the cable")
        return found


def checksum(data: bytes) -> int:
    """Return the checksum of bytes, the code of one character."""
    return (sum(data) & 0x3F) + _OFFSET


def encoded(value: int, characters: int) -> bytes:
    """Return a number as groups of six bits, the highest first.

    Raises:
        OptionError: if it does not fit.
    """
    if not 0 <= value < 1 << (6 * characters):
        raise OptionError(f"{value} does not fit {characters} characters of six bits")
    return bytes(((value >> (6 * k)) & 0x3F) + _OFFSET for k in reversed(range(characters)))


def decoded(data: bytes, characters: int) -> NDArray[np.int32]:
    """Return the numbers of groups of characters, (N,).

    Raises:
        ScipError: if a character is none of the code, or the last group is incomplete.
    """
    if len(data) % characters:
        raise ScipError(f"the line scanner sent {len(data)} characters where groups of {characters} are due")
    groups = np.frombuffer(data, np.uint8).reshape(-1, characters).astype(np.int32) - _OFFSET
    if groups.size and not (groups.min() >= 0 and groups.max() <= 0x3F):
        raise ScipError("the line scanner sent a character that its code does not have; check the cable")
    return np.asarray(groups @ (1 << (6 * np.arange(characters)[::-1])), dtype=np.int32)


def reply_length(received: bytes) -> int:
    """Return the length of the complete reply at the start of the bytes received, 0 if it is incomplete."""
    end = received.find(b"\n\n", len(received) - len(received.lstrip(b"\n")))
    if end < 0:
        return len(received) if len(received) > _LONGEST_REPLY else 0
    return end + 2


def without_local_echo(received: bytes, sent: bytes) -> bytes:
    """Return a reply without the command that a converter or serial server sent back before the scanner's own echo."""
    body = received.lstrip(b"\n")
    return body[len(sent) :] if sent.strip() and body.startswith(sent + sent) else received


def answers_another(received: bytes, sent: bytes) -> bool:
    """Return whether a complete reply is one to an earlier command, which came late."""
    echo, _, rest = received.strip(b"\n").partition(b"\n")
    status = rest[:3]
    whole = len(status) == 3 and checksum(status[:2]) == status[2] and rest[3:4] in (b"", b"\n")
    # One that acknowledges another number of lines, perhaps without end, is not late: the request was misread.
    misread = echo[:_COUNTED] == sent[:_COUNTED] and len(echo) > _COUNTED and status[:2] == b"00"
    return whole and echo != sent.strip(b"\n") and not misread


def parse_status(received: bytes, sent: bytes, *, allowed: tuple[str, ...] = ("00",)) -> tuple[str, list[bytes]]:
    """Return the status of a reply and the lines that follow it.

    Args:
        received: a complete reply.
        sent: the command, with its line feed.
        allowed: statuses that are no error.

    Raises:
        ScipNotReadyError: if the scanner does not measure yet.
        ScipError: if it is no reply to the command, its checksum is wrong, or the scanner reports an error.
    """
    if not received.endswith(b"\n\n"):
        raise ScipError(f"the line scanner sent {_shown(received)}, which is no complete reply; check the cable")
    echo, *lines = received[:-2].lstrip(b"\n").split(b"\n")
    if echo != sent.rstrip(b"\n"):
        raise ScipError(
            f"the line scanner answered {_shown(echo)} to {_shown(sent)}; check that no other program uses the port"
        )
    return _status_of(lines, sent, allowed), lines[1:]


def parse_fields(received: bytes, sent: bytes) -> Mapping[str, str]:
    """Return the fields of a reply to `VV`, `PP` or `II`, `NAME:VALUE;` with a checksum each.

    Raises:
        ScipError: if the reply is wrong, or a checksum is, or a name comes twice.
    """
    _, lines = parse_status(received, sent)
    fields: dict[str, str] = {}
    for line in lines:
        match = re.fullmatch(rb"([A-Z]{4}):([ -:<-~]*);(.)", line, re.DOTALL)
        if match is None or checksum(line[:-2]) != line[-1]:
            raise ScipError(
                f"the line scanner sent {_shown(line)} where a field is due, or its checksum is wrong; check the cable"
            )
        name = match.group(1).decode("ascii")
        if name in fields:
            raise ScipError(f"the line scanner sent the field {name} twice in one answer; check the cable")
        fields[name] = match.group(2).decode("ascii").strip()
    return fields


def parse_clock(received: bytes, sent: bytes) -> int:
    """Return the scanner's clock, ms, of a reply to `TM1`.

    Raises:
        ScipError: if the reply or its checksum is wrong.
    """
    _, lines = parse_status(received, sent)
    if len(lines) != 1:
        raise ScipError(f"the line scanner sent {len(lines)} lines where its clock is due; check the cable")
    return _clock(lines[0])


def is_acknowledgement(received: bytes, request: LineRequest) -> bool:
    """Return whether a reply to a request for several lines has a status only."""
    return not request.single and received.strip(b"\n").count(b"\n") == 1


def parse_line(received: bytes, request: LineRequest, *, most_mm: int = _LARGEST_MM) -> RawLine:
    """Return the line of a reply.

    Args:
        received: a complete reply.
        request: what was requested.
        most_mm: the scanner's largest distance; larger values up to 65,535 say that there was no return.

    Raises:
        ScipNotReadyError: if the scanner has interrupted the request.
        ScipError: if anything about it is not as specified.
    """
    sent, left, only_status = request.sent, 0, is_acknowledgement(received, request)
    if not request.single:
        # The echo counts the lines that are left; everything before is that of the request.
        echo = received.lstrip(b"\n").split(b"\n", 1)[0]
        digits = echo[-2:].decode("ascii", "replace")
        if not re.fullmatch("[0-9]{2}", digits) or int(digits) >= request.count + only_status:
            raise ScipError(f"the line scanner sent a line with the echo {_shown(echo)}; check the cable")
        sent, left = sent[:-3] + echo[-2:] + b"\n", int(digits)
    allowed = ("00",) if request.single or only_status else ("99",)
    _, lines = parse_status(received, sent, allowed=allowed)
    if only_status:
        raise ScipError("the line scanner acknowledged a request where a line is due; check the cable")
    if not lines:
        raise ScipError("the line scanner sent a line without a time stamp; check the cable")
    time_ms = _clock(lines[0])
    data = b"".join(_checked(block, last=k == len(lines) - 2) for k, block in enumerate(lines[1:]))
    each = 2 if request.with_intensity else 1
    if len(data) != request.rays * each * _CHARACTERS:
        raise ScipError(
            f"the line scanner sent {len(data)} characters of data where {request.rays * each * _CHARACTERS} are due; "
            "check the cable, and that no other program uses the port"
        )
    values = decoded(data, _CHARACTERS).reshape(-1, each)
    if values[:, 0].max() > max(_LARGEST_MM, most_mm):
        raise ScipError(f"the line scanner sent a distance of {values[:, 0].max()} mm, which it cannot measure")
    return RawLine(time_ms, values[:, 0], values[:, 1] if request.with_intensity else None, left)


def _status_of(lines: list[bytes], sent: bytes, allowed: tuple[str, ...]) -> str:
    if not lines or len(lines[0]) != 3 or checksum(lines[0][:2]) != lines[0][2]:
        raise ScipError(
            f"the line scanner's status {_shown(lines[0] if lines else b'')} is not one, or its checksum is wrong; "
            "check the cable"
        )
    status = lines[0][:2].decode("ascii", "replace")
    if status in allowed:
        return status
    kind = ScipNotReadyError if is_passing(status, sent) else ScipError
    raise kind(f"the line scanner answered {_shown(sent)} by {status_in_words(status, sent)}")


def _clock(line: bytes) -> int:
    if len(line) != 5 or checksum(line[:4]) != line[4]:
        raise ScipError(f"the checksum of the line scanner's time stamp {_shown(line)} is wrong; check the cable")
    return int(decoded(line[:4], 4)[0])


def _checked(block: bytes, *, last: bool) -> bytes:
    """Return the data of a block."""
    whole = len(block) == _BLOCK + 1 or (last and 2 <= len(block) <= _BLOCK)
    if not whole or checksum(block[:-1]) != block[-1]:
        raise ScipError("a block of the line scanner's data is incomplete, or its checksum is wrong; check the cable")
    return block[:-1]


def _shown(data: bytes) -> str:
    text = data[:60].decode("ascii", "backslashreplace").encode("unicode_escape").decode()
    return f'"{text}"' + ("..." if len(data) > 60 else "")
