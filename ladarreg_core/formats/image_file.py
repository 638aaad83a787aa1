"""Pictures as files: their size is judged from the header before a pixel is decoded."""

from __future__ import annotations

import mmap
import struct
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.arrays import ByteArray
from ladarreg_core.errors import FormatError
from ladarreg_core.formats.budget import PIXELS_PER_BYTE, ReadBudget
from ladarreg_core.formats.untrusted import one_line

if TYPE_CHECKING:
    from PIL.Image import Image

# Only decoders that run inside this process: others start programs on what the file says.
_PIL_FORMATS = ("PNG", "JPEG", "TIFF", "WEBP", "BMP", "PPM", "GIF", "JPEG2000")
_LARGEST_PIXELS = 178_000_000  # where Pillow itself stops
_MOST_PASSED = 200_000_000  # pixels times passes of a JPEG that are taken from a file of any size
_BAND_PIXELS = 4_000_000
# Memory for each pixel at the peak of a read, from the file to a photograph or a plane of a scan; as measured.
_BYTES_PER_PIXEL = {"L": 8.0, "RGB": 9.5, "1": 8.0, "F": 26.0, "I": 26.0}
_OTHER_BYTES = 14.0  # a palette, transparency, ink: turned into RGB in a copy
_COEFFICIENT_BYTES = 2  # a progressive JPEG is held whole before it becomes pixels
_START_OF_SCAN = b"\xff\xda"
_MAGICS = (
    (b"\x89PNG\r\n\x1a\n", "PNG"),
    (b"\xff\xd8\xff", "JPEG"),
    (b"II*\x00", "TIFF"),
    (b"MM\x00*", "TIFF"),
    (b"BM", "BMP"),
    (b"GIF8", "GIF"),
    (b"\x00\x00\x00\x0cjP  ", "JPEG 2000"),
    (b"P5", "PGM"),
    (b"P6", "PPM"),
)


def image_format(head: bytes) -> str | None:
    """Return the format whose first bytes these are, or None for no picture."""
    for magic, name in _MAGICS:
        if head.startswith(magic):
            return None if name in ("PGM", "PPM") and not head[2:3].isspace() else name
    return "WebP" if head[:4] == b"RIFF" and head[8:12] == b"WEBP" else None


@dataclass(frozen=True, slots=True, eq=False)
class ImageData:
    """A decoded picture, as it stands in the file."""

    values: NDArray[Any]
    """(H, W) or (H, W, 3); uint8, uint16, int32 or float32."""
    format: str
    """`PNG`, `JPEG`, ..."""
    exif: Mapping[int, Any] = field(default_factory=dict)
    """EXIF and TIFF tags by number."""


def read_image(path: Path, *, budget: ReadBudget | None = None) -> ImageData:
    """Decode a picture whole; a truncated one is an error.

    Args:
        path: a file that exists.
        budget: what reading it may cost; None: what a file of its size may.

    Raises:
        FormatError: if it is no picture of a known format, too large, or damaged.
    """
    from PIL import Image, UnidentifiedImageError

    with open(path, "rb") as stream:
        if stream.read(12)[4:12] in (b"ftypheic", b"ftypheix", b"ftypmif1", b"ftypavif"):
            raise FormatError("it is a HEIC or AVIF picture, which is not read; convert it to JPEG or PNG")
        stream.seek(0)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Pillow warns of large pictures; they are judged here
            try:
                with Image.open(stream, formats=_PIL_FORMATS) as image:
                    _judge(image, path, budget or ReadBudget.of(path.stat().st_size))
                    image.load()
                    return ImageData(_values_of(image), image.format or "picture", _tags_of(image))
            except UnidentifiedImageError:
                raise FormatError("it is no picture that can be read; give a PNG, JPEG, TIFF, WebP or BMP") from None
            except Image.DecompressionBombError:
                raise FormatError(f"it claims more than {_LARGEST_PIXELS:,} pixels; scale it down") from None
            except (OSError, SyntaxError, ValueError, EOFError) as error:
                reason = one_line(error, 100)
                raise FormatError(f"the picture is damaged or cut off ({reason}); copy or export it again") from error


