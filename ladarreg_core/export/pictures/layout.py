"""Layout of image sheets: blocks of text, badges and images as RGB arrays, arranged in rows and columns."""

from __future__ import annotations

import unicodedata
from collections.abc import Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import DependencyError
from ladarreg_core.foundations.arrays import ByteArray
from ladarreg_core.foundations.palette import BACKGROUND, INK, Color

if TYPE_CHECKING:
    from PIL.ImageFont import FreeTypeFont

Align = Literal["left", "centre", "right"]


_LINE_HEIGHT = 1.36
_NEAREST_FROM = 9
_REPLACEMENTS = {"\u2013": "-", "\u2014": "-", "\u2212": "-", "\u00d7": "x", "\u00df": "ss", "\u00b5": "u"}


def legible(text: str) -> str:
    """Return the text in characters of the font: accents are dropped, other unknown characters become '?'."""
    text = " ".join(text.split())
    if text.isascii() and text.isprintable():
        return text
    shown: list[str] = []
    for letter in unicodedata.normalize("NFC", text):
        letter = _REPLACEMENTS.get(letter, letter)
        if letter in "\u00b0\u00b7\u00b1\u2026" or letter.isascii():
            shown.append(letter if letter.isprintable() else "?")
            continue
        bare = "".join(c for c in unicodedata.normalize("NFKD", letter) if c.isascii() and c.isprintable()).strip()
        shown.append(bare or "?")
    return "".join(shown)


def text_width(text: str, *, size: int) -> float:
    """Return the width of a text, pixels."""
    return float(_font(size).getlength(legible(text)))


def shortened(text: str, *, size: int, width: float) -> str:
    """Return the text, truncated with an ellipsis if it is wider than `width` pixels."""
    text = legible(text)
    if text_width(text, size=size) <= width:
        return text
    low, high = 0, len(text)
    while low < high:  # the longest prefix that fits
        middle = (low + high + 1) // 2
        if text_width(text[:middle].rstrip() + "\u2026", size=size) <= width:
            low = middle
        else:
            high = middle - 1
    return text[:low].rstrip() + "\u2026"


def wrapped(text: str, *, size: int, width: float, lines: int) -> list[str]:
    """Return the text wrapped to lines of at most `width` pixels; an ellipsis replaces what exceeds the last line."""
    words = legible(text).split()
    result: list[str] = []
    while words and len(result) < lines - 1:
        count = len(words)
        while count > 1 and text_width(" ".join(words[:count]), size=size) > width:
            count -= 1
        result.append(shortened(" ".join(words[:count]), size=size, width=width))
        words = words[count:]
    if words:
        result.append(shortened(" ".join(words), size=size, width=width))
    return result


def text_block(
    text: str,
    *,
    size: int,
    width: int | None = None,
    lines: int = 1,
    color: Color = INK,
    ground: Color = BACKGROUND,
    weight: float = 0.0,
    align: Align = "left",
) -> NDArray[np.uint8]:
    """Return a text on a uniform background.

    Args:
        text: the text.
        size: font size, pixels.
        width: width of the block, to which the text is wrapped or truncated. None: as wide as the text.
        lines: largest number of lines.
        colour: text colour.
        ground: background colour.
        weight: additional stroke width, pixels.
        align: horizontal alignment within the block.

    Returns:
        (H, W, 3) uint8 RGB.
    """
    from PIL import Image, ImageDraw

    full = int(np.ceil(text_width(text, size=size) + weight)) if width is None else width
    rows = wrapped(text, size=size, width=full - weight, lines=lines) or [""]
    height = round(size * _LINE_HEIGHT)
    image = Image.new("RGB", (max(full, 1), height * len(rows)), ground)
    draw, font = ImageDraw.Draw(image), _font(size)
    for number, row in enumerate(rows):
        spare = full - weight - text_width(row, size=size)
        x = {"left": 0.0, "centre": spare / 2, "right": spare}[align]
        # Aligned at the baseline, not the bounding box, so that neighbouring blocks line up.
        y = height * number + height * 0.74
        for shift in (0.0, weight) if weight else (0.0,):
            draw.text((x + shift, y), row, font=font, fill=color, anchor="ls")
    return np.array(image, dtype=np.uint8)


def chip(text: str, *, size: int, color: Color, ground: Color, under: Color) -> NDArray[np.uint8]:
    """Return a badge: a text in a rounded box with a border of the same colour."""
    words = text_block(text, size=size, color=color, ground=ground, weight=0.4)
    return boxed(words, pad=(round(size * 0.14), round(size * 0.6)), ground=ground, line=color, under=under, radius=8)


