"""Plots of a report as SVG: residuals in the photograph, their distribution, and depth errors over range."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ladarreg_core.foundations.arrays import BoolArray, FloatArray
from ladarreg_core.foundations.markup import Html, tag
from ladarreg_core.results.registration import PoseResult

_WIDTH, _HEIGHT = 340.0, 270.0
_LEFT, _RIGHT, _TOP, _BOTTOM = 46.0, 10.0, 10.0, 38.0
_INLIER, _OUTLIER, _INK, _FAINT, _BAR = "#1c7a4d", "#b3261e", "#39424f", "#d5dae1", "#9fb4cc"
_MAX_POINTS = 1500
_BINS = 24
_LIMIT_SHARE = 97.0
_TICKS = (1.0, 2.0, 2.5, 5.0, 10.0)


def residual_plots(result: PoseResult) -> list[tuple[Html, str]]:
    """Return the plots of a result, each with its caption; plots that would be empty are left out."""
    length = np.linalg.norm(result.residuals_px, axis=-1)
    known = np.isfinite(length)
    if not known.any():
        return []
    plots = [_vectors(result, known), _histogram(length[known], result.inliers[known])]
    for values, name in (
        (result.stereo_depth_error_m, "laser minus stereo depth"),
        (result.residuals_m, "range residual, measured minus adjusted"),
    ):
        if np.isfinite(values).sum() >= 2:
            plots.append(_over_range(result, values, name))
            break
    return plots


def legend_of_points() -> Html:
    """Return the legend of inliers and outliers."""
    dot = tag("circle", cx=7, cy=7, r=3.4, fill=_INLIER)
    cross = _cross(7, 7)
    return tag(
        "p",
        *(
            tag("span", tag("svg", mark, width=14, height=14, aria_hidden="true"), f" {name}", class_="key")
            for mark, name in ((dot, "inlier"), (cross, "outlier"))
        ),
        class_="keys",
    )


def _vectors(result: PoseResult, known: BoolArray) -> tuple[Html, str]:
    du, dv = result.residuals_px[known].T
    inliers = result.inliers[known]
    limit = _limit(np.concatenate([np.abs(du), np.abs(dv), [3 * result.sigma_px]]))
    wide = limit * (_WIDTH - _LEFT - _RIGHT) / (_HEIGHT - _TOP - _BOTTOM)  # equal scales
    plot = _Plot((-wide, wide), (limit, -limit))  # v points down, as in the photograph
    marks = [
        tag("ellipse", cx=plot.x(0), cy=plot.y(0), rx=plot.x(k * result.sigma_px) - plot.x(0),
            ry=abs(plot.y(k * result.sigma_px) - plot.y(0)), fill="none", stroke=_INK, stroke_width=0.8,
            stroke_dasharray="3 3")
        for k in (1, 3) if 0 < k * result.sigma_px <= limit
    ]  # fmt: skip
    outside = int(((np.abs(du) > wide) | (np.abs(dv) > limit)).sum())
    marks += plot.points(np.clip(du, -wide, wide), np.clip(dv, -limit, limit), inliers)
    caption = "Residuals in the photograph, observed minus predicted; dashed: 1 and 3 sigma of the pixel noise."
    if outside:
        caption += f" {outside} beyond the frame {'is' if outside == 1 else 'are'} drawn on it."
    return plot.drawn(marks, "horizontal, px", "vertical, px"), caption


def _histogram(length: FloatArray, inliers: BoolArray) -> tuple[Html, str]:
    limit = _limit(length)
    edges = np.linspace(0, limit, _BINS + 1)
    counts = [np.histogram(np.minimum(length[chosen], limit), edges)[0] for chosen in (inliers, ~inliers)]
    highest = max(int((counts[0] + counts[1]).max()), 1)
    plot = _Plot((0, limit), (0, _round_up(highest)))
    marks = []
    for k in range(_BINS):
        x, width = plot.x(edges[k]), plot.x(edges[k + 1]) - plot.x(edges[k]) - 1
        base = 0
        for count, color in ((int(counts[0][k]), _INLIER), (int(counts[1][k]), _OUTLIER)):
            if count:
                top, bottom = plot.y(base + count), plot.y(base)
                marks.append(tag("rect", x=x, y=top, width=width, height=bottom - top, fill=color))
            base += count
    beyond = " The last bar also counts longer ones." if (length > limit).any() else ""
    return plot.drawn(marks, "residual, px", "matches, ends counted singly"), f"Lengths of the residuals.{beyond}"


def _over_range(result: PoseResult, values: FloatArray, name: str) -> tuple[Html, str]:
    known = np.isfinite(values) & np.isfinite(result.matches.ranges)
    mm, ranges, inliers = 1000 * values[known], result.matches.ranges[known], result.inliers[known]
    limit = _limit(np.abs(mm))
    low, high = float(ranges.min()), float(ranges.max())
    margin = 0.05 * (high - low) or 0.1
    plot = _Plot((low - margin, high + margin), (-limit, limit))
    zero = tag("line", x1=plot.x(low - margin), x2=plot.x(high + margin), y1=plot.y(0), y2=plot.y(0), stroke=_INK)
    outside = int((np.abs(mm) > limit).sum())
    caption = f"{name[0].upper()}{name[1:]}, over the range."
    if outside:
        caption += f" {outside} beyond the frame {'is' if outside == 1 else 'are'} drawn on it."
    return plot.drawn([zero, *plot.points(ranges, np.clip(mm, -limit, limit), inliers)], "range, m", "mm"), caption


class _Plot:
    """The axes of a plot.

    Args:
        across: values at the left and the right.
        up: values at the bottom and the top.
    """

    def __init__(self, across: tuple[float, float], up: tuple[float, float]) -> None:
        self._across, self._up = across, up
        self._width, self._height = _WIDTH - _LEFT - _RIGHT, _HEIGHT - _TOP - _BOTTOM

    def x(self, value: float) -> float:
        low, high = self._across
        return _LEFT + self._width * (float(value) - low) / (high - low)

    def y(self, value: float) -> float:
        low, high = self._up
        return _TOP + self._height * (1 - (float(value) - low) / (high - low))

    def points(self, x: FloatArray, y: FloatArray, inliers: BoolArray) -> list[Html]:
        """Return marks of points, the inliers last; of very many, an even choice."""
        step = max(1, math.ceil(len(x) / _MAX_POINTS))
        order = [*np.flatnonzero(~inliers)[::step], *np.flatnonzero(inliers)[::step]]
        return [
            tag("circle", cx=self.x(x[k]), cy=self.y(y[k]), r=2.3, fill=_INLIER, fill_opacity=0.75)
            if inliers[k]
            else _cross(self.x(x[k]), self.y(y[k]))
            for k in order
        ]

    def drawn(self, marks: Sequence[Html], x_label: str, y_label: str) -> Html:
        """Return the plot."""
        bottom, right = _TOP + self._height, _LEFT + self._width
        parts = [tag("rect", x=_LEFT, y=_TOP, width=self._width, height=self._height, fill="none", stroke=_INK)]
        for value in _ticks(*sorted(self._across)):
            at = self.x(value)
            parts.append(tag("line", x1=at, x2=at, y1=_TOP, y2=bottom, stroke=_FAINT))
            parts.append(_text(at, bottom + 13, f"{value:.4g}", anchor="middle"))
        for value in _ticks(*sorted(self._up)):
            at = self.y(value)
            parts.append(tag("line", x1=_LEFT, x2=right, y1=at, y2=at, stroke=_FAINT))
            parts.append(_text(_LEFT - 5, at + 3.5, f"{value:.4g}", anchor="end"))
        middle = _TOP + self._height / 2
        parts.append(_text(_LEFT + self._width / 2, bottom + 29, x_label, anchor="middle"))
        parts.append(_text(12, middle, y_label, anchor="middle", transform=f"rotate(-90 12 {middle:.6g})"))
        return tag("svg", *parts, *marks, viewBox=f"0 0 {right + _RIGHT:.6g} {bottom + _BOTTOM:.6g}", role="img",
                   aria_label=f"{y_label} over {x_label}")  # fmt: skip


def _text(x: float, y: float, text: str, *, anchor: str, transform: str | None = None) -> Html:
    return tag("text", text, x=x, y=y, text_anchor=anchor, font_size=10.5, fill=_INK, transform=transform)


def _cross(x: float, y: float) -> Html:
    path = f"M{x - 3:.6g} {y - 3:.6g}l6 6M{x - 3:.6g} {y + 3:.6g}l6 -6"
    return tag("path", d=path, stroke=_OUTLIER, stroke_width=1.5, fill="none")


def _limit(values: FloatArray) -> float:
    """Return a round number that nearly all values do not exceed, so that one gross outlier does not hide the rest."""
    known = values[np.isfinite(values)]
    high = float(np.percentile(known, _LIMIT_SHARE)) if len(known) > 20 else float(known.max(initial=0))
    typical = float(np.median(known)) if len(known) else 0.0
    return _round_up(max(min(high, 12 * typical) if typical > 0 else high, 1e-6))


def _round_up(value: float) -> float:
    power = 10.0 ** math.floor(math.log10(value))
    return next(n * power for n in _TICKS if n * power >= value * (1 - 1e-9))


def _ticks(low: float, high: float) -> list[float]:
    raw = (high - low) / 5
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(n * power for n in _TICKS if n * power >= raw * (1 - 1e-9))
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [0.0 if k == 0 else k * step for k in range(first, last + 1)]
