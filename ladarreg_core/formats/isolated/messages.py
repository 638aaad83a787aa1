"""Messages between a reader process and its parent: JSON followed by the raw bytes of the arrays.

Nothing is unpickled on either side. The permitted types are a closed list: plain values, paths, arrays of numbers and
the data types that readers return. A reader process that a hostile file has taken over can therefore send wrong
numbers, but no code; fields of the wrong type, and values that the data types refuse, are errors.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import ShapeError
from ladarreg_core.foundations.source import Source

_MARK = "#"
_LENGTH_BYTES = 8
_LONGEST_TEXT = 16 << 20
_UNIT_TOLERANCE = 1e-6


class MessageError(ValueError):
    """An invalid message."""


def write_message(stream: IO[bytes], value: Any) -> None:
    """Write one message.

    Args:
        stream: a buffered binary stream; it is flushed.
        value: plain values, paths, arrays of numbers, and the records of `ladarreg_core` that readers return.

    Raises:
        TypeError: if the value contains anything else.
    """
    for part in message_parts(value):
        stream.write(part)
    stream.flush()


def message_parts(value: Any) -> list[memoryview]:
    """Return the bytes of one message, part by part; arguments and errors as of `write_message`."""
    arrays: list[NDArray[Any]] = []
    text = json.dumps(_encode(value, arrays)).encode()
    head = len(text).to_bytes(_LENGTH_BYTES, "little") + text
    return [memoryview(head), *map(_bytes_of, arrays)]


def read_message(stream: IO[bytes], *, largest_bytes: int) -> Any:
    """Read one message.

    Args:
        stream: a buffered binary stream.
        largest_bytes: size limit of all arrays together.

    Raises:
        EOFError: if the stream ends before or inside the message.
        MessageError: if it is invalid or larger than allowed.
    """
    length = int.from_bytes(_exactly(stream, _LENGTH_BYTES), "little")
    if length > _LONGEST_TEXT:
        raise MessageError(f"the message has {length:,} bytes of text; at most {_LONGEST_TEXT:,} are allowed")
    text = _exactly(stream, length)
    try:
        return _Decoder(stream, largest_bytes).decode(json.loads(text))
    except EOFError:
        raise
    except Exception as error:  # the other side may have sent anything
        raise MessageError(f"the message cannot be read: {error}") from error


def _exactly(stream: IO[bytes], length: int) -> bytes:
    data = stream.read(length)
    if len(data) != length:
        raise EOFError("the other process has ended")
    return data


def _bytes_of(array: NDArray[Any]) -> memoryview:
    """Return the memory of a contiguous array."""
    return array.reshape(-1).view(np.uint8).data


def _encode(value: Any, arrays: list[NDArray[Any]]) -> Any:
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.generic):
        return _encode(value.item(), arrays)
    if isinstance(value, np.ndarray):
        if value.dtype.kind not in "biuf":
            raise TypeError(f"an array of {value.dtype} cannot be sent; only arrays of numbers can")
        array = value if value.flags.c_contiguous else np.array(value, order="C")
        arrays.append(array)
        return {_MARK: "array", "dtype": array.dtype.str, "shape": list(array.shape)}
    if isinstance(value, list):
        return [_encode(item, arrays) for item in value]
    if isinstance(value, tuple):
        return {_MARK: "tuple", "items": [_encode(item, arrays) for item in value]}
    if isinstance(value, Path):
        return {_MARK: "path", "path": str(value)}
    if isinstance(value, Mapping):
        items = [[_encode(key, arrays), _encode(item, arrays)] for key, item in value.items()]
        return {_MARK: "dict", "items": items}
    if isinstance(value, Source):  # the parent knows its files; a reader that was taken over must not name others
        return None
    name = type(value).__name__
    if _records().get(name) is not type(value):
        raise TypeError(f"a {name} cannot be sent between a reader process and its parent")
    fields = {f.name: _encode(getattr(value, f.name), arrays) for f in dataclasses.fields(value)}
    return {_MARK: name, "fields": fields}


class _Decoder:
    """Decodes a value; its arrays follow in the stream in the order of their occurrence."""

    def __init__(self, stream: IO[bytes], largest_bytes: int) -> None:
        self._stream, self._left = stream, largest_bytes

    def decode(self, value: Any) -> Any:
        """Return the decoded value."""
        if isinstance(value, list):
            return [self.decode(item) for item in value]
        if not isinstance(value, dict):
            return value
        kind = value[_MARK]
        if kind == "array":
            return self._array(np.dtype(value["dtype"]), value["shape"])
        if kind == "tuple":
            return tuple(self.decode(item) for item in value["items"])
        if kind == "path":
            return Path(value["path"])
        if kind == "dict":
            return {self.decode(key): self.decode(item) for key, item in value["items"]}
        record = _records()[kind]
        return _rebuild(record, {name: self.decode(field) for name, field in value["fields"].items()})

    def _array(self, dtype: np.dtype[Any], shape: list[int]) -> NDArray[Any]:
        if dtype.kind not in "biuf" or not all(isinstance(side, int) and side >= 0 for side in shape):
            raise MessageError(f"an array has the type {dtype} and the shape {shape}")
        size = math.prod(shape) * dtype.itemsize
        if size > self._left:
            raise MessageError(f"an array has {size:,} bytes; only {self._left:,} are left of the limit")
        self._left -= size
        array = np.empty(shape, dtype)
        rest = _bytes_of(array)
        while rest:
            count = self._stream.readinto(rest)  # type: ignore[attr-defined]  # buffered streams have it
            if not count:
                raise EOFError("the other process has ended")
            rest = rest[count:]
        array.flags.writeable = False  # so that the records share it instead of copying it
        return array


@cache
def _records() -> dict[str, type[Any]]:
    """Return the data types that a message can contain, by name."""
    from ladarreg_core.camera import Camera, EquirectangularCamera, FisheyeCamera
    from ladarreg_core.formats.e57_images import EmbeddedImage
    from ladarreg_core.formats.file_info import FileInfo
    from ladarreg_core.formats.survey import FileSurvey
    from ladarreg_core.frames import Rigid
    from ladarreg_core.matches import Pick
    from ladarreg_core.photo import Photo
    from ladarreg_core.scan import Scan

    return {
        found.__name__: found
        for found in (
            Camera,
            EquirectangularCamera,
            FisheyeCamera,
            EmbeddedImage,
            FileInfo,
            FileSurvey,
            Rigid,
            Pick,
            Photo,
            Scan,
            *_geometries(),
        )
    }


def _geometries() -> tuple[type[Any], ...]:
    from ladarreg_core.scanner.grids import (
        AzimuthElevation,
        PinholeGrid,
        RingGrid,
        RotatedGrid,
        SphericalGrid,
        TabulatedGrid,
    )

    return AzimuthElevation, PinholeGrid, SphericalGrid, TabulatedGrid, RingGrid, RotatedGrid


def _rebuild(record: type[Any], values: dict[str, Any]) -> Any:
    """Return a record with the given field values, each checked against the field's annotation."""
    fields = dataclasses.fields(record)
    if values.keys() != {f.name for f in fields}:
        raise MessageError(f"a {record.__name__} has the fields {sorted(values)}")
    for f in fields:
        annotation = str(f.type)
        optional = annotation.endswith(" | None")
        is_of_type = _field_types()[annotation.removesuffix(" | None")]
        if not (optional and values[f.name] is None) and not is_of_type(values[f.name]):
            raise MessageError(f"the field {f.name} of a {record.__name__} is a {type(values[f.name]).__name__}")
    return _ray_table(record, values) if record.__name__ == "TabulatedGrid" else record(**values)


