"""Textures of the 3-D model: the photograph, laser measurements, or the quality of the pose."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import OptionError, ShapeError
from ladarreg_core.foundations.arrays import ByteArray, FloatArray, read_only
from ladarreg_core.foundations.palette import (
    UNKNOWN,
    VISIBILITY,
    Color,
    as_css,
    diverging_colors,
    paint,
    ramp_colors,
    scale_end,
)
from ladarreg_core.inspection.surface_fields import (
    depth_error_field,
    residual_field,
    resolution_field,
    without_pepper,
)
from ladarreg_core.photo import Photo
from ladarreg_core.results.registration import PoseResult
from ladarreg_core.scan import Scan
from ladarreg_core.surface.perspective import View
from ladarreg_core.surface.remap import look_up
from ladarreg_core.surface.texture.registered_texture import (
    Label,
    RegisteredTexture,
    intensity_picture,
    model_picture,
    texture_scan,
)
from ladarreg_core.surface.uncertainty import picture_sigma
from ladarreg_core.surface.visibility.visible_points import LARGEST_WHOLE_SCAN

TextureKind = Literal["colour", "intensity", "range", "residual", "depth_error", "uncertainty", "resolution", "label"]


_LABEL_MEANINGS = {
    Label.SEEN: "seen by the camera",
    Label.OCCLUDED: "occluded: hidden from the camera",
    Label.OUT_OF_FRAME: "out of frame: outside the photograph",
    Label.GRAZING: "grazing: seen at a grazing angle",
    Label.UNCERTAIN: "uncertain: at a depth edge, or by more than 2 px",
}
_KINDS: dict[TextureKind, tuple[str, str]] = {
    "colour": ("Colour", "the photograph, where the camera sees the surface"),
    "intensity": ("Intensity", "laser intensity"),
    "range": ("Range", "distance from the scanner"),
    "residual": ("Residual", "residual of the nearby matches"),
    "depth_error": ("Depth error", "laser minus stereo depth of the nearby matches"),
    "uncertainty": ("Uncertainty", "uncertainty of the photo position"),
    "resolution": ("Resolution", "size of the photograph's pixels on the surface"),
    "label": ("Visibility class", "how reliable each colour is"),
}
_SHOWN_CELL_BY_CELL = ("colour", "intensity", "range", "label")
"""Of a large scan; other kinds are smooth, and shown by every n-th of its rows and columns."""
_ROWS_AT_ONCE = 256
_NEED_POSE = ("colour", "residual", "depth_error", "uncertainty", "resolution", "label")
_RAMP = 17
_SHARE_SHOWN = (1.0, 99.0)  # per cent; a few far cells must not compress the scale for all others
_MIN_COLOR_PX, _MIN_MM = 1e-3, 1e-3
_OUTSIDE = np.float32(-10)


@dataclass(frozen=True, slots=True)
class Legend:
    """Legend of a texture: single colours with their meanings, a scale, or both."""

    title: str
    """Quantity shown, with its unit."""
    entries: tuple[tuple[Color, str], ...] = ()
    """RGB with its meaning."""
    ramp: tuple[Color, ...] = ()
    """RGB along a scale, from its least to its greatest value; empty: no scale."""
    least: str = ""
    """Value of the first colour of the scale."""
    most: str = ""
    """Value of the last colour of the scale."""

    def as_fields(self) -> dict[str, Any]:
        """Return the legend with its colours as `#rrggbb`, JSON-ready."""
        return {
            "title": self.title,
            "entries": [{"colour": as_css(color), "label": words} for color, words in self.entries],
            "ramp": [as_css(color) for color in self.ramp],
            "least": self.least,
            "most": self.most,
        }


@dataclass(frozen=True, slots=True, eq=False)
class ModelTexture:
    """Texture for the whole scan grid with its legend; read-only."""

    image: ByteArray
    """(H, W, 3) uint8 RGB."""
    legend: Legend
    """Its legend."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "image", read_only(self.image, np.uint8, (None, None, 3), "the texture of the model"))


@dataclass(frozen=True, slots=True)
class TextureChoice:
    """Menu entry for a kind of texture."""

    kind: TextureKind
    """Its identifier."""
    label: str
    """Its displayed name."""
    usable: bool
    """Whether its inputs are available."""
    description: str
    """What it shows, or which input is missing."""


