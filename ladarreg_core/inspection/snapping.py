"""Snapping: a drawn line moves onto the edge under it, a point to the corner beside it, sub-pixel.

Edges are measured in linear light, since the blur of a lens or a laser beam acts on light: in encoded gray levels the
steepest place of a strong edge is off by up to a third of a pixel, towards its dark side.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ladarreg_core.camera import CameraModel
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.inspection.corners import gray_of_photo, gray_of_view, nearest_corner
from ladarreg_core.matching.features.edges import EdgeOptions, edge_under
from ladarreg_core.photo import Photo
from ladarreg_core.surface.perspective import View
from ladarreg_core.surface.remap import look_up

LINE_REACH = 6.0
"""Largest jump of a line's end, screen pixels: an end farther from every edge stays where it is."""
CORNER_REACH = 4.0
"""Largest jump of a point, screen pixels."""
_EXPECTED = 1.5
_MIN_REACH_PX = 1.0  # of the image, however far the pane is zoomed in
_MAX_CORNER_PX = 12.0
_GAMMA = 2.2
_LINEAR = (255 * (np.arange(256) / 255.0) ** _GAMMA).astype(np.float32)
_LEVELS_PER_RANGE = 150.0  # gray levels for a factor e in range
_WHITE_PERCENT = 99.5


@dataclass(frozen=True, eq=False)
class ViewSnapper:
    """Snaps on a view of the scan; edges of intensity and of range."""

    view: View
    """The view."""
    _gray: FloatArray
    _white: float

    @staticmethod
    def of(view: View) -> ViewSnapper:
        """Prepare a view."""
        known = view.intensity[np.isfinite(view.ranges)]
        white = float(np.percentile(known, _WHITE_PERCENT)) if len(known) else 1.0
        return ViewSnapper(view, gray_of_view(view), max(white, 1e-12))

    def line(self, ends: ArrayLike, *, px_per_screen: float = 1.0) -> NDArray[np.float64] | None:
        """Return the ends (2, 2) on the edge under a line of view pixels; None without one within reach.

        Args:
            ends: (2, 2), (u, v).
            px_per_screen: pixels of the view per pixel of the screen.
        """
        return edge_under(self._sample, ends, _options(px_per_screen))

    def point(self, at: ArrayLike, *, px_per_screen: float = 1.0) -> FloatArray | None:
        """Return the corner (2,) beside a view pixel (2,); None without one within reach."""
        return nearest_corner(self._gray, at, reach_px=_corner_reach_px(px_per_screen))

    def _sample(self, at: NDArray[np.float32]) -> FloatArray:
        u, v = at[..., 0], at[..., 1]
        intensity = look_up(self.view.intensity, u, v) * np.float32(255 / self._white)
        return np.stack([look_up(self._gray, u, v), intensity, _interpolated(self.view.ranges, u, v, _range_levels)])


@dataclass(frozen=True, eq=False)
class PhotoSnapper:
    """Snaps on a photograph; a line is straight in space, and bent by the lens."""

    photo: Photo
    """The photograph."""
    _gray: FloatArray

    @staticmethod
    def of(photo: Photo) -> PhotoSnapper:
        """Prepare a photograph."""
        return PhotoSnapper(photo, gray_of_photo(photo))

    def line(self, ends: ArrayLike, *, px_per_screen: float = 1.0) -> NDArray[np.float64] | None:
        """Return the ends (2, 2) on the edge under a line of photo pixels; None without one within reach.

        Args:
            ends: (2, 2), (u, v).
            px_per_screen: pixels of the photograph per pixel of the screen.
        """
        camera = self.photo.camera.as_pinhole
        if camera is None:
            return None  # straight edges are curves in a wide image
        if not camera.distortion:
            return edge_under(self._sample, ends, _options(px_per_screen))
        pinhole = camera.without_distortion()

        def bent(at: NDArray[np.float32]) -> FloatArray:
            return self._sample(np.nan_to_num(_through(pinhole, camera, at), nan=-1.0).astype(np.float32))

        found = edge_under(bent, _through(camera, pinhole, ends), _options(px_per_screen))
        return None if found is None else np.asarray(_through(pinhole, camera, found))

    def point(self, at: ArrayLike, *, px_per_screen: float = 1.0) -> FloatArray | None:
        """Return the corner (2,) beside a photo pixel (2,); None without one within reach."""
        return nearest_corner(self._gray, at, reach_px=_corner_reach_px(px_per_screen))

    def _sample(self, at: NDArray[np.float32]) -> FloatArray:
        return np.moveaxis(_interpolated(self.photo.pixels, at[..., 0], at[..., 1], _in_linear_light), -1, 0)


def _options(px_per_screen: float) -> EdgeOptions:
    reach = max(LINE_REACH * px_per_screen, _MIN_REACH_PX)
    return EdgeOptions(reach_px=reach, expected_px=_EXPECTED / LINE_REACH * reach)


def _corner_reach_px(px_per_screen: float) -> float:
    return min(CORNER_REACH * px_per_screen, _MAX_CORNER_PX)


def _through(seen_by: CameraModel, shown_by: CameraModel, uv: ArrayLike) -> NDArray[np.float64]:
    """Return the pixels (..., 2) of one camera for those of another at the same place."""
    return np.asarray(shown_by.project(seen_by.unproject(uv)), dtype=np.float64)


def _interpolated(
    image: NDArray[Any], u: FloatArray, v: FloatArray, levels_of: Callable[[NDArray[Any]], FloatArray]
) -> FloatArray:
    """Return the bilinear gray levels of an image at pixels; beyond its border those of the border.

    The levels are computed of the few pixels that are needed, not of the whole image.
    """
    height, width = image.shape[:2]
    u, v = np.clip(u, 0, width - 1), np.clip(v, 0, height - 1)
    left, top = np.minimum(u.astype(np.intp), max(width - 2, 0)), np.minimum(v.astype(np.intp), max(height - 2, 0))
    right, bottom = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    fu, fv = (u - left).astype(np.float32), (v - top).astype(np.float32)
    if image.ndim == 3:
        fu, fv = fu[..., None], fv[..., None]
    above = (1 - fu) * levels_of(image[top, left]) + fu * levels_of(image[top, right])
    below = (1 - fu) * levels_of(image[bottom, left]) + fu * levels_of(image[bottom, right])
    return np.asarray((1 - fv) * above + fv * below)


def _in_linear_light(encoded: NDArray[Any]) -> FloatArray:
    return np.asarray(_LINEAR[encoded])


def _range_levels(ranges: NDArray[Any]) -> FloatArray:
    known = np.isfinite(ranges)
    return np.asarray(np.where(known, _LEVELS_PER_RANGE * np.log(np.where(known, ranges, 1)), 0), dtype=np.float32)
