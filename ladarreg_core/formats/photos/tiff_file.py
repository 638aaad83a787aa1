"""TIFF images that Pillow reads with a loss or not at all: 16 bits in colour, floating point, planes apart, BigTIFF.

Nothing is decoded before its size is known: compressed strips and tiles are unpacked once into the void first, since
the decoders of Python would otherwise unpack as much as a file claims.
"""

from __future__ import annotations

import itertools
import math
import re
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import FormatError
from ladarreg_core.formats.parsing.budget import ReadBudget
from ladarreg_core.formats.parsing.untrusted import one_line
from ladarreg_core.foundations.temperatures import TemperatureUnit

_UNPACKED, _DEFLATED, _PACKBITS = (1,), (8, 32946), (32773,)
_MAX_SAMPLES = 16
_LARGEST_PIXELS = 400_000_000
_MAX_SEGMENTS = 2_000_000
_RAW_PHOTOMETRICS = (32803, 34892)  # colour filter array, linear raw
_DNG_VERSION, _DESCRIPTION, _GDAL_METADATA = 50706, 270, 42112
_MIN_IS_WHITE, _MIN_IS_BLACK, _RGB, _PALETTE, _SEPARATED = 0, 1, 2, 3, 5
_UNIT = re.compile(
    r"(?:unit\w*|temperature)[\"']?[^\w<]{0,6}(?:role=\"unittype\">|>)?\s*(kelvin|celsius|deg\w*\s*c|°\s*c|k|c)\b"
    r"|\b(kelvin|celsius|deg(?:rees)?[\s_]*c|°\s?c)\b",
    re.IGNORECASE,
)


@dataclass(frozen=True, slots=True)
class TiffFacts:
    """What the header of a TIFF says."""

    is_plain: bool
    """Whether its pixels are 8 bits, or gray of 16, which other decoders read without loss."""
    is_decodable: bool
    """Whether `tiff_values` can decode it."""
    compression: str
    """Name of its compression."""
    pages: int
    """1, or 2 if there are several."""
    unit: TemperatureUnit | None
    """`K` or `C` where its tags name a unit of temperature."""


def tiff_facts(path: Path) -> TiffFacts:
    """Return what the header of a TIFF says of its first page.

    Raises:
        FormatError: if it is damaged or the raw file of a camera.
    """
    with _opened(path) as tif:
        page = tif.pages[0]
        if page.tags.get(_DNG_VERSION) is not None or int(page.photometric) in _RAW_PHOTOMETRICS:
            raise FormatError("it is the raw file of a camera; develop it and export a TIFF or JPEG")
        # Pillow does not invert 16 bits where 0 is white.
        gray16 = page.dtype == np.uint16 and page.samplesperpixel == 1 and int(page.photometric) != _MIN_IS_WHITE
        plain = page.dtype is None or page.dtype in (np.uint8, np.bool_) or gray16
        return TiffFacts(
            is_plain=plain,
            is_decodable=_is_decodable(page),
            compression=_name(page.compression),
            pages=len(list(itertools.islice(tif.pages, 2))),
            unit=_unit_of(page),
        )


def tiff_size(path: Path) -> tuple[int, int]:
    """Return (width, height) of the first page, pixels."""
    with _opened(path) as tif:
        return int(tif.pages[0].imagewidth), int(tif.pages[0].imagelength)


def tiff_values(path: Path, budget: ReadBudget) -> tuple[NDArray[Any], list[str]]:
    """Decode the first page of a TIFF.

    Returns:
        (H, W) or (H, W, 3), of the type in the file, floating point as float32; and notes on conversions.

    Raises:
        FormatError: if it is damaged, would need too much memory, or has colours that are not read.
    """
    with _opened(path) as tif:
        page = tif.pages[0]
        _check(page, tif.filehandle, budget)
        values = np.asarray(page.asarray(maxworkers=1))
        axes, photometric, colormap = page.axes, int(page.photometric), page.colormap
    if axes == "SYX":
        values = np.moveaxis(values, 0, -1)
    elif axes not in ("YX", "YXS"):
        raise FormatError(
            f"its axes are {one_line(axes, 12)}; an image has rows, columns and colours: export one picture"
        )
    return _in_color(values, photometric, colormap)


def _opened(path: Path) -> Any:
    import tifffile

    try:
        tif = tifffile.TiffFile(path)
        if not len(tif.pages):
            tif.close()
            raise IndexError
    except (struct.error, IndexError) as error:
        raise FormatError("the TIFF is truncated: it ends before its first image; export it again") from error
    except (tifffile.TiffFileError, ValueError, KeyError, OverflowError, MemoryError) as error:
        raise FormatError(f"the TIFF is damaged ({one_line(error, 80)}); export it again") from error
    return tif


def _is_decodable(page: Any) -> bool:
    bits = page.bitspersample
    simple = (
        int(page.compression) in _UNPACKED + _DEFLATED + _PACKBITS
        and int(page.predictor) in (1, 2)
        and isinstance(bits, int)
        and bits in (8, 16, 32, 64)
        and page.dtype is not None
        and int(page.fillorder) == 1
    )
    return simple and not (int(page.predictor) == 2 and page.dtype.kind not in "iu")


