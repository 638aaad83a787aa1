"""Plots for the benchmarks' pages, drawn on the same blocks as the contact sheet: no plotting library is needed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from ladarreg_core.export.pictures.layout import beside, boxed, padded, placed, stacked, text_block, text_width
from ladarreg_core.foundations.palette import ACCENT, BACKGROUND, BAD, DIM, INK, LINE, PANEL, WARN, Color

Range = tuple[float, float]

YELLOW: Color = (0xFF, 0xD3, 0x4D)
PINK: Color = (0xFF, 0x8F, 0xAB)
VIOLET: Color = (0xC9, 0xA7, 0xFF)
FAINT: Color = (0x4A, 0x55, 0x66)
WIDTH = 1600
"""Width of a whole picture, px."""
GAP, MARGIN = 18, 26
_TITLE, _TEXT, _TICK = 23, 19, 17
_SHIFT = 4  # binary digits of a pixel's fraction
_LEFT, RIGHT, _BELOW = 74, 16, 34


def nice_ticks(low: float, high: float, *, count: int = 5) -> list[float]:
    """Return round numbers within a range, about `count` of them."""
    span = high - low
    power = 10 ** np.floor(np.log10(span / count))
    step = next(s * power for s in (1, 2, 2.5, 5, 10) if span / (s * power) <= count)
    first = np.ceil(low / step - 1e-9)
    return [float(k * step) + 0.0 for k in np.arange(first, np.floor(high / step + 1e-9) + 1)]  # no "-0"


def decades(low: float, high: float) -> list[float]:
    """Return the powers of ten within a range, and 2 and 5 times these where there are few."""
    factors = (1, 2, 5) if np.log10(high / low) < 2.2 else (1,)
    values = [
        f * 10.0**k for k in range(int(np.floor(np.log10(low))), int(np.ceil(np.log10(high))) + 1) for f in factors
    ]
    shown = [v for v in values if low * 0.999 <= v <= high * 1.001]
    return shown[:: max(1, int(np.ceil(len(shown) / 7)))]


def spread_of(*values: np.ndarray, margin: float = 0.08) -> Range:
    """Return a range around all finite values."""
    known = np.concatenate([np.ravel(v) for v in values])
    known = known[np.isfinite(known)]
    low, high = float(known.min()), float(known.max())
    pad = margin * (high - low) or 0.5 * abs(high) or 0.5
    return low - pad, high + pad


@dataclass
class Plot:
    """One plot on a panel; everything is drawn in data units."""

    width: int
    height: int
    """Size of the plotting area, px, without labels."""
    x: Range
    y: Range
    title: str
    x_label: str = ""
    log_x: bool = False
    log_y: bool = False
    row_names: Sequence[str] = ()
    """Names of the rows instead of numbers along y; row k is at y = k."""
    left: int = _LEFT
    image: np.ndarray = field(init=False)
    legend: list[tuple[str, Color]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.image = np.full((self.height, self.width, 3), PANEL, np.uint8)
        for value in self.x_ticks:
            self.vertical(value, LINE, 1)
        for value in self.y_ticks:
            self.horizontal(value, LINE, 1)

    @property
    def x_ticks(self) -> list[float]:
        return decades(*self.x) if self.log_x else nice_ticks(*self.x, count=6)

    @property
    def y_ticks(self) -> list[float]:
        if self.row_names:
            return []
        return decades(*self.y) if self.log_y else nice_ticks(*self.y, count=max(2, self.height // 38))

    def at(self, x: object, y: object) -> np.ndarray:
        """Return pixels (N, 2), clipped to just beyond the field."""

        def scaled(value: object, span: Range, log: bool) -> np.ndarray:
            v, (low, high) = np.atleast_1d(np.asarray(value, float)), span
            if log:
                v, low, high = np.log(np.maximum(v, 1e-300)), np.log(low), np.log(high)
            return np.clip((v - low) / (high - low), -0.5, 1.5)

        px = scaled(x, self.x, self.log_x) * (self.width - 1)
        py = (1 - scaled(y, self.y, self.log_y)) * (self.height - 1)
        return np.stack(np.broadcast_arrays(px, py), axis=-1)

    def lines(self, points: np.ndarray, color: Color, thickness: int = 2) -> None:
        """Draw a polyline through pixels."""
        fixed = np.rint(points * (1 << _SHIFT)).astype(np.int32)
        cv2.polylines(self.image, [fixed[:, None]], False, color, thickness, cv2.LINE_AA, _SHIFT)

    def curve(self, x: np.ndarray, y: np.ndarray, color: Color, *, name: str = "", thickness: int = 2) -> None:
        self.lines(self.at(x, y), color, thickness)
        self.named(name, color)

    def stems(self, x: np.ndarray, y: np.ndarray, color: Color, *, name: str = "", base: float = 0.0) -> None:
        """Draw a line from the base to each value, with a dot; values beyond the field become an arrow at its edge."""
        low, high = self.y
        for a, b in zip(self.at(x, np.clip(y, low, high)), self.at(x, np.full(len(x), base)), strict=True):
            self.lines(np.stack([a, b]), tuple(int(0.55 * c + 0.45 * p) for c, p in zip(color, PANEL, strict=True)), 1)
        self.dots(x, np.clip(y, low, high), color, radius=3.4)
        self.named(name, color)

    def dots(self, x: object, y: object, color: Color, *, radius: float = 4.0, name: str = "") -> None:
        for point in self.at(x, y):
            centre = tuple(np.rint(point * (1 << _SHIFT)).astype(int).tolist())
            cv2.circle(self.image, centre, round(radius * (1 << _SHIFT)), color, -1, cv2.LINE_AA, _SHIFT)
        self.named(name, color)

    def horizontal(self, y: float, color: Color, thickness: int = 2, *, dashed: bool = False, name: str = "") -> None:
        row = round(float(self.at(self.x[0], y)[0, 1]))
        self._straight((0, row), (self.width - 1, row), color, thickness, dashed)
        self.named(name, color)

    def vertical(self, x: float, color: Color, thickness: int = 2, *, dashed: bool = False, name: str = "") -> None:
        column = round(float(self.at(x, self.y[0])[0, 0]))
        self._straight((column, 0), (column, self.height - 1), color, thickness, dashed)
        self.named(name, color)

    def _straight(self, a: tuple[int, int], b: tuple[int, int], color: Color, thickness: int, dashed: bool) -> None:
        if not dashed:
            cv2.line(self.image, a, b, color, thickness)
            return
        across = b[0] != a[0]
        for start in range(0, self.width if across else self.height, 14):
            first, last = ((start, a[1]), (start + 7, a[1])) if across else ((a[0], start), (a[0], start + 7))
            cv2.line(self.image, first, last, color, thickness)

    def named(self, name: str, color: Color) -> None:
        if name and (name, color) not in self.legend:
            self.legend.append((name, color))

    def block(self, *, number: Callable[[float], str] = "{:.4g}".format) -> np.ndarray:
        """Return the panel: title and legend above, the field with its labels below."""
        canvas = np.full((self.height + _BELOW, self.left + self.width + RIGHT, 3), PANEL, np.uint8)
        canvas[: self.height, self.left : self.left + self.width] = self.image
        cv2.rectangle(canvas, (self.left, 0), (self.left + self.width - 1, self.height - 1), LINE, 1)
        rows = [
            *((k, name, INK) for k, name in enumerate(self.row_names)),
            *((v, number(v), DIM) for v in self.y_ticks),
        ]
        for value, label, color in rows:
            words = text_block(label, size=_TICK if not self.row_names else _TEXT, color=color, ground=PANEL)
            row = float(self.at(self.x[0], value)[0, 1])
            _put(canvas, words, self.left - 10 - words.shape[1], row - words.shape[0] / 2)
        for value in self.x_ticks:
            words = text_block(number(value), size=_TICK, color=DIM, ground=PANEL)
            _put(
                canvas, words, self.left + float(self.at(value, self.y[0])[0, 0]) - words.shape[1] / 2, self.height + 6
            )
        if self.x_label:
            words = text_block(self.x_label, size=_TICK, color=DIM, ground=PANEL)
            canvas = stacked([canvas, placed(words, width=canvas.shape[1], height=words.shape[0] + 2, ground=PANEL)])
        title = text_block(self.title, size=_TITLE, ground=PANEL, weight=0.5)
        keys = self._keys()
        room = canvas.shape[1]
        if keys is None:
            head = title
        elif title.shape[1] + keys.shape[1] + 24 <= room:
            height = max(title.shape[0], keys.shape[0])
            right = placed(keys, width=room - title.shape[1], height=height, ground=PANEL, align="right")
            head = beside([title, right], ground=PANEL)
        else:
            head = stacked([title, keys], gap=2, ground=PANEL)
        return stacked([head, canvas], gap=10, ground=PANEL)

    def _keys(self) -> np.ndarray | None:
        parts = []
        for name, color in self.legend:
            mark = np.full((round(_TICK * 1.36), 22, 3), PANEL, np.uint8)
            cv2.line(mark, (2, mark.shape[0] // 2), (19, mark.shape[0] // 2), color, 5, cv2.LINE_AA)
            parts.append(beside([mark, text_block(name, size=_TICK, color=DIM, ground=PANEL)], gap=4, ground=PANEL))
        return beside(parts, gap=18, ground=PANEL) if parts else None


def _put(canvas: np.ndarray, words: np.ndarray, x: float, y: float) -> None:
    """Draw a text, moved inside the canvas where it would extend beyond it."""
    left = round(min(max(x, 0), canvas.shape[1] - words.shape[1]))
    top = round(min(max(y, 0), canvas.shape[0] - words.shape[0]))
    canvas[top : top + words.shape[0], left : left + words.shape[1]] = words


def save(path: Path, picture: np.ndarray) -> None:
    """Write a picture as PNG of at most 256 colours, at a third of the size without visible loss."""
    from PIL import Image

    reduced = Image.fromarray(picture).quantize(256, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
    reduced.save(path, optimize=True)


def panel(block: np.ndarray, *, width: int | None = None, height: int | None = None) -> np.ndarray:
    """Return a block on a rounded panel; `width` and `height` are those of the panel, px."""
    pad = (14, 18)
    inner = (width or block.shape[1] + 2 * pad[1]) - 2 * pad[1], (height or block.shape[0] + 2 * pad[0]) - 2 * pad[0]
    block = placed(block, width=inner[0], height=inner[1], ground=PANEL, align="left", at_top=0)
    return boxed(block, pad=pad, ground=PANEL, line=LINE, under=BACKGROUND, radius=10)


def columns(blocks: Sequence[np.ndarray], *, width: int = WIDTH - 2 * MARGIN) -> np.ndarray:
    """Return panels of one height side by side over a width."""
    each, height = (width - GAP * (len(blocks) - 1)) // len(blocks), max(b.shape[0] for b in blocks) + 28
    return beside([panel(b, width=each, height=height) for b in blocks], gap=GAP)


def field_width(count: int, *, left: int = _LEFT) -> int:
    """Return the width of a plotting area for `count` panels side by side."""
    return (WIDTH - 2 * MARGIN - GAP * (count - 1)) // count - 36 - left - RIGHT


def page(title: str, note: str, rows: Sequence[np.ndarray]) -> np.ndarray:
    """Return a whole picture: a heading, a sentence, and rows of panels."""
    inner = WIDTH - 2 * MARGIN
    lines = int(np.ceil(text_width(note, size=_TEXT) / inner)) + 1
    head = stacked(
        [text_block(title, size=34, weight=0.7), text_block(note, size=_TEXT, width=inner, lines=lines, color=DIM)],
        gap=4,
    )
    sheet = stacked([head, *rows], gap=GAP)
    return padded(sheet, top=MARGIN, bottom=MARGIN, left=MARGIN, right=WIDTH - MARGIN - sheet.shape[1])


@dataclass(frozen=True)
class Bar:
    """One row of a strip chart: from the median to the 95th percentile."""

    name: str
    median: float
    p95: float
    color: Color


def strips(
    title: str,
    rows: Sequence[Bar],
    *,
    x: Range,
    marks: Sequence[tuple[float, Color, str]],
    width: int,
    left: int,
    label: str,
    figure: Callable[[float], str] = "{:.2f}".format,
) -> np.ndarray:
    """Return rows of a dot at the median and a line to the 95th percentile, on a logarithmic axis."""
    plot = Plot(
        width, 46 * len(rows), x, (len(rows) - 0.5, -0.5), title, label, log_x=True,
        row_names=[row.name for row in rows], left=left,
    )  # fmt: skip
    for value, color, name in marks:
        plot.vertical(value, color, 2, dashed=True, name=name)
    for k, row in enumerate(rows):
        if not np.isfinite(row.median):
            continue
        plot.curve(np.array([row.median, min(row.p95, x[1])]), np.array([k, k]), row.color, thickness=3)
        plot.dots(row.median, k, row.color, radius=7)
        words = text_block(figure(row.median), size=_TICK, color=row.color, ground=PANEL)
        spot = plot.at(row.median, k)[0]
        before = spot[0] - 14 - words.shape[1]
        _put(
            plot.image,
            words,
            before if before > 2 else spot[0] + 12,
            spot[1] - words.shape[0] - 2 if before <= 2 else spot[1] - words.shape[0] / 2,
        )
    return plot.block(number="{:g}".format)


_ERROR_STEPS = 10
ERROR_COLORS = np.array([(0x33, 0x70, 0x92), ACCENT, WARN, BAD], float)


def error_color(share: float) -> Color:
    """Return a colour from deep blue (0) over amber to red (1), in steps."""
    step = min(int(np.clip(share, 0, 1) * _ERROR_STEPS), _ERROR_STEPS - 1)
    place = step / (_ERROR_STEPS - 1) * (len(ERROR_COLORS) - 1)
    low = min(int(place), len(ERROR_COLORS) - 2)
    mixed = ERROR_COLORS[low] + (place - low) * (ERROR_COLORS[low + 1] - ERROR_COLORS[low])
    return tuple(round(float(v)) for v in mixed)  # type: ignore[return-value]


def wireframe(
    title: str, points: np.ndarray, errors: np.ndarray, *, grid: tuple[int, int], size: tuple[int, int], scale: float
) -> np.ndarray:
    """Return a closed-around mesh (rings, around) of points (N, 2) px, drawn from far to near, coloured by error."""
    plot = Plot(*size, (0.0, 1.0), (0.0, 1.0), title, left=4)
    plot.image[:] = PANEL
    rings, around = grid
    index = np.arange(rings * around).reshape(grid)
    edges = [
        *zip(index[:-1].ravel(), index[1:].ravel(), strict=True),
        *zip(index.ravel(), np.roll(index, -1, axis=1).ravel(), strict=True),
    ]
    edges.sort(
        key=lambda edge: max(errors[edge[0]], errors[edge[1]])
    )  # the largest errors are drawn last, so never hidden
    for a, b in edges:
        plot.lines(points[[a, b]], error_color(max(errors[a], errors[b]) / scale), 2)
    for k in np.argsort(errors, kind="stable"):
        centre = tuple(np.rint(points[k] * (1 << _SHIFT)).astype(int).tolist())
        cv2.circle(plot.image, centre, 4 << _SHIFT, error_color(errors[k] / scale), -1, cv2.LINE_AA, _SHIFT)
    head = text_block(title, size=_TITLE, ground=PANEL, weight=0.5)
    return stacked([head, plot.image], gap=8, ground=PANEL)


def color_bar(width: int, scale: float, label: str) -> np.ndarray:
    """Return the key of `error_colour`."""
    bar = np.array([[error_color(k / 200) for k in range(200)]] * 14, np.uint8)
    parts = [
        text_block(f"{label}:  0", size=_TICK, color=DIM),
        padded(bar, top=5),
        text_block(f"{scale:g} and more", size=_TICK, color=DIM),
    ]
    block = beside(parts, gap=10)
    return placed(block, width=width, height=block.shape[0], align="left")
