"""Protocols compared with implementations that were written from the published documents without reading ours."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator

import numpy as np
import pytest

from ladarreg_core.acquisition.devices import flir_protocol, scip_protocol
from ladarreg_core.acquisition.devices.flir_protocol import FlirError, command, parse_reply
from ladarreg_core.acquisition.devices.scip_protocol import (
    CLOCK_MS,
    LineRequest,
    ScipError,
    ScipParameters,
    is_acknowledgement,
    parse_clock,
    parse_fields,
    parse_line,
    parse_status,
)
from ladarreg_core.acquisition.simulated.flir_twin import FlirTwin
from ladarreg_core.acquisition.simulated.scip_twin import ScipTwin
from testing.devices import ptu_peer, scip_peer
from testing.devices.ptu_peer import PeerUnit
from testing.devices.scip_peer import PeerScanner
from testing.devices.wall import wall

PARTS, EXCHANGES = 20, 500  # 10,000 in all
parts = pytest.mark.parametrize("part", [0, *(pytest.param(k, marks=pytest.mark.long) for k in range(1, PARTS))])


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """Return bytes as a bad cable delivers them: a bit flipped, a byte lost or doubled, the end missing."""
    at = int(rng.integers(len(data)))
    kind = rng.integers(4)
    if kind == 0:
        return data[:at] + bytes([data[at] ^ (1 << int(rng.integers(8)))]) + data[at + 1 :]
    if kind == 1:
        return data[:at] + data[at + 1 :]
    if kind == 2:
        return data[:at] + data[at : at + 1] + data[at:]
    return data[:at]


# -- the line scanner ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "line",
    [
        b"VEND:Hokuyo Automatic Co.,Ltd.;[", b"PROD:SOKUIKI Sensor URG-04LX;[", b"FIRM:3.1.00(18/Jan./2007);`",
        b"PROT:SCIP 2.0;N", b"SERI:H0614967;V", b"DMIN:20;4", b"DMAX:5600;_", b"ARES:1024;\\", b"AMIN:44;7",
        b"AMAX:725;o", b"AFRT:384;6", b"SCAN:600;e",
    ],
)  # fmt: skip
def test_both_have_the_sums_of_the_document(line: bytes) -> None:
    assert scip_peer.check_character(line[:-2]) == line[-1:]
    assert scip_protocol.checksum(line[:-2]) == line[-1]


def test_both_have_the_numbers_of_the_document() -> None:
    for value, text in ((5432, b"1Dh"), (16_000_000, b"m2@0")):
        assert scip_peer.to_characters(value, len(text)) == scip_protocol.encoded(value, len(text)) == text
        assert scip_peer.from_characters(text) == int(scip_protocol.decoded(text, len(text))[0]) == value


def drawn_scanner(rng: np.random.Generator) -> PeerScanner:
    turn = 2 * int(rng.integers(180, 720))
    first = int(rng.integers(0, 40))
    last = int(rng.integers(first + 60, turn))
    farthest = int(rng.integers(4000, 65_000))
    numbers = np.random.default_rng(int(rng.integers(1 << 30)))

    def measure(number: int) -> list[tuple[int, int]]:
        distances = numbers.integers(0, farthest + 1, last + 1)
        return list(zip(distances.tolist(), numbers.integers(0, 1 << 18, last + 1).tolist(), strict=True))

    return PeerScanner(
        measure, first, last, int(rng.integers(first, last + 1)), turn, int(rng.integers(1, 100)), farthest,
        int(rng.integers(300, 6000)), knows_intensity=bool(rng.random() < 0.8), clock_ms=int(rng.integers(CLOCK_MS)),
        laser_on=bool(rng.random() < 0.7), adjusting=bool(rng.random() < 0.3),
    )  # fmt: skip


def drawn_request(peer: PeerScanner, rng: np.random.Generator) -> LineRequest:
    first = int(rng.integers(peer.last_step))
    last = min(int(rng.integers(first, first + 120)), peer.last_step + int(rng.random() < 0.05))
    single = bool(rng.random() < 0.5)
    count = 1 if single else int(rng.integers(1, 6))
    return LineRequest(first, last, count, with_intensity=bool(rng.random() < 0.6), single=single)


def ours(reply: bytes, sent: bytes, request: LineRequest | None) -> object:
    """Return what our protocol reads in a reply, in the peer's terms."""
    if request is not None and not is_acknowledgement(reply, request):
        with contextlib.suppress(ScipError):
            line = parse_line(reply, request, most_mm=1 << 17)
            columns = [line.distance_mm] if line.intensity is None else [line.distance_mm, line.intensity]
            return line.time_ms, tuple(np.stack(columns, axis=-1).ravel().tolist())
    if sent == b"TM1\n":
        with contextlib.suppress(ScipError):
            return parse_clock(reply, sent), ()
    if sent[:2] in (b"VV", b"PP"):
        return tuple(parse_fields(reply, sent).items())
    status, lines = parse_status(reply, sent, allowed=EVERY)
    if lines:
        raise ScipError("lines where a status is due")
    return status


