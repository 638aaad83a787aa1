"""Pictures of a scan for inspection: perspective views, renderings of them, and overlays of scan and photo."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, get_args
from weakref import ReferenceType, ref

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.camera import Camera, CameraModel
from ladarreg_core.errors import OptionError, ShapeError
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.foundations.palette import ACCENT, uniform
from ladarreg_core.foundations.validation import require_choice
from ladarreg_core.frames import Rigid, look_along
from ladarreg_core.inspection.drawn_surface import drawn_surface
from ladarreg_core.inspection.viewpoints import is_all_around
from ladarreg_core.matching.images.views import viewing_directions
from ladarreg_core.scan import Scan
from ladarreg_core.surface.perspective import View, check_viewable, most_view_pixels, native_focal_px, perspective_view
from ladarreg_core.surface.texture.registered_texture import RegisteredTexture, intensity_picture
from ladarreg_core.surface.visibility.render import LARGEST_DRAWN_SCAN, render_scan_picture

Show = Literal["intensity", "raw", "range", "shape", "normals", "edges", "color"]
OverlayShow = Literal["intensity", "edges", "range"]
_STRONG = 150.0
_WIDEST_PX = 2048
_MAX_PIXELS = 8_000_000
_ONE_VIEW_HALF_RAD = math.radians(50.0)
_FIELD_RAD = math.radians(90.0)
_WELL_FILLED, _SAMPLED = 0.9, 4
_NOTABLE = 1.05
_EMPTY = np.array((11, 12, 15), np.uint8)  # no return
_LIGHT = np.array((-0.58, 0.79, 0.21), np.float32)  # from above and the left: floors, walls and their sides differ
_CREASE = 0.04  # step of the range between neighbouring pixels, as a share of it, at which one surface hides another
_CREASE_GRAY = 0.25
_BINS = 4096
_RANGE_SAMPLES = 100_000  # for the limits of the gray levels
_MAX_GAMMA = 10.0
_BETWEEN_RAD = float(np.deg2rad(30.0))
_SAME_DIRECTION_RAD = float(np.deg2rad(10.0))
_MIN_SHARE_BETWEEN = 0.4  # of the cells that other views show


@dataclass(frozen=True, eq=False)
class NamedView:
    """A view of a scan with its name; the view itself, some 12 bytes a pixel, is made when it is asked for."""

    scan: Scan
    """The scan shown."""
    camera: Camera
    """The view's camera."""
    view_from_scanner: Rigid
    """Its rotation."""
    label: str
    """Its viewing direction, in words; empty for one in between, to which one turns step by step."""
    _latest: list[ReferenceType[View]] = field(default_factory=list, repr=False)

    @property
    def view(self) -> View:
        """The view: the same object for as long as anybody holds it."""
        found = self._latest[-1]() if self._latest else None
        if found is None:
            found = perspective_view(self.scan, self.camera, view_from_scanner=self.view_from_scanner)
            self._latest[:] = [ref(found)]
        return found


