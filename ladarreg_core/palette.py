"""The colours that carry a meaning, the same in the files, the 3-D scene and the page.

The colours of the look and of the matches are those of the page's dark theme, `static/tokens.css`.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.arrays import BoolArray, ByteArray

Colour = tuple[int, int, int]
"""RGB, 0 to 255."""
_SHARE_SHOWN = 98.0  # per cent; a few outlying cells must not compress the scale of all others
_NICE = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)
_DIVERGING_KNOTS: tuple[Colour, ...] = (
    (5, 48, 97), (33, 102, 172), (67, 147, 195), (146, 197, 222), (209, 229, 240), (247, 247, 247),
    (253, 219, 199), (244, 165, 130), (214, 96, 77), (178, 24, 43), (103, 0, 31),
)  # fmt: skip
_DIVERGING_STEPS = 1000
_LEAST_END, _MOST_END = 1e-6, 1e8
_GOLDEN = 0.6180339887498949
_TONES = ((0.6, 0.92), (0.85, 0.7), (0.35, 0.98), (0.75, 0.5))

BACKGROUND: Colour = (15, 17, 21)
PANEL: Colour = (22, 26, 33)
LINE: Colour = (42, 49, 61)
INK: Colour = (232, 236, 242)
DIM: Colour = (143, 155, 173)
ACCENT: Colour = (92, 200, 255)
HIGHLIGHT: Colour = (255, 255, 255)

OK: Colour = (76, 195, 138)
"""Accepted; a good finding; an inlier."""
OK_GROUND: Colour = (18, 36, 28)
WARN: Colour = (242, 184, 75)
"""Not accepted; a fair finding."""
WARN_GROUND: Colour = (42, 34, 19)
BAD: Colour = (242, 114, 111)
"""No pose; a poor finding; an outlier."""
BAD_GROUND: Colour = (43, 22, 23)

MATCHES: tuple[Colour, ...] = (
    (255, 211, 77),
    (92, 200, 255),
    (255, 143, 171),
    (126, 226, 168),
    (201, 167, 255),
    (255, 166, 92),
)
"""By a match's number less one, repeating."""
STATIONS: tuple[Colour, ...] = (
    (255, 143, 171), (126, 226, 168), (201, 167, 255), (255, 166, 92), (92, 200, 255), (214, 226, 110),
    (220, 110, 210), (80, 170, 150), (170, 150, 120), (130, 150, 230), (230, 120, 90), (160, 200, 90),
)  # fmt: skip
"""Of further stations, by their place in the list."""
SCANNER: Colour = (255, 211, 77)
OTHER_CAMERA: Colour = (76, 122, 158)
"""The camera of another photograph than the shown one: a duller accent."""
REFUSED: Colour = DIM
"""A pose that is not accepted."""

VISIBILITY: tuple[Colour, ...] = (
    (15, 17, 21),  # no return
    (76, 195, 138),  # seen
    (176, 74, 120),  # occluded
    (82, 91, 106),  # out of frame
    (242, 184, 75),  # grazing
    (157, 140, 255),  # uncertain
)
"""By the code of a visibility class (`surface.texture.Label`); they differ in lightness, too."""
UNSEEN: Colour = (48, 48, 48)
"""Cells without colour in the registered image."""
UNKNOWN: Colour = (62, 68, 79)
"""Cells of a map for which the quantity shown is not known."""


def ramp_colours(levels: NDArray[np.floating]) -> ByteArray:
    """Return the colours (..., 3), uint8 RGB, of levels (...,) on the scale of all maps, clipped to 0 to 1.

    The scale is viridis, dark blue to yellow: its lightness rises with the level, for the colour-blind too.
    """
    steps = np.rint(255 * np.clip(levels, 0, 1)).astype(np.uint8)
    coloured = np.asarray(cv2.applyColorMap(steps.reshape(-1, 1), cv2.COLORMAP_VIRIDIS), dtype=np.uint8)
    return coloured.reshape(*steps.shape, 3)[..., ::-1]


def diverging_colours(levels: NDArray[np.floating]) -> ByteArray:
    """Return the colours (..., 3), uint8 RGB, of signed levels (...,), clipped to -1 to 1.

    Blue is negative, red positive, and the middle nearly white: both ends differ from it by lightness, and from each
    other for the colour-blind too.
    """
    at = np.linspace(0, _DIVERGING_STEPS, len(_DIVERGING_KNOTS))
    steps = np.arange(_DIVERGING_STEPS + 1)
    table = np.stack([np.interp(steps, at, plane) for plane in zip(*_DIVERGING_KNOTS, strict=True)], axis=-1)
    found = np.rint((np.clip(levels, -1, 1) + 1) * (_DIVERGING_STEPS / 2)).astype(np.intp)
    return np.asarray(np.rint(table).astype(np.uint8).take(found, axis=0))


def uniform(shape: tuple[int, ...], colour: Colour) -> NDArray[np.uint8]:
    """Return a picture (H, W, 3) of one colour, given (H, W); NumPy takes thirty times as long to fill one."""
    return np.asarray(cv2.merge([np.full(shape, value, np.uint8) for value in colour]), dtype=np.uint8)


def paint(picture: NDArray[np.uint8], cells: BoolArray, colour: Colour) -> None:
    """Give cells (H, W) of a picture (H, W, 3) a colour, in a fraction of the time of an assignment by a mask."""
    if cells.any():
        cv2.copyTo(uniform(cells.shape, colour), cells.view(np.uint8), picture)


def scale_end(values: NDArray[np.floating]) -> float:
    """Return a round number that 98 % of the positive values do not exceed, as the end of a map's scale.

    It is 1 if there is no positive value.
    """
    known = values[np.isfinite(values) & (values > 0)]
    if not known.size:
        return 1.0
    high = float(np.clip(np.percentile(known.astype(np.float64), _SHARE_SHOWN), _LEAST_END, _MOST_END))
    power = 10.0 ** np.floor(np.log10(high))
    return float(power * next((n for n in _NICE if n * power >= high * (1 - 1e-6)), _NICE[-1]))


def as_css(colour: Colour) -> str:
    """Return `#rrggbb`."""
    return f"#{bytes(colour).hex()}"


def distinct_colours(count: int) -> NDArray[np.uint8]:
    """Return colours (N, 3), all different and none black; those of successive numbers are far apart in hue."""
    number = np.arange(count)
    tone = np.array(_TONES)[(number // 7) % len(_TONES)].reshape(-1, 2)
    hsv = np.column_stack([360 * ((0.08 + number * _GOLDEN) % 1), tone]).astype(np.float32)
    colours: ByteArray = np.rint(255 * cv2.cvtColor(hsv[None], cv2.COLOR_HSV2RGB)[0]).astype(np.uint8).reshape(-1, 3)
    taken: set[bytes] = set()
    for colour in colours:
        while colour.tobytes() in taken:
            # At most a few of thousands: the next blue that is free is nearly the same colour.
            colour[2] = (int(colour[2]) + 1) % 256
        taken.add(colour.tobytes())
    return np.asarray(colours, np.uint8)