def _ray_table(record: type[Any], values: dict[str, Any]) -> Any:
    """Return a tabulated grid without calling its constructor, which would complete and normalise the table again."""
    table, law = values["table"], values["law"]
    if table.dtype not in (np.float32, np.float64) or table.ndim != 3 or table.shape[2] != 3:
        raise ShapeError(f"a ray table has the type {table.dtype} and the shape {table.shape}")
    if not all(np.abs(np.einsum("jk,jk->j", row, row) - 1).max(initial=0) < _UNIT_TOLERANCE for row in table):
        raise ShapeError("a ray table has rays that are not of length 1")
    if law is not None and law.shape != table.shape[:2]:
        raise ShapeError("a ray table and its angle law differ in shape")
    table.flags.writeable = False
    grid = object.__new__(record)
    object.__setattr__(grid, "table", table)
    object.__setattr__(grid, "law", law)
    return grid


@cache
def _field_types() -> dict[str, Callable[[Any], bool]]:
    """Return the type check of a field by its annotation."""
    from ladarreg_core.camera import Camera, EquirectangularCamera, FisheyeCamera
    from ladarreg_core.frames import Rigid

    def is_a(*types: type[Any]) -> Callable[[Any], bool]:
        return lambda value: isinstance(value, types) and (bool in types or not isinstance(value, bool))

    def is_tuple_of(*types: type[Any]) -> Callable[[Any], bool]:
        inner = is_a(*types)
        return lambda value: isinstance(value, tuple) and all(map(inner, value))

    array, text, number = is_a(np.ndarray), is_a(str), is_a(int, float)
    return {
        "int": is_a(int),
        "float": number,
        "bool": is_a(bool),
        "str": text,
        "FileKind": text,
        "IntensityKind": text,
        "PickKind": text,
        "FloatArray": array,
        "ByteArray": array,
        "Camera": is_a(Camera),
        "CameraModel": is_a(Camera, EquirectangularCamera, FisheyeCamera),
        "Rigid": is_a(Rigid),
        "ScanGeometry": is_a(*_geometries()),
        "Source": lambda value: False,  # only None is received
        "tuple[str, ...]": is_tuple_of(str),
        "tuple[CameraModel, ...]": is_tuple_of(Camera, EquirectangularCamera, FisheyeCamera),
        "tuple[tuple[int, int], ...]": is_tuple_of(tuple),
        "tuple[float, ...]": is_tuple_of(int, float),
        "tuple[float, float]": is_tuple_of(int, float),
        "tuple[float, float, float, float]": is_tuple_of(int, float),
        "Mapping[str, Any]": is_a(dict),
    }
