"""The photograph on the scan's grid with a visibility class for every cell, and images of the model made of it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any
from weakref import WeakKeyDictionary

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.camera import CameraModel
from ladarreg_core.camera.uncertainty import CameraUncertainty
from ladarreg_core.errors import OptionError, ShapeError
from ladarreg_core.foundations.arrays import BoolArray, ByteArray, FloatArray, read_only
from ladarreg_core.foundations.palette import UNSEEN, uniform
from ladarreg_core.foundations.validation import require_number
from ladarreg_core.frames import Rigid
from ladarreg_core.photo import Photo
from ladarreg_core.scan import Scan
from ladarreg_core.surface.mesh.grid_mesh import grid_edges
from ladarreg_core.surface.remap import look_up
from ladarreg_core.surface.uncertainty import pixel_sigma
from ladarreg_core.surface.visibility.visible_points import (
    LARGEST_WHOLE_SCAN,
    ScanProjection,
    ScanTile,
    project_scan,
    projected_tiles,
)

_LARGEST_POSE_SIGMA_PX = 2.0
_ROWS_AT_ONCE = 256
_latest_intensity: WeakKeyDictionary[Scan, ByteArray] = WeakKeyDictionary()
_NET_NODES = 65
_UNSEEN_BRIGHTNESS = 0.45
_SEAM_PX = 64
_LARGEST_ISOLATED, _AROUND, _MOSTLY = 12, (5, 5), 0.5  # cells; share of visible cells around
_OUTSIDE = np.float32(-10)
_DARKEST, _BRIGHTEST = 18.0, 245.0
_PERCENTILES = (1.0, 99.0)
_GAMMA = 0.6  # raw intensity falls with the square of the range: most values are near the dark end


class Label(IntEnum):
    """Visibility class of a cell: how reliable its colour is. The codes are part of every export."""

    NO_RETURN = 0
    """The scanner has no return."""
    SEEN = 1
    """Visible to the camera."""
    OCCLUDED = 2
    """Hidden from the camera, or facing away from it."""
    OUT_OF_FRAME = 3
    """Outside the photograph."""
    GRAZING = 4
    """Seen by the camera at an incidence beyond 80 degrees: the colour is smeared."""
    UNCERTAIN = 5
    """Within one cell of a depth edge, as seen by scanner or camera, with a pose uncertainty of over 2 px, or among a
    few cells that only the noise of their ranges may hide from the camera."""


COLORED = (Label.SEEN, Label.GRAZING, Label.UNCERTAIN)
"""The classes whose cells have the photograph's colour."""


@dataclass(frozen=True, slots=True, eq=False)
class RegisteredTexture:
    """The photograph resampled onto the scan's grid; read-only."""

    image: ByteArray
    """(H, W, 3) uint8 RGB; cells not seen by the camera have a uniform colour."""
    labels: ByteArray
    """(H, W) uint8, codes of `Label`."""

    def __post_init__(self) -> None:
        image = read_only(self.image, np.uint8, (None, None, 3), "the registered image")
        object.__setattr__(self, "image", image)
        object.__setattr__(self, "labels", read_only(self.labels, np.uint8, image.shape[:2], "the labels"))

    @property
    def colored(self) -> BoolArray:
        """(H, W) bool: cells with the photograph's colour."""
        return self.colored_rows(slice(None))

    def colored_rows(self, rows: slice) -> BoolArray:
        """Return some rows of `coloured`."""
        table = np.zeros(256, dtype=np.bool_)
        table[list(COLORED)] = True
        return table[self.labels[rows]]


