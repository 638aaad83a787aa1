"""Scanner geometries: the ray of each cell of a scan grid, and the cell of a direction.

All rays are in the scanner frame (X forward, Y left, Z up). A cell is (row, column), possibly fractional; row 0 is the
top, column 0 the left.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ladarreg_core.camera import Camera
from ladarreg_core.errors import OptionError, ShapeError
from ladarreg_core.foundations.arrays import FloatArray, IntArray, read_only
from ladarreg_core.frames import CAMERA_AXES_FROM_SCANNER, wrap_angle
from ladarreg_core.scanner.ray_table import (
    RayTableInverse,
    complete_ray_table,
    complete_unit_rays,
    interpolate_rays,
)

_MIN_STEP_RAD = 1e-12
_STEP_CELLS = 2_000_000  # of larger tables some lines are measured


@runtime_checkable
class ScanGeometry(Protocol):
    """Interface of all scanner geometries."""

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W), cells."""
        ...

    @property
    def rays(self) -> FloatArray:
        """(H, W, 3) unit rays of the cell centres, read-only; float32 or float64."""
        ...

    @property
    def step_rad(self) -> tuple[float, float]:
        """The typical angle between neighbouring (rows, columns), rad."""
        ...

    def cell_of(self, directions: ArrayLike) -> FloatArray:
        """Return the fractional cells (..., 2) of directions (..., 3); NaN if there is none.

        Cells outside the grid are extrapolated if the geometry allows it; compare with `shape`.
        """
        ...

    def ray_at(self, cells: ArrayLike) -> NDArray[np.float64]:
        """Return the unit rays (..., 3) of fractional cells (..., 2); NaN outside a tabulated grid."""
        ...


@runtime_checkable
class SeparableGrid(Protocol):
    """A geometry whose angles are those of rows and of columns: many rays take few sines.

    It does not extend `ScanGeometry`, since `isinstance` would then evaluate all its properties, the rays among them.
    """

    def rays_of(self, rows: IntArray, columns: IntArray) -> NDArray[np.float64]:
        """Return the unit rays (h, w, 3) where some rows (h,) and columns (w,) cross, as `ray_at` does."""
        ...


