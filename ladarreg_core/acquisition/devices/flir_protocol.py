"""The ASCII protocol of FLIR / Directed Perception pan/tilt units: commands to bytes, bytes to replies; no I/O.

A command is one or two letters, for most an integer, and a space. The unit answers a success by `*`, a query by
`* value`, an error by `! message`, each ended by a line feed. A limit that is hit is reported unasked, by `!P` or `!T`,
which may stand before any answer. Answers may be terse or verbose, and follow the echo of the command if that is on.

Nothing has a checksum: an answer is taken only if all of it has the form of one, and who asks compares several.

Source: the units' command reference.
"""

from __future__ import annotations

import contextlib
import re
from dataclasses import dataclass

from ladarreg_core.errors import DeviceGlitchError, OptionError

STOP = b"\rH "
"""Ends a command that is half sent, and halts."""
_MAX_COUNTS = 1 << 31
_LONGEST_REPLY = 512
_NOTICE = re.compile(r"!([PT])(?=[ \t]*(?:[*!\r\n]|$))")
_NUMBER = re.compile(r"[-+]?[0-9]{1,10}(?:\.[0-9]{1,9})?")
_WORD = re.compile(r"[A-Za-z][A-Za-z/().,:]*")
_BANNER = re.compile(rb"(?m)^[^*!\r\n]*(?:controller|initiali[sz])", re.IGNORECASE)
_ZEROS_FOUND = re.compile(rb"(?:![PT]){3,}[ \t]*\*")  # a reset runs both axes into their limits: `!T!T!P!P*`
_SUPPLY = {"volts": r"([0-9.]+) ?V", "celsius": r"([-0-9.]+) ?deg ?C", "fahrenheit": r"([-0-9.]+) ?deg ?F"}
_OF_A_HALT = re.compile(r"H[ \t]*\*?")
_SPACE = " \t\r\n"
_NAME = re.compile(r"[A-Z]{1,3}")


class FlirError(DeviceGlitchError):
    """An answer of the unit that is an error, or that its protocol does not have."""


@dataclass(frozen=True, slots=True)
class FlirReply:
    """An answer to a command."""

    text: str
    """What follows the star, without surrounding space."""
    limits_hit: tuple[str, ...] = ()
    """Axes whose limit was reported before the answer: `pan`, `tilt`."""

    def number(self, sent: bytes) -> float:
        """Return the value of a query.

        Raises:
            FlirError: if the answer is anything but one number, among words if it is verbose.
        """
        tokens = self.text.split()
        numbers = [token for token in tokens if _NUMBER.fullmatch(token)]
        if len(numbers) != 1 or not all(token in numbers or _WORD.fullmatch(token) for token in tokens):
            raise FlirError(
                f"the pan/tilt unit answered {_shown(self.text)} to {_shown(sent)} where one number is due; check that "
                "it is a FLIR or Directed Perception unit, and the baud rate"
            )
        return float(numbers[0])

    def counts(self, sent: bytes) -> int:
        """Return the value of a query for a position, limit or speed, whole counts.

        Raises:
            FlirError: if it is no whole number within 31 bits.
        """
        value = self.number(sent)
        if value != int(value) or abs(value) >= _MAX_COUNTS:
            raise FlirError(f"the pan/tilt unit answered {_shown(self.text)} to {_shown(sent)} where counts are due")
        return int(value)


def command(name: str, value: int | None = None) -> bytes:
    """Return the bytes of a command.

    Args:
        name: one to three capital letters, e.g. `PP`.
        value: whole counts; None for a query or a command without one.

    Raises:
        OptionError: if the name is no command, or the value does not fit 31 bits.
    """
    if not _NAME.fullmatch(name):
        raise OptionError(f"{name!r} is no command of the unit; it has one to three capital letters")
    if value is not None and not -_MAX_COUNTS < value < _MAX_COUNTS:
        raise OptionError(f"the value {value} of the command {name} does not fit 31 bits")
    return f"{name}{'' if value is None else value} ".encode("ascii")


def reply_length(received: bytes, sent: bytes) -> int:
    """Return the length of the complete reply to a command at the start of the bytes received, 0 if it is incomplete.

    The bare star of an earlier command, such as a halt, is not taken for the answer to a query.
    """
    found = _first_answer(received, sent)
    return found[0] if found else 0