def texture_scan(
    scan: Scan,
    photo: Photo,
    camera_from_scanner: Rigid,
    *,
    camera: CameraModel | None = None,
    covariance: FloatArray | CameraUncertainty | None = None,
    background: tuple[int, int, int] = UNSEEN,
) -> RegisteredTexture:
    """Resample a photograph onto a scan's grid, for the cells that the camera sees.

    Args:
        scan: the scan.
        photo: the photograph.
        camera_from_scanner: its pose.
        camera: intrinsics instead of the photo's, e.g. estimated ones.
        covariance: (6, 6) of (w, c) as `PoseResult.covariance`, rad and m, or of pose and camera together; None: the
            pose is taken as exact.
        background: RGB of cells not seen by the camera.

    Returns:
        The image and its labels. If several classes apply, the first of these is used: no return, out of frame,
        occluded, uncertain, grazing, seen.

    Raises:
        ShapeError: if the camera is not of the photo's size, or the covariance not (6, 6) and positive.
        OptionError: if the background is not a colour.

    Source: thesis 2.5.
    """
    color = np.asarray(background)
    if color.shape != (3,) or color.dtype.kind not in "iu" or color.min() < 0 or color.max() > 255:
        raise OptionError(f"the background is {background!r}; it must be three whole numbers from 0 to 255")
    beyond = (int(color[0]), int(color[1]), int(color[2]))
    image = uniform(scan.shape, beyond)
    labels = np.full(scan.shape, Label.OUT_OF_FRAME, np.uint8)
    for part in textured_parts(
        scan, photo, camera_from_scanner, camera=camera, covariance=covariance, background=beyond
    ):
        image[part.rows, part.columns], labels[part.rows, part.columns] = part.image, part.labels
    labels[~scan.valid] = Label.NO_RETURN
    for array in (image, labels):
        array.flags.writeable = False  # handed over, not copied
    return RegisteredTexture(image, labels)


@dataclass(frozen=True, slots=True, eq=False)
class TexturedPart:
    """A rectangle of a scan with the colours of a photograph."""

    rows: slice
    """Rows of the scan."""
    columns: slice
    """Columns of the scan."""
    image: NDArray[np.uint8]
    """(h, w, 3), as `RegisteredTexture.image`."""
    labels: NDArray[np.uint8]
    """(h, w), as `RegisteredTexture.labels`."""
    projection: ScanProjection
    """Its cells in the photograph."""


def textured_parts(
    scan: Scan,
    photo: Photo,
    camera_from_scanner: Rigid,
    *,
    camera: CameraModel | None = None,
    covariance: FloatArray | CameraUncertainty | None = None,
    background: tuple[int, ...] = UNSEEN,
) -> Iterator[TexturedPart]:
    """Yield the parts of `texture_scan` that a photograph may show, so that memory does not grow with the scan.

    Raises:
        ShapeError: if the camera is not of the photo's size, or the covariance not (6, 6) and positive.
    """
    camera = photo.camera if camera is None else camera
    if camera.size != photo.camera.size:
        raise ShapeError(
            f"the camera is for {camera.width} x {camera.height} pixels, the photo has {photo.camera.width} x "
            f"{photo.camera.height}; give the intrinsics for this image size"
        )
    if covariance is not None and not isinstance(covariance, CameraUncertainty):
        covariance = read_only(covariance, np.float64, (6, 6), "the pose covariance")
    if scan.ranges.size > LARGEST_WHOLE_SCAN:
        tiles = projected_tiles(scan, camera, camera_from_scanner)
    else:
        whole = slice(0, scan.shape[0]), slice(0, scan.shape[1])
        projection = project_scan(scan, camera, camera_from_scanner)
        tiles = iter([ScanTile(*whole, scan, projection, whole)])
    for tile in tiles:
        projection = _without_isolated_shadows(tile.projection)
        labels = _labels(tile.scan, projection, camera, camera_from_scanner, covariance)
        image = cell_values(photo.pixels, projection, tile.scan.ranges, scan.geometry.step_rad, camera, background)
        inner = projection.of_cells(*tile.inner)
        yield TexturedPart(tile.rows, tile.columns, image[tile.inner], labels[tile.inner], inner)


def model_picture(scan: Scan, texture: RegisteredTexture) -> ByteArray:
    """Return the model's texture, (H, W, 3): the photo's colour where seen, dimmed laser intensity elsewhere.

    Raises:
        ShapeError: if the texture is not on the scan's grid.
    """
    if texture.labels.shape != scan.shape:
        raise ShapeError(f"the texture has {texture.labels.shape} cells, the scan {scan.shape}; they must agree")
    picture = np.empty((*scan.shape, 3), np.uint8)
    levels = dimmed_levels(scan)
    for first in range(0, scan.shape[0], _ROWS_AT_ONCE):
        rows = slice(first, first + _ROWS_AT_ONCE)
        picture[rows] = model_rows(scan, texture, rows, levels)
    return picture