@dataclass(frozen=True)
class AzimuthElevation:
    """The two-mirror scanner of the thesis: azimuth is the inner rotation, elevation the outer one.

    azimuth = ((W - 1)/2 - column) d_azimuth + offset, positive to the left; elevation = ((H - 1)/2 - row) d_elevation
    + offset, positive upward; direction (cos az cos el, sin az, cos az sin el). The thesis's own form (W/2 - column)
    differs by half a step: `azimuth_offset_rad = d_azimuth_rad / 2`.

    Source: thesis 2.2.1, Eq 2.1.
    """

    rows: int
    columns: int
    d_azimuth_rad: float
    d_elevation_rad: float
    azimuth_offset_rad: float = 0.0
    elevation_offset_rad: float = 0.0

    def __post_init__(self) -> None:
        _check_grid(self.rows, self.columns)
        for name in ("d_azimuth_rad", "d_elevation_rad"):
            step = getattr(self, name)
            if not (np.isfinite(step) and 0 < step < 0.5):
                raise OptionError(f"{name} is {step}; it must be a positive angle per cell in radians, below 0.5")
        if not np.isfinite([self.azimuth_offset_rad, self.elevation_offset_rad]).all():
            raise OptionError("the azimuth or elevation offset is not finite; give angles in radians")
        reach = abs(self.azimuth_offset_rad) + self.d_azimuth_rad * (self.columns - 1) / 2
        if reach >= np.pi / 2:
            raise OptionError(
                f"the azimuth reaches {np.degrees(reach):.1f} deg; an azimuth-elevation scanner must stay below "
                "90 deg: check that d_azimuth_rad is in radians"
            )
        reach = abs(self.elevation_offset_rad) + self.d_elevation_rad * (self.rows - 1) / 2
        if reach >= np.pi:
            raise OptionError(
                f"the elevation reaches {np.degrees(reach):.1f} deg; it must stay below 180 deg: check that "
                "d_elevation_rad is in radians"
            )

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W), cells."""
        return self.rows, self.columns

    @property
    def step_rad(self) -> tuple[float, float]:
        """(elevation step, azimuth step), rad."""
        return self.d_elevation_rad, self.d_azimuth_rad

    @cached_property
    def rays(self) -> NDArray[np.float64]:
        """(H, W, 3) unit rays, read-only."""
        rays = self.rays_of(np.arange(self.rows), np.arange(self.columns))
        rays.flags.writeable = False
        return rays

    def rays_of(self, rows: IntArray, columns: IntArray) -> NDArray[np.float64]:
        """Return the unit rays (h, w, 3) where some rows (h,) and columns (w,) cross, as `ray_at` does."""
        azimuth, elevation = self._azimuth(columns), self._elevation(rows)
        rays = np.empty((len(rows), len(columns), 3))
        rays[..., 0] = np.cos(elevation)[:, None] * np.cos(azimuth)
        rays[..., 1] = np.sin(azimuth)
        rays[..., 2] = np.sin(elevation)[:, None] * np.cos(azimuth)
        return rays

    def _azimuth(self, column: FloatArray | IntArray) -> NDArray[np.float64]:
        return np.asarray(((self.columns - 1) / 2 - column) * self.d_azimuth_rad + self.azimuth_offset_rad)

    def _elevation(self, row: FloatArray | IntArray) -> NDArray[np.float64]:
        return np.asarray(((self.rows - 1) / 2 - row) * self.d_elevation_rad + self.elevation_offset_rad)

    def cell_of(self, directions: ArrayLike) -> FloatArray:
        """Return the fractional cells (..., 2) of directions (..., 3) of any length. Source: thesis Eq 2.4, 2.5."""
        d = np.asarray(directions)
        in_plane = np.hypot(d[..., 0], d[..., 2])
        azimuth = np.arctan2(d[..., 1], in_plane)
        elevation = np.arctan2(d[..., 2], d[..., 0])
        row = (self.rows - 1) / 2 - (elevation - self.elevation_offset_rad) / self.d_elevation_rad
        column = (self.columns - 1) / 2 - (azimuth - self.azimuth_offset_rad) / self.d_azimuth_rad
        return np.stack([row, column], axis=-1)

    def ray_at(self, cells: ArrayLike) -> NDArray[np.float64]:
        """Return the unit rays (..., 3) of fractional cells (..., 2)."""
        c = np.asarray(cells, dtype=np.float64)
        azimuth, elevation = self._azimuth(c[..., 1]), self._elevation(c[..., 0])
        ahead = np.cos(azimuth)
        return np.stack([ahead * np.cos(elevation), np.sin(azimuth), ahead * np.sin(elevation)], axis=-1)


@dataclass(frozen=True)
class PinholeGrid:
    """A depth camera: cells are the pixels of a camera facing along the scanner's X."""

    camera: Camera

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W), cells."""
        return self.camera.height, self.camera.width

    @property
    def step_rad(self) -> tuple[float, float]:
        """Angles between neighbouring (rows, columns) at the picture's centre, rad."""
        return 1 / self.camera.fy, 1 / self.camera.fx

    @cached_property
    def rays(self) -> NDArray[np.float64]:
        """(H, W, 3) unit rays, read-only."""
        v, u = np.mgrid[: self.camera.height, : self.camera.width]
        rays = np.asarray(self.camera.unproject(np.stack([u, v], axis=-1)) @ CAMERA_AXES_FROM_SCANNER)
        rays.flags.writeable = False
        return rays

    def cell_of(self, directions: ArrayLike) -> FloatArray:
        """Return the fractional cells (..., 2) of directions (..., 3); NaN behind the camera or beyond its lens."""
        uv = self.camera.project(np.asarray(directions) @ CAMERA_AXES_FROM_SCANNER.T)
        return np.stack([uv[..., 1], uv[..., 0]], axis=-1)

    def ray_at(self, cells: ArrayLike) -> NDArray[np.float64]:
        """Return the unit rays (..., 3) of fractional cells (..., 2)."""
        c = np.asarray(cells, dtype=np.float64)
        return np.asarray(self.camera.unproject(np.stack([c[..., 1], c[..., 0]], axis=-1)) @ CAMERA_AXES_FROM_SCANNER)