def texture_choices(result: PoseResult | None) -> tuple[TextureChoice, ...]:
    """Return the kinds of texture, with those that need an accepted pose marked as unusable without one.

    Args:
        result: the pose shown, if any.
    """
    missing = None
    if result is None:
        missing = "needs a pose; there is none yet"
    elif not result.is_shown:
        missing = "needs an accepted pose; this one is not accepted"
    choices = []
    for kind, (label, description) in _KINDS.items():
        why_not = missing if kind in _NEED_POSE else None
        if why_not is None and kind == "uncertainty" and result is not None and result.joint_covariance is None:
            why_not = "needs the uncertainty of the pose, which is not known of a given one"
        if why_not is None and kind == "residual" and result is not None and not result.inliers.any():
            why_not = "needs matches; this pose has none of its own"
        if why_not is None and kind == "depth_error" and result is not None and not _has_stereo_depths(result):
            why_not = "needs matches with a stereo depth: the camera must stand beside the scanner"
        choices.append(TextureChoice(kind, label, why_not is None, why_not or description))
    return tuple(choices)


def usable_texture(kind: str, result: PoseResult | None) -> TextureKind:
    """Return the kind if its inputs are available, else `intensity`: only accepted poses are shown as registered.

    Raises:
        OptionError: if there is no such kind.
    """
    known = _checked_kind(kind)
    return known if any(c.usable for c in texture_choices(result) if c.kind == known) else "intensity"


def model_texture(
    scan: Scan,
    kind: str,
    *,
    photo: Photo | None = None,
    result: PoseResult | None = None,
    z_buffer: bool = True,
    registered: RegisteredTexture | None = None,
) -> ModelTexture:
    """Return a texture for the model.

    `colour` is the photograph where the camera sees the surface and the dimmed laser intensity elsewhere; without
    `z_buffer` it also colours occluded cells, as in thesis Figure 2.23. `residual` is at each cell the root mean square
    residual, px, of the inliers, weighted by a Gaussian of their angular distance from it (seen from the scanner) whose
    width is their typical spacing; cells more than three widths from all inliers have no data. `uncertainty` is the
    standard deviation of the pixel from which a cell takes its colour, from the covariance of the pose. See
    `surface_fields` for `depth_error` and `resolution`. Single cells of `colour` that the camera does not see, among
    ones that it sees, take the colour around them: the texture `label` marks them.

    Args:
        scan: the scan.
        kind: one of `TextureKind`.
        photo: the photograph, for `colour`, `resolution` and `label` unless `registered` is given.
        result: its accepted pose, for all kinds but `intensity` and `range`.
        z_buffer: whether cells that are hidden from the camera stay uncoloured.
        registered: `texture_scan` of these arguments, if already computed.

    Returns:
        The texture (H, W, 3) with its legend; the colour of cells without a return is arbitrary.

    Raises:
        OptionError: if there is no such kind, or its input is missing or not accepted.
        ShapeError: if the registered texture is not on the scan's grid.
    """
    known = _checked_kind(kind)
    if scan.ranges.size > LARGEST_WHOLE_SCAN and not (
        known in _SHOWN_CELL_BY_CELL and z_buffer and (scan.has_intensity or known != "intensity")
    ):
        return _of_thinned(scan, known, photo, result, registered, z_buffer=z_buffer)
    if known == "intensity":
        if not scan.has_intensity:
            return ModelTexture(
                shape_picture(scan),
                Legend("Shape: the scan has no intensity", ramp=_GRAYS, least="oblique", most="facing the scanner"),
            )
        gray = intensity_picture(scan)
        return ModelTexture(gray, Legend("Laser intensity", ramp=_GRAYS, least="weak", most="strong"))
    if known == "range":
        return _of_range(scan)
    choice = next(c for c in texture_choices(result) if c.kind == known)
    if result is None or not choice.usable:
        raise OptionError(f"the texture {kind!r} {choice.description}")
    if known == "residual":
        return _of_pixels(residual_field(scan, result), "Residual of the nearby matches, px")
    if known == "uncertainty":
        assert result.joint_covariance is not None, "the texture is not usable without"
        sigma = picture_sigma(scan, result.camera, result.camera_from_scanner, result.joint_covariance)
        return _of_pixels(sigma, "Standard deviation of the photo position, px")
    if known == "depth_error":
        return _of_depth_errors(depth_error_field(scan, result))
    if photo is None and (registered is None or not z_buffer):
        raise OptionError(f"the texture {kind!r} needs the photograph; give it")
    if known == "colour" and not z_buffer:
        assert photo is not None, "checked above"
        return ModelTexture(picture_without_z_buffer(scan, photo, result), _color_legend("outside the photograph"))
    if registered is None:
        assert photo is not None, "checked above"
        registered = registered_texture(scan, photo, result)
    if registered.labels.shape != scan.shape:
        raise ShapeError(f"the texture has {registered.labels.shape} cells, the scan {scan.shape}; they must agree")
    if known == "colour":
        fillable = np.isin(registered.labels, (Label.OCCLUDED, Label.NO_RETURN))
        picture = without_pepper(model_picture(scan, registered), registered.colored, fillable)
        return ModelTexture(picture, _color_legend("not seen by the camera"))
    if known == "resolution":
        return _of_resolution(resolution_field(scan, result, registered.colored))
    return visibility_texture(registered.labels)