def dimmed_levels(scan: Scan) -> tuple[float, float]:
    """Return the intensities that are drawn darkest and brightest where the camera sees nothing."""
    low, high = np.quantile(_sampled_intensity(scan), (0.02, 0.98))
    return float(low), float(high)


def model_rows(scan: Scan, texture: RegisteredTexture, rows: slice, levels: tuple[float, float]) -> NDArray[np.uint8]:
    """Return some rows of `model_picture`, given `dimmed_levels` of the scan."""
    gray = dimmed_gray(scan.intensity[rows], levels)
    picture = cv2.cvtColor(gray, cv2.COLOR_GRAY2RGB)
    cv2.copyTo(texture.image[rows], texture.colored_rows(rows).view(np.uint8), picture)
    return np.asarray(picture, dtype=np.uint8)


def dimmed_picture(scan: Scan) -> NDArray[np.uint8]:
    """Return the dimmed laser intensity of what no camera sees, (H, W) gray."""
    levels = dimmed_levels(scan)
    picture = np.empty(scan.shape, np.uint8)
    for first in range(0, scan.shape[0], _ROWS_AT_ONCE):
        rows = slice(first, first + _ROWS_AT_ONCE)
        picture[rows] = dimmed_gray(scan.intensity[rows], levels)
    return picture


def dimmed_gray(intensity: FloatArray, levels: tuple[float, float]) -> NDArray[np.uint8]:
    """Return intensities (...,) as gray levels of what no camera sees, given `dimmed_levels` of their scan."""
    low, high = levels
    span = max(high - low, 1e-12)
    bright = np.clip((intensity - np.float32(low)) / np.float32(span), 0, 1) * 0.85 + 0.15
    return np.asarray(np.rint(bright * (255 * _UNSEEN_BRIGHTNESS)).astype(np.uint8))


def _sampled_intensity(scan: Scan) -> FloatArray:
    """Return the intensities of the returns (N,), of a large scan of every n-th row and column."""
    stride = max(1, int(np.sqrt(scan.ranges.size / LARGEST_WHOLE_SCAN)))
    part = slice(None, None, stride), slice(None, None, stride)
    some = scan.intensity[part][scan.valid[part]]
    return some if len(some) else scan.intensity[scan.valid]


def intensity_levels(scan: Scan) -> tuple[float, float]:
    """Return the intensities that are drawn darkest and brightest in a picture of the scan."""
    low, high = np.percentile(_sampled_intensity(scan), _PERCENTILES)
    return float(low), float(high)


def intensity_rows(intensity: FloatArray, levels: tuple[float, float]) -> NDArray[np.uint8]:
    """Return intensities (...,) as gray levels with stretched contrast, given `intensity_levels` of their scan."""
    low, high = levels
    share = np.clip((intensity - np.float32(low)) / np.float32(max(high - low, 1e-12)), 0, 1)
    return np.asarray(np.rint(_DARKEST + share**_GAMMA * (_BRIGHTEST - _DARKEST)), dtype=np.uint8)


def intensity_picture(scan: Scan) -> ByteArray:
    """Return the scan's intensity, with stretched contrast, as gray RGB, (H, W, 3) uint8, read-only.

    The picture of the latest scan is kept, unless the scan is large: a report shows it in several places.
    """
    known = _latest_intensity.get(scan)
    if known is None:
        known = _intensity_picture(scan)
        known.flags.writeable = False
        _latest_intensity.clear()
        if scan.ranges.size <= LARGEST_WHOLE_SCAN:
            _latest_intensity[scan] = known
    return known


def _intensity_picture(scan: Scan) -> NDArray[np.uint8]:
    levels = intensity_levels(scan)
    gray = np.empty(scan.shape, np.uint8)
    for first in range(0, scan.shape[0], _ROWS_AT_ONCE):
        rows = slice(first, first + _ROWS_AT_ONCE)
        gray[rows] = intensity_rows(scan.intensity[rows], levels)
    gray[~scan.valid] = 0
    return np.asarray(cv2.cvtColor(gray, cv2.COLOR_GRAY2RGB), dtype=np.uint8)


