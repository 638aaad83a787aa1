"""Image pyramid of a scan in a perspective view: channels at three resolutions, computed once."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, TypeVar, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.camera import Camera
from ladarreg_core.foundations.arrays import BoolArray, FloatArray
from ladarreg_core.matching.features.channels import (
    FEW_HARMONICS,
    add_channels,
    channel_floor,
    channel_scale,
    raw_channels,
)
from ladarreg_core.matching.images.laser_images import CleanedScan, geometry_planes
from ladarreg_core.matching.images.photo_levels import (
    FINE_BLUR_PX,
    LEVELS,
    blur_px,
    halved,
    normalised_fine,
    normalised_level,
)
from ladarreg_core.matching.images.structure import painted_cells, shaped_pixels
from ladarreg_core.matching.images.support import carries_intensity, open_cells
from ladarreg_core.scan import Scan
from ladarreg_core.surface.perspective import View
from ladarreg_core.surface.ranges import EDGE_FRACTION
from ladarreg_core.surface.remap import look_up
from ladarreg_core.surface.spikes import fill_from_nearest

ChannelSet = Literal["both", "geometry", "intensity"]
"""Scan channels compared with the photo: laser intensity, geometry (normals and log range), or the sum of both."""
BLOCK_PX = 48
"""Side of a block of points that are compared together, level-0 pixels of the scan's view."""
_Made = TypeVar("_Made")
_SMALL_BLOCK_PX, _FEW_RETURNS = 32, 120_000
_BEYOND = 2.0  # times as far as the surface beside it: what returned nothing, for the edge between them
_HOLE_REACH_PX = 2.0
_OUTLINE_PX, _HOLE_PX, _BORDER_PX = 7, 5, 5
_SHARED_BY_SETS = ("_raw_intensity", "_near_returns", "geometry_planes", "intensity_channels", "geometry_channels")


@dataclass(frozen=True, slots=True)
class ChannelFloors:
    """Floors of the channels of several views of one scan, so that an empty view does not amplify its noise."""

    intensity: tuple[float, ...]
    """Of each level."""
    geometry: tuple[float, ...]
    """Of each level."""
    fine_intensity: float
    """Of the fine channels, if they are of intensity."""
    fine_geometry: float
    """Of the fine channels, if they are of geometry."""

    @staticmethod
    def common(views: Sequence[ScanLevels]) -> ChannelFloors:
        """Return the floors that one picture of all views would have."""

        def floor(raws: Iterable[FloatArray], blur_px: float) -> float:
            largest, median = zip(*(channel_scale(raw, blur_px=blur_px) for raw in raws), strict=True)
            return channel_floor(max(largest), float(np.median(median)))

        fine = FINE_BLUR_PX
        return ChannelFloors(
            tuple(floor((v.raw_intensity[L] for v in views), blur_px(L)) for L in LEVELS),
            tuple(floor((v.raw_geometry[L] for v in views), blur_px(L)) for L in LEVELS),
            floor((v.raw_intensity[0] for v in views), fine),
            floor((v.raw_geometry[0] for v in views), fine),
        )


