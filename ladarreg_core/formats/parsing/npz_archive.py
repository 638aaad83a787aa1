"""Arrays of an NPZ file, read one by one and checked by their headers first; nothing is ever unpickled."""

from __future__ import annotations

import io
import math
import zipfile
import zlib
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import FormatError
from ladarreg_core.formats.parsing.untrusted import one_line

_LONGEST_HEADER = 4096
_PIECE = 1 << 20


@contextmanager
def open_archive(file: Path) -> Iterator[zipfile.ZipFile]:
    """Open an NPZ.

    Raises:
        FormatError: also while it is read, if it is damaged.
    """
    try:
        with zipfile.ZipFile(file) as archive:
            yield archive
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError) as error:
        raise FormatError(f"the NPZ is damaged or truncated ({one_line(error, 80)}); save it again") from error


@dataclass(frozen=True, slots=True)
class ArrayMember:
    """One array of the archive as described by its header; its data have not been read."""

    entry: zipfile.ZipInfo
    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    fortran_order: bool
    data_offset: int

    @property
    def bytes_per_cell(self) -> int:
        """Bytes per (row, column)."""
        return math.prod(self.shape[2:]) * self.dtype.itemsize

    def read(self, archive: zipfile.ZipFile) -> NDArray[Any]:
        """Return the array; the zip's checksum is verified while reading."""
        values = np.empty(math.prod(self.shape), self.dtype)
        room = values.view(np.uint8)
        with archive.open(self.entry) as stream:
            stream.read(self.data_offset)
            at = 0
            while piece := stream.read(_PIECE):  # in one piece it would be in memory several times
                room[at : at + len(piece)] = np.frombuffer(piece, np.uint8)
                at += len(piece)
        if at != values.nbytes:
            raise FormatError("the NPZ ends within an array; it is damaged: save it again")
        values = values.reshape(self.shape, order="F" if self.fortran_order else "C")
        return values.astype(self.dtype.newbyteorder("="), copy=False)


def members_of(archive: zipfile.ZipFile, wanted: Collection[str], texts: Collection[str]) -> dict[str, ArrayMember]:
    """Return the arrays of an archive by name.

    Args:
        archive: the archive.
        wanted: names of the arrays that are known; others are ignored, even pickled ones.
        texts: names of those that hold a short string.

    Raises:
        FormatError: if one of these is there twice, or its header says anything but what its data can be.
    """
    found: dict[str, ArrayMember] = {}
    for entry in archive.infolist():
        name = entry.filename.removesuffix(".npy")
        if name not in wanted or not entry.filename.endswith(".npy"):
            continue
        if name in found:
            raise FormatError(f"the NPZ contains two arrays named {name!r}; it must contain one")
        if entry.flag_bits & 1:
            raise FormatError("the NPZ is encrypted; save it without a password")
        if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise FormatError("the NPZ uses an unsupported compression; save it with numpy.savez or savez_compressed")
        found[name] = _header_of(archive, entry, name, is_text=name in texts)
    if not found:
        inside = [one_line(entry.filename, 30) for entry in archive.infolist()[:4]]
        raise FormatError(
            f"it is a zip archive with {inside or 'nothing'} inside, not a scan; give an NPZ with a scan's arrays"
        )
    return found


def _header_of(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, name: str, *, is_text: bool) -> ArrayMember:
    with archive.open(entry) as stream:
        try:
            version = np.lib.format.read_magic(stream)
            readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
            if version not in readers:
                raise FormatError(f"the array {name!r} has .npy version {version}; only 1.0 and 2.0 are supported")
            start = stream.read(_LONGEST_HEADER + 4)  # NumPy would read the length that the header claims
            begin = io.BytesIO(start)
            shape, fortran, dtype = readers[version](begin, max_header_size=_LONGEST_HEADER)
        except (zipfile.BadZipFile, zlib.error, FormatError):
            raise
        except Exception as error:  # the header is a Python literal, whose parser fails in many ways
            raise FormatError(f"the array {name!r} has a damaged header; save it again") from error
        offset = np.lib.format.MAGIC_LEN + begin.tell()
    if dtype.hasobject:
        raise FormatError(f"the array {name!r} contains pickled Python objects, which are never loaded; save numbers")
    if dtype.kind not in ("US" if is_text else "fiub"):
        raise FormatError(f"the array {name!r} has the type {one_line(dtype, 40)}; it must contain numbers")
    if dtype.kind in "US" and dtype.itemsize > _LONGEST_HEADER:
        raise FormatError(
            f"the array {name!r} contains strings of {dtype.itemsize:,} bytes; it must be one short string"
        )
    if math.prod(map(int, shape)) * dtype.itemsize != entry.file_size - offset:
        raise FormatError(
            f"the array {name!r} claims {' x '.join(map(str, shape)) or 'one'} values of {dtype.itemsize} bytes, "
            f"but {max(entry.file_size - offset, 0):,} bytes are present; save it again"
        )
    return ArrayMember(entry, dtype, tuple(int(side) for side in shape), bool(fortran), offset)
