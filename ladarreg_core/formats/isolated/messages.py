"""The messages between a reader process and its parent: JSON, with the arrays as raw bytes behind it.

Nothing is unpickled on either side. What a message can hold is a closed list: plain values, paths, arrays of numbers
and the data types that readers return. A reader process whose decoder was taken over by a hostile file can therefore
send wrong numbers, but no code; fields of the wrong type, and values that the data types refuse, are errors.
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

_MARK = "#"
_LENGTH_BYTES = 8
_LONGEST_TEXT = 16 << 20
_UNIT_TOLERANCE = 1e-6


class MessageError(ValueError):
    """A message that is not one of ours."""


def write_message(stream: IO[bytes], value: Any) -> None:
    """Write one message.

    Args:
        stream: a buffered binary stream; it is flushed.
        value: plain values, paths, arrays of numbers, and the records of `ladarreg_core` that readers return.

    Raises:
        TypeError: if the value holds anything else.
    """
    arrays: list[NDArray[Any]] = []
    text = json.dumps(_encoded(value, arrays)).encode()
    stream.write(len(text).to_bytes(_LENGTH_BYTES, "little"))
    stream.write(text)
    for array in arrays:
        stream.write(_bytes_of(array))
    stream.flush()


def read_message(stream: IO[bytes], *, largest_bytes: int) -> Any:
    """Read one message.

    Args:
        stream: a buffered binary stream.
        largest_bytes: what all arrays together may hold.

    Raises:
        EOFError: if the stream ends before or inside the message.
        MessageError: if it is no message, or larger than allowed.
    """
    length = int.from_bytes(_exactly(stream, _LENGTH_BYTES), "little")
    if length > _LONGEST_TEXT:
        raise MessageError(f"a message of {length:,} bytes of text; at most {_LONGEST_TEXT:,} are read")
    text = _exactly(stream, length)
    try:
        return _Decoder(stream, largest_bytes).decoded(json.loads(text))
    except EOFError:
        raise
    except Exception as error:  # whatever the other side sent
        raise MessageError(f"the message cannot be read: {error}") from error


def _exactly(stream: IO[bytes], length: int) -> bytes:
    data = stream.read(length)
    if len(data) != length:
        raise EOFError("the other side has gone")
    return data


def _bytes_of(array: NDArray[Any]) -> memoryview:
    """Return the memory of a contiguous array."""
    return array.reshape(-1).view(np.uint8).data


def _encoded(value: Any, arrays: list[NDArray[Any]]) -> Any:
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.generic):
        return _encoded(value.item(), arrays)
    if isinstance(value, np.ndarray):
        if value.dtype.kind not in "biuf":
            raise TypeError(f"an array of {value.dtype} cannot be sent; only arrays of numbers can")
        array = value if value.flags.c_contiguous else np.array(value, order="C")
        arrays.append(array)
        return {_MARK: "array", "dtype": array.dtype.str, "shape": list(array.shape)}
    if isinstance(value, list):
        return [_encoded(item, arrays) for item in value]
    if isinstance(value, tuple):
        return {_MARK: "tuple", "items": [_encoded(item, arrays) for item in value]}
    if isinstance(value, Path):
        return {_MARK: "path", "path": str(value)}
    if isinstance(value, Mapping):
        items = [[_encoded(key, arrays), _encoded(item, arrays)] for key, item in value.items()]
        return {_MARK: "dict", "items": items}
    name = type(value).__name__
    if _records().get(name) is not type(value):
        raise TypeError(f"a {name} cannot be sent between a reader process and its parent")
    fields = {f.name: _encoded(getattr(value, f.name), arrays) for f in dataclasses.fields(value)}
    return {_MARK: name, "fields": fields}


class _Decoder:
    """Rebuilds a value, its arrays read from the stream in the order in which they are met."""

    def __init__(self, stream: IO[bytes], largest_bytes: int) -> None:
        self._stream, self._left = stream, largest_bytes

    def decoded(self, value: Any) -> Any:
        """Return what was encoded."""
        if isinstance(value, list):
            return [self.decoded(item) for item in value]
        if not isinstance(value, dict):
            return value
        kind = value[_MARK]
        if kind == "array":
            return self._array(np.dtype(value["dtype"]), value["shape"])
        if kind == "tuple":
            return tuple(self.decoded(item) for item in value["items"])
        if kind == "path":
            return Path(value["path"])
        if kind == "dict":
            return {self.decoded(key): self.decoded(item) for key, item in value["items"]}
        record = _records()[kind]
        return _rebuilt(record, {name: self.decoded(field) for name, field in value["fields"].items()})

    def _array(self, dtype: np.dtype[Any], shape: list[int]) -> NDArray[Any]:
        if dtype.kind not in "biuf" or not all(isinstance(side, int) and side >= 0 for side in shape):
            raise MessageError(f"an array of {dtype} and shape {shape}")
        size = math.prod(shape) * dtype.itemsize
        if size > self._left:
            raise MessageError(f"arrays of more than was agreed: {size:,} bytes where {self._left:,} are left")
        self._left -= size
        array = np.empty(shape, dtype)
        rest = _bytes_of(array)
        while rest:
            count = self._stream.readinto(rest)  # type: ignore[attr-defined]  # buffered streams have it
            if not count:
                raise EOFError("the other side has gone")
            rest = rest[count:]
        return array


@cache
def _records() -> dict[str, type[Any]]:
    """Return the data types that a message can hold, by name."""
    from ladarreg_core.camera import Camera
    from ladarreg_core.formats.file_info import FileInfo
    from ladarreg_core.frames import Rigid
    from ladarreg_core.matches import Pick
    from ladarreg_core.photo import Photo
    from ladarreg_core.scan import Scan

    return {found.__name__: found for found in (Camera, FileInfo, Rigid, Pick, Photo, Scan, *_geometries())}


def _geometries() -> tuple[type[Any], ...]:
    from ladarreg_core.scanner.gridding import RingGrid, TurnedGrid
    from ladarreg_core.scanner.grids import AzimuthElevation, PinholeGrid, SphericalGrid, TabulatedGrid

    return AzimuthElevation, PinholeGrid, SphericalGrid, TabulatedGrid, RingGrid, TurnedGrid


def _rebuilt(record: type[Any], values: dict[str, Any]) -> Any:
    """Return a record of the values of its fields, each of the type that the field is annotated with."""
    fields = dataclasses.fields(record)
    if values.keys() != {f.name for f in fields}:
        raise MessageError(f"a {record.__name__} with the fields {sorted(values)}")
    for f in fields:
        annotation = str(f.type)
        optional = annotation.endswith(" | None")
        is_of_type = _field_types()[annotation.removesuffix(" | None")]
        if not (optional and values[f.name] is None) and not is_of_type(values[f.name]):
            raise MessageError(f"the field {f.name} of a {record.__name__} is a {type(values[f.name]).__name__}")
    return _ray_table(record, values) if record.__name__ == "TabulatedGrid" else record(**values)


def _ray_table(record: type[Any], values: dict[str, Any]) -> Any:
    """Return a tabulated grid as it was: its constructor would complete and normalise the whole table once more."""
    table, law = values["table"], values["law"]
    if table.dtype != np.float64 or table.ndim != 3 or table.shape[2] != 3:
        raise ShapeError(f"a ray table of {table.dtype} and shape {table.shape}")
    if not np.abs(np.einsum("ijk,ijk->ij", table, table) - 1).max(initial=0) < _UNIT_TOLERANCE:
        raise ShapeError("a ray table whose rays are not of length 1")
    if law is not None and law.shape != table.shape[:2]:
        raise ShapeError("a ray table and a law of different shapes")
    table.flags.writeable = False
    grid = object.__new__(record)
    object.__setattr__(grid, "table", table)
    object.__setattr__(grid, "law", law)
    return grid


@cache
def _field_types() -> dict[str, Callable[[Any], bool]]:
    """Return, by the annotation of a field, the test that its values pass."""
    from ladarreg_core.camera import Camera
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
        "Rigid": is_a(Rigid),
        "ScanGeometry": is_a(*_geometries()),
        "tuple[str, ...]": is_tuple_of(str),
        "tuple[float, ...]": is_tuple_of(int, float),
        "tuple[float, float]": is_tuple_of(int, float),
        "Mapping[str, Any]": is_a(dict),
    }
