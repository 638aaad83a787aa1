"""Image files; their size is checked from the header before a pixel is decoded."""

from __future__ import annotations

import importlib
import mmap
import struct
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import FormatError
from ladarreg_core.formats.parsing.budget import PIXELS_PER_BYTE, ReadBudget
from ladarreg_core.formats.parsing.untrusted import one_line
from ladarreg_core.formats.photos.tiff_file import tiff_facts, tiff_size, tiff_values
from ladarreg_core.foundations.arrays import ByteArray
from ladarreg_core.foundations.opened_image import MAX_PIXELS, opened_image
from ladarreg_core.foundations.temperatures import TemperatureUnit

if TYPE_CHECKING:
    from PIL.Image import Image

# Only decoders that run inside this process: others start external programs on the file's content.
_PIL_FORMATS = ("PNG", "JPEG", "TIFF", "WEBP", "BMP", "PPM", "GIF", "JPEG2000", "AVIF")
_MAX_PASSED = 200_000_000  # pixels times passes of a JPEG that are accepted from a file of any size
_BAND_PIXELS = 4_000_000
# Measured peak memory per pixel of a read, from the file to a photograph or a channel of a scan.
_BYTES_PER_PIXEL = {"L": 8.0, "RGB": 9.5, "1": 8.0, "F": 26.0, "I": 26.0}
_OTHER_BYTES = 14.0  # palettes, transparency and CMYK are converted to RGB in a copy
_COEFFICIENT_BYTES = 2  # all coefficients of a progressive JPEG are held until it is decoded
_START_OF_SCAN = b"\xff\xda"
_MAGICS = (
    (b"\x89PNG\r\n\x1a\n", "PNG"),
    (b"\xff\xd8\xff", "JPEG"),
    (b"II*\x00", "TIFF"),
    (b"MM\x00*", "TIFF"),
    (b"II+\x00", "TIFF"),
    (b"MM\x00+", "TIFF"),
    (b"BM", "BMP"),
    (b"GIF8", "GIF"),
    (b"\x00\x00\x00\x0cjP  ", "JPEG 2000"),
    (b"P5", "PGM"),
    (b"P6", "PPM"),
)


_AVIF_BRANDS = (b"avif", b"avis")
_HEIC_BRANDS = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1")


def image_format(head: bytes) -> str | None:
    """Return the image format that these first bytes belong to; None where they belong to no image."""
    for magic, name in _MAGICS:
        if head.startswith(magic):
            return None if name in ("PGM", "PPM") and not head[2:3].isspace() else name
    if head[4:8] == b"ftyp":
        brands = [head[k : k + 4] for k in (8, *range(16, min(int.from_bytes(head[:4], "big"), 64), 4))]
        if any(brand in _AVIF_BRANDS for brand in brands):
            return "AVIF"
        if any(brand in _HEIC_BRANDS for brand in brands):
            return "HEIC"
    return "WebP" if head[:4] == b"RIFF" and head[8:12] == b"WEBP" else None


@dataclass(frozen=True, slots=True, eq=False)
class ImageData:
    """A decoded image, as stored in the file."""

    values: NDArray[Any]
    """(H, W) or (H, W, 3); uint8, uint16, int32 or float32."""
    format: str
    """`PNG`, `JPEG`, ..."""
    exif: Mapping[int, Any] = field(default_factory=dict)
    """EXIF and TIFF tags by number."""
    notes: tuple[str, ...] = ()
    """Remarks on what was left out or converted."""
    temperature_unit: TemperatureUnit | None = None
    """`K` or `C` where the file says that its pixels are temperatures."""
    xmp: bytes = b""
    """The XMP packet, unchecked; empty: none."""


def require_image(path: Path) -> None:
    """Decode an image file, and keep nothing of it.

    Raises:
        FormatError: as `read_image`.
    """
    read_image(path)


def read_image(path: Path, *, budget: ReadBudget | None = None) -> ImageData:
    """Decode a complete image; a truncated one is an error.

    Args:
        path: an existing file.
        budget: memory limits; None: the default for a file of its size.

    Raises:
        FormatError: if it is not an image of a known format, is too large, or is damaged.
    """
    budget = budget or ReadBudget.of(path.stat().st_size)
    with open(path, "rb") as stream:
        kind = image_format(stream.read(64))
    if kind == "TIFF":
        return _read_tiff(path, budget)
    return _read_by_pillow(path, budget, _formats_for(kind))


def _formats_for(kind: str | None) -> tuple[str, ...]:
    """Return the names of Pillow's readers; HEIC needs one that the user has installed."""
    if kind != "HEIC":
        return _PIL_FORMATS
    try:
        heif = importlib.import_module("pillow_heif")
    except ImportError:
        raise FormatError(
            "it is a HEIC image, which needs the package pillow-heif (pip install pillow-heif); or export it as JPEG, "
            "which phones offer as 'Most compatible'"
        ) from None
    heif.register_heif_opener(thumbnails=False)
    return ("HEIF",)


