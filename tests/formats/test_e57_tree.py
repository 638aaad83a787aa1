"""The XML of an E57 comes from strangers: what could make a program open something else is refused."""

from __future__ import annotations

import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from ladarreg_core.errors import FormatError
from ladarreg_core.formats import describe, read_scan
from ladarreg_core.formats.e57.tree import open_e57
from ladarreg_core.formats.e57_images import embedded_images
from ladarreg_core.scan import Scan
from testing.attacks.bombs import e57_with_xml

ROOT = b'<e57Root type="Structure"'
SCHEMA = b"http://www.w3.org/2001/XMLSchema-instance"
ATTACKS = {
    "external document type": (
        lambda xml: xml.replace(ROOT, b'<!DOCTYPE e57Root SYSTEM "http://127.0.0.1:9/a.dtd">\n' + ROOT),
        "declares a document type",
    ),
    "entity of a local file": (
        lambda xml: xml.replace(ROOT, b'<!DOCTYPE e57Root [<!ENTITY a SYSTEM "file:///etc/passwd">]>\n' + ROOT),
        "declares a document type",
    ),
    "undeclared entity": (lambda xml: xml.replace(b"<data3D", b"<note>&a;</note><data3D"), "uses an entity"),
    "processing instruction": (
        lambda xml: xml.replace(ROOT, b'<?xml-stylesheet href="http://127.0.0.1:9/a.xsl"?>' + ROOT),
        "processing instruction .xml-stylesheet.",
    ),
    "schema": (
        lambda xml: xml.replace(
            ROOT, ROOT + b' xmlns:xsi="' + SCHEMA + b'" xsi:schemaLocation="http://127.0.0.1:9/ http://127.0.0.1:9/a"'
        ),
        "refers to a schema .xsi:schemaLocation.",
    ),
    "schema by another prefix": (
        lambda xml: xml.replace(
            b"<data3D", b'<data3D xmlns:q="' + SCHEMA + b'" q:noNamespaceSchemaLocation="/etc/passwd"', 1
        ),
        "refers to a schema .q:noNamespaceSchemaLocation.",
    ),
    "another encoding": (lambda xml: xml.replace(b"<data3D", b"<note>\xe9</note><data3D"), "XML is damaged"),
}  # fmt: skip


@pytest.mark.parametrize("attack", ATTACKS)
def test_what_opens_other_files_is_refused_in_one_sentence(attack: str, tmp_path: Path, make: Any, wall: Scan) -> None:
    change, said = ATTACKS[attack]
    path = make.e57(tmp_path / "a.e57", make.e57_fields(wall))

    def changed(xml: bytes) -> bytes:
        assert change(xml) != xml
        return change(xml)

    e57_with_xml(path, changed)
    for read in (read_scan, describe, embedded_images):
        with pytest.raises(FormatError, match=said) as caught:
            read(path)  # type: ignore[operator]
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("shift", [1020, 1021, 1022, 1023])
def test_an_offset_inside_a_checksum_is_refused(shift: int, tmp_path: Path, make: Any, wall: Scan) -> None:
    path = make.e57(tmp_path / "a.e57", make.e57_fields(wall))
    data = bytearray(path.read_bytes())
    (xml_at,) = struct.unpack_from("<Q", data, 24)
    struct.pack_into("<Q", data, 24, xml_at // 1024 * 1024 + shift)
    path.write_bytes(data)
    with pytest.raises(FormatError, match=r"puts its XML at byte .*, inside the checksum of a page; it is malicious"):
        describe(path)


@pytest.mark.parametrize("last", [1016, 1018, 1019, 0, 1])
def test_the_xml_may_begin_anywhere_in_a_page(last: int, tmp_path: Path, make: Any, wall: Scan) -> None:
    """Logical and physical offsets differ by four bytes for each page before."""
    path = make.e57(tmp_path / "a.e57", make.e57_fields(wall))
    with open_e57(path) as file:
        content = file.pages.read(0, file.pages.logical_bytes, "all").tobytes()
    xml_at, xml_length = struct.unpack_from("<QQ", content, 24)
    start = xml_at // 1024 * 1020 + xml_at % 1024
    xml = content[start : start + xml_length]
    moved = start + (last - start) % 1020
    content = content[:start].ljust(moved, b"\0") + xml
    content = content[:24] + struct.pack("<Q", moved // 1020 * 1024 + moved % 1020) + content[32:]
    content += bytes(-len(content) % 1020)
    content = content[:16] + struct.pack("<Q", len(content) // 1020 * 1024) + content[24:]
    path.write_bytes(b"".join(content[k : k + 1020] + bytes(4) for k in range(0, len(content), 1020)))
    e57_with_xml(path, lambda same: same)  # with the right checksums
    assert read_scan(path).shape == wall.shape


def test_damage_in_the_xml_shows_in_its_checksum(tmp_path: Path, make: Any, wall: Scan) -> None:
    path = make.e57(tmp_path / "a.e57", make.e57_fields(wall))
    data = path.read_bytes()
    path.write_bytes(data.replace(b"<guid", b"<gujd", 1))
    with pytest.raises(FormatError, match="checksum of the page at byte"), open_e57(path):
        pass


def test_libe57_reads_nothing(tmp_path: Path, make: Any, wall: Scan) -> None:
    path = make.e57(tmp_path / "a.e57", make.e57_fields(wall))
    code = "import sys; from ladarreg_core.formats import describe, read_scan; read_scan(sys.argv[1]); "
    code += "describe(sys.argv[1]); assert not any(name.startswith('pye57') for name in sys.modules)"
    subprocess.run([sys.executable, "-c", code, str(path)], check=True)