def _of_thinned(
    scan: Scan,
    kind: TextureKind,
    photo: Photo | None,
    result: PoseResult | None,
    registered: RegisteredTexture | None,
    *,
    z_buffer: bool,
) -> ModelTexture:
    """Return the texture of every n-th row and column of a large scan, each repeated n times."""
    thin, n = scan.thinned(LARGEST_WHOLE_SCAN)
    if registered is not None and registered.labels.shape == scan.shape:
        registered = RegisteredTexture(registered.image[::n, ::n], registered.labels[::n, ::n])
    found = model_texture(thin, kind, photo=photo, result=result, z_buffer=z_buffer, registered=registered)
    whole = np.empty((*scan.shape, 3), np.uint8)
    for k in range(n):
        rows = whole[k::n]
        for m in range(n):
            part = rows[:, m::n]
            part[:] = found.image[: part.shape[0], : part.shape[1]]
    whole.flags.writeable = False
    return ModelTexture(whole, found.legend)


def registered_texture(scan: Scan, photo: Photo, result: PoseResult) -> RegisteredTexture:
    """Return `texture_scan` of a result, with its camera and covariance."""
    return texture_scan(
        scan, photo, result.camera_from_scanner, camera=result.camera, covariance=result.joint_covariance
    )


def picture_without_z_buffer(scan: Scan, photo: Photo, result: PoseResult) -> NDArray[np.uint8]:
    """Return the texture that also colours occluded cells, (H, W, 3) uint8 RGB.

    Cells outside the photograph show the dimmed laser intensity. Source: thesis 2.5, Figure 2.23.

    Raises:
        ShapeError: if the camera and the photo differ in size.
    """
    return np.array(model_picture(scan, texture_without_z_buffer(scan, photo, result)))