def _read_tiff(path: Path, budget: ReadBudget) -> ImageData:
    """Decode a TIFF by Pillow where that loses nothing, or else by tifffile."""
    facts = tiff_facts(path)
    notes = ["it has several pages; the first one is read"] if facts.pages > 1 else []
    read = None
    if facts.is_plain or not facts.is_decodable:
        try:
            read = _read_by_pillow(path, budget, ("TIFF",))
        except _UnknownImageError:
            if not facts.is_decodable:
                raise FormatError(
                    f"its compression, {facts.compression}, cannot be read with these pixels; save it without "
                    "compression or with Deflate (ZIP)"
                ) from None
    if read is not None:
        return ImageData(read.values, "TIFF", read.exif, tuple(notes), facts.unit)
    values, more = tiff_values(path, budget)
    return ImageData(values, "TIFF", _tags_in(path), (*notes, *more), facts.unit)


class _UnknownImageError(FormatError):
    """Pillow has no decoder for an image."""


def _read_by_pillow(path: Path, budget: ReadBudget, formats: tuple[str, ...]) -> ImageData:
    from PIL import Image, UnidentifiedImageError

    with open(path, "rb") as stream:
        try:
            with opened_image(stream, formats) as image:
                _check_size(image, path, budget)
                image.load()
                return ImageData(_values_of(image), image.format or "image", _tags_of(image), xmp=_xmp_of(image))
        except UnidentifiedImageError:
            raise _UnknownImageError(
                "it is not an image that can be read; give a PNG, JPEG, TIFF, WebP, AVIF or BMP"
            ) from None
        except Image.DecompressionBombError:
            raise FormatError(f"it claims more than {MAX_PIXELS:,} pixels; scale it down") from None
        except (OSError, SyntaxError, ValueError, EOFError) as error:
            reason = one_line(error, 100)
            raise FormatError(f"the image is damaged or truncated ({reason}); copy or export it again") from error


def _tags_in(path: Path) -> dict[int, Any]:
    """Return the tags of a TIFF that Pillow may not decode; none if it cannot even open it."""
    from PIL import Image

    try:
        with open(path, "rb") as stream:
            exif = Image.Exif()
            exif.load_from_fp(stream)
            return {**dict(exif), **dict(exif.get_ifd(0x8769))}
    except Exception:  # an orientation and a focal length are optional
        return {}


def image_size(path: Path) -> tuple[int, int, str]:
    """Return (width, height, format) from an image's header.

    Raises:
        FormatError: if it is not an image.
    """

    with _header_of(path) as kind:
        if kind == "TIFF":
            return *tiff_size(path), "TIFF"
        with opened_image(path, _formats_for(kind)) as image:
            return image.width, image.height, image.format or "image"


def image_header(path: Path) -> tuple[tuple[int, int], dict[int, Any]]:
    """Return (width, height) and the EXIF tags from an image's header, without decoding it.

    Raises:
        FormatError: if it is not an image.
    """
    with _header_of(path) as kind:
        if kind == "TIFF":
            return tiff_size(path), _tags_in(path)
        with opened_image(path, _formats_for(kind)) as image:
            return image.size, _tags_of(image)


@contextmanager
def _header_of(path: Path) -> Iterator[str | None]:
    """Give the kind of an image, and turn what goes wrong with its header into a `FormatError`."""
    try:
        with open(path, "rb") as stream:
            kind = image_format(stream.read(64))
        yield kind
    except FormatError:
        raise
    except Exception as error:
        raise FormatError(f"the image's header cannot be read ({one_line(error, 100)})") from error


def _check_size(image: Image, path: Path, budget: ReadBudget) -> None:
    """Refuse an image whose header shows that it would take too much memory or time."""
    width, height = image.size
    if not 1 <= width * height <= MAX_PIXELS:
        raise FormatError(f"the image claims {width:,} x {height:,} pixels; between 1 and {MAX_PIXELS:,} are read")
    if image.format == "JPEG2000":
        _check_codestream(image, path)
    mode = "I" if image.mode.startswith("I;16") else image.mode
    needed = _BYTES_PER_PIXEL.get(mode, _OTHER_BYTES)
    if image.format not in ("JPEG", "PNG", "PPM", "BMP"):  # whole strips and frames are decoded in addition
        needed += _OTHER_BYTES
    if image.info.get("progressive"):
        needed = max(needed, 4.3 + _COEFFICIENT_BYTES * len(image.getbands()))
    budget.require_pixels(width, height, needed)
    passed = width * height * _passes_of(image, path)
    if passed > max(_MAX_PASSED, PIXELS_PER_BYTE * budget.file_bytes):
        raise FormatError(
            f"the JPEG of {width:,} x {height:,} pixels has {passed // (width * height):,} passes in "
            f"{budget.file_bytes:,} bytes; it is damaged or malicious: export it again"
        )


