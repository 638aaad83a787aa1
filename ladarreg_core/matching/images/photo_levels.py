"""Image pyramid of a photograph: channels at three resolutions, computed once.

The photograph is undistorted once and not resampled again.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.camera import Camera
from ladarreg_core.foundations.arrays import BoolArray, FloatArray
from ladarreg_core.foundations.temperatures import thermal_gray
from ladarreg_core.matching.features.channels import FEW_HARMONICS, normalised_channels, raw_channels
from ladarreg_core.matching.images.support import comparison_focal_px
from ladarreg_core.photo import Photo
from ladarreg_core.scan import Scan
from ladarreg_core.surface.remap import look_up

LEVELS = (0, 1, 2)
"""Pyramid levels; level L has 1 / 2^L of the working resolution."""
FINE_BLUR_PX = 1.2
"""Blur of the fine channels, level-0 pixels."""
_FINE_FACTOR = 2.0
_MAX_PIXELS = 1_000_000
_FEW_PIXELS = 160_000
_MAX_ENLARGED = 2.0


def blur_px(level: int) -> float:
    """Return the blur of the channels of a level, level pixels."""
    return 1.2 if level >= 2 else 1.5


def normalised_level(raw: FloatArray, level: int, least_floor: float = 0.0, *, overwrite: bool = False) -> FloatArray:
    """Return the channels of a level from raw ones (C, h, w); see `normalised_channels`."""
    local_px = 6.0 if level >= 2 else 8.0
    return normalised_channels(
        raw, blur_px=blur_px(level), local_px=local_px, least_floor=least_floor, overwrite=overwrite
    )


def normalised_fine(raw: FloatArray, least_floor: float = 0.0, *, overwrite: bool = False) -> FloatArray:
    """Return the channels of the finish from raw ones (C, h, w): sharper, and more strongly normalised."""
    return normalised_channels(
        raw, blur_px=FINE_BLUR_PX, local_factor=_FINE_FACTOR, least_floor=least_floor, overwrite=overwrite
    )


def halved(planes: list[FloatArray], camera: Camera) -> list[FloatArray]:
    """Return planes (h, w) at half the resolution, of a camera's size."""
    return [np.asarray(cv2.resize(p, camera.size, interpolation=cv2.INTER_AREA), dtype=np.float32) for p in planes]


def working_camera(scan: Scan, camera: Camera) -> Camera:
    """Return the ideal camera used for matching: the photo's, with at most 1 Mpixel and no finer than the scan.

    A small photo is enlarged, at most twice, if the scan is finer: regions have a fixed size in pixels, and a verdict
    needs enough of them. A coarse scan is not interpolated for this purpose: unmeasured detail must not count as
    agreement. (With more enlargement the regions of a blurred image hold no detail: of a thermal image 320 pixels wide,
    enlarged 1.44 times, twice as large a fraction agrees as when it is enlarged to the scan's resolution.)
    """
    pixels = camera.width * camera.height
    enlarged = min(max(1.0, float(np.sqrt(_FEW_PIXELS / pixels))), _MAX_ENLARGED)
    factor = min(enlarged, comparison_focal_px(scan, camera) / camera.focal_px, float(np.sqrt(_MAX_PIXELS / pixels)))
    scaled = camera.scaled(factor)
    return Camera(scaled.width, scaled.height, scaled.focal_px, scaled.focal_px, scaled.cx, scaled.cy)


@dataclass(frozen=True, eq=False)
class PhotoLevels:
    """The undistorted photo at three resolutions."""

    source: Camera
    """The photo's own camera."""
    cameras: tuple[Camera, ...]
    """The ideal camera of each level."""
    planes: tuple[list[FloatArray], ...]
    """R, G and B of each level, float32, 0 to 255; a thermal image has one plane, gray levels around 0."""
    usable: tuple[BoolArray, ...]
    """Mask of pixels with data, by level: the corners of an undistorted image may be empty."""
    harmonics: int = FEW_HARMONICS
    """Harmonics of the channels, those of the scan."""

    @cached_property
    def gray(self) -> FloatArray:
        """(h, w) float32, level 0."""
        if len(self.planes[0]) == 1:
            return self.planes[0][0]
        red, green, blue = self.planes[0]
        return np.asarray(0.299 * red + 0.587 * green + 0.114 * blue, dtype=np.float32)

    @cached_property
    def _raw_fine(self) -> FloatArray:
        return raw_channels(self.planes[0], harmonics=self.harmonics)

    @cached_property
    def channels(self) -> tuple[FloatArray, ...]:
        """(h, w, C) of each level."""
        raws = ((level, raw_channels(self.planes[level], harmonics=self.harmonics)) for level in LEVELS[1:])
        return (
            normalised_level(self._raw_fine, 0),
            *(normalised_level(raw, level, overwrite=True) for level, raw in raws),
        )

    @cached_property
    def fine_channels(self) -> FloatArray:
        """(h, w, C), level 0, sharper and more strongly normalised, for the final sub-pixel refinement."""
        return normalised_fine(self._raw_fine)


def photo_levels(photo: Photo, working: Camera, *, harmonics: int = FEW_HARMONICS) -> PhotoLevels:
    """Return the levels of a photo.

    Args:
        photo: the photograph.
        working: the ideal camera of level 0, with the photo's aspect ratio.
        harmonics: of the channels.
    """
    scaled = photo.pinhole.resized(*working.size)
    kelvin = photo.temperature_k
    pixels: NDArray[Any] = photo.pixels if kelvin is None else thermal_gray(kelvin)[..., None]
    if scaled.size != photo.pinhole.size:
        smaller = scaled.width <= photo.pinhole.width
        how = cv2.INTER_AREA if smaller else cv2.INTER_CUBIC
        pixels = np.atleast_3d(np.asarray(cv2.resize(pixels, scaled.size, interpolation=how)))
    usable = np.ones((working.height, working.width), np.bool_)
    if scaled.distortion or abs(scaled.fx - scaled.fy) > 1e-3 * scaled.fx:
        v, u = np.mgrid[: working.height, : working.width].astype(np.float32)
        x, y = (u - working.cx) / working.fx, (v - working.cy) / working.fy
        source = scaled.project(np.stack([x, y, np.ones_like(x)], axis=-1).astype(np.float32))
        usable = scaled.contains(source)
        source = np.nan_to_num(source, nan=-1e4)
        pixels = np.atleast_3d(look_up(pixels, source[..., 0], source[..., 1]))
    planes = [np.ascontiguousarray(pixels[..., k], dtype=np.float32) for k in range(pixels.shape[-1])]
    cameras, all_planes, masks = [working], [planes], [usable]
    for level in LEVELS[1:]:
        cameras.append(working.scaled(0.5**level))
        all_planes.append(halved(all_planes[-1], cameras[-1]))
        small = cv2.resize(usable.astype(np.float32), cameras[-1].size, interpolation=cv2.INTER_AREA)
        masks.append(small > 0.99)
    return PhotoLevels(photo.pinhole, tuple(cameras), tuple(all_planes), tuple(masks), harmonics)
