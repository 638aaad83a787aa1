"""The perspective views in which an operator looks at a whole scan."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ladarreg_core.camera import Camera
from ladarreg_core.matching.views import viewing_directions
from ladarreg_core.scan import Scan
from ladarreg_core.surface.perspective import View, check_viewable, most_view_pixels, native_focal_px, perspective_view

_MOST_PIXELS = 8_000_000
_ONE_VIEW_HALF_RAD = math.radians(50.0)
_FIELD_RAD = math.radians(90.0)
_WORTH_SAYING = 1.05


@dataclass(frozen=True, slots=True)
class NamedView:
    """A view and what to call it."""

    view: View
    """The view."""
    label: str
    """Where it looks."""


def inspection_views(scan: Scan) -> tuple[NamedView, ...]:
    """Return one view of all that a scan sees, or several beside each other where one would be too wide.

    Each has about a pixel per cell, but no more than 8 Mpixel, 16 pixels for each cell of the scan, or 32,000 pixels a
    side; where that asks for it the views are coarser. Source: thesis 2.2.2.

    Raises:
        DegenerateGeometryError: if the scan spreads so little one way that no such view shows its rows and columns.
    """
    rays = scan.sampled_directions
    away = np.arccos(np.clip(rays @ scan.mean_direction, -1, 1))
    if float(np.percentile(away, 99)) <= _ONE_VIEW_HALF_RAD:
        return (NamedView(perspective_view(scan, most_pixels=_MOST_PIXELS), "the whole scan"),)
    focal = native_focal_px(scan)
    side = 2 * focal * math.tan(_FIELD_RAD / 2)
    share = min(1.0, math.sqrt(min(_MOST_PIXELS, most_view_pixels(scan))) / side)
    if share < 1:
        check_viewable(scan, focal * share)
    camera = Camera.from_focal(max(2, round(side * share)), max(2, round(side * share)), focal * share)
    directions = sorted(viewing_directions(scan, camera), key=lambda d: -_azimuth(d.rotation[2]))
    return tuple(
        NamedView(perspective_view(scan, camera, view_from_scanner=d), _named(_azimuth(d.rotation[2])))
        for d in directions
    )


def resolution_note(scan: Scan, views: Sequence[NamedView]) -> str | None:
    """Return a sentence where views show fewer pixels than the scan has cells in its finer direction."""
    cells = max((native_focal_px(scan) / named.view.camera.fx for named in views), default=1.0)
    if cells < _WORTH_SAYING:
        return None
    return f"shown at one pixel for {cells:.2g} cells of its finer direction, which is as fine as a view is made"


def _azimuth(forward: np.ndarray) -> float:
    return math.atan2(float(forward[1]), float(forward[0]))


def _named(azimuth: float) -> str:
    degrees = round(math.degrees(azimuth))
    if degrees == 0:
        return "ahead"
    return f"{abs(degrees)} deg {'left' if degrees > 0 else 'right'}"