def texture_without_z_buffer(scan: Scan, photo: Photo, result: PoseResult) -> RegisteredTexture:
    """Return the photograph on every cell in front of the camera, visible or occluded: all are labelled as seen.

    Source: thesis 2.5, Figure 2.23, which shows the resulting errors.

    Raises:
        ShapeError: if the camera and the photo differ in size.
    """
    camera, pose = result.camera, result.camera_from_scanner
    if camera.size != photo.camera.size:
        raise ShapeError(
            f"the camera is for {camera.width} x {camera.height} pixels, the photo has {photo.camera.width} x "
            f"{photo.camera.height}; give a camera of this size"
        )
    uv = camera.project(pose @ scan.points)
    inside = camera.contains(uv)
    depth = (scan.points @ pose.rotation[2].astype(np.float32) + np.float32(pose.translation[2]))[inside]
    cell_px = camera.focal_px * np.sqrt(np.prod(scan.geometry.step_rad)) * scan.ranges[inside] / depth
    # Cells coarser than pixels take the mean of their pixels, not one of them.
    reduce = max(1, int(np.median(cell_px))) if inside.any() else 1
    size = tuple(max(1, n // reduce) for n in camera.size)
    copy = np.asarray(cv2.resize(photo.pixels, size, interpolation=cv2.INTER_AREA), np.uint8)
    at = []
    for k in range(2):
        moved = (uv[..., k] + np.float32(0.5)) * np.float32(size[k] / camera.size[k]) - np.float32(0.5)
        at.append(np.where(inside, np.clip(moved, 0, size[k] - 1), _OUTSIDE).astype(np.float32))
    labels = np.where(inside, Label.SEEN, Label.OUT_OF_FRAME).astype(np.uint8)
    labels[~scan.valid] = Label.NO_RETURN
    return RegisteredTexture(look_up(copy, *at, outside=(0.0, 0.0, 0.0)), labels)


def shape_picture(scan: Scan) -> NDArray[np.uint8]:
    """Return the cosine of the incidence angle of each cell in gray RGB, (H, W, 3) uint8."""
    points = np.where(scan.valid[..., None], scan.points, 0).astype(np.float32)
    normal = np.cross(np.gradient(points, axis=0), np.gradient(points, axis=1))
    length = np.linalg.norm(normal, axis=-1) * np.maximum(np.linalg.norm(points, axis=-1), np.float32(1e-12))
    facing = np.abs((normal * points).sum(axis=-1)) / np.maximum(length, np.float32(1e-20))
    gray = np.rint(_GRAYS[0][0] + (_GRAYS[-1][0] - _GRAYS[0][0]) * np.clip(facing, 0, 1)).astype(np.uint8)
    return np.repeat(gray[..., None], 3, axis=-1)


def view_picture(view: View, picture: ByteArray) -> NDArray[np.uint8]:
    """Resample a gray texture (H, W, 3) of the scan grid into a view, (h, w, 3) uint8 RGB."""
    gray = view.resample(np.asarray(picture[..., 0], dtype=np.float32))
    return np.repeat(np.rint(gray).astype(np.uint8)[..., None], 3, axis=-1)


def small_picture(picture: ByteArray, longest_px: int, *, codes: bool = False) -> NDArray[np.uint8]:
    """Return an image (h, w, 3) with its longer side reduced to at most `longest_px`.

    Args:
        picture: the image.
        longest_px: longer side at most.
        codes: whether its colours are codes, which must not be mixed.
    """
    how = cv2.INTER_NEAREST_EXACT if codes else cv2.INTER_AREA
    size = small_size(picture.shape[:2], longest_px)
    return np.array(cv2.resize(np.asarray(picture), size, interpolation=how), dtype=np.uint8)


def small_size(shape: tuple[int, ...], longest_px: int) -> tuple[int, int]:
    """Return (width, height) of an image of (h, w) reduced to at most `longest_px`."""
    factor = min(1.0, longest_px / max(shape))
    return max(1, round(shape[1] * factor)), max(1, round(shape[0] * factor))


def uniform_picture(color: Color) -> NDArray[np.uint8]:
    """Return a small image of one colour, (2, 2, 3) uint8 RGB."""
    return np.full((2, 2, 3), color, dtype=np.uint8)


def _checked_kind(kind: str) -> TextureKind:
    for known in get_args(TextureKind):
        if kind == known:
            return known  # type: ignore[no-any-return]
    raise OptionError(f"the texture is {kind!r}; it must be one of {', '.join(get_args(TextureKind))}")


def _color_legend(elsewhere: str) -> Legend:
    return Legend("Colour of the photograph", ((UNKNOWN, f"{elsewhere}: laser intensity, dimmed"),))


def _of_range(scan: Scan) -> ModelTexture:
    seen = scan.ranges[scan.valid]
    seen = seen[:: max(1, len(seen) // LARGEST_WHOLE_SCAN)].astype(np.float64)
    low, high = (float(v) for v in np.percentile(seen, _SHARE_SHOWN))
    span = np.float32(max(high - low, 1e-6 * high))
    picture = np.empty((*scan.shape, 3), np.uint8)
    for first in range(0, scan.shape[0], _ROWS_AT_ONCE):
        rows = slice(first, first + _ROWS_AT_ONCE)
        picture[rows] = ramp_colors((np.nan_to_num(scan.ranges[rows], nan=low) - np.float32(low)) / span)
    picture.flags.writeable = False
    legend = Legend("Range from the scanner, m", ramp=_VIRIDIS, least=_number(low), most=_number(high))
    return ModelTexture(picture, legend)


def _of_pixels(values: FloatArray, title: str) -> ModelTexture:
    """Return a texture of values (H, W) in pixels, on a scale from 0 to a round number."""
    known = np.isfinite(values)
    most = max(scale_end(np.where(known, values, np.float32(np.nan))), _MIN_COLOR_PX)
    picture = np.array(ramp_colors(np.where(known, values, 0).astype(np.float32) / np.float32(most)))
    paint(picture, ~known, UNKNOWN)
    legend = Legend(title, ((UNKNOWN, "no data"),), _VIRIDIS, least="0", most=f"{most:.3g} and above")
    return ModelTexture(picture, legend)


def _of_depth_errors(values: FloatArray) -> ModelTexture:
    """Return a texture of signed lengths (H, W), m, on a scale that is as long on both sides of zero."""
    known = np.isfinite(values)
    mm = np.where(known, 1000 * values, 0).astype(np.float32)
    most = max(scale_end(np.abs(mm)), _MIN_MM) if known.any() else _MIN_MM
    picture = np.full((*values.shape, 3), UNKNOWN, np.uint8)
    picture[known] = diverging_colors(mm[known] / np.float32(most))
    legend = Legend(
        "Laser minus stereo depth of the nearby matches, mm",
        ((UNKNOWN, "no data"),),
        _DIVERGING,
        least=f"-{most:.3g} and below",
        most=f"+{most:.3g} and above",
    )
    return ModelTexture(picture, legend)


def _of_resolution(values: FloatArray) -> ModelTexture:
    """Return a texture of the photograph's pixels on the surface (H, W), mm."""
    known = np.isfinite(values)
    shown = values[known].astype(np.float64)
    low, high = (float(v) for v in np.percentile(shown, _SHARE_SHOWN)) if shown.size else (0.0, 1.0)
    level = (np.where(known, values, low) - np.float32(low)) / np.float32(max(high - low, 1e-6 * high, 1e-9))
    picture = np.array(ramp_colors(level))
    paint(picture, ~known, UNKNOWN)
    legend = Legend(
        "Resolution on the surface, mm per pixel of the photograph",
        ((UNKNOWN, "not seen by the camera"),),
        _VIRIDIS,
        least=f"{low:.2g}",
        most=f"{high:.2g}",
    )
    return ModelTexture(picture, legend)


def _has_stereo_depths(result: PoseResult) -> bool:
    return bool(np.isfinite(result.stereo_depth_error_m[result.inliers]).any())


def visibility_texture(labels: ByteArray) -> ModelTexture:
    """Return the visibility classes (H, W) in their colours; the legend lists those that occur."""
    table = np.zeros((256, 3), dtype=np.uint8)
    table[: len(VISIBILITY)] = VISIBILITY
    picture = np.asarray(cv2.LUT(cv2.merge([np.asarray(labels)] * 3), table[None]), dtype=np.uint8)
    return ModelTexture(picture, visibility_legend(labels))


def visibility_legend(labels: ByteArray) -> Legend:
    """Return the legend of the visibility classes that occur among labels (H, W)."""
    count = np.bincount(labels.reshape(-1), minlength=len(VISIBILITY))
    entries = tuple((VISIBILITY[label], words) for label, words in _LABEL_MEANINGS.items() if count[label])
    return Legend("Visibility class", entries)


def _ramp(colors: Callable[[FloatArray], ByteArray]) -> tuple[Color, ...]:
    return tuple((int(r), int(g), int(b)) for r, g, b in colors(np.linspace(0, 1, _RAMP)))


_VIRIDIS = _ramp(ramp_colors)
_DIVERGING = _ramp(lambda level: diverging_colors(2 * level - 1))
_GRAYS = _ramp(lambda level: np.repeat(np.rint(18 + 227 * level).astype(np.uint8)[:, None], 3, axis=1))


def _number(metres: float) -> str:
    return f"{metres:.2f}" if metres < 10 else f"{metres:.1f}"