@dataclass(frozen=True, eq=False)
class ScanLevels:
    """The scan's perspective view at three resolutions, with its ranges."""

    view: View
    """The view at level 0."""
    cameras: tuple[Camera, ...]
    """The view's ideal camera at each level."""
    gray_planes: tuple[FloatArray, ...]
    """Laser intensity of each level, range-compensated and stretched, 0 to 255."""
    smooth_ranges: FloatArray
    """(h, w) float32 m, level 0: median-filtered and without holes, for the geometry."""
    ranges: FloatArray
    """(h, w) float32 m, level 0: without spikes, median-filtered, the foreground at depth edges; NaN: no return."""
    edge: BoolArray
    """(h, w) bool, level 0: within three pixels of a depth edge or a hole."""
    channel_set: ChannelSet = "both"
    """The set that `channels` are computed from."""
    structured: BoolArray | None = None
    """(h, w) bool, level 0: pixels with structure to compare; None: all."""
    floors: ChannelFloors | None = None
    """Least floors of the channels, common to several views; None: each view has its own."""
    coarse: bool = False
    """Whether the scan is much coarser than the photo: the finish then needs its depth edges, too."""
    block_px: int = BLOCK_PX
    """Side of the blocks that are compared, level-0 pixels."""
    harmonics: int = FEW_HARMONICS
    """Harmonics of the channels."""

    @cached_property
    def made(self) -> dict[object, Any]:
        """What has been made `once` of these levels, by name."""
        return {}

    def once(self, name: object, make: Callable[[], _Made]) -> _Made:
        """Return what `make` returns, from the first call with this name; it depends on the levels only.

        Levels are kept for further photos, and what is made of them with them.
        """
        made = self.made
        if name not in made:
            made[name] = make()
        return cast(_Made, made[name])

    @property
    def has_channels(self) -> bool:
        """Whether the channels have been computed."""
        return "channels" in vars(self)

    def with_channels(self, channel_set: ChannelSet) -> ScanLevels:
        """Return the same levels with another channel set; channels already computed are shared."""
        if channel_set == self.channel_set:
            return self
        other = replace(self, channel_set=channel_set)
        shared = {name: made for name, made in vars(self).items() if name in _SHARED_BY_SETS}
        vars(other).update(shared)
        return other

    @cached_property
    def geometry_planes(self) -> tuple[list[FloatArray], ...]:
        """Normals and log range of each level, about 0 to 255."""
        planes = [geometry_planes(self.view, self.smooth_ranges)]
        for camera in self.cameras[1:]:
            planes.append(halved(planes[-1], camera))
        return tuple(planes)

    @cached_property
    def _raw_intensity(self) -> FloatArray:
        return _raw_near([self.gray_planes[0]], self._near_returns[0], self.harmonics)

    @cached_property
    def raw_intensity(self) -> tuple[FloatArray, ...]:
        """(C, h, w) of each level, from intensity, not normalised."""
        coarser = zip(self.gray_planes[1:], self._near_returns[1:], strict=True)
        return (self._raw_intensity, *(_raw_near([plane], near, self.harmonics) for plane, near in coarser))

    @cached_property
    def raw_geometry(self) -> tuple[FloatArray, ...]:
        """(C, h, w) of each level, from normals and log range, not normalised."""
        pairs = zip(self.geometry_planes, self._near_returns, strict=True)
        return tuple(_raw_near(planes, near, self.harmonics) for planes, near in pairs)

    def with_floors(self, floors: ChannelFloors) -> ScanLevels:
        """Return the same levels with floors common to several views; raw channels already computed are shared."""
        other = replace(self, floors=floors)
        shared = ("_raw_intensity", "_near_returns", "geometry_planes", "raw_intensity", "raw_geometry")
        vars(other).update({name: made for name, made in vars(self).items() if name in shared})
        return other

    def without_raw(self) -> ScanLevels:
        """Return the same levels without the raw channels, which take more memory than all others."""
        for name in ("raw_intensity", "raw_geometry", "_raw_intensity"):
            vars(self).pop(name, None)
        return self

    @cached_property
    def _near_returns(self) -> tuple[FloatArray, ...]:
        """1 within a few pixels of a return, by level: farther away the filled ranges would produce false edges."""
        near = []
        valid = np.isfinite(self.ranges).astype(np.float32)
        for camera in self.cameras:
            share = cv2.resize(valid, camera.size, interpolation=cv2.INTER_AREA)
            distance = cv2.distanceTransform((share < 0.25).astype(np.uint8), cv2.DIST_L2, 3)
            near.append((distance <= _HOLE_REACH_PX).astype(np.float32))
        return tuple(near)

    @cached_property
    def intensity_channels(self) -> tuple[FloatArray, ...]:
        """(h, w, C) of each level, from intensity."""
        if self.floors is not None:
            return tuple(map(normalised_level, self.raw_intensity, LEVELS, self.floors.intensity))
        coarser = zip(self.gray_planes[1:], self._near_returns[1:], LEVELS[1:], strict=True)
        raws = ((level, _raw_near([plane], near, self.harmonics)) for plane, near, level in coarser)
        made = (normalised_level(raw, level, overwrite=True) for level, raw in raws)
        return (normalised_level(self._raw_intensity, 0), *made)

    @cached_property
    def geometry_channels(self) -> tuple[FloatArray, ...]:
        """(h, w, C) of each level, from normals and log range."""
        if self.floors is not None:
            return tuple(map(normalised_level, self.raw_geometry, LEVELS, self.floors.geometry))
        pairs = zip(self.geometry_planes, self._near_returns, strict=True)
        raws = (_raw_near(planes, near, self.harmonics) for planes, near in pairs)
        return tuple(normalised_level(raw, level, overwrite=True) for level, raw in enumerate(raws))

    @cached_property
    def channels(self) -> tuple[FloatArray, ...]:
        """(h, w, C) of each level, of the channel set; intensity and geometry are normalised before they are summed."""
        if self.channel_set != "both":
            return self.geometry_channels if self.channel_set == "geometry" else self.intensity_channels
        return tuple(map(add_channels, self.intensity_channels, self.geometry_channels))

    @property
    def fine_channels(self) -> FloatArray:
        """(h, w, C), level 0, sharper, for the final sub-pixel refinement.

        Of intensity, if the set includes it; of a coarse scan, of the whole set.
        """
        return self.once("fine channels", self._made_fine)

    def _made_fine(self) -> FloatArray:
        if self.channel_set == "both" and self.coarse:
            return add_channels(self._fine_intensity, self._fine_geometry)
        return self._fine_geometry if self.channel_set == "geometry" else self._fine_intensity

    @property
    def _fine_intensity(self) -> FloatArray:
        least = 0.0 if self.floors is None else self.floors.fine_intensity
        return normalised_fine(self._raw_intensity, least)

    @property
    def _fine_geometry(self) -> FloatArray:
        least = 0.0 if self.floors is None else self.floors.fine_geometry
        raw = _raw_near(self.geometry_planes[0], self._near_returns[0], self.harmonics)
        return normalised_fine(raw, least, overwrite=True)


