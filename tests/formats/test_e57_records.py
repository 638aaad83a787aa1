"""Records and blobs of E57 files, decoded by our reader: bit-equal to those of libe57, which is the peer here."""

from __future__ import annotations

import re
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ladarreg_core.errors import FormatError
from ladarreg_core.formats.e57 import records as e57_records
from ladarreg_core.formats.e57.header import contents_of
from ladarreg_core.formats.e57.records import fields_of, read_records, unpacked
from ladarreg_core.formats.e57.tree import E57Node, open_e57
from ladarreg_core.scan import Scan
from testing.attacks.bombs import e57_with_xml
from testing.files.small_scans import make_scan

pye57 = pytest.importorskip("pye57")
libe57 = pye57.libe57

from tests.unit.export import e57_samples  # noqa: E402  needs pye57

CODES = {"integer": "q", "scaled": "q", "single": "f", "double": "d"}
LOWEST, HIGHEST = -(2**63), 2**63 - 1


def of_libe57(path: Path, index: int, codes: dict[str, str], *, scaled: bool) -> dict[str, np.ndarray]:
    """The values of a scan's fields as libe57 reads them."""
    file = libe57.ImageFile(str(path), "r")
    node = file.root()["data3D"][index]["points"]
    count = node.childCount()
    values = {name: np.zeros(max(1, count), code) for name, code in codes.items()}
    if count:
        buffers = libe57.VectorSourceDestBuffer()
        for name, array in values.items():
            buffers.append(libe57.SourceDestBuffer(file, name, array, count, True, scaled))
        reader = node.reader(buffers)
        assert reader.read() == count
        reader.close()
    file.close()
    return {name: array[:count] for name, array in values.items()}


def of_ours(
    path: Path, index: int, codes: dict[str, str], *, scaled: bool, at_once: int = 1000
) -> dict[str, np.ndarray]:
    """The values of a scan's fields as our reader gives them."""
    buffers = {name: np.zeros(at_once, code) for name, code in codes.items()}
    parts: dict[str, list[np.ndarray]] = {name: [np.zeros(0, code)] for name, code in codes.items()}
    with open_e57(path) as file:
        points = points_of(file.scan(index))
        for count in read_records(file.pages, points, buffers, "the scan", scaled=scaled):
            for name, buffer in buffers.items():
                parts[name].append(buffer[:count].copy())
    return {name: np.concatenate(some) for name, some in parts.items()}


def points_of(scan: E57Node) -> E57Node:
    points = scan.child("points")
    assert points is not None
    return points


def assert_equal_bits(path: Path, *, at_once: int = 1000) -> int:
    """Compare all fields of all scans of a file, raw and scaled; return the number of values."""
    compared = 0
    with open_e57(path) as file:
        scans = [fields_of(points_of(file.scan(k))) for k in range(len(contents_of(file).scans))]
    for index, fields in enumerate(scans):
        raw = {field.name: CODES[field.stored] for field in fields}
        real = {name: "d" if code == "q" else code for name, code in raw.items()}
        for codes, scaled in ((raw, False), (real, True)):
            found = of_ours(path, index, codes, scaled=scaled, at_once=at_once)
            for name, expected in of_libe57(path, index, codes, scaled=scaled).items():
                assert found[name].tobytes() == expected.tobytes(), (path.name, index, name, scaled)
                compared += len(expected)
    return compared


def test_fixtures_of_other_writers_are_equal(real_data: Path) -> None:
    compared = {path.name: assert_equal_bits(path) for path in sorted((real_data / "e57_fixtures").glob("*.e57"))}
    assert min(count for name, count in compared.items() if name != "PinholeImageWithDistortionParameters.e57") > 0


def test_images_of_other_writers_are_equal(real_data: Path) -> None:
    for path in (*(real_data / "e57_fixtures").glob("*.e57"), *(real_data / "pump").glob("*.e57")):
        file = libe57.ImageFile(str(path), "r")
        expected = sorted(pictures_in(file.root()["images2D"]))
        file.close()
        with open_e57(path) as ours:
            found = sorted(ours.blob(image.offset, image.bytes).tobytes() for image in contents_of(ours).images)
        assert found == expected, path.name


def pictures_in(node: Any) -> list[bytes]:
    """The content of all pictures below a node of libe57."""
    if isinstance(node, libe57.BlobNode):
        return [bytes(node.read_buffer())] if node.elementName() in ("jpegImage", "pngImage") else []
    if not isinstance(node, (libe57.StructureNode, libe57.VectorNode)):
        return []
    return [picture for index in range(node.childCount()) for picture in pictures_in(node[index])]


@pytest.mark.parametrize("kind", e57_samples.KINDS)
def test_scans_of_every_kind_are_equal(kind: str, tmp_path: Path) -> None:
    wall = make_scan(40, 60)
    scan = Scan(wall.geometry, wall.ranges, wall.intensity / np.nanmax(wall.intensity))
    e57_samples.KINDS[kind](tmp_path / "a.e57", scan)
    assert assert_equal_bits(tmp_path / "a.e57") > 10_000


