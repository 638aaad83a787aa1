"""Fields of calibrations in YAML, JSON or OpenCV's XML: one mapping of names to values, none of which is lost."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ladarreg_core.errors import CameraError, FormatError
from ladarreg_core.formats.cameras.camera_in_file import READ_MODELS
from ladarreg_core.formats.parsing.json_file import begins_with_brace, read_json_object
from ladarreg_core.formats.parsing.untrusted import one_line
from ladarreg_core.formats.parsing.xml_file import read_xml
from ladarreg_core.formats.parsing.yaml_file import parse_yaml

LARGEST_BYTES = 1_000_000
"""Size limit of a calibration."""
_GROUPS = frozenset(
    ("camera", "calibration", "intrinsic", "intrinsics", "intrinsicparameters", "cameraparameters", "distortion",
     "distortionparameters", "projectionparameters", "mirrorparameters", "resolution", "imagesize", "size")
)  # fmt: skip
_DEEPEST_GROUP = 3
_HARMLESS = frozenset(
    ("aabbscale", "avgreprojectionerror", "boardheight", "boardwidth", "calibrationtime", "cameraname",
     "camoverlaps", "comment", "comments", "date", "description", "extrinsicparameters", "flags", "framecount",
     "framerate", "gridpoints", "header", "imagepoints", "meta", "name", "nframes", "nrofframes",
     "orientationoverride", "p", "perviewreprojectionerrors", "plyfilepath", "projectionmatrix", "r",
     "rectificationmatrix", "reprojectionerror", "rms", "rostopic", "sha256", "squaresize", "version")
)  # fmt: skip
_LENS_TERM = re.compile(r"(camera\d?)?([kpsb]\d|tau[xy]|xi|alpha|skew|gamma\d?)")
_MAX_NAMED = 8


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


class CameraFields:
    """The fields of a calibration by plain names (`Camera_Matrix` and `cameraMatrix` agree), and which were used.

    Groups (`distortion_parameters`, `camera`, ...) are flattened: their fields stand beside the others.
    """

    def __init__(self, fields: Mapping[str, Any]) -> None:
        self._by_name: dict[str, tuple[str, Any]] = {}
        self._twice: set[str] = set()
        self._used: set[str] = set()
        self._notes: list[str] = []
        self._add(fields, 0)

    def _add(self, fields: Mapping[str, Any], depth: int) -> None:
        for key, value in fields.items():
            plain = _plain(key)
            if plain in _GROUPS and isinstance(value, Mapping) and "data" not in value and depth < _DEEPEST_GROUP:
                self._add(value, depth + 1)
            elif value is not None and self._by_name.setdefault(plain, (str(key), value))[1] != value:
                self._twice.add(plain)

    def peek(self, names: Sequence[str]) -> Any:
        """Return the value of the first of several fields that is there, without using it; None if there is none."""
        return next((self._by_name[name][1] for name in names if name in self._by_name), None)

    def take(self, names: Sequence[str]) -> Any:
        """Return the value of the first of several fields that is there, which counts as used; None if there is none.

        Raises:
            FormatError: if it is stated twice, with different values.
        """
        name = next((name for name in names if name in self._by_name), None)
        if name is None:
            return None
        if name in self._twice:
            raise FormatError(
                f"it states {one_line(self._by_name[name][0], 40)!r} twice, with different values; keep one of them"
            )
        self._used.add(name)
        return self._by_name[name][1]

    def called(self, names: Sequence[str]) -> str | None:
        """Return the file's own spelling of the first of several fields that is there."""
        return next((self._by_name[name][0] for name in names if name in self._by_name), None)

    def note(self, remark: str) -> None:
        """Add a remark on the file."""
        self._notes.append(remark)

    def notes_on_the_rest(self) -> tuple[str, ...]:
        """Return the remarks, and one that names the fields that were not used.

        Raises:
            CameraError: if one of them changes the lens.
        """
        rest = {name: entry for name, entry in self._by_name.items() if name not in self._used}
        return (*self._notes, *notes_on_unused(dict(rest.values())))


def notes_on_unused(fields: Mapping[str, Any]) -> tuple[str, ...]:
    """Return a note that names the fields of a camera file that were not used; none if none matters.

    Raises:
        CameraError: if one of them is a term of the lens: without it the camera would be wrong.
    """
    said = []
    for key, value in fields.items():
        plain = _plain(key)
        if _is_nothing(value) or plain in _HARMLESS:
            continue
        if _LENS_TERM.fullmatch(plain) and isinstance(value, int | float):
            raise CameraError(
                f"its field {one_line(key, 40)!r} ({value:g}) is a term of the lens that is not read; calibrate with "
                f"{READ_MODELS}, or export undistorted photographs"
            )
        said.append(one_line(key, 30))
    if not said:
        return ()
    more = f" and {len(said) - _MAX_NAMED} more" if len(said) > _MAX_NAMED else ""
    return (f"fields of the camera file that were not used: {', '.join(said[:_MAX_NAMED])}{more}",)


def _plain(name: object) -> str:
    """Return a name in lower case without separators."""
    return "".join(c for c in str(name).lower() if c.isalnum())


def _is_nothing(value: Any) -> bool:
    """Return whether a value says nothing: zero, false, empty, a list of zeros, or a group of such values."""
    if isinstance(value, Mapping):
        return all(map(_is_nothing, value.values()))
    if isinstance(value, list):
        return not any(value)
    return value in (None, 0, "", "false", "False")