def blended_picture(scan: Scan, texture: RegisteredTexture, *, share: float) -> ByteArray:
    """Return the model's texture, blended from the laser intensity (`share` 0) and the photograph's colour (1).

    Args:
        scan: the scan.
        texture: the photograph on its grid.
        share: share of the photograph's colour, 0 to 1.

    Returns:
        (H, W, 3) uint8 RGB; `model_picture` for a share of 1.

    Raises:
        OptionError: if the share is not from 0 to 1.
        ShapeError: if the texture is not on the scan's grid.
    """
    require_number(share, "the share of colour", least=0, most=1)
    color = model_picture(scan, texture)
    if share == 1:
        return color
    mixed = (1 - share) * intensity_picture(scan).astype(np.float32) + share * color.astype(np.float32)
    return np.rint(mixed).astype(np.uint8)


def _without_isolated_shadows(projection: ScanProjection) -> ScanProjection:
    """Return a projection in which a few occluded cells among visible ones count as untested.

    The noise of the ranges hides single cells of plain walls from the camera, which a real shadow of that size does not
    differ from: they keep the photograph's colour, which would else be peppered, and are labelled as uncertain.
    """
    count, component, stats, _ = cv2.connectedComponentsWithStats(projection.occluded.view(np.uint8), connectivity=4)
    small = stats[:count, cv2.CC_STAT_AREA] <= _LARGEST_ISOLATED
    small[0] = False  # the visible cells
    around = cv2.blur(projection.visible.astype(np.float32), _AROUND, borderType=cv2.BORDER_REPLICATE)
    isolated = small[component] & (around >= _MOSTLY)
    return replace(
        projection, occluded=projection.occluded & ~isolated, untested=np.asarray(projection.untested | isolated)
    )


def _labels(
    scan: Scan,
    projection: ScanProjection,
    camera: CameraModel,
    camera_from_scanner: Rigid,
    covariance: FloatArray | CameraUncertainty | None,
) -> NDArray[np.uint8]:
    labels = np.full(scan.shape, Label.SEEN, dtype=np.uint8)
    labels[projection.grazing] = Label.GRAZING
    uncertain = _at_depth_edge(scan) | projection.untested | _dilated(projection.occluded)
    if covariance is not None:
        uncertain |= _pose_uncertain(scan, projection, camera, camera_from_scanner, covariance)
    labels[uncertain] = Label.UNCERTAIN
    labels[projection.occluded] = Label.OCCLUDED
    labels[~projection.in_picture] = Label.OUT_OF_FRAME
    labels[~scan.valid] = Label.NO_RETURN
    return labels


def _at_depth_edge(scan: Scan) -> BoolArray:
    """Return the cells on both sides of every depth edge."""
    edges, valid = grid_edges(scan), scan.valid
    result = np.zeros(scan.shape, dtype=np.bool_)
    torn = ~edges.right & valid[:, 1:] & valid[:, :-1]
    result[:, 1:] |= torn
    result[:, :-1] |= torn
    torn = ~edges.down & valid[1:] & valid[:-1]
    result[1:] |= torn
    result[:-1] |= torn
    return result


def _dilated(mask: BoolArray) -> BoolArray:
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    return np.asarray(cv2.dilate(mask.view(np.uint8), cross)).astype(np.bool_)


