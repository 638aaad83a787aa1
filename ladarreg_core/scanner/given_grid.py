"""A grid that a caller gives as arrays, in any order of rows and columns: points, or ranges with rays or angles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ladarreg_core.errors import OptionError, ShapeError
from ladarreg_core.foundations.arrays import FloatArray, read_only
from ladarreg_core.scanner.grid_order import GridOrder, is_scan_grid, order_of
from ladarreg_core.scanner.grids import TabulatedGrid

_MAX_APART_RAD = 0.01
_NEEDED = "give `xyz`, or `ranges` with `rays`, or `ranges` with `azimuth_rad` and `elevation_rad`"


@dataclass(frozen=True, slots=True, eq=False)
class UprightGrid:
    """A grid with row 0 on top and column 0 on the left."""

    geometry: TabulatedGrid
    """The rays."""
    ranges: NDArray[np.float64]
    """(H, W) m; NaN: no return."""
    order: GridOrder
    """What brought the given rows and columns into this order."""
    given_shape: tuple[int, int]
    """Rows and columns as given."""
    notes: tuple[str, ...]
    """What was changed."""


def upright_grid(
    xyz: ArrayLike | None,
    ranges: ArrayLike | None,
    rays: ArrayLike | None,
    azimuth_rad: ArrayLike | None,
    elevation_rad: ArrayLike | None,
) -> UprightGrid:
    """Return the grid of the arrays described at `Scan.from_grid`.

    Raises:
        OptionError: unless points, or ranges with rays or both angles, are given.
        ShapeError: if the arrays do not match, there is no return, or too few rays are known.
    """
    angles = azimuth_rad is not None or elevation_rad is not None
    if (xyz is None) == (ranges is None) or (angles and (rays is not None or xyz is not None)):
        raise OptionError(f"the grid is not described by one set of arrays; {_NEEDED}")
    if xyz is not None:
        points = read_only(xyz, np.float64, (None, None, 3), "the grid's points")
        with np.errstate(over="ignore", invalid="ignore"):
            distance = np.linalg.norm(points, axis=-1)
        measured = np.isfinite(distance) & (distance > 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            own = np.where(measured[..., None], points / distance[..., None], np.nan)
        table = own if rays is None else _completed(own, _unit(rays, measured.shape))
    else:
        assert ranges is not None
        distance = read_only(ranges, np.float64, (None, None), "the grid's ranges")
        if angles:
            if azimuth_rad is None or elevation_rad is None:
                raise OptionError(f"one of two angles is missing; {_NEEDED}")
            table = _rays_of_angles(azimuth_rad, elevation_rad, distance.shape)
        elif rays is not None:
            table = _unit(rays, distance.shape)
        else:
            raise OptionError(f"ranges are given without directions; {_NEEDED}")
        with np.errstate(invalid="ignore"):
            measured = np.isfinite(distance) & (distance > 0) & np.isfinite(table[..., 0])
    if not measured.any():
        raise ShapeError("the grid has no returns: every point is missing, zero or not finite; give measured points")
    order = order_of(table) if is_scan_grid(table) else GridOrder(False, False, False)
    return UprightGrid(
        TabulatedGrid(order.apply(table)),
        order.apply(np.where(measured, distance, np.nan)),
        order,
        (distance.shape[0], distance.shape[1]),
        (_note(order),) if order else (),
    )


def _note(order: GridOrder) -> str:
    done = [
        words
        for words, applied in (
            ("rows and columns were exchanged", order.transpose),
            ("the rows were reversed", order.flip_rows),
            ("the columns were reversed", order.flip_columns),
        )
        if applied
    ]
    return f"{', '.join(done)}, so that row 0 is the top and column 0 the left"


def _unit(rays: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Return directions as unit vectors; NaN for those that are zero or not finite."""
    given = read_only(rays, np.float64, (*shape, 3), "the grid's rays")
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        length = np.linalg.norm(given, axis=-1, keepdims=True)
        return np.where(np.isfinite(length) & (length > 0), given / length, np.nan)


def _completed(own: FloatArray, rays: FloatArray) -> NDArray[np.float64]:
    """Return the directions of the points, and elsewhere the rays; those that contradict each other are refused."""
    apart = np.linalg.norm(own - rays, axis=-1)
    apart = apart[np.isfinite(apart)]
    if len(apart) and np.median(apart) > _MAX_APART_RAD:
        raise ShapeError(
            f"the points do not lie on the rays (median difference {np.degrees(np.median(apart)):.2g} deg); both must "
            "be in the scanner's frame"
        )
    return np.where(np.isfinite(own), own, rays)


def _rays_of_angles(azimuth_rad: ArrayLike, elevation_rad: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.float64]:
    height, width = shape
    azimuth, elevation = (np.asarray(angle, dtype=np.float64) for angle in (azimuth_rad, elevation_rad))
    if azimuth.shape not in ((width,), shape) or elevation.shape not in ((height,), shape):
        raise ShapeError(
            f"the azimuths have the shape {azimuth.shape} and the elevations {elevation.shape}; for ranges of "
            f"{height} x {width} they must be ({width},) and ({height},), or both {shape}"
        )
    elevation = elevation[:, None] if elevation.ndim == 1 else elevation
    azimuth, elevation = np.broadcast_arrays(azimuth, elevation)
    level = np.cos(elevation)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=-1)