@st.composite
def some_fields(draw: st.DrawFn) -> list[tuple[str, int, int]]:
    """Fields by kind and bounds; every width from 0 to 64 bits."""
    fields = [("single", 0, 0)]  # libe57 does not read constants alone
    for _ in range(draw(st.integers(1, 5))):
        kind = draw(st.sampled_from(["integer", "integer", "scaled", "single", "double"]))
        bits = draw(st.integers(0, 64))
        low = draw(st.integers(LOWEST, HIGHEST - (2**bits - 1))) if bits < 64 else LOWEST
        least = low + (2 ** (bits - 1) if bits else 0)  # the smallest maximum that needs so many bits
        fields.append((kind, low, draw(st.integers(least, low + 2**bits - 1))))
    return fields


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(
    fields=some_fields(), count=st.integers(1, 3000), at_once=st.sampled_from([1, 7, 100, 4096]), seed=st.integers(0, 9)
)
def test_records_of_any_widths_are_equal(
    fields: list[tuple[str, int, int]], count: int, at_once: int, seed: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.getbasetemp() / "any.e57"
    count = min(count, 300 * at_once)
    write_fields(path, fields, count, seed)
    assert_equal_bits(path, at_once=at_once)


def write_fields(path: Path, fields: list[tuple[str, int, int]], count: int, seed: int = 0) -> None:
    """Write a file of one scan with random values."""
    generator = np.random.default_rng(seed)
    writer = e57_samples.Writer(path)
    made: dict[str, tuple[Any, np.ndarray]] = {}
    for number, (kind, low, high) in enumerate(fields):
        if kind in ("single", "double"):
            values = generator.normal(0, 1e3, count).astype("f4" if kind == "single" else "f8")
            made[f"field{number}"] = writer.real(single=kind == "single"), values
        else:
            node = writer.integer(low, high) if kind == "integer" else writer.scaled(low, high, 0.001, -7.25)
            made[f"field{number}"] = node, generator.integers(low, high, count, endpoint=True).astype("q")
    writer.scan(made, guid="{a}", name="any")
    writer.close()


def test_many_packets_and_strips_are_equal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(e57_records, "_STRIP_BYTES", 70_000)
    fields = [("integer", -5, 2**19), ("double", 0, 0), ("scaled", 0, 6), ("integer", -3, -3), ("integer", 0, 1)]
    write_fields(tmp_path / "a.e57", fields, 40_000)
    assert_equal_bits(tmp_path / "a.e57", at_once=9_999)


@pytest.mark.parametrize("bits", [1, 3, 7, 12, 25, 26, 33, 57, 58, 63, 64])
def test_packed_whole_numbers_begin_at_any_bit(bits: int) -> None:
    values = [int.from_bytes(np.random.default_rng(k).bytes(8), "little") >> (64 - bits) for k in range(21)]
    for first in range(8):
        packed = sum(value << (first + k * bits) for k, value in enumerate(values))
        data = packed.to_bytes((first + 21 * bits + 7) // 8, "little")
        assert unpacked(memoryview(data), first, bits, 21).tolist() == values


def test_values_are_converted_as_asked_for(tmp_path: Path) -> None:
    write_fields(tmp_path / "a.e57", [("integer", -3, 90), ("scaled", -4000, 4000), ("double", 0, 0)], 500)
    codes = {"field0": "f", "field1": "q", "field2": "q"}
    found = of_ours(tmp_path / "a.e57", 0, codes, scaled=True)
    for name, expected in of_libe57(tmp_path / "a.e57", 0, codes, scaled=True).items():
        np.testing.assert_array_equal(found[name], expected)


def damaged_section(path: Path, change: Any) -> Path:
    """A file whose binary section was changed below the checksums, from the section's first byte on."""
    with open_e57(path) as file:
        at = file.pages.logical(points_of(file.scan(0)).whole("fileOffset"), "")
        content = bytearray(file.pages.read(0, file.pages.logical_bytes, "").tobytes())
    change(memoryview(content)[at:])
    pages = [bytes(content[k : k + 1020]) for k in range(0, len(content), 1020)]
    path.write_bytes(b"".join(page + bytes(4) for page in pages))
    e57_with_xml(path, lambda xml: xml)  # with the right checksums
    return path


@pytest.mark.parametrize(
    ("at", "code", "value", "said"),
    [
        (0, "<B", 3, "not where the XML"),
        (16, "<Q", 1 << 60, "puts the scan at byte"),
        (16, "<Q", 1021, "inside the checksum"),
        (32, "<B", 9, "invalid packet"),
        (34, "<H", 6, "invalid packet"),
        (36, "<H", 60_000, "invalid packet"),
        (36, "<H", 0, "invalid packet"),
        (38, "<H", 65_535, "invalid packet"),
        (8, "<Q", 40, "invalid packet"),
        (8, "<Q", 32, "ends after 0 of 300 points; it is truncated"),
    ],
)
def test_damaged_sections_are_refused(at: int, code: str, value: int, said: str, tmp_path: Path) -> None:
    write_fields(tmp_path / "a.e57", [("integer", 0, 4000), ("double", 0, 0)], 300)
    damaged_section(tmp_path / "a.e57", lambda section: struct.pack_into(code, section, at, value))
    with pytest.raises(FormatError, match=said):
        of_ours(tmp_path / "a.e57", 0, {"field0": "q", "field1": "d"}, scaled=False)


def test_fewer_records_than_claimed_and_fields_far_apart_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.e57"
    write_fields(path, [("single", 0, 0), ("double", 0, 0)], 30_000)
    codes = {"field0": "f", "field1": "d"}
    monkeypatch.setattr(e57_records, "_MAX_AHEAD_BYTES", -20_000)
    with pytest.raises(FormatError, match="too far apart"):
        of_ours(path, 0, codes, scaled=False, at_once=2_000)
    monkeypatch.undo()
    e57_with_xml(path, lambda xml: xml.replace(b'recordCount="30000"', b'recordCount="30001"'))
    with pytest.raises(FormatError, match="ends after 30,000 of 30,001 points; it is truncated"):
        of_ours(path, 0, codes, scaled=False)
    e57_with_xml(path, lambda xml: re.sub(rb'maximum="\d+"', b"", xml).replace(b'"Float"', b'"String"'))
    with pytest.raises(FormatError, match="not a number"):
        of_ours(path, 0, codes, scaled=False)
