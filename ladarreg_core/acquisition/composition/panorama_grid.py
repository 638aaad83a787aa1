"""The spherical grid around the pieces of a mosaic."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import ShapeError
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.frames import Rigid
from ladarreg_core.scan import IntensityKind, Scan
from ladarreg_core.scanner.grids import SphericalGrid

_SAMPLES_A_SIDE = 160
_SMALLEST_GAP_RAD = float(np.radians(2.0))
_MAX_CELLS = 100_000_000


@dataclass(frozen=True, slots=True, eq=False)
class Footprint:
    """The directions that a piece may show, from the origin of the world."""

    directions: NDArray[np.float64]
    """(N, 3) unit rays, spread over the piece, its border included."""
    axis: NDArray[np.float64]
    """(3,) the middle direction."""
    reach_rad: float
    """No direction is farther from the axis."""
    step_rad: float
    """Angle between neighbouring cells."""
    poles: tuple[bool, bool]
    """Whether the zenith and the nadir are within the piece."""
    intensity_is: IntensityKind
    in_color: bool

    def may_show(self, rays: FloatArray) -> bool:
        """Return whether some of the rays (N, 3) of a tile may lie within the piece."""
        middle = rays.astype(np.float64).mean(axis=0)
        length = float(np.linalg.norm(middle))
        if length < 0.1:
            return True
        middle /= length
        wide = float(np.arccos(np.clip((rays @ middle.astype(rays.dtype)).min(), -1, 1)))
        return float(np.arccos(np.clip(middle @ self.axis, -1, 1))) <= wide + self.reach_rad


def footprint_of(scan: Scan, world_from_scanner: Rigid) -> Footprint:
    """Return where a piece may show something: the directions of its returns, and of its cells without one."""
    places = [np.unique(np.linspace(0, side - 1, _SAMPLES_A_SIDE).round()).astype(int) for side in scan.shape]
    row, column = np.meshgrid(*places, indexing="ij")
    rays = scan.geometry.ray_at(np.stack([row, column], axis=-1)).reshape(-1, 3)
    ranges = scan.ranges[np.ix_(*places)].astype(np.float64).ravel()
    rays, ranges = rays[np.isfinite(rays).all(axis=-1)], ranges[np.isfinite(rays).all(axis=-1)]
    points = rays * np.where(np.isfinite(ranges), ranges, 1e6)[:, None]
    seen = world_from_scanner @ points
    lengths = np.linalg.norm(seen, axis=-1)
    directions = seen[lengths > 0] / lengths[lengths > 0, None]
    axis = directions.mean(axis=0)
    length = float(np.linalg.norm(axis))
    axis = axis / length if length > 1e-6 else np.array([1.0, 0.0, 0.0])
    margin = 2 * (max(scan.shape) / _SAMPLES_A_SIDE + 1) * max(scan.geometry.step_rad)
    nearest = float(np.nanmin(scan.ranges))
    margin += float(np.arctan(np.linalg.norm(world_from_scanner.translation) / max(nearest, 1e-3)))
    reach = float(np.arccos(np.clip((directions @ axis).min(), -1, 1))) + margin
    return Footprint(
        directions, axis, reach, float(np.median(scan.geometry.step_rad)),
        (_within(scan, world_from_scanner, 1.0), _within(scan, world_from_scanner, -1.0)),
        scan.intensity_is, scan.color is not None,
    )  # fmt: skip


def _within(scan: Scan, pose: Rigid, up: float) -> bool:
    """Return whether the zenith (up = 1) or the nadir (-1) is within a piece."""
    cell = np.asarray(scan.geometry.cell_of(np.array([[0.0, 0.0, up]]) @ pose.rotation))[0]
    return bool(np.isfinite(cell).all() and (cell >= -0.5).all() and (cell <= np.array(scan.shape) - 0.5).all())


def grid_around(footprints: Sequence[Footprint]) -> SphericalGrid:
    """Return the spherical grid around all pieces, as fine as the finest; open where the widest gap in longitude is.

    Raises:
        ShapeError: if it would have more than 100 million cells.
    """
    step = min(footprint.step_rad for footprint in footprints)
    directions = np.concatenate([footprint.directions for footprint in footprints])
    latitude = np.arcsin(np.clip(directions[:, 2], -1, 1))
    zenith, nadir = (any(footprint.poles[k] for footprint in footprints) for k in (0, 1))
    top = np.pi / 2 - step / 2 if zenith else float(latitude.max())
    bottom = -np.pi / 2 + step / 2 if nadir else float(latitude.min())
    rows = max(2, int(np.ceil((top - bottom) / step - 0.01)) + 1)
    longitude = np.arctan2(directions[:, 1], directions[:, 0])
    start, width = _arc(longitude)
    around = zenith or nadir or 2 * np.pi - width < _SMALLEST_GAP_RAD
    columns = max(2, round(2 * np.pi / step) if around else int(np.ceil(width / step - 0.01)) + 1)
    if rows * columns > _MAX_CELLS:
        raise ShapeError(
            f"the panorama would have {rows:,} x {columns:,} cells; at most {_MAX_CELLS:,} are possible: the pieces' "
            f"steps are {np.degrees(step):.4g} deg, use coarser ones"
        )
    if around:
        return SphericalGrid(rows, columns, 2 * np.pi / columns, step, 0.0, float(top))
    return SphericalGrid(rows, columns, step, step, start + width / 2, float(top))


def _arc(longitude: FloatArray) -> tuple[float, float]:
    """Return the start and the width, rad, of the arc that holds all longitudes (N,) outside the widest gap."""
    ordered = np.sort(np.asarray(longitude, np.float64))
    gaps = np.diff(np.append(ordered, ordered[0] + 2 * np.pi))
    widest = int(gaps.argmax())
    start = float(ordered[(widest + 1) % len(ordered)])
    return start, float(2 * np.pi - gaps[widest])