def _judge(image: Image, path: Path, budget: ReadBudget) -> None:
    """Refuse a picture, by its header, that would take too much memory or time."""
    width, height = image.size
    if not 1 <= width * height <= _LARGEST_PIXELS:
        raise FormatError(
            f"the picture claims {width:,} x {height:,} pixels; between 1 and {_LARGEST_PIXELS:,} are read"
        )
    if image.format == "JPEG2000":
        _judge_codestream(image, path)
    mode = "I" if image.mode.startswith("I;16") else image.mode
    needed = _BYTES_PER_PIXEL.get(mode, _OTHER_BYTES)
    if image.format not in ("JPEG", "PNG", "PPM", "BMP"):  # whole strips and frames are unpacked beside the picture
        needed += _OTHER_BYTES
    if image.info.get("progressive"):
        needed = max(needed, 4.3 + _COEFFICIENT_BYTES * len(image.getbands()))
    budget.require_pixels(width, height, needed)
    passed = width * height * _passes_of(image, path)
    if passed > max(_MOST_PASSED, PIXELS_PER_BYTE * budget.file_bytes):
        raise FormatError(
            f"the JPEG of {width:,} x {height:,} pixels has {passed // (width * height):,} passes in "
            f"{budget.file_bytes:,} bytes; it is damaged or no honest file: export it again"
        )


def _passes_of(image: Image, path: Path) -> int:
    """Return how often a JPEG goes over its pixels: a progressive one may do so in passes of a few bytes each."""
    if image.format != "JPEG":
        return 1
    with open(path, "rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
        count, at = 0, data.find(_START_OF_SCAN)
        while at >= 0:
            count, at = count + 1, data.find(_START_OF_SCAN, at + 2)
    # A colour picture may hold its channels one by one, which is no pass more.
    return max(1, count // len(image.getbands()))


def _judge_codestream(image: Image, path: Path) -> None:
    """Refuse a JPEG 2000 whose data are of another size than its header says: room is made for what the data say."""
    with open(path, "rb") as stream:
        head = stream.read(1 << 16)
    at = head.find(b"\xff\x4f\xff\x51")
    if at < 0 or len(head) < at + 42:
        raise FormatError("the JPEG 2000 picture's data begin nowhere; convert it to PNG")
    right, bottom, left, top = struct.unpack_from(">4I", head, at + 8)
    channels = struct.unpack_from(">H", head, at + 40)[0]
    if (right - left, bottom - top) != image.size or channels > 4:
        raise FormatError(
            f"the JPEG 2000 picture's header says {image.width:,} x {image.height:,} pixels, its data "
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
    """Return a picture's values, turned into a mode, in bands: whole they would be held three times over."""
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
    except Exception:  # tags are a courtesy: a damaged block must not cost the picture
        return {}


def as_rgb(values: NDArray[Any]) -> tuple[ByteArray, str | None]:
    """Return a picture as (H, W, 3) uint8, and a note on how deep pixels were made shallow, if they were.

    16-bit pixels are shifted by as many bits as their largest value needs less than 8: 12-bit pictures in 16-bit files
    would be black otherwise.

    Raises:
        FormatError: if it has no finite pixel.
    """
    note = None
    if values.dtype == np.uint16:
        bits = max(8, int(values.max(initial=0)).bit_length())
        values = (values >> (bits - 8)).astype(np.uint8)
        note = f"16-bit pixels, {bits} bits used, shown in 8"
    elif values.dtype != np.uint8:
        finite = np.isfinite(values)
        if not finite.any():
            raise FormatError("the picture has no finite pixel; export it again")
        low, high = float(values[finite].min()), float(values[finite].max())
        scale = 255 / (high - low) if high > low else 0.0
        values = np.where(finite, (values.astype(np.float64) - low) * scale, 0).round().astype(np.uint8)
        note = f"pixel values from {low:g} to {high:g}, stretched to 8 bits"
    if values.ndim == 2:
        values = np.repeat(values[..., None], 3, axis=-1)
    return np.ascontiguousarray(values), note