EVERY = tuple(f"{a}{b}" for a in "0123456789" for b in "0123456789ABCDEFGHI")


def theirs(reply: bytes) -> object:
    assert reply.endswith(b"\n\n")
    found = scip_peer.read(reply[:-2])
    if found.named:
        return found.named
    return found.status.decode("ascii") if found.stamp_ms is None else (found.stamp_ms, found.values)


@parts
def test_replies_of_a_scanner_are_read_alike(part: int) -> None:
    rng = np.random.default_rng([36, part])
    accepted = refused = done = 0
    while done < EXCHANGES:
        peer = drawn_scanner(rng)
        peer.adjusting = peer.adjusting and rng.random() < 0.5
        request = drawn_request(peer, rng) if rng.random() < 0.6 else None
        commands = [b"VV\n", b"PP\n", b"BM\n", b"QT\n", b"TM0\n", b"TM1\n", b"TM2\n", b"XX\n"]
        sent = request.sent if request is not None else commands[int(rng.integers(len(commands)))]
        replies, rest = scip_peer.split(peer.answer(sent.rstrip(b"\n")))
        assert not rest
        for reply in (each + b"\n\n" for each in replies):
            done += 1
            assert scip_protocol.reply_length(reply) == len(reply)
            assert ours(reply, sent, request) == theirs(reply), (sent, reply)
            bad = damaged(reply, rng)
            if not bad.endswith(b"\n\n") or bad.lstrip(b"\n") == reply:
                continue
            try:
                found = ours(bad, sent, request)
            except ScipError:
                refused += 1
                continue
            # Ours asks for more: the echo, lengths, values that a scanner can have. What it takes is in the document.
            accepted += 1
            assert found == theirs(bad.lstrip(b"\n")), (sent, bad)
    assert refused > 20 * accepted, "a six-bit sum alone lets pass one in 64"


def test_parameters_of_a_scanner_are_read_alike() -> None:
    rng = np.random.default_rng(36)
    for _ in range(100):
        peer = drawn_scanner(rng)
        peer.adjusting = False
        found = ScipParameters.of(parse_fields(peer.answer(b"PP"), b"PP\n"))
        stated = (peer.nearest_mm, peer.farthest_mm, peer.steps_in_turn, peer.first_step, peer.last_step)
        assert (found.least_mm, found.most_mm, found.steps_a_turn, found.first_step, found.last_step) == stated
        assert (found.front_step, found.turns_a_minute) == (peer.front_step, peer.rpm)


def test_the_simulated_scanner_answers_as_the_document_says() -> None:
    twin = ScipTwin(wall, seed=1)
    now = 0.0
    for sent in (
        b"QT", b"VV", b"PP", b"II", b"TM0", b"TM1", b"TM2", b"TM2", b"BM", b"BM", b"GE0000010001", b"QT",
        b"GD0000010001", b"ME0000010001003", b"MD0100000100003", b"GD0000999901", b"ZZ",
    ):  # fmt: skip
        twin.feed(sent + b"\n", now)
        stream = b""
        for _ in range(40):
            now += 0.01
            stream += twin.due(now)
        replies, rest = scip_peer.split(stream)
        assert not rest
        assert replies, sent
        read = [scip_peer.read(reply) for reply in replies]
        assert all(one.echo[:2] == sent[:2] for one in read)
        if sent[:2] == b"ME":
            assert [one.status for one in read] == [b"00", b"99", b"99", b"99"]
            assert [one.echo[13:15] for one in read] == [b"03", b"02", b"01", b"00"]
            assert all(len(one.values) == 2 * 101 for one in read[1:])


# -- the pan/tilt unit -----------------------------------------------------------------------------------------------