def _check(page: Any, stream: BinaryIO, budget: ReadBudget) -> None:
    """Refuse an image whose header claims too much, or whose compressed data exceed what the header claims."""
    width, height, samples = int(page.imagewidth), int(page.imagelength), int(page.samplesperpixel)
    if not 1 <= width * height <= _LARGEST_PIXELS or int(page.imagedepth) != 1 or not 1 <= samples <= _MAX_SAMPLES:
        raise FormatError(
            f"the image claims {width:,} x {height:,} pixels of {samples:,} samples; at most "
            f"{_LARGEST_PIXELS:,} pixels of {_MAX_SAMPLES} samples are read: scale it down"
        )
    itemsize = page.dtype.itemsize
    budget.require_pixels(width, height, 3 * samples * itemsize + 26.0)
    chunk = math.prod(map(int, page.chunks)) * itemsize
    if chunk > 4 * max(width * height * samples * itemsize, 1 << 20):
        raise FormatError(f"its tiles claim {chunk:,} bytes each, more than the image; it is damaged: export it again")
    offsets, counts = page.dataoffsets, page.databytecounts
    wanted = math.prod(map(int, page.chunked))
    if len(offsets) != len(counts) or len(offsets) > _MAX_SEGMENTS or len(offsets) < wanted:
        raise FormatError(
            f"it has {len(offsets):,} strips or tiles where {wanted:,} are needed; it is truncated: export it again"
        )
    size = budget.file_bytes
    for offset, count in zip(offsets[:wanted], counts[:wanted], strict=True):
        if not (offset > 0 and count > 0 and offset + count <= size):
            raise FormatError("a strip or tile lies outside the file; it is truncated: copy or export it again")
        if int(page.compression) in _UNPACKED:
            continue
        stream.seek(offset)
        data = stream.read(count)
        if int(page.compression) in _DEFLATED:
            _require_inflated(data, chunk)
        elif 64 * count < chunk // 4 and 128 * count > 8 * chunk:
            raise FormatError("a strip is larger than the image; it is damaged: export it again")


def _require_inflated(data: bytes, most: int) -> None:
    unpacker = zlib.decompressobj()
    total, rest = 0, data
    while rest and not unpacker.eof:
        total += len(unpacker.decompress(rest, 1 << 20))
        rest = unpacker.unconsumed_tail
        if total > most:
            raise FormatError(f"a strip holds more than the {most:,} bytes that it may; it is damaged: export it again")


def _in_color(values: NDArray[Any], photometric: int, colormap: Any) -> tuple[NDArray[Any], list[str]]:
    notes: list[str] = []
    if values.dtype.kind == "f" or values.dtype.itemsize > 4:
        with np.errstate(over="ignore"):
            values = values.astype(np.float32)
    elif values.dtype in (np.int8, np.int16, np.uint32, np.int32):
        values = values.astype(np.float32 if values.dtype.itemsize == 4 else np.int32)
    if values.ndim == 3 and values.shape[2] == 1:
        values = values[..., 0]
    if photometric == _PALETTE and colormap is not None and values.ndim == 2 and values.dtype.kind == "u":
        table = np.asarray(colormap).T
        if values.max(initial=0) >= len(table):
            raise FormatError("a pixel lies outside the palette; the image is damaged: export it again")
        return (table >> 8).astype(np.uint8)[values], notes
    if photometric == _SEPARATED and values.ndim == 3 and values.shape[2] >= 4 and values.dtype.kind == "u":
        full = np.iinfo(values.dtype).max
        ink = values[..., :4].astype(np.float32) / np.float32(full)
        rgb = 255 * (1 - ink[..., :3]) * (1 - ink[..., 3:])
        return np.rint(rgb).astype(np.uint8), ["CMYK converted to RGB without a colour profile"]
    if photometric not in (_MIN_IS_WHITE, _MIN_IS_BLACK, _RGB):
        raise FormatError("its colours are neither gray, RGB, CMYK nor a palette; convert it to RGB")
    if values.ndim == 3:
        if photometric == _RGB and values.shape[2] >= 3:
            if values.shape[2] > 3:
                notes.append(f"the first 3 of {values.shape[2]} channels are used")
            return np.ascontiguousarray(values[..., :3]), notes
        notes.append(f"the first of {values.shape[2]} channels is used")
        values = np.ascontiguousarray(values[..., 0])
    if photometric == _MIN_IS_WHITE and values.dtype.kind == "u":
        values = np.iinfo(values.dtype).max - values
    return values, notes


def _unit_of(page: Any) -> TemperatureUnit | None:
    """Return the unit of temperature that a tag names, `K` or `C`; None if none does."""
    for number in (_GDAL_METADATA, _DESCRIPTION):
        tag = page.tags.get(number)
        text = tag.value if tag is not None else None
        found = _UNIT.search(text[:20_000]) if isinstance(text, str) else None
        if found:
            word = (found.group(1) or found.group(2)).casefold()
            return "K" if word.startswith("k") else "C"
    return None


def _name(compression: Any) -> str:
    return one_line(getattr(compression, "name", compression), 30)