def inspection_views(scan: Scan) -> tuple[NamedView, ...]:
    """Return one view of the whole scan, or several side by side where one would be too wide.

    Several go from left to right and on at the left again; they begin with a well filled one, as nearly ahead as can
    be, or in the middle of the scan. Behind them are the views in between, without a label: of the directions in which
    the scan has cells, none is far from the middle of a view.

    Each has about one pixel per cell, but no more than 8 Mpixel, 16 pixels per cell of the scan, or 32,000 pixels a
    side; beyond these limits the views are coarser. Source: thesis 2.2.2.

    Raises:
        DegenerateGeometryError: if the scan is so narrow that no such view resolves its rows and columns.
    """
    rays = scan.sampled_directions
    away = np.arccos(np.clip(rays @ scan.mean_direction, -1, 1))
    if float(np.percentile(away, 99)) <= _ONE_VIEW_HALF_RAD:
        whole = perspective_view(scan, most_pixels=_MAX_PIXELS)
        return (NamedView(scan, whole.camera, whole.view_from_scanner, "the whole scan"),)
    focal = native_focal_px(scan)
    side = 2 * focal * math.tan(_FIELD_RAD / 2)
    share = min(1.0, math.sqrt(min(_MAX_PIXELS, most_view_pixels(scan))) / side)
    if share < 1:
        check_viewable(scan, focal * share)
    camera = Camera.from_focal(max(2, round(side * share)), max(2, round(side * share)), focal * share)
    directions = sorted(viewing_directions(scan, camera), key=lambda d: -_azimuth(d.rotation[2]))
    views = [NamedView(scan, camera, d, _direction_name(_azimuth(d.rotation[2]))) for d in directions]
    if len(views) > 1:
        filled = [_returns_in(view.view) for view in views]
        good = [k for k in range(len(views)) if filled[k] >= _WELL_FILLED * max(filled)]
        ahead = np.array([1.0, 0.0, 0.0]) if is_all_around(scan) else scan.mean_direction
        first = max(good, key=lambda k: float(directions[k].rotation[2] @ ahead))
        views = views[first:] + views[:first]
    return (*views, *_views_between(scan, camera, directions)) if len(views) > 1 else tuple(views)


def _views_between(scan: Scan, camera: Camera, directions: Sequence[Rigid]) -> list[NamedView]:
    """Return upright views some 30 degrees apart, in directions that no other has and where the scan has cells."""
    axes = [direction.rotation[2] for direction in directions]
    rays = scan.sampled_directions
    within = np.cos(_FIELD_RAD / 2)
    usual = float(np.median([np.count_nonzero(rays @ axis > within) for axis in axes]))
    found = []
    for elevation in np.arange(-3, 4) * _BETWEEN_RAD:
        count = max(1, round(2 * np.pi * np.cos(elevation) / _BETWEEN_RAD))
        for azimuth in 2 * np.pi * np.arange(count) / count:
            level = np.cos(elevation)
            axis = np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])
            if np.count_nonzero(rays @ axis > within) < _MIN_SHARE_BETWEEN * usual:
                continue
            if max(float(axis @ other) for other in axes) < np.cos(_SAME_DIRECTION_RAD):
                axes.append(axis)
                found.append(NamedView(scan, camera, Rigid(look_along(axis), np.zeros(3)), ""))
    return found


def _returns_in(view: View) -> int:
    """Return how many of a sample of pixels have returns."""
    column, row = np.rint(view.cells[::_SAMPLED, ::_SAMPLED][view.inside[::_SAMPLED, ::_SAMPLED]]).astype(np.intp).T
    return int(np.count_nonzero(view.scan.valid[row, column]))


def resolution_note(scan: Scan, views: Sequence[NamedView]) -> str | None:
    """Return a note where the views have fewer pixels than the scan has cells in its finer direction."""
    cells = max((native_focal_px(scan) / named.camera.fx for named in views), default=1.0)
    if cells < _NOTABLE:
        return None
    return f"shown at one pixel per {cells:.2g} cells of its finer direction, the finest resolution of a view"


def usual_show(scan: Scan) -> Show:
    """Return how a scan is shown at first: by its intensity or, where it has none, by its shape."""
    return "intensity" if scan.has_intensity else "shape"


def display_note(scan: Scan) -> str | None:
    """Return a note on how a scan without intensity is shown."""
    if scan.has_intensity:
        return None
    return "the scan has no intensity, so it is shown by its shape; its range, normals and edges can be shown instead"


@dataclass(frozen=True, slots=True, kw_only=True)
class Stretch:
    """Mapping of intensities to gray levels.

    Raises:
        OptionError: if the percentiles do not rise, or gamma is not positive.
    """

    low: float = 1.0
    """Percentile that becomes black."""
    high: float = 99.5
    """Percentile that becomes white."""
    gamma: float = 0.6
    """Exponent; values below 1 brighten dark parts."""
    equalise: bool = False
    """Equalise the histogram instead."""

    def __post_init__(self) -> None:
        if not 0 <= self.low < self.high <= 100:
            raise OptionError(f"the contrast runs from {self.low} to {self.high} %; give rising percentiles, 0 to 100")
        if not 0 < self.gamma <= _MAX_GAMMA:
            raise OptionError(f"gamma is {self.gamma}; it must be positive, at most {_MAX_GAMMA:g}")