def _pose_uncertain(
    scan: Scan,
    projection: ScanProjection,
    camera: CameraModel,
    camera_from_scanner: Rigid,
    covariance: FloatArray | CameraUncertainty,
) -> BoolArray:
    """Return the visible cells where the pose uncertainty exceeds 2 px; all of them if the covariance is not finite."""
    visible = projection.visible
    numbers = covariance.covariance if isinstance(covariance, CameraUncertainty) else covariance
    if not np.isfinite(numbers).all() or not visible.any():
        return visible
    rotation = camera_from_scanner.rotation
    # At a pixel the variance is convex in 1/z, so it is largest at the nearest or the farthest depth: if it is small
    # for both all over the image, as it nearly always is, no cell needs to be checked.
    net = [np.linspace(0, n - 1, _NET_NODES) for n in camera.size]
    rays = camera.unproject(np.stack(np.meshgrid(*net), axis=-1))
    along = camera.depth_of(rays)[..., None]
    depths = projection.depth_m[visible]
    ends = [
        pixel_sigma(rays * (depth / along), camera, rotation, covariance)
        for depth in (float(depths.min()), float(depths.max()))
    ]
    if np.isfinite(ends).all() and np.max(ends) < 0.99 * _LARGEST_POSE_SIGMA_PX:
        return np.zeros(scan.shape, dtype=np.bool_)
    result = np.zeros(scan.shape, dtype=np.bool_)
    sigma = pixel_sigma(camera_from_scanner @ scan.points[visible], camera, rotation, covariance)
    result[visible] = ~(sigma <= _LARGEST_POSE_SIGMA_PX)
    return result


def cell_values(
    pixels: NDArray[Any],
    projection: ScanProjection,
    ranges: FloatArray,
    step_rad: tuple[float, float],
    camera: CameraModel,
    background: tuple[float, ...],
) -> NDArray[Any]:
    """Return a picture's values at every visible cell, from a copy reduced to about the size of the cell.

    Args:
        pixels: (h, w, 3) uint8, or (h, w) float32; NaN in it makes the cells around NaN.
        projection: the cells (H, W) in the picture.
        ranges: (H, W) of the cells, m.
        step_rad: angles between neighbouring rows and columns of the scan.
        camera: the picture's camera.
        background: the value of other cells, a number per channel.

    Returns:
        values (H, W, 3) or (H, W), of the picture's type.
    """
    visible = projection.visible
    u, v = (np.where(visible, projection.uv[..., k], _OUTSIDE) for k in range(2))
    if camera.turn_px:  # colours are continuous across the seam
        pixels = np.concatenate([pixels[:, -_SEAM_PX:], pixels, pixels[:, :_SEAM_PX]], axis=1)
        u = np.where(visible, u + np.float32(min(_SEAM_PX, camera.width)), _OUTSIDE)
    reach = np.float32(camera.focal_px * np.sqrt(step_rad[0] * step_rad[1]))
    with np.errstate(invalid="ignore", divide="ignore"):
        cell_px = np.where(visible, reach * ranges / projection.depth_m, np.float32(0))
    largest = float(cell_px.max())
    smallest = float(np.min(cell_px, where=visible, initial=largest))
    result: NDArray[Any] | None = None
    reduced, level = pixels, 0
    while True:
        last = largest < 2 ** (level + 1) or min(reduced.shape[:2]) < 4
        if last or smallest < 2 ** (level + 1):  # this copy fits some cells best
            at_u, at_v = (u, v) if level == 0 else _in_copy(u, v, visible, pixels, reduced)
            colors = look_up(reduced, at_u, at_v, outside=background)
            if result is None:
                result = colors
            else:
                larger = cell_px >= 2**level
                np.copyto(result, colors, where=larger[..., None] if colors.ndim == 3 else larger)
        if last:
            assert result is not None, "the last copy is always used"
            return result
        size = (reduced.shape[1] // 2, reduced.shape[0] // 2)
        reduced = np.asarray(cv2.resize(reduced, size, interpolation=cv2.INTER_AREA), dtype=pixels.dtype)
        level += 1


def _in_copy(
    u: FloatArray, v: FloatArray, visible: BoolArray, pixels: NDArray[Any], reduced: NDArray[Any]
) -> tuple[FloatArray, FloatArray]:
    """Return the positions of pixels in a reduced copy: outer borders are fixed, so centres move."""
    half, at = np.float32(0.5), []
    for position, n, whole in ((u, reduced.shape[1], pixels.shape[1]), (v, reduced.shape[0], pixels.shape[0])):
        moved = np.clip((position + half) * np.float32(n / whole) - half, 0, n - 1)
        at.append(np.where(visible, moved, _OUTSIDE))
    return at[0], at[1]
