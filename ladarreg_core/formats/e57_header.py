"""Table of contents of an E57 file, read and validated before any point is decoded.

Only the 48-byte header and the XML at the end are read, so that scans and images are listed quickly, and a file that
claims more than it contains is refused before memory is allocated.
"""

from __future__ import annotations

import math
import struct
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO
from xml.parsers import expat

import numpy as np

from ladarreg_core.errors import FormatError
from ladarreg_core.formats.pcd import pose_of_quaternion
from ladarreg_core.formats.untrusted import one_line
from ladarreg_core.formats.world_pose import LARGEST_COORDINATE_M
from ladarreg_core.frames import Rigid

SIGNATURE = b"ASTM-E57"
_HEADER = struct.Struct("<8sIIQQQQ")
_PAGE = 1024
_PAGE_DATA = 1020  # the last four bytes of a page are its checksum
_LARGEST_XML = 32 << 20
_DEEPEST = 64
_MOST_ELEMENTS = 500_000
_MOST_CHILDREN = 4_000  # the native reader compares the names of all of them
_UNIT_TOLERANCE = 1e-3
_LEAST_LENGTH = 1e-9
_LEAST_BITS = 8  # smallest point record


@dataclass(frozen=True, slots=True)
class E57Field:
    """One field of the point records."""

    name: str
    bits: float
    """Bits of one value; 0 for a constant."""
    stored: str = ""
    """`single`, `double`, `integer` or `scaled`; empty for other types."""


@dataclass(frozen=True, slots=True)
class E57ScanInfo:
    """One scan of the file."""

    name: str
    guid: str
    points: int
    fields: tuple[E57Field, ...]
    grid: tuple[int, int] | None
    """(rows, columns) from the index bounds; None without them."""
    first_cell: tuple[int, int]
    """Smallest row and column index by the index bounds."""
    world_from_scanner: Rigid | None
    color_largest: float
    """Largest value of a colour channel; 255 where the file gives none."""
    pose_problem: str = ""
    """A sentence on a pose that is not a rigid transformation; empty: it is one, or there is none."""

    @property
    def field_names(self) -> frozenset[str]:
        """Names of the fields."""
        return frozenset(field.name for field in self.fields)


@dataclass(frozen=True, slots=True)
class E57ImageInfo:
    """One embedded image."""

    name: str
    kind: str
    """`visual reference`, `pinhole`, `spherical` or `cylindrical`."""
    format: str
    """`jpeg` or `png`."""
    width: int
    height: int
    bytes: int
    blob_path: tuple[str | int, ...]
    """Path of its data in the file's tree."""
    numbers: dict[str, float]
    """Numeric elements of its representation and distortion block, by name."""
    world_from_image: Rigid | None
    """Pose; E57 cameras look along -Z with Y up."""
    associated_guid: str
    """GUID of the scan that it was taken with."""


@dataclass(frozen=True, slots=True)
class E57Info:
    """Scans and images of a file."""

    scans: tuple[E57ScanInfo, ...]
    images: tuple[E57ImageInfo, ...]


def sniff_e57(head: bytes) -> bool:
    """Return whether these are the first bytes of an E57 file."""
    return head.startswith(SIGNATURE)


def read_e57_info(path: Path) -> E57Info:
    """Read the table of contents.

    Args:
        path: an existing file.

    Raises:
        FormatError: if it is truncated, damaged, or claims more than it can contain.
    """
    size = path.stat().st_size
    with open(path, "rb") as stream:
        xml = _read_xml(stream, size)
    _check_xml(xml)
    try:
        root = ElementTree.fromstring(xml)
    except ElementTree.ParseError as error:
        raise FormatError(f"the E57's XML is damaged ({one_line(error, 80)})") from error
    scans = tuple(_scan(node, k, size) for k, node in enumerate(_children(_child(root, "data3D"))))
    images = tuple(_images(root, size))
    return E57Info(scans, images)


