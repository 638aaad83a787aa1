"""The scan: ranges and intensities of a laser scanner, on its own grid."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.arrays import BoolArray, ByteArray, FloatArray, read_only
from ladarreg_core.errors import ShapeError
from ladarreg_core.frames import Rigid
from ladarreg_core.scanner.grid_window import GridWindow, grid_rays
from ladarreg_core.scanner.grids import ScanGeometry
from ladarreg_core.validation import require_choice

IntensityKind = Literal["raw", "range_normalised"]
_SMALLEST_SIDE = 2
_DIRECTION_SAMPLES = 20_000
_ROWS_AT_ONCE = 256


@dataclass(frozen=True, eq=False)
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

    @property
    def rays(self) -> FloatArray:
        """(H, W, 3) unit rays, scanner frame; float32 or float64."""
        return self.geometry.rays

    @cached_property
    def points(self) -> FloatArray:
        """(H, W, 3) float32, scanner frame, m; NaN = no return. Source: thesis Eq 2.1."""
        points = np.empty((*self.shape, 3), np.float32)
        rays = self.rays
        for first in range(0, len(points), _ROWS_AT_ONCE):
            part = slice(first, first + _ROWS_AT_ONCE)
            np.multiply(rays[part].astype(np.float32), self.ranges[part, :, None], out=points[part])
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
