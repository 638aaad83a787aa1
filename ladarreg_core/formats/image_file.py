"""Pictures as files: their size is judged from the header before a pixel is decoded."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.arrays import ByteArray
from ladarreg_core.errors import FormatError
from ladarreg_core.formats.untrusted import one_line

if TYPE_CHECKING:
    from PIL.Image import Image

# Only decoders that run inside this process: others start programs on what the file says.
_PIL_FORMATS = ("PNG", "JPEG", "TIFF", "WEBP", "BMP", "PPM", "GIF", "JPEG2000")
_LARGEST_PIXELS = 178_000_000  # where Pillow itself stops
_SUSPICIOUS_PIXELS = 20_000_000
_PIXELS_PER_BYTE = 2500
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


def read_image(path: Path) -> ImageData:
    """Decode a picture whole; a truncated one is an error.

    Args:
        path: a file that exists.

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
                    _judge_size(image.size, path.stat().st_size)
                    image.load()
                    return ImageData(_values_of(image), image.format or "picture", _tags_of(image))
            except UnidentifiedImageError:
                raise FormatError("it is no picture that can be read; give a PNG, JPEG, TIFF, WebP or BMP") from None
            except Image.DecompressionBombError:
                raise FormatError(f"it claims more than {_LARGEST_PIXELS:,} pixels; scale it down") from None
            except (OSError, SyntaxError, ValueError, EOFError) as error:
                reason = one_line(error, 100)
                raise FormatError(f"the picture is damaged or cut off ({reason}); copy or export it again") from error


def image_size(path: Path) -> tuple[int, int, str]:
    """Return (width, height, format) from a picture's header.

    Raises:
        FormatError: if it is no picture.
    """
    from PIL import Image

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            with Image.open(path, formats=_PIL_FORMATS) as image:
                return image.width, image.height, image.format or "picture"
        except Exception as error:
            raise FormatError(f"the picture's header cannot be read ({one_line(error, 100)})") from error


def _judge_size(size: tuple[int, int], file_bytes: int) -> None:
    width, height = size
    pixels = width * height
    if pixels < 1 or pixels > _LARGEST_PIXELS:
        raise FormatError(
            f"the picture claims {width:,} x {height:,} pixels; between 1 and {_LARGEST_PIXELS:,} are read"
        )
    if pixels > _SUSPICIOUS_PIXELS and pixels > _PIXELS_PER_BYTE * file_bytes:
        raise FormatError(
            f"the picture claims {width:,} x {height:,} pixels in {file_bytes:,} bytes; it is cut off or no honest file"
        )


def _values_of(image: Image) -> NDArray[Any]:
    mode = image.mode
    if mode in ("L", "RGB"):
        return np.array(image)
    if mode.startswith("I;16"):
        return np.array(image).astype(np.uint16)
    if mode == "I":
        values = np.array(image)
        fits = values.min(initial=0) >= 0 and values.max(initial=0) < 1 << 16
        return values.astype(np.uint16) if fits else values.astype(np.int32)
    if mode == "F":
        return np.array(image, dtype=np.float32)
    if mode in ("1", "LA", "La"):
        return np.array(image.convert("L"))
    return np.array(image.convert("RGB"))


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
