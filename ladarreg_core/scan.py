"""The scan: ranges and intensities of a laser scanner, on its own grid."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ladarreg_core.errors import ShapeError
from ladarreg_core.foundations.arrays import BoolArray, ByteArray, FloatArray, read_only
from ladarreg_core.foundations.source import Source
from ladarreg_core.foundations.validation import require_choice
from ladarreg_core.frames import Rigid
from ladarreg_core.scanner.grid_window import GridWindow, grid_rays
from ladarreg_core.scanner.grids import ScanGeometry

IntensityKind = Literal["raw", "range_normalised"]
_SMALLEST_SIDE = 2
_DIRECTION_SAMPLES = 20_000
_ROWS_AT_ONCE = 256
_LARGEST_WITH_RAYS = 4_000_000
LUMA_NOTE = "the intensity is the luminance of the colours (Rec. 709), not the laser's"
"""Note of a scan whose intensity is the luminance of its colours."""
NO_INTENSITY_NOTE = "the scan has no intensity: only its shape can be compared with a photo"
"""Note of a scan whose intensity is the same everywhere."""
_REC_709 = (0.2126, 0.7152, 0.0722)


@dataclass(frozen=True, eq=False, repr=False)
class Scan:
    """Range and intensity on a grid with a ray for every cell; read-only.

    Raises:
        ShapeError: if the arrays do not match the grid, it is smaller than 2 x 2 cells, or there is no return at all.
        OptionError: if `intensity_is` is unknown.
    """

    geometry: ScanGeometry
    """The ray of each cell."""
    ranges: FloatArray
    """(H, W) float32, m along the ray; NaN = no return. Values that are not finite and positive become NaN."""
    intensity: FloatArray
    """(H, W) float32, in the unit of the sensor."""
    color: ByteArray | None = None
    """(H, W, 3) uint8 RGB, if the scanner has a colour camera."""
    intensity_is: IntensityKind = "raw"
    """`raw` falls with range; `range_normalised` does not."""
    world_from_scanner: Rigid | None = None
    """The scanner's pose in the file, if it has one."""
    name: str = "scan"
    """Display name."""
    notes: tuple[str, ...] = field(default=())
    """Remarks on the file for the operator, e.g. that its unit may be millimetres."""
    source: Source | None = None
    """The files that `read_scan` read it from; None: it was made otherwise."""

    def __post_init__(self) -> None:
        shape = self.geometry.shape
        if min(shape) < _SMALLEST_SIDE:
            raise ShapeError(f"the scan grid is {shape[0]} x {shape[1]} cells; it must be at least 2 x 2")
        require_choice(self.intensity_is, get_args(IntensityKind), "intensity_is")
        ranges = read_only(self.ranges, np.float32, shape, "the scan's range")
        intensity = read_only(self.intensity, np.float32, shape, "the scan's intensity")
        ranges, intensity = _without_faults(ranges, intensity)
        if np.isnan(ranges).all():
            raise ShapeError(
                "the scan has no returns: every range is missing, zero or not finite; check the file's range data"
            )
        object.__setattr__(self, "ranges", ranges)
        object.__setattr__(self, "intensity", intensity)
        if self.color is not None:
            object.__setattr__(self, "color", read_only(self.color, np.uint8, (*shape, 3), "the scan's colour"))
        object.__setattr__(self, "notes", tuple(self.notes))

    def __repr__(self) -> str:
        cells, ranges = self._described
        return (
            f"Scan({self.name!r}: {cells}, {self.valid.mean():.0%} with returns, {ranges}"
            f"{', colour' if self.color is not None else ''}"
            f"{'' if self.world_from_scanner is None else ', placed in the world'})"
        )

    def _repr_html_(self) -> str:
        """Return what a notebook shows: the figures of the grid and a picture."""
        from ladarreg_core.foundations.card import card, gray, thumbnail

        cells, ranges = self._described
        kind = "colour" if self.color is not None else "intensity" if self.has_intensity else "nearness"
        near = np.divide(1, self.ranges, where=self.valid, out=np.zeros(self.shape, np.float32))
        shown = gray(self.intensity if self.has_intensity else near, self.valid) if self.color is None else self.color
        facts = [
            ("grid", cells),
            ("returns", f"{int(self.valid.sum())}, {self.valid.mean():.0%} of the cells"),
            ("range", ranges),
            ("picture", kind),
            ("world", "not stated" if self.world_from_scanner is None else "the scanner's pose is stated"),
        ]
        return card(f"Scan {self.name}", facts, picture=thumbnail(shown, f"{kind} of the scan"), notes=self.notes)

    @staticmethod
    def from_points(
        points: ArrayLike,
        intensity: ArrayLike | None = None,
        colors: ArrayLike | None = None,
        *,
        origin: ArrayLike | None = (0.0, 0.0, 0.0),
        world_from_scanner: Rigid | None = None,
        ring: ArrayLike | None = None,
        intensity_is: IntensityKind = "raw",
        name: str = "scan",
    ) -> Scan:
        """Return the scan of points without a grid: they are gridded by direction around the scanner.

        Args:
            points: (N, 3) m, with the scanner's Z up; those that are not finite are left out.
            intensity: (N,) in the unit of the sensor; None: the luminance of the colours, or zero without any, with
                which only matches that are given can be registered.
            colors: (N, 3) uint8 RGB.
            origin: where the scanner stood in the coordinates of the points, (3,) m; None: estimated from the pattern
                of the points.
            world_from_scanner: pose of the coordinates of the points in the world.
            ring: (N,) whole numbers, the beam of each point, if known.
            intensity_is: `raw` or `range_normalised`.
            name: display name.

        Returns:
            The scan, whose frame has the axes of the points and its zero at `origin`; `world_from_scanner` contains the
            origin if it is not zero, and `notes` say how the points were arranged.

        Raises:
            ShapeError: if the arrays do not match, there are fewer than 12 returns, or all are in one row or column.
            UnderspecifiedError: if `origin` is None and the points do not show where the scanner stood.
        """
        from ladarreg_core.scanner.cloud import locate_cloud

        p = read_only(points, np.float64, (None, 3), "the points")
        paint = None if colors is None else read_only(colors, np.uint8, (len(p), 3), "the colours of the points")
        light, notes = _light_of(intensity, paint, (len(p),))
        beams = None if ring is None else read_only(ring, np.int64, (len(p),), "the rings of the points")
        located = locate_cloud(
            p, light, paint, origin=origin, ring=beams, world_from_scanner=world_from_scanner,
            what="the cloud",
        )  # fmt: skip
        cloud = located.cloud
        return Scan(
            cloud.geometry, cloud.ranges, cloud.intensity, color=cloud.color, intensity_is=intensity_is,
            world_from_scanner=located.world_from_scanner, name=name, notes=(*notes, *located.notes),
        )  # fmt: skip

    @staticmethod
    def from_grid(
        xyz: ArrayLike | None = None,
        *,
        ranges: ArrayLike | None = None,
        rays: ArrayLike | None = None,
        azimuth_rad: ArrayLike | None = None,
        elevation_rad: ArrayLike | None = None,
        intensity: ArrayLike | None = None,
        colors: ArrayLike | None = None,
        world_from_scanner: Rigid | None = None,
        intensity_is: IntensityKind = "raw",
        name: str = "scan",
    ) -> Scan:
        """Return the scan of a grid: of points, or of ranges with rays or angles.

        Rows and columns may be in any order: they are transposed and flipped so that row 0 is the top and column 0 the
        left, as the readers do, and `notes` say so.

        Args:
            xyz: (H, W, 3) points, m, X forward, Y left, Z up; NaN or zero for no return. Rays of cells without a
                return are fitted unless `rays` are given.
            ranges: (H, W) m along the rays, instead of `xyz`; NaN or zero for no return.
            rays: (H, W, 3) directions of any length; NaN for those that are not known.
            azimuth_rad: instead of rays, (W,) or (H, W), counter-clockwise from X: positive to the left.
            elevation_rad: with it, (H,) or (H, W), up from the horizontal.
            intensity: (H, W) in the unit of the sensor; None: as in `from_points`.
            colors: (H, W, 3) uint8 RGB.
            world_from_scanner: the scanner's pose in the world.
            intensity_is: `raw` or `range_normalised`.
            name: display name.

        Raises:
            OptionError: unless `xyz`, or `ranges` with rays or both angles, are given.
            ShapeError: if the arrays do not match, there is no return, or too few rays are known.
        """
        from ladarreg_core.scanner.given_grid import upright_grid

        grid = upright_grid(xyz, ranges, rays, azimuth_rad, elevation_rad)
        shape = grid.given_shape
        paint = None if colors is None else read_only(colors, np.uint8, (*shape, 3), "the colours of the grid")
        light, notes = _light_of(intensity, paint, shape)
        return Scan(
            grid.geometry, grid.ranges, grid.order.apply(light),
            color=None if paint is None else grid.order.apply(paint), intensity_is=intensity_is,
            world_from_scanner=world_from_scanner, name=name, notes=(*notes, *grid.notes),
        )  # fmt: skip

    @property
    def _described(self) -> tuple[str, str]:
        """The grid and the ranges, in words."""
        low, high = (float(reduce(self.ranges)) for reduce in (np.nanmin, np.nanmax))
        step = " x ".join(f"{np.degrees(angle):.3g}" for angle in self.geometry.step_rad)
        return f"{self.shape[0]} x {self.shape[1]} cells of {step} deg", f"{low:.2f} to {high:.2f} m"

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W), cells."""
        return self.geometry.shape

    @cached_property
    def valid(self) -> BoolArray:
        """(H, W) bool: the cells with a return."""
        mask = np.isfinite(self.ranges)
        mask.flags.writeable = False
        return mask

    @cached_property
    def has_intensity(self) -> bool:
        """Whether the intensity differs between returns; that of a scanner which measures none is 0 everywhere."""
        low = self.intensity.min(initial=np.inf, where=self.valid)
        return bool(low < self.intensity.max(initial=-np.inf, where=self.valid))

    @property
    def rays(self) -> FloatArray:
        """(H, W, 3) unit rays, scanner frame; float32 or float64."""
        return self.geometry.rays

    @cached_property
    def points(self) -> FloatArray:
        """(H, W, 3) float32, scanner frame, m; NaN = no return. Source: thesis Eq 2.1."""
        points = np.empty((*self.shape, 3), np.float32)
        for first in range(0, len(points), _ROWS_AT_ONCE):
            part = slice(first, first + _ROWS_AT_ONCE)
            if self.ranges.size > _LARGEST_WITH_RAYS:  # the grid would keep its rays, twice the size of the points
                points[part] = self.points_at(part, slice(None))
            else:
                np.multiply(self.rays[part].astype(np.float32), self.ranges[part, :, None], out=points[part])
        points.flags.writeable = False
        return points

    def points_at(self, rows: slice, columns: slice) -> FloatArray:
        """Return the points (h, w, 3) float32 of some rows and columns, without computing the others."""
        rays = grid_rays(self.geometry, rows, columns)
        return rays.astype(np.float32) * self.ranges[rows, columns, None]

    def thinned_points(self, stride: int) -> FloatArray:
        """Return the points (h, w, 3) float32 of every n-th row and column."""
        return self.points_at(slice(None, None, stride), slice(None, None, stride))

    def window(self, rows: slice, columns: slice) -> Scan:
        """Return the scan of some rows and columns, in steps if the slices have any.

        Raises:
            ShapeError: if it is smaller than 2 x 2 cells or has no returns.
        """
        at = [range(n)[part] for n, part in zip(self.shape, (rows, columns), strict=True)]
        if min(map(len, at)) < _SMALLEST_SIDE:
            raise ShapeError("the part of the scan is smaller than 2 x 2 cells; take a larger one")
        grid = GridWindow(self.geometry, (at[0].start, at[1].start), (len(at[0]), len(at[1])), (at[0].step, at[1].step))
        color = None if self.color is None else self.color[rows, columns]
        return replace(
            self, geometry=grid, ranges=self.ranges[rows, columns], intensity=self.intensity[rows, columns], color=color
        )

    def thinned(self, most_cells: int) -> tuple[Scan, int]:
        """Return the scan of every n-th row and column, and n: the least with which it has at most `most_cells`."""
        stride = max(1, int(np.ceil(np.sqrt(self.ranges.size / most_cells))))
        part = slice(None, None, stride)
        return (self if stride == 1 else self.window(part, part)), stride

    @cached_property
    def sampled_directions(self) -> NDArray[np.float64]:
        """Unit rays (N, 3) of about ten thousand cells with a return, spread over the grid."""
        stride = max(1, int(np.sqrt(self.ranges.size / _DIRECTION_SAMPLES)))
        rows, columns = (index * stride for index in np.nonzero(self.valid[::stride, ::stride]))
        if not len(rows):  # so few returns that the sample misses all of them
            rows, columns = np.nonzero(self.valid)
        return self.geometry.ray_at(np.stack([rows, columns], axis=-1))

    @cached_property
    def mean_direction(self) -> NDArray[np.float64]:
        """The mean ray of the cells with a return, (3,), unit; X forward if they cancel out."""
        mean = self.sampled_directions.mean(axis=0)
        length = float(np.linalg.norm(mean))
        return mean / length if length > 1e-3 else np.array([1.0, 0.0, 0.0])


def _light_of(
    intensity: ArrayLike | None, colors: ByteArray | None, shape: tuple[int, ...]
) -> tuple[FloatArray, tuple[str, ...]]:
    """Return the intensity given, or what stands for it, with a note that says so."""
    if intensity is not None:
        return read_only(intensity, np.float32, shape, "the intensity"), ()
    if colors is not None:
        return luma(colors), (LUMA_NOTE,)
    return np.zeros(shape, np.float32), (NO_INTENSITY_NOTE,)


def luma(color: ByteArray) -> NDArray[np.float32]:
    """Return the luminance (...,), 0 to 255, of RGB colours (..., 3), weighted as by Rec. 709."""
    weights = np.array(_REC_709, np.float32)
    return np.asarray(color @ weights, dtype=np.float32)


def _without_faults(ranges: FloatArray, intensity: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return ranges that are positive or NaN, and finite intensities; the same read-only arrays if they are so."""
    copied = False
    for first in range(0, len(ranges), _ROWS_AT_ONCE):
        part = slice(first, first + _ROWS_AT_ONCE)
        with np.errstate(invalid="ignore"):
            dark = ~np.isfinite(intensity[part])
            wrong = (ranges[part] <= 0) | np.isinf(ranges[part]) | dark
        if not wrong.any():
            continue
        if not copied:
            ranges, intensity, copied = ranges.copy(), intensity.copy(), True
        ranges[part][wrong] = np.nan
        intensity[part][dark] = 0
    for array in (ranges, intensity):
        array.flags.writeable = False
    return ranges, intensity