def boxed(
    block: ByteArray, *, pad: tuple[int, int], ground: Color, line: Color, under: Color, radius: int
) -> NDArray[np.uint8]:
    """Return a block in a box with rounded corners and `pad` pixels (vertical, horizontal) of padding."""
    result = padded(block, top=pad[0], bottom=pad[0], left=pad[1], right=pad[1], ground=ground)
    height, width = result.shape[:2]
    radius = min(radius, height // 2, width // 2)
    half = np.array([height, width]) / 2
    y = np.abs(np.arange(height) + 0.5 - half[0])[:, None] - half[0]
    x = np.abs(np.arange(width) + 0.5 - half[1])[None] - half[1]
    middle = slice(radius, height - radius)
    # Only the strips along the sides differ from the plain ground.
    for rows, columns in (
        (slice(0, radius), slice(None)),
        (slice(height - radius, height), slice(None)),
        (middle, slice(0, radius)),
        (middle, slice(width - radius, width)),
    ):
        dy, dx = y[rows], x[:, columns]
        rounded = np.hypot(np.maximum(dy + radius, 0), np.maximum(dx + radius, 0)) - radius
        outside = np.where((dy > -radius) & (dx > -radius), rounded, np.maximum(dy, dx))  # signed distance, pixels
        rim, gone = np.clip(outside + 2.0, 0, 1)[..., None], np.clip(outside + 0.5, 0, 1)[..., None]
        drawn = result[rows, columns] * (1 - rim) + np.array(line) * rim
        result[rows, columns] = np.rint(drawn * (1 - gone) + np.array(under) * gone)
    return result


def padded(
    block: ByteArray, *, top: int = 0, bottom: int = 0, left: int = 0, right: int = 0, ground: Color = BACKGROUND
) -> NDArray[np.uint8]:
    """Return a block with margins."""
    how = cv2.BORDER_CONSTANT
    return np.asarray(cv2.copyMakeBorder(block, top, bottom, left, right, how, value=ground), dtype=np.uint8)


def placed(
    block: ByteArray,
    *,
    width: int,
    height: int,
    ground: Color = BACKGROUND,
    align: Align = "centre",
    at_top: float = 0.5,
) -> NDArray[np.uint8]:
    """Return a block within a larger field; `at_top` is the fraction of the spare height above it."""
    spare = width - block.shape[1]
    left = {"left": 0, "centre": spare // 2, "right": spare}[align]
    above = round((height - block.shape[0]) * at_top)
    return padded(
        block, top=above, bottom=height - block.shape[0] - above, left=left, right=spare - left, ground=ground
    )


def stacked(blocks: Sequence[ByteArray], *, gap: int = 0, ground: Color = BACKGROUND) -> NDArray[np.uint8]:
    """Return blocks one below the other, aligned left."""
    width = max(block.shape[1] for block in blocks)
    rows = [padded(b, right=width - b.shape[1], bottom=gap, ground=ground) for b in blocks[:-1]]
    return np.concatenate([*rows, padded(blocks[-1], right=width - blocks[-1].shape[1], ground=ground)])


def beside(blocks: Sequence[ByteArray], *, gap: int = 0, ground: Color = BACKGROUND) -> NDArray[np.uint8]:
    """Return blocks side by side, aligned at the top."""
    height = max(block.shape[0] for block in blocks)
    columns = [padded(b, bottom=height - b.shape[0], right=gap, ground=ground) for b in blocks[:-1]]
    last = padded(blocks[-1], bottom=height - blocks[-1].shape[0], ground=ground)
    return np.concatenate([*columns, last], axis=1)


def fit_size(aspect: float, *, width: int, height: int) -> tuple[int, int]:
    """Return the largest (width, height), pixels, with a given aspect ratio (width / height) that fits a field."""
    w = min(float(width), height * aspect)
    return max(1, min(width, round(w))), max(1, min(height, round(w / aspect)))


def resized(picture: ByteArray, size: tuple[int, int]) -> NDArray[np.uint8]:
    """Return an image resized to (width, height) pixels: averaged if reduced, nearest neighbour if much enlarged."""
    growth = min(size[0] / picture.shape[1], size[1] / picture.shape[0])
    how = cv2.INTER_AREA if growth < 1 else cv2.INTER_CUBIC if growth < _NEAREST_FROM else cv2.INTER_NEAREST
    return np.asarray(cv2.resize(picture, size, interpolation=how), dtype=np.uint8)


def framed(picture: ByteArray, color: Color, *, thickness: int = 2) -> NDArray[np.uint8]:
    """Return an image with a frame drawn over its outermost pixels."""
    result = np.array(picture, dtype=np.uint8)
    for side in (np.s_[:thickness], np.s_[-thickness:], np.s_[:, :thickness], np.s_[:, -thickness:]):
        result[side] = color
    return result


def with_mark(picture: ByteArray, mark: ByteArray, *, margin: int = 10) -> NDArray[np.uint8]:
    """Return an image with a mark over its lower left corner; it must be larger than the mark."""
    result = np.array(picture, dtype=np.uint8)
    bottom = result.shape[0] - margin
    result[bottom - mark.shape[0] : bottom, margin : margin + mark.shape[1]] = mark
    return result


@lru_cache(maxsize=32)
def _font(size: int) -> FreeTypeFont:
    from PIL import ImageFont

    try:
        font = ImageFont.load_default(size=size)
    except ImportError:
        font = None
    if not hasattr(font, "getlength"):
        raise DependencyError("Pillow was built without FreeType; reinstall it with pip, as a wheel")
    return font  # type: ignore[return-value]
