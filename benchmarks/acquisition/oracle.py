"""What a reply of a device means, decided byte by byte from the text of its protocol alone: a judge of the parsers.

Nothing here comes from the drivers, and no regular expression from their parsers: what both get wrong must be
misread in the protocol, not mistyped twice.
"""

from __future__ import annotations

from dataclasses import dataclass

_DIGITS = b"0123456789"
_LARGEST_MM = 65_535


@dataclass(frozen=True, slots=True)
class Line:
    """A line as the protocol reads it."""

    time_ms: int
    values: tuple[tuple[int, ...], ...]
    left: int


def scip_frame(received: bytes) -> bytes | None:
    """Return the lines of the first reply, up to and without the empty line that ends it; None if none has ended."""
    begin = 0
    while begin < len(received) and received[begin] == 10:  # the end of what came before
        begin += 1
    for k in range(begin, len(received) - 1):
        if received[k] == 10 and received[k + 1] == 10:
            return received[begin:k]
    return None


def scip_line(received: bytes, sent: bytes, *, several: bool, intensity: bool) -> Line | None:
    """Return the line in answer to GD, GE, MD or ME; None if the reply is not exactly one."""
    frame = scip_frame(received)
    if frame is None:
        return None
    rows = frame.split(b"\n")
    command = sent[:-1]
    left = 0
    if several:
        count = int(command[-2:])
        if len(rows[0]) != len(command) or rows[0][:-2] != command[:-2]:
            return None
        if rows[0][-1] not in _DIGITS or rows[0][-2] not in _DIGITS or int(rows[0][-2:]) >= count:
            return None
        left = int(rows[0][-2:])
    elif rows[0] != command:
        return None
    if len(rows) < 4 or rows[1] != (b"99b" if several else b"00P"):
        return None
    payload = []
    for k, row in enumerate(rows[2:]):
        body = _summed(row)
        if body is None:
            return None
        # A stamp of four characters, then blocks of 64; the last block has what is left.
        last = k == len(rows) - 3
        if (k == 0 and len(body) != 4) or (k > 0 and len(body) != 64 and not (last and 1 <= len(body) <= 64)):
            return None
        if any(not 48 <= byte <= 111 for byte in body):
            return None
        payload.append(body)
    each = 2 if intensity else 1
    rays = int(command[6:10]) - int(command[2:6]) + 1
    data = b"".join(payload[1:])
    if len(data) != rays * each * 3:
        return None
    numbers = [_number(data[k : k + 3]) for k in range(0, len(data), 3)]
    values = tuple(tuple(numbers[k : k + each]) for k in range(0, len(numbers), each))
    if any(value[0] > _LARGEST_MM for value in values):
        return None
    return Line(_number(payload[0]), values, left)


def scip_fields(received: bytes, sent: bytes) -> dict[str, str] | None:
    """Return the fields in answer to VV, PP or II; None if the reply is not exactly some."""
    frame = scip_frame(received)
    if frame is None:
        return None
    rows = frame.split(b"\n")
    if rows[0] != sent[:-1] or len(rows) < 2 or rows[1] != b"00P":
        return None
    found: dict[str, str] = {}
    for row in rows[2:]:
        if len(row) < 7 or row[-2:-1] != b";" or row[4:5] != b":" or not row[:4].isalpha() or not row[:4].isupper():
            return None
        text = row[:-2]
        if row[-1] != sum(text) % 64 + 48 or any(not 32 <= byte <= 126 or byte == 59 for byte in text):
            return None
        name = text[:4].decode()
        if name in found:
            return None
        found[name] = text[5:].decode().strip(" ")
    return found


def scip_clock(received: bytes, sent: bytes) -> int | None:
    """Return the clock in answer to TM1, ms; None if the reply is not exactly one."""
    frame = scip_frame(received)
    rows = frame.split(b"\n") if frame is not None else []
    if len(rows) != 3 or rows[0] != sent[:-1] or rows[1] != b"00P":
        return None
    body = _summed(rows[2])
    if body is None or len(body) != 4 or any(not 48 <= byte <= 111 for byte in body):
        return None
    return _number(body)


def in_time(time_ms: int, before_ms: int, period_ms: float) -> bool:
    """Return whether a line came whole turns after the one before it, within what a motor and a clock of 1 ms allow."""
    step = (time_ms - before_ms) % (1 << 24)
    off = min(step % period_ms, period_ms - step % period_ms)
    turns = round(step / period_ms)
    return turns >= 1 and off <= 2 + period_ms / 10 + (turns - 1) * period_ms / 50


def flir_value(received: bytes, sent: bytes) -> int | None:
    """Return the counts in answer to a query; None if the first answer is not exactly that."""
    line = b""
    for byte in received:
        if byte not in b"\r\n":
            line += bytes([byte])
            continue
        rest = _without_echo_and_notices(line, sent)
        line = b""
        if rest in (b"", b"*"):  # nothing, or the star of a halt
            continue
        return _flir_counts(rest)
    return None


def _without_echo_and_notices(line: bytes, sent: bytes) -> bytes:
    rest = line.strip(b" \t")
    echo = sent.strip()
    if rest.startswith(echo):
        while echo and rest.startswith(echo):  # once from the unit, once from a converter that echoes, too
            rest = rest[len(echo) :].strip(b" \t")
    elif rest[:1] == b"H" and rest[1:].strip(b" \t") in (b"", b"*"):
        return b""
    while rest[:2] in (b"!P", b"!T") and rest[2:].lstrip(b" \t")[:1] in (b"", b"*", b"!"):
        rest = rest[2:].strip(b" \t")
    return rest


def _flir_counts(answer: bytes) -> int | None:
    if answer[:1] != b"*" or any(not 32 <= byte <= 126 for byte in answer):
        return None
    numbers = []
    for token in answer[1:].decode().split(" "):
        digits = token[1:] if token[:1] in ("+", "-") else token
        whole, point, fraction = digits.partition(".")
        if token == "" or (token[0].isalpha() and all(c.isalpha() or c in "/().,:" for c in token)):
            continue
        is_number = whole.isdigit() and len(whole) <= 10
        if not is_number or (point and not (fraction.isdigit() and len(fraction) <= 9)):
            return None
        numbers.append(token)
    if len(numbers) != 1 or float(numbers[0]) % 1 or abs(float(numbers[0])) >= 1 << 31:
        return None
    return int(float(numbers[0]))


def _summed(row: bytes) -> bytes | None:
    """Return a row without its checksum, None if that is wrong or nothing stands before it."""
    if len(row) < 2 or row[-1] != sum(row[:-1]) % 64 + 48:
        return None
    return row[:-1]


def _number(characters: bytes) -> int:
    value = 0
    for byte in characters:
        value = value * 64 + byte - 48
    return value