def scan_picture(view: View, show: str, stretch: Stretch | None = None) -> NDArray[np.uint8]:
    """Render a view of the scan, (h, w, 3) uint8 RGB.

    Args:
        view: the view.
        show: `intensity`, compensated for range; `raw`, as recorded; `range`, colours by inverse range, to which
            parallax is proportional; `shape`, the surface as if lit from above, with dark outlines, which needs no
            intensity; `normals`, surface normals as colours; `edges` of intensity and range; `color`,
            the colour recorded by the scanner.
        stretch: contrast of the intensity; for the range only its percentiles count.

    Raises:
        OptionError: if there is no such rendering.
        ShapeError: if the scan has no colour of its own.
    """
    if show not in get_args(Show):
        raise OptionError(f"the scan cannot be shown as {show!r}; choose one of {', '.join(get_args(Show))}")
    if show == "color":
        if view.scan.color is None:
            raise ShapeError("the scan has no colour of its own; show its intensity")
        planes = [view.resample(view.scan.color[..., k].astype(np.float32)) for k in range(3)]
        picture = np.rint(np.stack(planes, axis=-1)).astype(np.uint8)
        return np.where(view.inside[..., None], picture, _EMPTY)
    ranges, intensity = drawn_surface(view)
    seen = np.isfinite(ranges)
    if show in ("intensity", "raw"):
        values = intensity if show == "raw" else _compensated(view.scan, ranges, intensity)
        gray = stretched(values, seen, stretch or Stretch())
        picture = np.repeat(gray[..., None], 3, axis=-1)
    elif show == "range":
        picture = _range_colors(ranges, seen, stretch or Stretch(low=1, high=99))
    elif show == "shape":
        picture = np.repeat(_shape_shading(view.camera, ranges, seen)[..., None], 3, axis=-1)
    elif show == "normals":
        picture = _normal_colors(view.camera, ranges)
    else:
        gray = 255 - edge_strength(view)
        picture = np.repeat(gray[..., None], 3, axis=-1)
    return np.where(seen[..., None], picture, _EMPTY)


def compensated(view: View) -> FloatArray:
    """Return the intensity of a view, (h, w), compensated to the median range.

    Returned light falls with the square of the range; compensation makes far surfaces as legible as near ones. It is
    limited to a factor of four in range, beyond which it would amplify noise only.
    """
    return _compensated(view.scan, view.ranges, view.intensity)


def _compensated(scan: Scan, ranges: FloatArray, intensity: FloatArray) -> FloatArray:
    seen = np.isfinite(ranges)
    if scan.intensity_is != "raw" or not seen.any():
        return intensity
    share = ranges / np.float32(np.median(ranges[seen]))
    return np.asarray(intensity * np.clip(np.nan_to_num(share, nan=1.0), 0.25, 4.0) ** 2, dtype=np.float32)


def stretched(values: FloatArray, known: NDArray[np.bool_], stretch: Stretch) -> NDArray[np.uint8]:
    """Map values (h, w) to gray levels (h, w), by the distribution of the known ones."""
    if not known.any():
        return np.zeros(values.shape, np.uint8)
    chosen = values[known]
    low, high = (float(v) for v in np.percentile(chosen, (stretch.low, stretch.high)))
    share = np.clip((values - np.float32(low)) / np.float32(max(high - low, 1e-12)), 0, 1)
    if stretch.equalise:
        counts, edges = np.histogram(share[known], bins=_BINS, range=(0, 1))
        rank = np.concatenate([[0.0], np.cumsum(counts)]) / max(int(counts.sum()), 1)
        share = np.interp(share, edges, rank).astype(np.float32)
    else:
        share = share ** np.float32(stretch.gamma)
    return np.asarray(np.rint(share * 255), dtype=np.uint8)