def _read_xml(stream: BinaryIO, size: int) -> bytes:
    head = stream.read(_HEADER.size)
    if len(head) < _HEADER.size or not head.startswith(SIGNATURE):
        raise FormatError("it is not an E57 file; an E57 begins with 'ASTM-E57' and a header of 48 bytes")
    _, major, _, length, xml_at, xml_length, page = _HEADER.unpack(head)
    if major != 1 or page != _PAGE:
        raise FormatError(f"it is E57 version {major} with pages of {page} bytes; version 1 with {_PAGE} is read")
    if length != size:
        state = "truncated" if length > size else "damaged"
        raise FormatError(f"its header says {length:,} bytes, the file has {size:,}; it is {state}: copy it again")
    if xml_length > min(_LARGEST_XML, size) or xml_at < _HEADER.size or xml_at >= size:
        raise FormatError(f"its header puts {xml_length:,} bytes of XML at {xml_at:,} of {size:,}; it is damaged")
    first = xml_at // _PAGE
    stream.seek(first * _PAGE)
    pages = (xml_length + xml_at % _PAGE) // _PAGE_DATA + 2
    raw = stream.read(pages * _PAGE)
    raw = raw[: len(raw) // _PAGE * _PAGE]
    data = np.frombuffer(raw, np.uint8).reshape(-1, _PAGE)[:, :_PAGE_DATA].tobytes()
    start = xml_at % _PAGE
    xml = data[start : start + xml_length]
    if len(xml) != xml_length:
        raise FormatError(f"its XML of {xml_length:,} bytes ends with the file; it is damaged")
    return xml.rstrip(b"\0")


def _check_xml(xml: bytes) -> None:
    """Refuse entities, deep nesting and excessive numbers of elements, which exhaust the memory of XML parsers."""
    parser = expat.ParserCreate()
    count = 0
    children = [0]  # so far, of each element that is open

    def start(name: str, attributes: dict[str, str]) -> None:
        nonlocal count
        count += 1 + len(attributes)
        children[-1] += 1
        depth = len(children)
        if depth > _DEEPEST or count > _MOST_ELEMENTS:
            raise FormatError(
                f"the E57's XML is nested {depth} deep with {count:,} elements; it is malicious or damaged"
            )
        if children[-1] > _MOST_CHILDREN:
            raise FormatError(
                f"an element of the E57's XML contains more than {_MOST_CHILDREN:,} others; it is malicious or damaged"
            )
        children.append(0)

    def end(name: str) -> None:
        children.pop()

    def doctype(*_: object) -> None:
        raise FormatError(
            "the E57's XML declares a document type, which E57 does not allow; it is malicious or damaged"
        )

    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.StartDoctypeDeclHandler = doctype
    try:
        parser.Parse(xml, True)
    except expat.ExpatError as error:
        raise FormatError(f"the E57's XML is damaged ({one_line(error, 80)})") from error


_Node = ElementTree.Element


def _local(node: _Node) -> str:
    return node.tag.rpartition("}")[2]


def _children(node: _Node | None) -> list[_Node]:
    return [] if node is None else list(node)


def _child(node: _Node | None, *names: str) -> _Node | None:
    for name in names:
        node = next((child for child in _children(node) if _local(child) == name), None)
    return node


def _text(node: _Node | None) -> str:
    return (node.text or "").strip() if node is not None else ""


def _number(node: _Node | None, default: float = 0.0) -> float:
    """Return a number element's value, scaled; an empty element means 0."""
    if node is None:
        return default
    try:
        value = float(_text(node) or 0)
        if node.get("type") == "ScaledInteger":
            value = value * float(node.get("scale", 1)) + float(node.get("offset", 0))
    except ValueError:
        raise FormatError(f"the E57's {_local(node)} is {one_line(_text(node), 30)!r}; it must be a number") from None
    return value


def _whole(text: str | None, what: str, default: int = 0) -> int:
    if text is None or text == "":
        return default
    digits = text.removeprefix("-")
    if not (digits.isascii() and digits.isdigit() and len(digits) <= 19):
        raise FormatError(f"the E57's {what} is {one_line(text, 30)!r}; it must be a whole number")
    return int(text)


def _scan(node: _Node, index: int, file_bytes: int) -> E57ScanInfo:
    points = _child(node, "points")
    if points is None:
        raise FormatError(f"scan {index} of the E57 has no points; it is damaged")
    count = _whole(points.get("recordCount"), "recordCount")
    fields = tuple(_field(child) for child in _children(_child(points, "prototype")))
    bits = sum(field.bits for field in fields)
    # Constant fields take no bits, but points without any other field are not a scan.
    if count < 0 or count * max(bits, _LEAST_BITS) / 8 > file_bytes + 1024:
        raise FormatError(
            f"scan {index} claims {count:,} points of {bits:.0f} bits, but the whole file has {file_bytes:,} bytes; it "
            "is damaged or malicious"
        )
    bounds = _child(node, "indexBounds")
    grid, first_cell = None, (0, 0)
    if bounds is not None and {"rowIndex", "columnIndex"} <= {field.name for field in fields}:
        sides = [
            _number(_child(bounds, f"{axis}Maximum")) - _number(_child(bounds, f"{axis}Minimum")) + 1
            for axis in ("row", "column")
        ]
        if all(1 < side < 2**31 for side in sides):
            grid = int(sides[0]), int(sides[1])
            first = [_number(_child(bounds, f"{axis}Minimum")) for axis in ("row", "column")]
            first_cell = int(first[0]), int(first[1])
    return E57ScanInfo(
        one_line(_text(_child(node, "name")) or f"scan {index}", 60),
        _text(_child(node, "guid")),
        count,
        fields,
        grid,
        first_cell,
        _scan_pose(_child(node, "pose")),
        _number(_child(node, "colorLimits", "colorRedMaximum"), 255.0),
        _pose_problem(_child(node, "pose")),
    )


def _field(node: _Node) -> E57Field:
    kind = node.get("type", "")
    if kind == "Float":
        single = node.get("precision") == "single"
        return E57Field(_local(node), 32 if single else 64, "single" if single else "double")
    if kind in ("Integer", "ScaledInteger"):
        low = _whole(node.get("minimum"), "minimum", -(2**63))
        high = _whole(node.get("maximum"), "maximum", 2**63 - 1)
        stored = "integer" if kind == "Integer" else "scaled"
        return E57Field(_local(node), max(high - low, 0).bit_length(), stored)
    return E57Field(_local(node), 8)


def _pose(node: _Node | None) -> Rigid | None:
    if node is None or _beyond_repair(*_rotation_and_translation(node)):
        return None
    return pose_of_quaternion(*_rotation_and_translation(node))


def _scan_pose(node: _Node | None) -> Rigid | None:
    """Return the pose that the file states for a scan; the identity, too: the first scan of a survey often has it."""
    if node is None or _beyond_repair(*_rotation_and_translation(node)):
        return None
    return _pose(node) or Rigid.identity()


def _pose_problem(node: _Node | None) -> str:
    if node is None:
        return ""
    quaternion, translation = _rotation_and_translation(node)
    length = math.hypot(*quaternion)
    if _beyond_repair(quaternion, translation):
        return (
            "the scan's pose in the file is not a rotation and a translation in metres (quaternion "
            f"{', '.join(f'{q:g}' for q in quaternion)}; translation {', '.join(f'{t:g}' for t in translation)}): it "
            "is ignored, and where the scanner stands in the world is not known"
        )
    if abs(length - 1) > _UNIT_TOLERANCE:
        return f"the quaternion of the scan's pose has the length {length:.4g} instead of 1 and was normalised"
    return ""


def _rotation_and_translation(node: _Node) -> tuple[list[float], list[float]]:
    quaternion = [_number(_child(node, "rotation", axis), float(axis == "w")) for axis in "wxyz"]
    return quaternion, [_number(_child(node, "translation", axis)) for axis in "xyz"]


def _beyond_repair(quaternion: list[float], translation: list[float]) -> bool:
    length = math.hypot(*quaternion)
    largest = max(map(abs, translation))
    return not (_LEAST_LENGTH < length < math.inf and largest <= LARGEST_COORDINATE_M)


def _images(root: _Node, file_bytes: int) -> Iterator[E57ImageInfo]:
    together = 0
    for index, node in enumerate(_children(_child(root, "images2D"))):
        for kind in ("pinhole", "spherical", "cylindrical", "visualReference"):
            shape = _child(node, f"{kind}Representation")
            if shape is None:
                continue
            for encoding in ("jpeg", "png"):
                blob = _child(shape, f"{encoding}Image")
                if blob is None:
                    continue
                length = _whole(blob.get("length"), "picture length")
                together += length
                if length <= 0 or together > file_bytes:
                    raise FormatError(
                        f"the first {index + 1} images claim {together:,} bytes in a file of {file_bytes:,}; it is "
                        "damaged"
                    )
                numbers = {_local(child): _number(child) for child in _children(shape) if _is_number(child)}
                distortion = _child(node, "distortion")
                numbers |= {_local(child): _number(child) for child in _children(distortion) if _is_number(child)}
                yield E57ImageInfo(
                    one_line(_text(_child(node, "name")) or f"image {index}", 60),
                    "visual reference" if kind == "visualReference" else kind,
                    encoding,
                    _whole(_text(_child(shape, "imageWidth")), "imageWidth"),
                    _whole(_text(_child(shape, "imageHeight")), "imageHeight"),
                    length,
                    ("images2D", index, f"{kind}Representation", f"{encoding}Image"),
                    numbers,
                    _pose(_child(node, "pose")),
                    _text(_child(node, "associatedData3DGuid")),
                )


def _is_number(node: _Node) -> bool:
    return node.get("type") in ("Float", "Integer", "ScaledInteger")