def parse_reply(received: bytes, sent: bytes) -> FlirReply:
    """Return the reply to a command.

    Args:
        received: bytes from the unit, whatever they are.
        sent: the command.

    Raises:
        FlirError: if the unit reports an error, or the bytes are no complete answer.
    """
    found = _first_answer(received, sent)
    if found is None:
        raise FlirError(
            f"the pan/tilt unit sent {_shown(received)} in answer to {_shown(sent)}, which is no complete answer; "
            "check the baud rate and the cable"
        )
    _, line, hit = found
    if not (line.isascii() and line.isprintable()):
        raise FlirError(
            f"the pan/tilt unit sent {_shown(line)} in answer to {_shown(sent)}, which is no text; check the baud rate "
            "and the cable"
        )
    if line.startswith("*"):
        return FlirReply(line[1:].strip(_SPACE), hit)
    if line.startswith("!"):
        reason = line[1:].strip(_SPACE) or "no reason"
        raise FlirError(f"the pan/tilt unit refused {_shown(sent)}: {reason[:120]}")
    raise FlirError(
        f"the pan/tilt unit sent {_shown(line)} in answer to {_shown(sent)}, where * or ! is due; check the baud rate, "
        "and that no other program uses the port"
    )


def limits_hit(unasked: bytes) -> tuple[str, ...]:
    """Return the axes whose limits are reported in bytes that came unasked."""
    return tuple({"P": "pan", "T": "tilt"}[axis] for axis in _NOTICE.findall(unasked.decode("ascii", "replace")))


def has_restarted(received: bytes) -> bool:
    """Return whether bytes contain what a unit sends after a restart: its banner, or notices from finding zeros."""
    return bool(_BANNER.search(received) or _ZEROS_FOUND.search(received))


def supply_of(text: str) -> dict[str, float]:
    """Return what an answer to `O` states, if anything: `volts` of the input, `celsius` of the case."""
    found = {}
    for name, pattern in _SUPPLY.items():
        if match := re.search(pattern, text):
            with contextlib.suppress(ValueError):
                found[name] = float(match[1])
    if "fahrenheit" in found:
        found["celsius"] = round((found.pop("fahrenheit") - 32) / 1.8, 1)
    return found


def _first_answer(received: bytes, sent: bytes) -> tuple[int, str, tuple[str, ...]] | None:
    """Return the end of the first answer, its line without echo and notices, and the notices before it."""
    is_query = not any(chr(byte).isdigit() for byte in sent) and sent.strip() in _QUERIES
    notices: list[str] = []
    start = 0
    echo = sent.decode("ascii", "replace").strip()
    for match in re.finditer(rb"[^\r\n]*[\r\n]", received):
        line = match.group().decode("ascii", "replace").strip(_SPACE)
        # What comes unasked may stand before the echo, too, and nothing separates them.
        if echo and (before := re.match(rf"((?:![PT][ \t]*)+)(?={re.escape(echo)})", line)):
            notices += [{"P": "pan", "T": "tilt"}[axis] for axis in re.findall("[PT]", before[1])]
            line = line[before.end() :]
        if echo and line.startswith(echo):
            while line.startswith(echo):  # twice where what lies between echoes, too
                line = line[len(echo) :].strip(_SPACE)
        elif _OF_A_HALT.fullmatch(line):
            line = ""
        start = match.end()
        while notice := _NOTICE.match(line):
            notices.append({"P": "pan", "T": "tilt"}[notice.group(1)])
            line = line[notice.end() :].strip(_SPACE)
        if not line or (is_query and line == "*"):
            continue
        while start < len(received) and received[start : start + 1] in (b"\r", b"\n"):
            start += 1
        return start, line, tuple(notices)
    if len(received) > _LONGEST_REPLY:
        return len(received), received[:_LONGEST_REPLY].decode("ascii", "replace"), tuple(notices)
    return None


_AXIS_QUERIES = ("P", "O", "S", "D", "R", "N", "X", "U", "L", "A", "B", "NU", "XU", "NF", "XF")
_QUERIES = frozenset(f"{axis}{letter}".encode() for axis in "PT" for letter in _AXIS_QUERIES) | {
    b"L",
    b"O",
    b"V",
    b"VV",
    b"VM",
    b"VS",
}
"""Commands whose answer has a value where no value is sent."""


def _shown(data: bytes | str) -> str:
    text = data.decode("ascii", "backslashreplace") if isinstance(data, bytes) else data
    return '"' + text[:60].encode("unicode_escape").decode() + ('"' if len(text) <= 60 else '..."')