def scan_levels(
    scan: Scan,
    view: View,
    *,
    channel_set: ChannelSet = "both",
    cleaned: CleanedScan | None = None,
    coarse: bool = False,
    harmonics: int = FEW_HARMONICS,
) -> ScanLevels:
    """Return the levels of a scan in one view.

    Args:
        scan: the scan.
        view: the view.
        channel_set: the channels to compare.
        cleaned: the scan's images, if they have been computed already.
        coarse: whether the scan is coarse, as `is_coarse` says; the outlines of its surfaces against the sky are then
            edges, too.
        harmonics: of the channels.
    """
    cleaned = cleaned or CleanedScan.of(scan)
    ranges = view.resample_ranges(cleaned.ranges)
    ranges[~view.inside] = np.nan
    valid = np.isfinite(ranges)
    filled, structured = fill_from_nearest(ranges, valid), None
    median: FloatArray = np.asarray(cv2.medianBlur(filled, 5), np.float32)
    low, high = cv2.erode(median, np.ones((5, 5))), cv2.dilate(median, np.ones((5, 5)))
    jump = high - low > EDGE_FRACTION * median
    surface = np.where(jump, low, median)  # the foreground owns the contour
    jump |= ~valid
    edge = cv2.dilate(jump.astype(np.uint8), np.ones((3, 3))) > 0  # the 5 x 5 window already reaches two pixels
    if cleaned.structured is not None:
        structured = _in_view(view, cleaned.structured)
    if coarse:
        beyond = ~valid & _in_view(view, open_cells(scan))
        structured = _shown_by_coarse(scan, view, ranges, cleaned.gray, beyond)
        median = np.asarray(cv2.medianBlur(np.where(beyond, np.float32(_BEYOND) * filled, filled), 5), np.float32)

    gray = look_up(cleaned.gray, view.cells[..., 0], view.cells[..., 1])  # the border is replicated beyond the grid
    gray = cleaned.stretched(gray, valid)
    cameras, grays = [view.camera], [gray]
    for level in LEVELS[1:]:
        cameras.append(view.camera.scaled(0.5**level))
        grays.append(halved([grays[-1]], cameras[-1])[0])
    return ScanLevels(
        view,
        tuple(cameras),
        tuple(grays),
        median,
        np.where(valid, surface, np.nan).astype(np.float32),
        edge,
        channel_set,
        structured,
        coarse=coarse,
        harmonics=harmonics,
    )


def _shown_by_coarse(scan: Scan, view: View, ranges: FloatArray, gray: FloatArray, beyond: BoolArray) -> BoolArray:
    """Return the pixels (h, w) at which a coarse scan shows something: a shape, an outline against the sky, paint.

    The border of what was looked at is no outline of anything.
    """
    shown = shaped_pixels(ranges, focal_px=view.camera.fx, cell_rad=min(scan.geometry.step_rad))
    shown |= cv2.dilate(beyond.astype(np.uint8), np.ones((_OUTLINE_PX, _OUTLINE_PX), np.uint8)) > 0
    if carries_intensity(scan):
        shown |= _in_view(view, painted_cells(gray))
    unseen: NDArray[Any] = np.pad((np.isnan(ranges) & ~beyond).astype(np.uint8), _BORDER_PX, constant_values=1)
    unseen = cv2.morphologyEx(unseen, cv2.MORPH_OPEN, np.ones((_HOLE_PX, _HOLE_PX), np.uint8))
    unseen = cv2.dilate(unseen, np.ones((2 * _BORDER_PX + 1, 2 * _BORDER_PX + 1), np.uint8))
    inner = np.s_[_BORDER_PX:-_BORDER_PX, _BORDER_PX:-_BORDER_PX]
    return np.asarray(shown & (unseen[inner] == 0))


def _in_view(view: View, cells: BoolArray) -> BoolArray:
    return np.asarray(view.resample(cells.astype(np.float32)) > 0.5)


def pair_levels(scan: Scan, view: View, *, channel_set: ChannelSet, coarse: bool, harmonics: int) -> ScanLevels:
    """Return the levels of a scan in the one view that is compared with a photo.

    A verdict needs enough regions, so that a view with few returns, of a coarse or narrow scan, has smaller blocks.

    Args:
        scan: the scan.
        view: the view.
        channel_set: the channels to compare.
        coarse: whether the scan is coarse.
        harmonics: of the channels.
    """
    levels = scan_levels(scan, view, channel_set=channel_set, coarse=coarse, harmonics=harmonics)
    few = np.count_nonzero(np.isfinite(levels.ranges)) < _FEW_RETURNS
    return replace(levels, block_px=_SMALL_BLOCK_PX) if few else levels


def _raw_near(planes: list[FloatArray], near: FloatArray, harmonics: int) -> FloatArray:
    """Return the raw channels of planes, 0 where `near` is."""
    raw = raw_channels(planes, harmonics=harmonics)
    raw *= near
    return raw
