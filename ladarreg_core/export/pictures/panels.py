"""Panels of the contact sheet and the report: the scan with outlined windows, details with edges, marks on pictures."""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.export.pictures.detail import Window, cell_aspect, whole_window
from ladarreg_core.export.pictures.layout import fit_size, framed, padded, placed, resized, text_block, with_mark
from ladarreg_core.foundations.arrays import BoolArray, ByteArray
from ladarreg_core.foundations.palette import (
    ACCENT,
    BACKGROUND,
    BAD,
    BAD_GROUND,
    LINE,
    OK,
    OK_GROUND,
    WARN,
    WARN_GROUND,
    Color,
)
from ladarreg_core.scan import Scan
from ladarreg_core.surface.texture.registered_texture import intensity_picture

BADGES: dict[str, tuple[Color, Color]] = {
    "accepted": (OK, OK_GROUND),
    "not accepted": (WARN, WARN_GROUND),
    "no pose": (BAD, BAD_GROUND),
}
"""Ink and ground of a verdict's badge."""
_MARK_SIZE = 19
_SHARE_SHOWN = (1.0, 99.0)
_DARKEST, _BRIGHTEST, _MIN_CONTRAST = 18.0, 240.0, 12.0


def window_aspect(scan: Scan, window: Window) -> float:
    """Return the angular aspect ratio of a window, width / height."""
    return window.width * cell_aspect(scan) / window.height


def window_size(scan: Scan, window: Window, width: int, height: int) -> tuple[int, int]:
    """Return the largest (width, height), pixels, of a window in its angular aspect that fits a field."""
    return fit_size(window_aspect(scan, window), width=width, height=height)


def scan_panel(
    scan: Scan, size: tuple[int, int], windows: Iterable[tuple[Window | None, Color]] = ()
) -> NDArray[np.uint8]:
    """Return the scan's intensity in a size (width, height), with the outlines of windows in their colours."""
    picture = framed(resized(intensity_picture(scan), size), LINE)
    for window, color in windows:
        if window is None or window == whole_window(scan):
            continue
        x, y = size[0] / scan.shape[1], size[1] / scan.shape[0]
        first = (round(window.left * x), round(window.top * y))
        last = (round((window.left + window.width) * x) - 1, round((window.top + window.height) * y) - 1)
        cv2.rectangle(picture, first, last, BACKGROUND, 5)
        cv2.rectangle(picture, first, last, color, 2)
    return picture


def contrasted(picture: ByteArray) -> NDArray[np.uint8]:
    """Return a gray image (H, W, 3) whose contrast is stretched to its own: a dark part of a scan shows its details."""
    count = np.bincount(picture[..., 0].reshape(-1), minlength=256)
    count[0] = 0
    shown = np.cumsum(count)
    low, high = (float(np.searchsorted(shown, share / 100 * shown[-1])) for share in _SHARE_SHOWN)
    if high - low < _MIN_CONTRAST:
        return np.array(picture)
    level = (np.arange(256) - low) / (high - low)
    stretched = np.rint(_DARKEST + (_BRIGHTEST - _DARKEST) * np.clip(level, 0, 1)).astype(np.uint8)
    stretched[0] = 0
    return np.asarray(cv2.LUT(np.asarray(picture), stretched), dtype=np.uint8)


def with_edges(picture: ByteArray, edges: BoolArray) -> NDArray[np.uint8]:
    """Return an image (H, W, 3) with thin edges (H, W), bool, drawn on it; a darker halo keeps them visible."""
    result = np.array(picture, dtype=np.uint8)
    halo = cv2.dilate(edges.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    result[halo] = result[halo] // 3 * 2
    result[edges] = ACCENT
    return result


def marked(
    picture: ByteArray, words: str, colors: tuple[Color, Color], *, width: int, ground: Color = BACKGROUND
) -> NDArray[np.uint8]:
    """Return an image centred in a field `width` pixels wide, with words in its lower left corner.

    Words that do not fit the image are placed over the field next to it, or above.
    """
    ink, mark_ground = colors
    text = text_block(words, size=_MARK_SIZE, color=ink, ground=mark_ground, weight=0.4)
    mark = padded(text, top=2, bottom=2, left=10, right=10, ground=mark_ground)
    if picture.shape[1] >= mark.shape[1] + 20 and picture.shape[0] >= mark.shape[0] + 20:
        picture = with_mark(picture, mark)
        return placed(picture, width=width, height=picture.shape[0], ground=ground)
    height = max(picture.shape[0], mark.shape[0] + 20)
    return with_mark(placed(picture, width=width, height=height, ground=ground), mark)
