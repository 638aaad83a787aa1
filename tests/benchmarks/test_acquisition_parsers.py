"""A short run of the benchmark of the devices' parsers, and its judge by what real devices send."""

from __future__ import annotations

import pytest

from benchmarks.acquisition import oracle as oracle
from benchmarks.acquisition.parsers import CLASSES, measure, trusting


@pytest.mark.slow
def test_the_parsers_agree_with_the_judge_on_damaged_replies() -> None:
    found = measure(3_000)
    assert len(found) == 2 * len(CLASSES)
    for name, count in found.items():
        assert not count.faults, (name, count.faults[:3])
        assert count.replies > 100
        assert count.refused + count.as_sent + count.other == count.replies
    for device in ("scanner", "unit"):
        assert found[f"{device}, whole"].as_sent == found[f"{device}, whole"].replies
    assert sum(count.refused for count in found.values()) > 1_000
    assert found == measure(3_000), "seeded"


def test_a_parser_that_trusts_what_comes_is_found_out() -> None:
    assert sum(len(count.faults) for count in measure(600, parse=trusting).values()) > 300


def test_the_judge_reads_what_real_scanners_send() -> None:
    fields = b"PP\n00P\nMODL:URG-04LX(Hokuyo Automatic Co.,Ltd.);N\nDMIN:20;4\nDMAX:5600;_\n\n"
    assert oracle.scip_fields(fields, b"PP\n") == {
        "MODL": "URG-04LX(Hokuyo Automatic Co.,Ltd.)", "DMIN": "20", "DMAX": "5600",
    }  # fmt: skip
    assert oracle.scip_fields(fields.replace(b"5600", b"5601"), b"PP\n") is None
    line = b"GD0000000001\n00P\nm2@0?\n1Dh0CBg\n\n"
    sums = b"".join(part + bytes([sum(part) % 64 + 48]) + b"\n" for part in (b"m2@0", b"1Dh0CB"))
    whole = line[:17] + sums + b"\n"
    read = oracle.scip_line(whole, b"GD0000000101\n", several=False, intensity=False)
    assert read is None, "another request"
    read = oracle.scip_line(b"GD0000000101" + whole[12:], b"GD0000000101\n", several=False, intensity=False)
    assert read == oracle.Line(16_000_000, ((5432,), (1234,)), 0)


@pytest.mark.parametrize(
    ("received", "counts"),
    [
        (b"PP * Current Pan position is 250\r\n", 250),
        (b"!T\r\n* -1700\r\n", -1700),
        (b"*\r\n* 12\r\n", 12),
        (b"* 185.1428 seconds arc per Pan position\r\n", None),
        (b"! Illegal command\r\n", None),
        (b"* 25", None),
    ],
)
def test_the_judge_reads_what_real_units_send(received: bytes, counts: int | None) -> None:
    assert oracle.flir_value(received, b"PP ") == counts
