"""The forms in which a picture is sent: exact, quick (small and lossy, for a slow link), and exact parts of it."""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import OptionError

QUICK_PX = 800
"""The longer side of a quick picture; about the width of a pane."""
SMALL_PX = 160
"""The longer side of a small picture, as in the list of photographs."""
PART_PX = 256
"""The side of a part, pixels of its level."""
FORMS = ("exact", "quick", "small")
_QUALITIES = (70, 80, 90)
_MAX_ERROR = 4.0
"""RMS error of the brightness of a quick picture, levels of 255: about the noise of a camera, and hardly visible."""
_JPEG_ABOVE_PIXELS = 2_500_000
_JPEG_QUALITY = 93
_MAX_LEVEL = 12
_MAX_DIGITS = 6


@dataclass(frozen=True, slots=True)
class EncodedPicture:
    """A picture as it is sent."""

    data: bytes
    """PNG, JPEG or WebP."""
    media_type: str
    """For example `image/png`."""


def exact(pixels: NDArray[np.uint8], *, natural: bool = False) -> EncodedPicture:
    """Return the whole picture as PNG; a large natural one, for which PNG is a poor choice, as JPEG of high quality.

    Args:
        pixels: (h, w, 3) or (h, w, 4) uint8, RGB or RGBA.
        natural: whether it is a photograph.
    """
    if natural and pixels.shape[0] * pixels.shape[1] > _JPEG_ABOVE_PIXELS:
        return _saved(pixels, "JPEG", quality=_JPEG_QUALITY, subsampling=0)
    return _saved(pixels, "PNG", compress_level=1)


def small(pixels: NDArray[np.uint8]) -> EncodedPicture:
    """Return a picture of at most `SMALL_PX`, as WebP."""
    return _saved(_at_most(pixels, SMALL_PX), "WEBP", quality=_QUALITIES[0], method=2)


def quick(pixels: NDArray[np.uint8]) -> EncodedPicture:
    """Return a picture of at most `QUICK_PX`, as WebP of the lowest quality whose error is hardly visible."""
    small = _at_most(pixels, QUICK_PX)
    has_alpha = small.shape[2] == 4
    bgr = cv2.cvtColor(small, cv2.COLOR_RGBA2BGRA if has_alpha else cv2.COLOR_RGB2BGR)
    gray = cv2.cvtColor(bgr, cv2.COLOR_BGRA2GRAY if has_alpha else cv2.COLOR_BGR2GRAY)
    for quality in _QUALITIES:
        _, data = cv2.imencode(".webp", bgr, [cv2.IMWRITE_WEBP_QUALITY, quality])
        again = cv2.cvtColor(np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR)), cv2.COLOR_BGR2GRAY)
        if cv2.norm(again, gray) <= _MAX_ERROR * np.sqrt(gray.size):
            break
    return EncodedPicture(data.tobytes(), "image/webp")


def _at_most(pixels: NDArray[np.uint8], longest_px: int) -> NDArray[np.uint8]:
    """Return a picture whose longer side is at most `longest_px`."""
    height, width = pixels.shape[:2]
    share = min(1.0, longest_px / max(height, width))
    size = max(1, round(width * share)), max(1, round(height * share))
    return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA) if share < 1 else pixels, dtype=np.uint8)


def reduced(pixels: NDArray[np.uint8], level: int) -> NDArray[np.uint8]:
    """Return a picture of half the size, `level` times; sides are rounded up."""
    for _ in range(level):
        half = (pixels.shape[1] + 1) // 2, (pixels.shape[0] + 1) // 2
        pixels = np.asarray(cv2.resize(pixels, half, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    return pixels


def level_column_row(text: str) -> tuple[int, int, int]:
    """Return the three numbers of a part, `LEVEL.COLUMN.ROW`.

    Raises:
        OptionError: if there are not three, or the level is too high.
    """
    words = text.split(".")
    if len(words) != 3 or not all(word.isdecimal() and len(word) <= _MAX_DIGITS for word in words):
        raise OptionError(f"the part is {text[:40]!r}; give LEVEL.COLUMN.ROW, three whole numbers")
    level, column, row = (int(word) for word in words)
    if level > _MAX_LEVEL:
        raise OptionError(f"the part is of level {level}; the highest is {_MAX_LEVEL}")
    return level, column, row


def part(pixels: NDArray[np.uint8], column: int, row: int) -> EncodedPicture:
    """Return one square of a reduced picture, as lossless WebP; squares at the border are smaller.

    Raises:
        OptionError: if it lies outside.
    """
    square = pixels[row * PART_PX : (row + 1) * PART_PX, column * PART_PX : (column + 1) * PART_PX]
    if square.size == 0:
        raise OptionError(f"the part in column {column}, row {row} lies outside of the picture")
    return _saved(np.ascontiguousarray(square), "WEBP", lossless=True, method=1, quality=20, exact=True)


def _saved(pixels: NDArray[np.uint8], name: str, **options: Any) -> EncodedPicture:
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, name, **options)
    return EncodedPicture(buffer.getvalue(), f"image/{name.lower()}")
