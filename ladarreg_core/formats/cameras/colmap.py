"""COLMAP's cameras.txt and cameras.bin; images.txt or images.bin beside it say which photograph each camera took.

Pixels: COLMAP counts the centre of the first pixel as (.5, .5), so principal points are ours + .5.

Source: COLMAP's documentation, "Output format" and "Camera models".
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.camera import CameraModel
from ladarreg_core.errors import FormatError, LadarregError
from ladarreg_core.formats.cameras.camera_in_file import (
    FileCamera,
    equirectangular_camera,
    lens_camera,
    naming,
    refuse_model,
)
from ladarreg_core.formats.parsing.untrusted import one_line
from ladarreg_core.frames import Rigid

_LARGEST_BYTES = 8_000_000
_LARGEST_IMAGES_BYTES = 2_000_000_000
_MAX_PARAMETERS = 20
_Make = Callable[[int, int, tuple[float, ...]], CameraModel]


def _pinhole(f: int, terms: tuple[int | None, ...]) -> _Make:
    return _lens("pinhole", f, terms)


def _lens(lens: str, f: int, terms: tuple[int | None, ...]) -> _Make:
    """Return the maker of a camera with `f` focal lengths; `terms` are the places of OpenCV's terms, None: 0."""

    def make(width: int, height: int, given: tuple[float, ...]) -> CameraModel:
        fx, fy = given[0], given[f - 1]
        matrix = (fx, fy, given[f] - 0.5, given[f + 1] - 0.5)
        k = [0.0 if place is None else given[f + 2 + place] for place in terms]
        return lens_camera("fisheye" if lens == "fisheye" else "pinhole", width, height, matrix, k)

    return make


_MODELS: Mapping[str, tuple[int, int, _Make]] = {
    "SIMPLE_PINHOLE": (0, 3, _pinhole(1, ())),
    "PINHOLE": (1, 4, _pinhole(2, ())),
    "SIMPLE_RADIAL": (2, 4, _pinhole(1, (0, None, None, None))),
    "RADIAL": (3, 5, _pinhole(1, (0, 1, None, None))),
    "OPENCV": (4, 8, _pinhole(2, (0, 1, 2, 3))),
    "OPENCV_FISHEYE": (5, 8, _lens("fisheye", 2, (0, 1, 2, 3))),
    "FULL_OPENCV": (6, 12, _pinhole(2, (0, 1, 2, 3, 4, 5, 6, 7))),
    "SIMPLE_RADIAL_FISHEYE": (8, 4, _lens("fisheye", 1, (0, None, None, None))),
    "RADIAL_FISHEYE": (9, 5, _lens("fisheye", 1, (0, 1, None, None))),
    "SIMPLE_FISHEYE": (14, 3, _lens("fisheye", 1, (None, None, None, None))),
    "FISHEYE": (15, 4, _lens("fisheye", 2, (None, None, None, None))),
    "EQUIRECTANGULAR": (17, 2, lambda width, height, _: equirectangular_camera(width, height)),
}
"""Number, count of parameters and maker of every model that is read."""
_OTHERS: Mapping[str, tuple[int, int]] = {
    "FOV": (7, 5), "THIN_PRISM_FISHEYE": (10, 12), "RAD_TAN_THIN_PRISM_FISHEYE": (11, 16), "SIMPLE_DIVISION": (12, 4),
    "DIVISION": (13, 5), "EUCM": (16, 6),
}  # fmt: skip
"""The models that are refused by name."""
_NUMBERED = {number: (name, count) for name, (number, count, _) in _MODELS.items()} | {
    number: (name, count) for name, (number, count) in _OTHERS.items()
}
_TEXT_LINE = re.compile(rb"^\s*\d+\s+([A-Z][A-Z_]+)\s+\d+\s+\d+(\s+[-+.\deEnaif]+)+\s*$")


@dataclass(frozen=True, slots=True)
class _Stated:
    """A camera as a file states it."""

    id: int
    model: str
    width: int
    height: int
    parameters: tuple[float, ...]


def sniff_colmap_text(head: bytes, file: Path) -> bool:
    """Return whether a file begins like cameras.txt."""
    lines = [line for line in head.splitlines() if line.strip() and not line.lstrip().startswith(b"#")]
    if not lines:
        return head.lstrip().startswith(b"# Camera list with one line of data per camera")
    return _TEXT_LINE.match(lines[0][:2000]) is not None


def sniff_colmap_binary(head: bytes, file: Path) -> bool:
    """Return whether a file is cameras.bin: it has no signature, but its records must fit its size."""
    if len(head) < 8 + 24 + 24:
        return False
    count, _, model, width, height = struct.unpack_from("<QiiQQ", head)
    known = model in _NUMBERED and 1 <= count <= _LARGEST_BYTES // 48
    if not known or not (1 <= width < 1 << 24 and 1 <= height < 1 << 24):
        return False
    smallest = min(24 + 8 * n for _, n in _NUMBERED.values())
    return bool(8 + smallest * count <= file.stat().st_size <= 8 + (24 + 8 * _MAX_PARAMETERS) * count)


