"""The protocol of the pan/tilt unit, by laws and by what units are known to send."""

from __future__ import annotations

import contextlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ladarreg_core.acquisition.devices.flir_protocol import FlirError, command, limits_hit, parse_reply, reply_length
from ladarreg_core.errors import DeviceError, OptionError

KNOWN = [
    (b"PP ", b"* -1700\r\n", -1700, ()),
    (b"PP ", b"PP * Current Pan position is 250\r\n", 250, ()),  # verbose, with the echo
    (b"PR ", b"* 185.1428\r\n", 185.1428, ()),
    (b"PR ", b"* 185.1428 seconds arc per position\r\n", 185.1428, ()),
    (b"TP ", b"!T\r\n* 12\r\n", 12, ("tilt",)),
    (b"TP ", b"!P!T* 12\r\n", 12, ("pan", "tilt")),
    (b"TP ", b"*\r\n* 12\r\n", 12, ()),  # the star of a halt stands before it
    (b"TP ", b"H *\r\nTP * 12\r\n", 12, ()),  # with its echo
    (b"PX ", b"PX * Maximum Pan position is 3090\r\n", 3090, ()),
    (b"TN ", b"* -907\r\n", -907, ()),
    (b"TP ", b"!P * 12\r\n", 12, ("pan",)),
    (b"TP ", b"  *  12 \r\n", 12, ()),
]


@pytest.mark.parametrize(("sent", "received", "value", "hit"), KNOWN)
def test_what_units_send(sent: bytes, received: bytes, value: float, hit: tuple[str, ...]) -> None:
    assert reply_length(received + b"* 3\r\n", sent) == len(received)
    reply = parse_reply(received, sent)
    assert reply.number(sent) == value
    assert reply.limits_hit == hit
    for cut in range(len(received) - 1):
        assert reply_length(received[:cut], sent) in (0, cut), "an answer is complete at its line's end"


@pytest.mark.parametrize(
    "damaged",
    [b"* 12a", b"* 1 2", b"* 1-2", b"* 0x12", b"* 1e3", b"* 12*", b"* --12", b"* 1.2.3", b"* 12 !", b"*\x1f12",
     b"* 12\x00", b"* 1\xb22", b"* Current Pan pos1tion is 12", b"* ,", b"12", b"+ 12",
     b"* 123456789012", b"PP * 12", b"*** 12"],
)  # fmt: skip
def test_what_is_no_number_is_refused(damaged: bytes) -> None:
    """Answers have no checksum, so their form is all that tells."""
    assert parse_reply(b"* 12\r\n", b"TP ").counts(b"TP ") == 12
    with pytest.raises(FlirError):
        parse_reply(damaged + b"\r\n", b"TP ").counts(b"TP ")


def test_what_is_no_text_is_refused() -> None:
    """As at a wrong baud rate."""
    assert parse_reply(b"* PTU v2.13\r\n", b"V ").text == "PTU v2.13"
    with pytest.raises(FlirError, match="no text; check the baud rate"):
        parse_reply(b"* PTU\xf8\x80 v2.13\r\n", b"V ")


def test_errors_and_notices() -> None:
    with pytest.raises(FlirError, match='refused "PP9999999 ": Maximum allowable position'):
        parse_reply(b"! Maximum allowable position exceeded\r\n", b"PP9999999 ")
    with pytest.raises(FlirError, match="one number is due"):
        parse_reply(b"* 1 2\r\n", b"PP ").number(b"PP ")
    with pytest.raises(FlirError, match="counts are due"):
        parse_reply(b"* 1.5\r\n", b"PP ").counts(b"PP ")
    assert parse_reply(b"!T!T!P!P*\r\n", b"R ").text == ""
    assert limits_hit(b"!P\r\n!T\r\n") == ("pan", "tilt")
    assert limits_hit(b"! Pan limit\r\n!Position\r\n! T\r\n") == ()
    for name, value in (("pp", 1), ("PP", 1 << 31), ("", None), ("PPPP", None)):
        with pytest.raises(OptionError):
            command(name, value)


@given(st.integers(-(1 << 31) + 1, (1 << 31) - 1), st.sampled_from(["PP", "TP", "PN"]), st.binary(max_size=6))
def test_positions_survive_the_way_there_and_back(counts: int, name: str, noise: bytes) -> None:
    stale = noise.replace(b"*", b"").replace(b"!", b"").replace(b"\r", b"").replace(b"\n", b"")
    assert command(name, counts) == f"{name}{counts} ".encode()
    assert parse_reply(f"* {counts}\r\n".encode(), command(name)).counts(command(name)) == counts
    if stale.strip() and not stale.startswith(b"*"):
        with pytest.raises(DeviceError):
            parse_reply(stale + f"{counts}\r\n".encode(), command(name)).counts(command(name))


@given(st.binary(max_size=600), st.sampled_from([b"PP ", b"PP100 ", b"A ", b"H ", b"V "]))
def test_any_bytes_are_a_reply_or_a_typed_error(received: bytes, sent: bytes) -> None:
    assert 0 <= reply_length(received, sent) <= len(received)
    with contextlib.suppress(FlirError):
        parse_reply(received, sent).counts(sent)
