"""Fields of calibrations in YAML, JSON or OpenCV's XML: one mapping of names to values."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ladarreg_core.errors import FormatError
from ladarreg_core.formats.json_file import begins_with_brace, read_json_object
from ladarreg_core.formats.opencv_yaml import parse_yaml
from ladarreg_core.formats.xml_file import read_xml

LARGEST_BYTES = 1_000_000
"""Size limit of a calibration."""


def read_fields(path: Path) -> dict[str, Any]:
    """Return the fields of a calibration file; values are numbers, strings, lists or mappings.

    Raises:
        FormatError: if it is too large or damaged, or is none of YAML, JSON and OpenCV's XML.
    """
    size = path.stat().st_size
    if size > LARGEST_BYTES:
        raise FormatError(f"it has {size:,} bytes; a camera file has at most {LARGEST_BYTES:,}: give the right file")
    if begins_with_brace(path):
        return read_json_object(path, "a camera file")
    with open(path, "rb") as stream:
        if stream.read(64).removeprefix(b"\xef\xbb\xbf").lstrip().startswith(b"<"):
            return _opencv_xml(read_xml(path, LARGEST_BYTES, "a camera file"))
    try:
        return parse_yaml(path.read_text(encoding="utf-8-sig"))
    except UnicodeDecodeError:
        raise FormatError(
            "it is not text; a camera is read from JSON, YAML, XML or COLMAP's cameras.bin: give one of these"
        ) from None


def _opencv_xml(root: ElementTree.Element) -> dict[str, Any]:
    if root.tag != "opencv_storage":
        raise FormatError(
            "it is XML of another kind; XML of OpenCV (<opencv_storage>) and Agisoft "
            "(<calibration>, <document>) is read: export one of these"
        )
    return {node.tag: _xml_value(node) for node in root}


def _xml_value(node: ElementTree.Element) -> Any:
    if len(node):
        return {child.tag: _xml_value(child) for child in node}
    words = (node.text or "").split()
    values = [_word(word) for word in words]
    if node.tag != "data" and len(values) == 1:
        return values[0]
    return values if values and not all(isinstance(value, str) for value in values) else (node.text or "").strip()


def _word(word: str) -> int | float | str:
    try:
        return int(word)
    except ValueError:
        pass
    try:
        return float(word)
    except ValueError:
        return word


def plain_names(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields by their names in lower case without separators: `Camera_Matrix` and `cameraMatrix` agree."""
    return {"".join(c for c in str(key).lower() if c.isalnum()): value for key, value in fields.items()}


def first_of(by_name: Mapping[str, Any], names: Sequence[str]) -> Any:
    """Return the first of several fields that is there; None if there is none."""
    return next((by_name[name] for name in names if by_name.get(name) is not None), None)