def read_colmap_text(path: Path) -> tuple[FileCamera, ...]:
    """Return the cameras of cameras.txt, named by their number.

    Raises:
        FormatError: if a line is damaged.
        CameraError: if a model is not read, or its parameters are invalid.
    """
    try:
        text = _content(path).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise FormatError("it is not text; cameras.txt of COLMAP is: export it again") from None
    stated: list[_Stated] = []
    for line in text.splitlines():
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        try:
            numbers = tuple(float(word) for word in words[4:])
            stated.append(_Stated(int(words[0]), words[1], int(words[2]), int(words[3]), numbers))
        except (ValueError, IndexError):
            raise FormatError(
                f"the line {one_line(line, 50)!r} is not 'CAMERA_ID MODEL WIDTH HEIGHT PARAMS'; export it again"
            ) from None
    return _cameras(path, stated)


def read_colmap_binary(path: Path) -> tuple[FileCamera, ...]:
    """Return the cameras of cameras.bin, named by their number; errors as `read_colmap_text`."""
    data = _content(path)
    stated: list[_Stated] = []
    at = 8
    for _ in range(struct.unpack_from("<Q", data)[0]):
        if at + 24 > len(data):
            raise FormatError(f"it ends after {len(stated)} cameras; it is truncated: copy it again")
        number, model, width, height = struct.unpack_from("<iiQQ", data, at)
        if model not in _NUMBERED:
            refuse_model(f"number {model} of COLMAP", "export another model with model_converter")
        name, count = _NUMBERED[model]
        at += 24 + 8 * count
        if at > len(data):
            raise FormatError(f"it ends after {len(stated)} cameras; it is truncated: copy it again")
        parameters = struct.unpack_from(f"<{count}d", data, at - 8 * count)
        stated.append(_Stated(number, name, width, height, parameters))
    if at != len(data):
        raise FormatError(f"{len(data) - at:,} bytes follow its cameras; it is damaged: copy it again")
    return _cameras(path, stated)


def _content(path: Path) -> bytes:
    size = path.stat().st_size
    if size > _LARGEST_BYTES:
        raise FormatError(
            f"it has {size:,} bytes; a file of cameras has at most {_LARGEST_BYTES:,}: give the right file"
        )
    return path.read_bytes()


def _cameras(path: Path, stated: list[_Stated]) -> tuple[FileCamera, ...]:
    if not stated:
        raise FormatError("it contains no camera; export the reconstruction again")
    photographs = _photographs(path, {each.id for each in stated})
    found = []
    for each in stated:
        with naming(f"camera {each.id}"):
            known = _MODELS.get(each.model)
            if known is None:
                refuse_model(each.model, "convert it to OPENCV or OPENCV_FISHEYE, or undistort the photographs")
            _, count, make = known
            if len(each.parameters) != count:
                raise FormatError(f"{each.model} has {len(each.parameters)} parameters; it must have {count}")
            poses = photographs.get(each.id, {})
            found.append(
                FileCamera(
                    camera=make(each.width, each.height, each.parameters),
                    name=str(each.id),
                    pictures=tuple(poses),
                    poses=poses,
                )
            )
    return tuple(found)


def _photographs(path: Path, cameras: set[int]) -> dict[int, dict[str, Rigid]]:
    """Return the photographs of each camera with their poses, from the images file beside it; none if it is damaged."""
    found: dict[int, dict[str, Rigid]] = {}
    text, binary = path.with_name("images.txt"), path.with_name("images.bin")
    with open(path, "rb") as stream:
        is_text = b"\0" not in stream.read(16)
    wanted, other = (text, binary) if is_text else (binary, text)
    beside = wanted if wanted.is_file() else other
    try:
        rows = _text_images(beside) if beside == text else _binary_images(beside)
        for camera, name, numbers in rows:
            if camera in cameras:
                found.setdefault(camera, {})[name] = Rigid(_rotation(numbers), np.array(numbers[4:]))
    except (OSError, ValueError, IndexError, struct.error, LadarregError):
        return {}
    return found


def _rotation(numbers: tuple[float, ...]) -> NDArray[np.float64]:
    """Return the rotation (3, 3) of a quaternion w x y z."""
    from scipy.spatial.transform import Rotation

    w, x, y, z = numbers[:4]
    return np.asarray(Rotation.from_quat([x, y, z, w]).as_matrix())


def _text_images(path: Path) -> Iterator[tuple[int, str, tuple[float, ...]]]:
    if path.stat().st_size > _LARGEST_IMAGES_BYTES:
        return
    with open(path, encoding="utf-8") as stream:
        for line in stream:
            if line.startswith("#") or not line.strip():
                continue
            words = line.split(maxsplit=9)
            yield int(words[8]), words[9].strip(), tuple(float(word) for word in words[1:8])
            next(stream, None)  # its points


def _binary_images(path: Path) -> Iterator[tuple[int, str, tuple[float, ...]]]:
    size = path.stat().st_size
    with open(path, "rb") as stream:
        for _ in range(struct.unpack("<Q", stream.read(8))[0]):
            numbers = struct.unpack("<I7dI", stream.read(64))
            name = bytearray()
            while (byte := stream.read(1)) not in (b"", b"\0"):
                name += byte
                if len(name) > 4096:
                    return
            count = struct.unpack("<Q", stream.read(8))[0]
            if stream.tell() + 24 * count > size:
                return
            stream.seek(24 * count, 1)
            yield numbers[8], name.decode("utf-8"), numbers[1:8]