@dataclass(frozen=True)
class SphericalGrid:
    """Rows of equal polar angle, columns of equal longitude: panoramas, and clouds without a grid of their own.

    longitude = centre - (column - (W - 1)/2) d_longitude, positive to the left; latitude = top - row d_latitude.
    Direction (cos lat cos lon, cos lat sin lon, sin lat).

    Source: thesis 2.2.3 (theta_s is the longitude, phi_s = pi/2 - latitude).
    """

    rows: int
    columns: int
    d_longitude_rad: float
    d_latitude_rad: float
    centre_longitude_rad: float
    top_latitude_rad: float

    def __post_init__(self) -> None:
        _check_grid(self.rows, self.columns)
        if not (0 < self.d_longitude_rad < 0.5 and 0 < self.d_latitude_rad < 0.5):
            raise OptionError(
                f"the spherical grid's steps are {self.d_longitude_rad:g} and {self.d_latitude_rad:g} rad; they "
                "must be positive and below 0.5"
            )

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W), cells."""
        return self.rows, self.columns

    @property
    def step_rad(self) -> tuple[float, float]:
        """(latitude step, longitude step), rad."""
        return self.d_latitude_rad, self.d_longitude_rad

    @cached_property
    def rays(self) -> NDArray[np.float64]:
        """(H, W, 3) unit rays, read-only."""
        rays = self.rays_of(np.arange(self.rows), np.arange(self.columns))
        rays.flags.writeable = False
        return rays

    def rays_of(self, rows: IntArray, columns: IntArray) -> NDArray[np.float64]:
        """Return the unit rays (h, w, 3) where some rows (h,) and columns (w,) cross, as `ray_at` does."""
        latitude, longitude = self._latitude(rows), self._longitude(columns)
        level = np.cos(latitude)[:, None]
        rays = np.empty((len(rows), len(columns), 3))
        rays[..., 0] = level * np.cos(longitude)
        rays[..., 1] = level * np.sin(longitude)
        rays[..., 2] = np.sin(latitude)[:, None]
        return rays

    def _latitude(self, row: FloatArray | IntArray) -> NDArray[np.float64]:
        return np.asarray(self.top_latitude_rad - row * self.d_latitude_rad)

    def _longitude(self, column: FloatArray | IntArray) -> NDArray[np.float64]:
        return np.asarray(self.centre_longitude_rad - (column - (self.columns - 1) / 2) * self.d_longitude_rad)

    def cell_of(self, directions: ArrayLike) -> FloatArray:
        """Return the fractional cells (..., 2) of directions (..., 3)."""
        d = np.asarray(directions)
        latitude = np.arctan2(d[..., 2], np.hypot(d[..., 0], d[..., 1]))
        from_centre = wrap_angle(np.arctan2(d[..., 1], d[..., 0]) - self.centre_longitude_rad)
        row = (self.top_latitude_rad - latitude) / self.d_latitude_rad
        return np.stack([row, (self.columns - 1) / 2 - from_centre / self.d_longitude_rad], axis=-1)

    def ray_at(self, cells: ArrayLike) -> NDArray[np.float64]:
        """Return the unit rays (..., 3) of fractional cells (..., 2)."""
        c = np.asarray(cells, dtype=np.float64)
        latitude, longitude = self._latitude(c[..., 0]), self._longitude(c[..., 1])
        level = np.cos(latitude)
        return np.stack([level * np.cos(longitude), level * np.sin(longitude), np.sin(latitude)], axis=-1)


@dataclass(frozen=True, eq=False)
class RingGrid:
    """Rows are the rings of a spinning scanner at their latitudes, columns are equal steps of longitude.

    latitude = `latitudes_rad[row]`, linear between rings; longitude = centre - (column - (W - 1)/2 +
    `phases[row]`) d_longitude, positive to the left.
    """

    latitudes_rad: FloatArray
    """(H,) falling from the top."""
    phases: FloatArray
    """(H,) delay of each ring, in columns."""
    columns: int
    d_longitude_rad: float
    centre_longitude_rad: float

    def __post_init__(self) -> None:
        latitudes = read_only(self.latitudes_rad, np.float64, (None,), "the rings' latitudes")
        if len(latitudes) < 2 or not (np.diff(latitudes) < 0).all():
            raise ShapeError(
                f"there are {len(latitudes)} rings; a grid needs at least 2, with latitudes falling from the top"
            )
        object.__setattr__(self, "latitudes_rad", latitudes)
        object.__setattr__(self, "phases", read_only(self.phases, np.float64, latitudes.shape, "the rings' phases"))

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W), cells."""
        return len(self.latitudes_rad), self.columns

    @property
    def step_rad(self) -> tuple[float, float]:
        """(median latitude step, longitude step), rad."""
        return float(np.median(-np.diff(self.latitudes_rad))), self.d_longitude_rad

    @cached_property
    def rays(self) -> NDArray[np.float64]:
        """(H, W, 3) unit rays, read-only."""
        row, column = np.mgrid[: self.shape[0], : self.columns]
        rays = self.ray_at(np.stack([row, column], axis=-1))
        rays.flags.writeable = False
        return rays

    def cell_of(self, directions: ArrayLike) -> FloatArray:
        """Return the fractional cells (..., 2) of directions (..., 3)."""
        d = np.asarray(directions)
        row = self._row_of(np.arctan2(d[..., 2], np.hypot(d[..., 0], d[..., 1])))
        from_centre = wrap_angle(np.arctan2(d[..., 1], d[..., 0]) - self.centre_longitude_rad)
        phase = np.interp(row, np.arange(self.shape[0]), self.phases)
        return np.stack([row, (self.columns - 1) / 2 - from_centre / self.d_longitude_rad - phase], axis=-1)

    def ray_at(self, cells: ArrayLike) -> NDArray[np.float64]:
        """Return the unit rays (..., 3) of fractional cells (..., 2)."""
        c = np.asarray(cells, dtype=np.float64)
        latitude = _extended_interp(c[..., 0], np.arange(float(self.shape[0])), self.latitudes_rad)
        phase = np.interp(c[..., 0], np.arange(self.shape[0]), self.phases)
        from_centre = (c[..., 1] - (self.columns - 1) / 2 + phase) * self.d_longitude_rad
        longitude = self.centre_longitude_rad - from_centre
        level = np.cos(latitude)
        return np.stack([level * np.cos(longitude), level * np.sin(longitude), np.sin(latitude)], axis=-1)

    def _row_of(self, latitude: FloatArray) -> NDArray[np.float64]:
        return _extended_interp(latitude, self.latitudes_rad[::-1], np.arange(float(self.shape[0]))[::-1])


