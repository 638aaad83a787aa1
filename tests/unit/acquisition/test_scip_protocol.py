"""The line scanner's protocol by laws: numbers, checksums, statuses, fields, lines."""

from __future__ import annotations

import contextlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ladarreg_core.acquisition.devices.scip_protocol import (
    LineRequest,
    ScipError,
    ScipNotReadyError,
    ScipParameters,
    checksum,
    decoded,
    encoded,
    parse_fields,
    parse_line,
    parse_status,
    reply_length,
)
from ladarreg_core.acquisition.simulated.scip_twin import ScipTwin
from ladarreg_core.errors import OptionError
from testing.devices.wall import wall


def test_the_examples_of_the_specification() -> None:
    assert decoded(b"1Dh", 3).tolist() == [5432]
    assert decoded(b"CB", 2).tolist() == [1234]
    assert decoded(b"m2@0", 4).tolist() == [16_000_000]
    assert encoded(5432, 3) == b"1Dh"
    assert chr(checksum(b"00")) == "P"
    assert chr(checksum(b"99")) == "b"


@given(st.integers(2, 4).flatmap(lambda n: st.tuples(st.just(n), st.integers(0, (1 << 6 * n) - 1))))
def test_numbers_survive_the_way_there_and_back(case: tuple[int, int]) -> None:
    characters, value = case
    assert decoded(encoded(value, characters), characters).tolist() == [value]
    with pytest.raises(OptionError):
        encoded(1 << (6 * characters), characters)


@given(st.binary(max_size=400), st.booleans())
def test_any_bytes_are_a_line_or_a_typed_error(received: bytes, single: bool) -> None:
    request = LineRequest(0, 9, single=single)
    assert 0 <= reply_length(received) <= len(received)
    for data in (received, received + b"\n\n", request.sent + received + b"\n\n"):
        for parse in (lambda d: parse_line(d, request), lambda d: parse_fields(d, b"VV\n")):
            with contextlib.suppress(ScipError):
                parse(data)


def one_line(request: LineRequest) -> bytes:
    twin = ScipTwin(wall)
    twin.feed(b"BM\n", 0.5)
    twin.due(0.9)
    twin.feed(request.sent, 1.0)
    return b"".join(twin.due(t) for t in np.arange(1, 1.5, 0.005))


@pytest.mark.slow
def test_every_single_corrupted_byte_is_noticed_unless_nothing_could_tell() -> None:
    """Of all replies in which one byte is changed, none is accepted with other values."""
    request = LineRequest(530, 560)
    whole = one_line(request)
    right = parse_line(whole, request)
    assert right.intensity is not None
    accepted = 0
    for place in range(len(whole)):
        for value in range(256):
            if value == whole[place]:
                continue
            with contextlib.suppress(ScipError):
                found = parse_line(whole[:place] + bytes([value]) + whole[place + 1 :], request)
                assert found.intensity is not None
                accepted += 1
                assert found.time_ms == right.time_ms
                assert (found.distance_mm == right.distance_mm).all()
                assert (found.intensity == right.intensity).all()
    assert accepted == 0
    for cut in range(len(whole)):
        with pytest.raises(ScipError):
            parse_line(whole[:cut], request)


@pytest.mark.parametrize(
    ("sent", "status", "said"),
    [
        (b"GE0000001001\n", b"10", "laser is off"),
        (b"GE0000001001\n", b"01", "a start step that is no number"),
        (b"BM\n", b"01", "its laser does not work"),
        (b"BM\n", b"02", "on already"),
        (b"TM1\n", b"04", "clock is not being compared"),
        (b"QT\n", b"01", "the status 01, which the protocol does not have for this command"),
        (b"ME0000001001001\n", b"07", "a number of lines that is no number"),
        (b"GE0000001001\n", b"07", "does not have for this command"),
        (b"BM\n", b"0E", "does not know the command"),
        (b"BM\n", b"0I", "firmware is being updated"),
        (b"BM\n", b"60", "fault of its hardware"),
        (b"QT\n", b"30", "fault of its own"),
    ],
)
def test_what_a_status_says_depends_on_the_command(sent: bytes, status: bytes, said: str) -> None:
    reply = sent + status + bytes([checksum(status)]) + b"\n\n"
    with pytest.raises(ScipError, match=said) as refused:
        parse_status(reply, sent)
    assert not isinstance(refused.value, ScipNotReadyError)


def test_a_scanner_that_verifies_itself_is_not_broken() -> None:
    for sent, status in ((b"ME0000001001001\n", b"21"), (b"ME0000001001001\n", b"98"), (b"GD0000001001\n", b"98")):
        with pytest.raises(ScipNotReadyError, match="does not measure yet"):
            parse_status(sent + status + bytes([checksum(status)]) + b"\n\n", sent)