def _passes_of(image: Image, path: Path) -> int:
    """Return the number of passes over a JPEG's pixels; those of a progressive one may be a few bytes each."""
    if image.format != "JPEG":
        return 1
    with open(path, "rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
        count, at = 0, data.find(_START_OF_SCAN)
        while at >= 0:
            count, at = count + 1, data.find(_START_OF_SCAN, at + 2)
    # A colour image may store its channels in separate scans, which together are one pass.
    return max(1, count // len(image.getbands()))


def _check_codestream(image: Image, path: Path) -> None:
    """Refuse a JPEG 2000 whose codestream and header differ in size: memory is allocated for the codestream's size."""
    with open(path, "rb") as stream:
        head = stream.read(1 << 16)
    at = head.find(b"\xff\x4f\xff\x51")
    if at < 0 or len(head) < at + 42:
        raise FormatError("the JPEG 2000 image has no codestream; convert it to PNG")
    right, bottom, left, top = struct.unpack_from(">4I", head, at + 8)
    channels = struct.unpack_from(">H", head, at + 40)[0]
    if (right - left, bottom - top) != image.size or channels > 4:
        raise FormatError(
            f"the JPEG 2000 image's header says {image.width:,} x {image.height:,} pixels, its data "
            f"{right - left:,} x {bottom - top:,} of {channels} channels; it is damaged: convert it to PNG"
        )


def _values_of(image: Image) -> NDArray[Any]:
    mode = image.mode
    if mode in ("L", "RGB", "F"):
        return _pixels(image, np.float32 if mode == "F" else np.uint8)
    if mode.startswith("I;16"):
        return _pixels(image, np.uint16)
    if mode == "I":
        values = _pixels(image, np.int32)
        fits = values.min(initial=0) >= 0 and values.max(initial=0) < 1 << 16
        return values.astype(np.uint16) if fits else values
    return _pixels(image, np.uint8, "L" if mode in ("1", "LA", "La") else "RGB")


def _pixels(image: Image, dtype: Any, mode: str | None = None) -> NDArray[Any]:
    """Return an image's values, converted to a mode band by band: all at once would take three times the memory."""
    channels = 3 if (mode or image.mode) == "RGB" else 1
    values = np.empty((image.height, image.width, channels), dtype)
    rows = max(1, _BAND_PIXELS // image.width)
    for top in range(0, image.height, rows):
        band = image.crop((0, top, image.width, min(top + rows, image.height)))
        values[top : top + rows] = np.asarray(band.convert(mode) if mode else band).reshape(-1, image.width, channels)
    return values if channels == 3 else values[..., 0]


def _tags_of(image: Image) -> dict[int, Any]:
    try:
        exif = image.getexif()
        return {**dict(exif), **dict(exif.get_ifd(0x8769))}
    except Exception:  # tags are optional: a damaged block must not make the image unreadable
        return {}


def _xmp_of(image: Image) -> bytes:
    found = image.info.get("xmp") or image.info.get("XML:com.adobe.xmp") or b""
    return found.encode("utf-8", "replace") if isinstance(found, str) else found if isinstance(found, bytes) else b""


def as_rgb(values: NDArray[Any]) -> tuple[ByteArray, str | None]:
    """Return an image as (H, W, 3) uint8, and a note on the conversion to 8 bits, if there was one.

    16-bit pixels are shifted by the number of bits that their largest value has beyond 8; a fixed shift would make
    12-bit images in 16-bit files black.

    Raises:
        FormatError: if no pixel is finite.
    """
    note = None
    if values.dtype == np.uint16:
        bits = max(8, int(values.max(initial=0)).bit_length())
        values = (values >> (bits - 8)).astype(np.uint8)
        note = f"16-bit pixels, {bits} bits used, converted to 8"
    elif values.dtype != np.uint8:
        finite = np.isfinite(values)
        if not finite.any():
            raise FormatError("the image has no finite pixel; export it again")
        low, high = float(values[finite].min()), float(values[finite].max())
        scale = 255 / (high - low) if high > low else 0.0
        values = np.where(finite, (values.astype(np.float64) - low) * scale, 0).round().astype(np.uint8)
        note = f"pixel values from {low:g} to {high:g}, stretched to 8 bits"
    if values.ndim == 2:
        values = np.repeat(values[..., None], 3, axis=-1)
    return np.ascontiguousarray(values), note