@dataclass(frozen=True, eq=False)
class RotatedGrid:
    """A geometry in a rotated frame, e.g. a spherical grid whose pole must not be within the cloud."""

    grid: ScanGeometry
    """The geometry, in its own frame."""
    grid_from_scanner: FloatArray
    """(3, 3) rotation."""

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W), cells."""
        return self.grid.shape

    @property
    def step_rad(self) -> tuple[float, float]:
        """The typical angle between neighbouring (rows, columns), rad."""
        return self.grid.step_rad

    @cached_property
    def rays(self) -> FloatArray:
        """(H, W, 3) unit rays, read-only."""
        rays = np.asarray(self.grid.rays @ self.grid_from_scanner)
        rays.flags.writeable = False
        return rays

    def cell_of(self, directions: ArrayLike) -> FloatArray:
        """Return the fractional cells (..., 2) of directions (..., 3)."""
        return self.grid.cell_of(np.asarray(directions) @ self.grid_from_scanner.T)

    def ray_at(self, cells: ArrayLike) -> NDArray[np.float64]:
        """Return the unit rays (..., 3) of fractional cells (..., 2)."""
        return np.asarray(self.grid.ray_at(cells) @ self.grid_from_scanner)


@dataclass(frozen=True, eq=False)
class TabulatedGrid:
    """A grid with a ray for every cell: E57 grids, and clouds gridded by a geometry that their points follow roughly.

    Args:
        table: (H, W, 3) rays of any length; NaN for cells without a point, which get a smooth fit plus the
            interpolated residuals of their neighbours.
        law: a geometry that the table follows to within a cell (a cloud gridded by it); `cell_of` is then the law's.

    Raises:
        ShapeError: if the table is not an (H, W, 3) grid, has fewer than 12 rays, or most neighbours have the same ray.
    """

    table: FloatArray
    law: ScanGeometry | None = None

    def __post_init__(self) -> None:
        table = read_only(self.table, np.float64, (None, None, 3), "the ray table")
        if self.law is not None and self.law.shape != table.shape[:2]:
            raise ShapeError(f"the ray table has {table.shape[:2]} cells, its law {self.law.shape}; they must agree")
        rays = complete_ray_table(table, self.law.rays if self.law else None)
        rays.flags.writeable = False
        object.__setattr__(self, "table", rays)
        self._check_steps()

    def _check_steps(self) -> None:
        if min(self.shape) > 1 and not min(self.step_rad) > _MIN_STEP_RAD:
            raise ShapeError(
                "most neighbouring cells of the scan have the same ray; each cell must have a ray of its own"
            )

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W), cells."""
        return self.table.shape[0], self.table.shape[1]

    @staticmethod
    def taking_over(rays: NDArray[np.float32]) -> TabulatedGrid:
        """Return the grid of an array of unit rays, which is completed in place and must not be used any more.

        Args:
            rays: (H, W, 3) float32, contiguous; zero for none.

        Raises:
            ShapeError: as for the constructor.
        """
        complete_unit_rays(rays)
        rays.flags.writeable = False
        grid = object.__new__(TabulatedGrid)
        object.__setattr__(grid, "table", rays)
        object.__setattr__(grid, "law", None)
        grid._check_steps()
        return grid

    @property
    def rays(self) -> FloatArray:
        """(H, W, 3) unit rays, read-only; every cell has one."""
        return self.table

    @cached_property
    def step_rad(self) -> tuple[float, float]:
        """The median angle between neighbouring (rows, columns), rad."""
        if self.law is not None:
            return self.law.step_rad
        stride = max(1, self.table.size // 3 // _STEP_CELLS)
        lines = self.table[:, ::stride], self.table[::stride]
        steps = [np.median(np.linalg.norm(np.diff(some, axis=axis), axis=-1)) for axis, some in enumerate(lines)]
        return float(steps[0]), float(steps[1])

    @cached_property
    def _inverse(self) -> RayTableInverse:
        return RayTableInverse(self.rays)

    def cell_of(self, directions: ArrayLike) -> FloatArray:
        """Return the fractional cells (..., 2) of directions (..., 3); NaN for directions outside the table."""
        return self.law.cell_of(directions) if self.law is not None else self._inverse.cell_of(directions)

    def ray_at(self, cells: ArrayLike) -> NDArray[np.float64]:
        """Return the unit rays (..., 3) of fractional cells (..., 2), interpolated; NaN outside the table."""
        rays = interpolate_rays(self.rays, np.asarray(cells, dtype=np.float64))
        return np.asarray(rays / np.linalg.norm(rays, axis=-1, keepdims=True))


def _extended_interp(x: FloatArray, xp: FloatArray, fp: FloatArray) -> NDArray[np.float64]:
    """Interpolate linearly, and extrapolate linearly beyond both ends."""
    inside = np.interp(x, xp, fp)
    below = (x - xp[0]) * (fp[1] - fp[0]) / (xp[1] - xp[0])
    above = (x - xp[-1]) * (fp[-1] - fp[-2]) / (xp[-1] - xp[-2])
    return np.asarray(np.where(x < xp[0], fp[0] + below, np.where(x > xp[-1], fp[-1] + above, inside)))


def _check_grid(rows: int, columns: int) -> None:
    if rows < 1 or columns < 1:
        raise ShapeError(f"the scan grid is {rows} x {columns} cells; it must have at least one row and one column")


def range_from_counts(counts: ArrayLike, r0_m: float, dr_m: float) -> NDArray[np.float64]:
    """Return ranges in metres, `r0 + n dr`; NaN where the count is 0 (no return).

    Source: thesis 2.2.1, the equation above Eq 2.1.
    """
    n = np.asarray(counts)
    return np.where(n == 0, np.nan, r0_m + n * float(dr_m))
