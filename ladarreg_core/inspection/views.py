"""The perspective views in which an operator looks at a whole scan."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ladarreg_core.camera import Camera
from ladarreg_core.matching.views import viewing_directions
from ladarreg_core.perspective import View, native_focal_px, perspective_view
from ladarreg_core.scan import Scan

_MOST_PIXELS = 8_000_000
_ONE_VIEW_HALF_RAD = math.radians(50.0)
_FIELD_RAD = math.radians(90.0)


@dataclass(frozen=True, slots=True)
class NamedView:
    """A view and what to call it."""

    view: View
    """The view."""
    label: str
    """Where it looks."""


def inspection_views(scan: Scan) -> tuple[NamedView, ...]:
    """Return one view of all that a scan sees, or several beside each other where one would be too wide.

    Each has about a pixel per cell, but no more than 8 Mpixel. Source: thesis 2.2.2.
    """
    rays = scan.sampled_directions
    away = np.arccos(np.clip(rays @ scan.mean_direction, -1, 1))
    focal = native_focal_px(scan)
    if float(np.percentile(away, 99)) <= _ONE_VIEW_HALF_RAD:
        view = perspective_view(scan)
        pixels = view.camera.width * view.camera.height
        if pixels > _MOST_PIXELS:
            share = math.sqrt(_MOST_PIXELS / pixels)
            view = perspective_view(scan, Camera.from_focal(2, 2, focal * share), whole_scan=True)
        return (NamedView(view, "the whole scan"),)
    side = 2 * focal * math.tan(_FIELD_RAD / 2)
    share = min(1.0, math.sqrt(_MOST_PIXELS) / side)
    camera = Camera.from_focal(max(2, round(side * share)), max(2, round(side * share)), focal * share)
    directions = sorted(viewing_directions(scan, camera), key=lambda d: -_azimuth(d.rotation[2]))
    return tuple(
        NamedView(perspective_view(scan, camera, view_from_scanner=d), _named(_azimuth(d.rotation[2])))
        for d in directions
    )


def _azimuth(forward: np.ndarray) -> float:
    return math.atan2(float(forward[1]), float(forward[0]))


def _named(azimuth: float) -> str:
    degrees = round(math.degrees(azimuth))
    if degrees == 0:
        return "ahead"
    return f"{abs(degrees)} deg {'left' if degrees > 0 else 'right'}"