QUERIES = [f"{axis}{what}" for axis in "PT" for what in "PSRNXUL"]


def drawn_unit(rng: np.random.Generator) -> PeerUnit:
    def each(low: int, high: int) -> dict[str, int]:
        return {axis: int(rng.integers(low, high)) for axis in "PT"}

    unit = PeerUnit(
        position=each(-3000, 3000), speed=each(60, 2900), least=each(-9000, -3000), most=each(3000, 9000),
        echo=bool(rng.random() < 0.5), terse=bool(rng.random() < 0.5), limits=bool(rng.random() < 0.8),
        resolution={axis: f"{rng.uniform(5, 200):.6f}" for axis in "PT"},
    )  # fmt: skip
    unit.target = dict(unit.position)
    return unit


def exchanges(rng: np.random.Generator, count: int) -> Iterator[tuple[bytes, bytes, bool]]:
    """Yield commands, what the unit of the document answers to them, and whether that has an echo."""
    unit = drawn_unit(rng)
    for number in range(count):
        if number % 50 == 0:
            unit = drawn_unit(rng)
        kind = rng.integers(4)
        if kind < 2:
            sent = command(QUERIES[int(rng.integers(len(QUERIES)))])
        elif kind == 2:
            sent = command(
                f"{'PT'[int(rng.integers(2))]}{'PS'[int(rng.integers(2))]}", int(rng.integers(-12000, 12000))
            )
        else:
            names = ("A", "H", "I", "CI", "L", "V", "LE", "FT", "FV", "ED", "EE")
            sent = command(names[int(rng.integers(len(names)))])
        echo = unit.echo
        unasked = b"!P" if rng.random() < 0.05 else b""
        yield sent, unasked + unit.answer(sent), echo


@parts
def test_answers_of_a_unit_are_read_alike(part: int) -> None:
    rng = np.random.default_rng([37, part])
    compared = 0
    for sent, answer, echo in exchanges(rng, EXCHANGES):
        line = answer.rstrip(b"\r")
        if echo:  # as the document has it, the echo precedes the answer
            line = line.replace(sent, b"", 1)
        theirs = ptu_peer.read(line)
        assert theirs is not None, answer
        assert flir_protocol.reply_length(answer, sent) == len(answer), (sent, answer)
        if not theirs.done:
            with pytest.raises(FlirError, match=re.escape(theirs.text[:60])):
                parse_reply(answer, sent)
            continue
        reply = parse_reply(answer, sent)
        assert reply.text == theirs.text, (sent, answer)
        assert reply.limits_hit == tuple({"P": "pan", "T": "tilt"}[axis] for axis in theirs.hits)
        if sent.decode().strip() in QUERIES:
            assert theirs.number is None or reply.number(sent) == theirs.number
        bad = damaged(answer, rng)
        with contextlib.suppress(FlirError):
            found = parse_reply(bad, sent)
            again = ptu_peer.read(bad.replace(sent, b"", 1).strip(b"\r"))
            if again is not None and again.done and "\r" not in again.text:
                assert found.text == again.text, (sent, bad)
                compared += 1
    assert compared > EXCHANGES // 20, "damaged answers that both read"


def test_the_simulated_unit_answers_as_the_document_says() -> None:
    twin, peer = FlirTwin(baud=115_200), PeerUnit()
    now = 0.0
    for name, value in (
        ("FT", None), ("ED", None), ("CI", None), ("I", None), ("PP", None), ("TP", None), ("PP", 300), ("A", None),
        ("PP", None), ("TP", -200), ("A", None), ("TP", None), ("PS", None), ("H", None), ("PP", 99_999), ("LE", None),
    ):  # fmt: skip
        sent = command(name, value)
        twin.feed(sent, now)
        stream = b""
        while not stream.endswith(b"\n"):
            now += 0.01
            stream += twin.due(now)
        echo = name in ("FT", "ED")
        assert stream.startswith(sent.rstrip()) == echo
        found = ptu_peer.read(stream.replace(sent, b"", 1).strip() if echo else stream.strip())
        theirs = ptu_peer.read(peer.answer(sent).replace(sent, b"", 1).strip())
        assert found is not None
        assert theirs is not None
        assert found.done == theirs.done, (sent, stream)
        if name in ("PP", "TP"):
            assert found.number == theirs.number, (sent, stream)