def test_lines_are_never_requested_without_end_nor_acknowledged_so() -> None:
    for count in (0, 100, -1):
        with pytest.raises(OptionError, match="1 to 99"):
            LineRequest(0, 10, count=count, single=False)
    request = LineRequest(0, 10, count=7, single=False)
    for echo in (request.sent, request.sent.replace(b"07\n", b"00\n")):
        reply = echo + b"00" + bytes([checksum(b"00")]) + b"\n\n"
        if echo == request.sent:
            assert parse_status(reply, request.sent) == ("00", [])
        else:
            with pytest.raises(ScipError, match="answered"):
                parse_status(reply, request.sent)
    assert all(LineRequest(0, 10, count=n, single=False).sent[-3:-1] == f"{n:02d}".encode() for n in range(1, 100))


def fields_reply(*fields: bytes, sent: bytes = b"PP\n") -> bytes:
    return sent + b"00P\n" + b"".join(each + b";" + bytes([checksum(each)]) + b"\n" for each in fields) + b"\n"


def test_fields() -> None:
    # As real scanners state them, with their own checksums.
    real = b"PP\n00P\nMODL:URG-04LX(Hokuyo Automatic Co.,Ltd.);N\nDMIN:20;4\nDMAX:5600;_\nARES:1024;\\\nAMIN:44;7\n"
    real += b"AMAX:725;o\nAFRT:384;6\nSCAN:600;e\n\n"
    assert ScipParameters.of(parse_fields(real, b"PP\n")) == ScipParameters(20, 5600, 1024, 44, 725, 384, 600)
    assert parse_fields(fields_reply(b"DMIN: 20"), b"PP\n") == {"DMIN": "20"}
    for fields, said in (
        ((b"DMIN:20", b"DMIN:30"), "the field DMIN twice in one answer"),
        ((b"DMIN:2\xb2",), "where a field is due"),
        ((b"DMIN:2\x00",), "where a field is due"),
        ((b"DMI:20",), "where a field is due"),
    ):
        with pytest.raises(ScipError, match=said):
            parse_fields(fields_reply(*fields), b"PP\n")
    with pytest.raises(ScipError, match="checksum"):
        parse_fields(fields_reply(b"DMIN:20").replace(b"20", b"21"), b"PP\n")


GOOD = {"DMIN": "23", "DMAX": "60000", "ARES": "1440", "AMIN": "0", "AMAX": "1080", "AFRT": "540", "SCAN": "2400"}


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"AFRT": "1081"}, "AFRT 1081, AMIN 0, AMAX 1080, which no scanner has"),
        ({"AMIN": "600"}, "AFRT 540, AMIN 600, AMAX 1080"),
        ({"DMAX": "0"}, "DMIN 23, DMAX 0"),
        ({"DMAX": "300000"}, "DMAX 300000"),
        ({"ARES": "1439"}, "ARES 1439"),
        ({"ARES": "0"}, "ARES 0"),
        ({"AMAX": "1440"}, "AMAX 1440, ARES 1440"),
        ({"AMAX": "0", "AFRT": "0"}, "AMIN 0, AMAX 0"),
        ({"SCAN": "0"}, "SCAN 0"),
        ({"SCAN": "24000"}, "SCAN 24000"),
        ({"SCAN": "9" * 5000}, "does not state SCAN in numbers"),
        ({"DMIN": "\u0663"}, "does not state DMIN in numbers"),
        ({"DMIN": "-5"}, "does not state DMIN in numbers"),
    ],
)
def test_absurd_parameters_are_refused_in_a_sentence(changed: dict[str, str], said: str) -> None:
    assert ScipParameters.of(GOOD).most_mm == 60_000
    with pytest.raises(ScipError, match=said):
        ScipParameters.of(GOOD | changed)


def test_what_is_no_distance_is_no_return() -> None:
    """Error codes below the least distance, and what lies beyond the largest one; few send more than 65,535."""
    request, stamp = LineRequest(0, 5, with_intensity=False), encoded(1, 4)
    head = request.sent + b"00P\n" + stamp + bytes([checksum(stamp)]) + b"\n"

    def reply(*values: int) -> bytes:
        data = b"".join(encoded(value, 3) for value in values)
        return head + data + bytes([checksum(data)]) + b"\n\n"

    raw = parse_line(reply(0, 22, 23, 60_000, 60_001, 65_535), request)
    ranges = ScipParameters.of(GOOD).ranges_m(raw.distance_mm)
    np.testing.assert_allclose(ranges, [np.nan, np.nan, 0.023, 60.0, np.nan, np.nan], rtol=1e-6)
    far = reply(0, 22, 23, 60_000, 60_001, 65_536)
    with pytest.raises(ScipError, match="65536 mm"):
        parse_line(far, request)
    assert parse_line(far, request, most_mm=80_000).distance_mm[-1] == 65_536
