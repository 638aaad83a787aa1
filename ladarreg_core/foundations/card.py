"""What a notebook shows of a value: its name, its facts in a table, and a small picture."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from ladarreg_core.foundations.arrays import BoolArray, ByteArray, FloatArray
from ladarreg_core.foundations.markup import Html, joined, map_uri, photograph_uri, tag
from ladarreg_core.foundations.palette import Color

PICTURE_PX = 320
"""Longest side of the picture, px."""
_PERCENTILES = (1.0, 99.0)
_SAMPLES = 200_000
_BOX = "display:flex;gap:16px;align-items:flex-start;flex-wrap:wrap;margin:4px 0"
_ROW = "display:grid;grid-template-columns:max-content auto;gap:2px 14px;margin:6px 0 0"
_NAME = "opacity:.65;margin:0"  # of the notebook's own ink, so that it is legible in light and dark themes


def card(
    title: str,
    facts: Sequence[tuple[str, str]],
    *,
    picture: Html | None = None,
    verdict: tuple[str, Color] | None = None,
    notes: Sequence[str] = (),
) -> str:
    """Return the HTML of a value; every text is escaped.

    Args:
        title: what it is, and its name.
        facts: names and values.
        picture: markup, as of `thumbnail`.
        verdict: a sentence, and the colour of its mark.
        notes: sentences below the facts.
    """
    head = tag("strong", title)
    mark = tag("div", tag("span", "\u25cf ", style=f"color:{_css(verdict[1])}"), verdict[0]) if verdict else Html("")
    rows = [joined(tag("dt", name, style=_NAME), tag("dd", value, style="margin:0")) for name, value in facts]
    below = [tag("div", note, style="opacity:.8;margin-top:4px;max-width:60ch") for note in notes]
    text = tag("div", head, mark, tag("dl", rows, style=_ROW), below)
    return str(tag("div", picture or Html(""), text, style=_BOX))


def thumbnail(picture: ByteArray, name: str, *, exact: bool = False) -> Html:
    """Return an image (H, W, 3), uint8 RGB, reduced to `PICTURE_PX`.

    Args:
        picture: the image.
        name: what it shows, for readers who do not see it.
        exact: whether colours matter more than bytes.
    """
    height, width = picture.shape[:2]
    share = min(1.0, PICTURE_PX / max(height, width))
    size = max(1, round(width * share)), max(1, round(height * share))
    small = np.asarray(cv2.resize(np.ascontiguousarray(picture), size, interpolation=cv2.INTER_AREA), np.uint8)
    uri = map_uri(small) if exact else photograph_uri(small)
    return tag("img", src=uri, alt=name, width=size[0], height=size[1], style="image-rendering:auto")


def gray(values: FloatArray, known: BoolArray) -> ByteArray:
    """Return a field (H, W) as gray levels (H, W, 3) between two of its percentiles; black where it is not known."""
    chosen = values[known]
    if not chosen.size:
        return np.zeros((*values.shape, 3), np.uint8)
    low, high = np.percentile(chosen[:: max(1, chosen.size // _SAMPLES)], _PERCENTILES)
    share = np.clip((values - low) / max(float(high - low), 1e-12), 0, 1)
    return np.repeat(np.where(known, np.rint(255 * np.nan_to_num(share)), 0).astype(np.uint8)[..., None], 3, axis=2)


def arrows(
    size: tuple[int, int], at: FloatArray, moved: FloatArray, good: BoolArray, colors: tuple[Color, Color], name: str
) -> Html:
    """Return displacements in a frame as a drawing, enlarged so that their median is well seen.

    Args:
        size: width and height of the frame, px.
        at: (N, 2) where they begin, px.
        moved: (N, 2) displacements, px.
        good: (N,) bool, drawn in the first colour; the others in the second, at most three times as long as those.
        colours: of both kinds.
        name: what they are.
    """
    width, height = size
    share = PICTURE_PX / max(width, height)
    known = np.isfinite(at).all(axis=1) & np.isfinite(moved).all(axis=1)
    lengths = np.linalg.norm(moved, axis=1)
    typical = float(np.median(lengths[known & good])) if (known & good).any() else 0.0
    longest = 0.06 * PICTURE_PX
    scale = longest / max(typical, 0.02 / share)  # of drawn pixels for a pixel of the frame
    lines = [tag("rect", width="100%", height="100%", fill="none", stroke=_css((128, 128, 128)))]
    for k in np.flatnonzero(known):
        drawn = moved[k] * scale
        drawn = drawn * min(1.0, 3 * longest / max(float(np.linalg.norm(drawn)), 1e-12))
        x, y = at[k] * share
        color = _css(colors[0] if good[k] else colors[1])
        lines.append(tag("circle", cx=_px(x), cy=_px(y), r="1.6", fill=color))
        lines.append(tag("line", x1=_px(x), y1=_px(y), x2=_px(x + drawn[0]), y2=_px(y + drawn[1]), stroke=color))
    enlarged = round(scale / share, 1 - len(str(int(scale / share))))
    caption = f"{name}, enlarged {enlarged:.0f} times" if enlarged >= 2 else name
    drawing = tag("svg", lines, width=_px(width * share), height=_px(height * share), role="img", aria_label=caption)
    return tag("div", drawing, tag("div", caption, style="font-size:smaller;opacity:.65"))


def _css(color: Color) -> str:
    return "#" + "".join(f"{level:02x}" for level in color)


def _px(value: float) -> str:
    return f"{value:.1f}"