def edge_strength(view: View) -> NDArray[np.uint8]:
    """Return the edge strength, (h, w) 0 to 255: of intensity or of inverse range, whichever is stronger."""
    seen = np.isfinite(view.ranges)
    gray = stretched(compensated(view), seen, Stretch()).astype(np.float32)
    depth = np.where(seen, 1 / np.where(seen, view.ranges, 1), 0).astype(np.float32)
    typical = float(np.median(depth[seen])) if seen.any() else 1.0
    of_gray = _magnitude(gray) / 160
    of_depth = _magnitude(depth) / (0.25 * typical)
    return np.asarray(np.rint(255 * np.clip(np.maximum(of_gray, of_depth), 0, 1)), dtype=np.uint8)


def scan_over_photo(scan: Scan, camera: CameraModel, camera_from_scanner: Rigid, show: str) -> NDArray[np.uint8]:
    """Render the scan as seen by the camera of the photo, (h, w, 4) uint8 RGBA; alpha 0 where it sees no surface.

    Args:
        scan: the scan.
        camera: the camera of the photo; images wider than 2048 px are reduced.
        camera_from_scanner: its pose.
        show: `intensity`, `edges` of the intensity and of the surface, or `range`.

    Raises:
        OptionError: if there is no such overlay.
    """
    require_choice(show, get_args(OverlayShow), "the overlay")
    if camera.width > _WIDEST_PX:
        camera = camera.resized(_WIDEST_PX, max(1, round(camera.height * _WIDEST_PX / camera.width)))
    scan, _ = scan.thinned(LARGEST_DRAWN_SCAN)
    picture = _range_picture(scan) if show == "range" else intensity_picture(scan)
    if show == "edges":  # one rendering for both grays, of which every channel is a copy
        picture = np.stack([picture[..., 0], _range_picture(scan)[..., 0], picture[..., 0]], axis=-1)
    color, covered = render_scan_picture(scan, camera, camera_from_scanner, picture)
    if show != "edges":
        return _with_alpha(color, np.where(covered, 255, 0))
    strength = np.maximum(_magnitude(color[..., 0]), _magnitude(color[..., 1]))
    edge = uniform(covered.shape, ACCENT)
    inside = cv2.erode(covered.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    return _with_alpha(edge, np.where(inside, np.clip(255 * strength / _STRONG, 0, 255), 0))


def photo_over_scan(view: View, texture: RegisteredTexture) -> NDArray[np.uint8]:
    """Render the photo as seen from the scanner, in a view, (h, w, 4) uint8 RGBA; alpha 0 where it has no colour."""
    planes = [view.resample(texture.image[..., k].astype(np.float32)) for k in range(3)]
    known = view.resample(texture.colored.astype(np.float32))
    color = np.rint(np.stack(planes, axis=-1)).astype(np.uint8)
    return _with_alpha(color, np.where(view.inside, 255 * known, 0))


def _azimuth(forward: np.ndarray) -> float:
    return math.atan2(float(forward[1]), float(forward[0]))


def _direction_name(azimuth: float) -> str:
    degrees = round(math.degrees(azimuth))
    if degrees == 0:
        return "ahead"
    return f"{abs(degrees)} deg {'left' if degrees > 0 else 'right'}"


def _magnitude(plane: NDArray[Any]) -> FloatArray:
    """Return the gradient magnitude (h, w) of a plane, by Sobel filters."""
    values = plane.astype(np.float32)
    return np.hypot(cv2.Sobel(values, cv2.CV_32F, 1, 0), cv2.Sobel(values, cv2.CV_32F, 0, 1))


def _range_colors(ranges: FloatArray, seen: NDArray[np.bool_], stretch: Stretch) -> NDArray[np.uint8]:
    inverse = np.where(seen, 1 / np.where(seen, ranges, 1), 0)
    if not seen.any():
        return np.zeros((*ranges.shape, 3), np.uint8)
    low, high = np.percentile(inverse[seen], (stretch.low, stretch.high))
    level = np.rint(255 * np.clip((inverse - low) / max(high - low, 1e-12), 0, 1)).astype(np.uint8)
    return np.asarray(cv2.cvtColor(cv2.applyColorMap(level, cv2.COLORMAP_VIRIDIS), cv2.COLOR_BGR2RGB), dtype=np.uint8)


def _normal_colors(camera: Camera, ranges: FloatArray) -> NDArray[np.uint8]:
    """Colour a surface by its normal in view axes, as renderers do: right red, up green, facing the viewer blue."""
    return np.asarray(np.rint(127.5 * (_normals(camera, np.nan_to_num(ranges)) + 1)), dtype=np.uint8)


def _shape_shading(camera: Camera, ranges: FloatArray, seen: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Return gray levels (h, w) of a matt surface, darker along the outlines of nearer parts and beside holes."""
    if not seen.any():
        return np.zeros(ranges.shape, np.uint8)
    normals = _normals(camera, _filled(ranges, seen))
    shade = 0.15 + 0.85 * np.clip(0.5 + 0.5 * normals @ _LIGHT, 0, 1) ** 1.5
    low = cv2.erode(np.where(seen, ranges, np.float32(1e9)).astype(np.float32), np.ones((3, 3), np.uint8))
    hidden = seen & (ranges / low > 1 + _CREASE)  # the farther side: the nearer surface keeps its whole width
    shade = np.where(hidden, _CREASE_GRAY * shade, shade)
    return np.asarray(np.rint(255 * np.clip(shade, 0, 1)), dtype=np.uint8)


def _filled(ranges: FloatArray, seen: NDArray[np.bool_]) -> FloatArray:
    """Return ranges (h, w) with those of the nearest known pixel where there is none, so that borders have normals."""
    empty = np.asarray(~seen, np.uint8)
    _, label = cv2.distanceTransformWithLabels(empty, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    of_label = np.zeros(int(label.max()) + 1, np.float32)
    of_label[label[seen]] = ranges[seen]
    return np.asarray(of_label[label])


def _normals(camera: Camera, ranges: FloatArray) -> FloatArray:
    """Return the normals (h, w, 3) of a surface, x right, y up, z towards the viewer; of ranges in m, 0 for none."""
    smooth = cv2.bilateralFilter(np.log(np.maximum(ranges, 1e-3)).astype(np.float32), 7, 0.03, 3)
    v, u = np.mgrid[: camera.height, : camera.width].astype(np.float32)
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], axis=-1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    points = rays * np.exp(smooth)[..., None]
    across, down = (
        np.stack([cv2.Sobel(points[..., k], cv2.CV_32F, dx, dy, ksize=5) for k in range(3)], axis=-1)
        for dx, dy in ((1, 0), (0, 1))
    )
    normal = np.cross(down, across)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
    return np.asarray(normal * np.array([1, -1, -1], np.float32))


def _range_picture(scan: Scan) -> NDArray[np.uint8]:
    inverse = np.where(scan.valid, 1 / np.where(scan.valid, scan.ranges, 1), 0)
    seen = inverse[scan.valid]
    low, high = np.percentile(seen[:: max(1, len(seen) // _RANGE_SAMPLES)], (1, 99))
    level = np.rint(255 * np.clip((inverse - low) / max(high - low, 1e-12), 0, 1)).astype(np.uint8)
    return np.asarray(cv2.cvtColor(level, cv2.COLOR_GRAY2RGB), dtype=np.uint8)


def _with_alpha(color: NDArray[np.uint8], alpha: NDArray[np.generic]) -> NDArray[np.uint8]:
    return np.dstack([color, np.rint(alpha).astype(np.uint8)])
