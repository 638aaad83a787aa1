"""The worst matches enlarged: the scan and the photograph around each, side by side, as SVG with an embedded image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.export.pictures.panels import contrasted
from ladarreg_core.foundations.arrays import ByteArray, FloatArray
from ladarreg_core.foundations.markup import Html, photograph_uri, tag
from ladarreg_core.foundations.palette import BACKGROUND
from ladarreg_core.photo import Photo
from ladarreg_core.results.registration import PoseResult
from ladarreg_core.scan import Scan
from ladarreg_core.surface.texture.registered_texture import intensity_picture

_PANEL_PX = 300
_MIN_HALF_PX, _MIN_HALF_CELLS, _WIDEST_SHARE = 40.0, 12.0, 0.25
_RESIDUALS_ACROSS = 5.0
_NEAREST_FROM = 9
_MAX_OUTLIERS = 3
_LINE_POINTS = 17
_OBSERVED, _PREDICTED, _DRAWN, _HALO = "#ffd34d", "#5cc8ff", "#ffffff", "#0f1115"


@dataclass(frozen=True, slots=True)
class WorstMatch:
    """A match among the worst, by its worst end."""

    pick_id: str
    """Its id."""
    end: int
    """Index of its worst end among the matches of the result."""
    others: tuple[int, ...]
    """Indices of its other ends."""


def worst_matches(result: PoseResult, *, most: int) -> list[WorstMatch]:
    """Return the matches with the longest residuals, of which a few at most are outliers, the longest first.

    Every match is named once, by its worst end.
    """
    length = np.linalg.norm(result.residuals_px, axis=-1)
    by_pick: dict[str, list[int]] = {}
    for k, name in enumerate(result.matches.pick_ids):
        if np.isfinite(length[k]):
            by_pick.setdefault(name, []).append(k)
    found = []
    for name, ends in by_pick.items():
        worst = max(ends, key=lambda k: (float(length[k]), -k))
        found.append(WorstMatch(name, worst, tuple(k for k in ends if k != worst)))
    found.sort(key=lambda match: (-float(length[match.end]), match.end))
    outliers = [match for match in found if not result.inliers[match.end]]
    inliers = [match for match in found if result.inliers[match.end]]
    dropped = outliers[: min(_MAX_OUTLIERS, most)]
    return dropped + inliers[: most - len(dropped)]


def match_crops(scan: Scan, photo: Photo, result: PoseResult, matches: Sequence[WorstMatch]) -> list[tuple[Html, Html]]:
    """Return the scan and the photograph around each match, about equally large in angle.

    Yellow: as drawn or found; blue, in the photograph: where the pose predicts it.
    """
    intensity, crops = intensity_picture(scan), []
    for match in matches:
        residual = float(np.linalg.norm(result.residuals_px[match.end]))
        half = max(_MIN_HALF_PX, _RESIDUALS_ACROSS * residual / 2)
        half = min(half, _WIDEST_SHARE * max(photo.camera.size))
        in_scan = _scan_crop(scan, intensity, result, match, half / result.camera.focal_px)
        crops.append((in_scan, _photo_crop(photo, result, match, half)))
    return crops


def crop_legend() -> Html:
    """Return the legend of the crops."""
    entries = ((_OBSERVED, "where the match was drawn or found"), (_PREDICTED, "where the pose predicts it"))
    return tag(
        "p",
        *(
            tag(
                "span",
                tag("svg", _ring(8, 8, color, radius=4), width=16, height=16, aria_hidden="true"),
                f" {words}",
                class_="key",
            )
            for color, words in entries
        ),
        class_="keys",
    )


def _photo_crop(photo: Photo, result: PoseResult, match: WorstMatch, half: float) -> Html:
    uv = result.matches.uv
    centre = uv[match.end]
    view = _Crop(centre, np.array([half, half]))
    marks = [view.line(uv[[match.end, other]]) for other in match.others]
    predicted = centre - result.residuals_px[match.end]
    marks += [view.line(np.stack([centre, predicted]), color=_PREDICTED), view.ring(predicted, _PREDICTED)]
    marks.append(view.ring(centre, _OBSERVED))
    return view.drawn(photo.pixels, marks, label=f"photograph around ({centre[0]:.0f}, {centre[1]:.0f})")


def _scan_crop(scan: Scan, intensity: ByteArray, result: PoseResult, match: WorstMatch, half_rad: float) -> Html:
    rays = result.matches.rays
    centre = _cells(scan, rays[[match.end]])[0]
    if not np.isfinite(centre).all():
        return tag("p", "outside of the scan's grid", class_="dim")
    steps = np.maximum(np.array(scan.geometry.step_rad)[::-1], 1e-9)  # across, down
    half = half_rad / steps
    half *= max(1.0, _MIN_HALF_CELLS / float(half.min()))
    view = _Crop(centre, half)
    marks = []
    for other in match.others:
        along = np.linspace(0, 1, _LINE_POINTS)[:, None]
        points = _cells(scan, (1 - along) * rays[match.end] + along * rays[other])
        marks.append(view.line(points[np.isfinite(points).all(axis=1)]))
    marks.append(view.ring(centre, _OBSERVED))
    return view.drawn(intensity, marks, contrast=True, label=f"scan around row {centre[1]:.0f}, column {centre[0]:.0f}")


def _cells(scan: Scan, directions: FloatArray) -> NDArray[np.float64]:
    """Return the fractional column and row of directions (N, 3)."""
    rays = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    return np.asarray(scan.geometry.cell_of(rays), dtype=np.float64)[:, ::-1]


class _Crop:
    """A square panel around a position (2,) of an image that shows `half` (2,) of its pixels to each side."""

    def __init__(self, centre: FloatArray, half: FloatArray) -> None:
        self._scale = _PANEL_PX / (2 * half)
        self._shift = _PANEL_PX / 2 - self._scale * centre

    def at(self, positions: FloatArray) -> NDArray[np.float64]:
        return np.asarray(positions * self._scale + self._shift, dtype=np.float64)

    def line(self, points: FloatArray, *, color: str = _DRAWN) -> Html:
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in self.at(points))
        return tag(
            "g",
            tag("polyline", points=path, fill="none", stroke=_HALO, stroke_width=3.2, stroke_opacity=0.7),
            tag("polyline", points=path, fill="none", stroke=color, stroke_width=1.4),
        )

    def ring(self, position: FloatArray, color: str) -> Html:
        x, y = self.at(position)
        return _ring(float(x), float(y), color, radius=7)

    def drawn(self, picture: ByteArray, marks: list[Html], *, label: str, contrast: bool = False) -> Html:
        """Return the panel; what lies outside of the image is dark."""
        how = cv2.INTER_NEAREST if self._scale.min() >= _NEAREST_FROM else cv2.INTER_CUBIC
        # A pixel's centre is at whole numbers in the image, and at halves in the panel's coordinates.
        matrix = np.array([[self._scale[0], 0, self._shift[0] - 0.5], [0, self._scale[1], self._shift[1] - 0.5]])
        crop = cv2.warpAffine(
            np.asarray(picture), matrix, (_PANEL_PX, _PANEL_PX), flags=how, borderMode=cv2.BORDER_CONSTANT,
            borderValue=BACKGROUND,
        )  # fmt: skip
        shown = np.asarray(crop, dtype=np.uint8)
        shown = contrasted(shown) if contrast else shown
        image = tag("image", href=photograph_uri(shown), width=_PANEL_PX, height=_PANEL_PX)
        size = f"0 0 {_PANEL_PX} {_PANEL_PX}"
        return tag("svg", image, *marks, viewBox=size, role="img", aria_label=label)


def _ring(x: float, y: float, color: str, *, radius: float) -> Html:
    return tag(
        "g",
        tag("circle", cx=x, cy=y, r=radius, fill="none", stroke=_HALO, stroke_width=3.4, stroke_opacity=0.7),
        tag("circle", cx=x, cy=y, r=radius, fill="none", stroke=color, stroke_width=1.6),
    )
