"""The colours that carry a meaning, the same in the files, the 3-D scene and the page.

The colours of the look and of the matches are those of the page's dark theme, `static/tokens.css`.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.foundations.arrays import BoolArray, ByteArray

Color = tuple[int, int, int]
"""RGB, 0 to 255."""
_SHARE_SHOWN = 98.0  # per cent; a few outlying cells must not compress the scale of all others
_NICE = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)
_DIVERGING_KNOTS: tuple[Color, ...] = (
    (5, 48, 97), (33, 102, 172), (67, 147, 195), (146, 197, 222), (209, 229, 240), (247, 247, 247),
    (253, 219, 199), (244, 165, 130), (214, 96, 77), (178, 24, 43), (103, 0, 31),
)  # fmt: skip
_DIVERGING_STEPS = 1000
_MIN_END, _MAX_END = 1e-6, 1e8
_GOLDEN = 0.6180339887498949
_TONES = ((0.6, 0.92), (0.85, 0.7), (0.35, 0.98), (0.75, 0.5))

BACKGROUND: Color = (15, 17, 21)
PANEL: Color = (22, 26, 33)
LINE: Color = (42, 49, 61)
INK: Color = (232, 236, 242)
DIM: Color = (143, 155, 173)
ACCENT: Color = (92, 200, 255)
HIGHLIGHT: Color = (255, 255, 255)

OK: Color = (76, 195, 138)
"""Accepted; a good finding; an inlier."""
OK_GROUND: Color = (18, 36, 28)
WARN: Color = (242, 184, 75)
"""Not accepted; a fair finding."""
WARN_GROUND: Color = (42, 34, 19)
BAD: Color = (242, 114, 111)
"""No pose; a poor finding; an outlier."""
BAD_GROUND: Color = (43, 22, 23)

MATCHES: tuple[Color, ...] = (
    (255, 211, 77),
    (92, 200, 255),
    (255, 143, 171),
    (126, 226, 168),
    (201, 167, 255),
    (255, 166, 92),
)
"""By a match's number less one, repeating."""
STATIONS: tuple[Color, ...] = (
    (255, 143, 171), (126, 226, 168), (201, 167, 255), (255, 166, 92), (92, 200, 255), (214, 226, 110),
    (220, 110, 210), (80, 170, 150), (170, 150, 120), (130, 150, 230), (230, 120, 90), (160, 200, 90),
)  # fmt: skip
"""Of further stations, by their place in the list."""
SCANNER: Color = (255, 211, 77)
OTHER_CAMERA: Color = (76, 122, 158)
"""The camera of another photograph than the shown one: a duller accent."""
REFUSED: Color = DIM
"""A pose that is not accepted."""

VISIBILITY: tuple[Color, ...] = (
    (15, 17, 21),  # no return
    (76, 195, 138),  # seen
    (176, 74, 120),  # occluded
    (82, 91, 106),  # out of frame
    (242, 184, 75),  # grazing
    (157, 140, 255),  # uncertain
)
"""By the code of a visibility class (`surface.texture.Label`); they differ in lightness, too."""
UNSEEN: Color = (48, 48, 48)
"""Cells without colour in the registered image."""
UNKNOWN: Color = (62, 68, 79)
"""Cells of a map for which the quantity shown is not known."""


def ramp_colors(levels: NDArray[np.floating]) -> ByteArray:
    """Return the colours (..., 3), uint8 RGB, of levels (...,) on the scale of all maps, clipped to 0 to 1.

    The scale is viridis, dark blue to yellow: its lightness rises with the level, for the colour-blind too.
    """
    steps = np.rint(255 * np.clip(levels, 0, 1)).astype(np.uint8)
    if not steps.size:  # OpenCV fails there
        return np.empty((*steps.shape, 3), np.uint8)
    colored = np.asarray(cv2.applyColorMap(steps.reshape(-1, 1), cv2.COLORMAP_VIRIDIS), dtype=np.uint8)
    return colored.reshape(*steps.shape, 3)[..., ::-1]


def diverging_colors(levels: NDArray[np.floating]) -> ByteArray:
    """Return the colours (..., 3), uint8 RGB, of signed levels (...,), clipped to -1 to 1.

    Blue is negative, red positive, and the middle nearly white: both ends differ from it by lightness, and from each
    other for the colour-blind too.
    """
    at = np.linspace(0, _DIVERGING_STEPS, len(_DIVERGING_KNOTS))
    steps = np.arange(_DIVERGING_STEPS + 1)
    table = np.stack([np.interp(steps, at, plane) for plane in zip(*_DIVERGING_KNOTS, strict=True)], axis=-1)
    found = np.rint((np.clip(levels, -1, 1) + 1) * (_DIVERGING_STEPS / 2)).astype(np.intp)
    return np.asarray(np.rint(table).astype(np.uint8).take(found, axis=0))


def uniform(shape: tuple[int, ...], color: Color) -> NDArray[np.uint8]:
    """Return a picture (H, W, 3) of one colour, given (H, W); NumPy takes thirty times as long to fill one."""
    return np.asarray(cv2.merge([np.full(shape, value, np.uint8) for value in color]), dtype=np.uint8)


def paint(picture: NDArray[np.uint8], cells: BoolArray, color: Color) -> None:
    """Give cells (H, W) of a picture (H, W, 3) a colour, in a fraction of the time of an assignment by a mask."""
    if cells.any():
        cv2.copyTo(uniform(cells.shape, color), cells.view(np.uint8), picture)


def scale_end(values: NDArray[np.floating]) -> float:
    """Return a round number that 98 % of the positive values do not exceed, as the end of a map's scale.

    It is 1 if there is no positive value.
    """
    known = values[np.isfinite(values) & (values > 0)]
    if not known.size:
        return 1.0
    high = float(np.clip(np.percentile(known.astype(np.float64), _SHARE_SHOWN), _MIN_END, _MAX_END))
    power = 10.0 ** np.floor(np.log10(high))
    return float(power * next((n for n in _NICE if n * power >= high * (1 - 1e-6)), _NICE[-1]))


def as_css(color: Color) -> str:
    """Return `#rrggbb`."""
    return f"#{bytes(color).hex()}"


def distinct_colors(count: int) -> NDArray[np.uint8]:
    """Return colours (N, 3), all different and none black; those of successive numbers are far apart in hue."""
    number = np.arange(count)
    tone = np.array(_TONES)[(number // 7) % len(_TONES)].reshape(-1, 2)
    hsv = np.column_stack([360 * ((0.08 + number * _GOLDEN) % 1), tone]).astype(np.float32)
    colors: ByteArray = np.rint(255 * cv2.cvtColor(hsv[None], cv2.COLOR_HSV2RGB)[0]).astype(np.uint8).reshape(-1, 3)
    taken: set[bytes] = set()
    for color in colors:
        while color.tobytes() in taken:
            # At most a few of thousands: the next blue that is free is nearly the same colour.
            color[2] = (int(color[2]) + 1) % 256
        taken.add(color.tobytes())
    return np.asarray(colors, np.uint8)
