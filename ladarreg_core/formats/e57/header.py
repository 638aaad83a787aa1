"""Table of contents of an E57 file, read and validated before any point is decoded.

Only the 48-byte header and the XML at the end are read, so that scans and images are listed quickly, and a file that
claims more than it contains is refused before memory is allocated.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from ladarreg_core.errors import FormatError
from ladarreg_core.formats.e57.records import E57Field, fields_of
from ladarreg_core.formats.e57.tree import SIGNATURE, E57File, E57Node, open_e57, whole_number
from ladarreg_core.formats.parsing.untrusted import one_line
from ladarreg_core.formats.scans.pcd import pose_of_quaternion
from ladarreg_core.formats.scans.world_pose import LARGEST_COORDINATE_M
from ladarreg_core.frames import Rigid

_UNIT_TOLERANCE = 1e-3
_MIN_LENGTH = 1e-9
_MIN_BITS = 8  # smallest point record


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
    offset: int
    """Physical offset of its blob."""
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
    with open_e57(path) as file:
        return contents_of(file)


def contents_of(file: E57File) -> E57Info:
    """Return the table of contents of an open file; errors as of `read_e57_info`."""
    size = file.pages.file_bytes
    scans = tuple(_scan(node, k, size) for k, node in enumerate(_children(file.root.child("data3D"))))
    return E57Info(scans, tuple(_images(file.root, size)))


def _children(node: E57Node | None) -> list[E57Node]:
    return [] if node is None else node.children


def _text(node: E57Node | None) -> str:
    return "" if node is None else node.text.strip()


def _number(node: E57Node | None, default: float = 0.0) -> float:
    return default if node is None else node.number()


def _scan(node: E57Node, index: int, file_bytes: int) -> E57ScanInfo:
    points = node.child("points")
    if points is None:
        raise FormatError(f"scan {index} of the E57 has no points; it is damaged")
    count = points.whole("recordCount")
    fields = fields_of(points)
    bits = sum(field.bits for field in fields)
    # Constant fields take no bits, but points without any other field are not a scan.
    if count < 0 or count * max(bits, _MIN_BITS) / 8 > file_bytes + 1024:
        raise FormatError(
            f"scan {index} claims {count:,} points of {bits:.0f} bits, but the whole file has {file_bytes:,} bytes; it "
            "is damaged or malicious"
        )
    bounds = node.child("indexBounds")
    grid, first_cell = None, (0, 0)
    if bounds is not None and {"rowIndex", "columnIndex"} <= {field.name for field in fields}:
        sides = [
            _number(bounds.child(f"{axis}Maximum")) - _number(bounds.child(f"{axis}Minimum")) + 1
            for axis in ("row", "column")
        ]
        if all(1 < side < 2**31 for side in sides):
            grid = int(sides[0]), int(sides[1])
            first = [_number(bounds.child(f"{axis}Minimum")) for axis in ("row", "column")]
            first_cell = int(first[0]), int(first[1])
    return E57ScanInfo(
        one_line(_text(node.child("name")) or f"scan {index}", 60),
        _text(node.child("guid")),
        count,
        fields,
        grid,
        first_cell,
        _scan_pose(node.child("pose")),
        _number(node.child("colorLimits", "colorRedMaximum"), 255.0),
        _pose_problem(node.child("pose")),
    )


def _pose(node: E57Node | None) -> Rigid | None:
    if node is None or _beyond_repair(*_rotation_and_translation(node)):
        return None
    return pose_of_quaternion(*_rotation_and_translation(node))


def _scan_pose(node: E57Node | None) -> Rigid | None:
    """Return the pose that the file states for a scan; the identity, too: the first scan of a survey often has it."""
    if node is None or _beyond_repair(*_rotation_and_translation(node)):
        return None
    return _pose(node) or Rigid.identity()


def _pose_problem(node: E57Node | None) -> str:
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


def _rotation_and_translation(node: E57Node) -> tuple[list[float], list[float]]:
    quaternion = [_number(node.child("rotation", axis), float(axis == "w")) for axis in "wxyz"]
    return quaternion, [_number(node.child("translation", axis)) for axis in "xyz"]


def _beyond_repair(quaternion: list[float], translation: list[float]) -> bool:
    length = math.hypot(*quaternion)
    largest = max(map(abs, translation))
    return not (_MIN_LENGTH < length < math.inf and largest <= LARGEST_COORDINATE_M)


def _images(root: E57Node, file_bytes: int) -> Iterator[E57ImageInfo]:
    together = 0
    for index, node in enumerate(_children(root.child("images2D"))):
        for kind in ("pinhole", "spherical", "cylindrical", "visualReference"):
            shape = node.child(f"{kind}Representation")
            if shape is None:
                continue
            for encoding in ("jpeg", "png"):
                blob = shape.child(f"{encoding}Image")
                if blob is None:
                    continue
                length = blob.whole("length")
                together += length
                if length <= 0 or together > file_bytes:
                    raise FormatError(
                        f"the first {index + 1} images claim {together:,} bytes in a file of {file_bytes:,}; it is "
                        "damaged"
                    )
                distortion = next((child for child in node.children if _local(child) == "distortion"), None)
                numbers = _numbers(shape) | _numbers(distortion)
                yield E57ImageInfo(
                    one_line(_text(node.child("name")) or f"image {index}", 60),
                    "visual reference" if kind == "visualReference" else kind,
                    encoding,
                    whole_number(_text(shape.child("imageWidth")), "imageWidth"),
                    whole_number(_text(shape.child("imageHeight")), "imageHeight"),
                    length,
                    blob.whole("fileOffset"),
                    numbers,
                    _pose(node.child("pose")),
                    _text(node.child("associatedData3DGuid")),
                )


def _numbers(node: E57Node | None) -> dict[str, float]:
    """Return the numbers in a structure by name, without prefixes: the terms of a distortion are an extension."""
    kinds = ("Float", "Integer", "ScaledInteger")
    return {_local(child): child.number() for child in _children(node) if child.kind in kinds}


def _local(node: E57Node) -> str:
    """Return a name without the prefix of an extension."""
    return node.name.rpartition(":")[2]
