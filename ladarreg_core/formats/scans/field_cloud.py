"""A cloud of named fields, as PCL and ROS keep them, becomes a scan: organised, or gridded by its directions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import FormatError, ShapeError
from ladarreg_core.formats.parsing.untrusted import as_float32, one_line, unit_notes
from ladarreg_core.formats.scans.cloud import scan_of_cloud
from ladarreg_core.formats.scans.intensity import chosen_intensity, intensity_name, require_intensity
from ladarreg_core.formats.scans.scan_request import IntensitySource
from ladarreg_core.foundations.arrays import ByteArray
from ladarreg_core.frames import Rigid
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.cloud import in_world_note, moved_pose
from ladarreg_core.scanner.grid_order import is_scan_grid, order_of, unit_rays
from ladarreg_core.scanner.grids import TabulatedGrid

_VIEWPOINT = "VIEWPOINT was read as the scanner's pose in the world; the points stay in the scanner's frame"
RING_NAMES = ("ring", "channel", "laser_id", "laserid", "beam", "line")
"""Names of the field that is the beam of each point, in lower case."""
PACKED_COLOR_NAMES = ("rgb", "rgba")
"""Names of the field that is the colour of each point, four bytes 0xAARRGGBB as a float or an integer."""


def scan_of_fields(
    columns: Mapping[str, NDArray[Any]],
    shape: tuple[int, int],
    *,
    name: str,
    intensity: IntensitySource,
    most_cells: int,
    origin: tuple[float, float, float] | None = None,
    zero_is_stated: bool = False,
    pose: Rigid | None = None,
    notes: Sequence[str] = (),
) -> Scan:
    """Return the scan of a cloud whose fields are known by name.

    Args:
        columns: the scalar fields by name, each (N,) in native byte order: x, y, z (m), intensity, and a ring and
            packed colours if present.
        shape: rows and columns of an organised cloud, whose product is N; (1, N) without an order.
        name: of the scan.
        intensity: `luma` takes the luminance of the colours.
        most_cells: size to which finer clouds are thinned.
        origin: where the scanner stood in the coordinates of the points, (3,) m.
        zero_is_stated: whether the file says that the points are in the scanner's frame.
        pose: of the coordinates of the points in the world.
        notes: remarks on the file so far.

    Raises:
        FormatError: without x, y, z, or without what is asked for as the intensity.
        ShapeError: if there are no returns.
    """
    names = {field.lower(): field for field in columns}
    if not {"x", "y", "z"} <= set(names):
        raise FormatError(f"its fields are {one_line(' '.join(columns), 80)}; a scan needs x, y, z")
    found = intensity_name(columns)
    color = next((_unpack_rgb(columns[names[field]]) for field in PACKED_COLOR_NAMES if field in names), None)
    require_intensity(intensity, has_intensity=found is not None, has_color=color is not None, fields=" ".join(columns))
    points = np.stack([columns[names[axis]].astype(np.float64) for axis in "xyz"], axis=-1)
    strength, said = chosen_intensity(intensity, None if found is None else columns[found], color, points.shape[:-1])
    ring = next((columns[names[field]] for field in RING_NAMES if field in names), None)
    remarks = [*notes, *said]
    stated = [] if pose is None else [("VIEWPOINT", np.asarray(pose.translation, dtype=np.float64))]
    if min(shape) > 1 and (origin is None or not any(origin)):
        grid = _organised(points, shape, stated)
        if grid is not None:
            points, where, said_where = grid
            rays = unit_rays(points.reshape(*shape, 3))
            order = order_of(rays)
            remarks += said_where
            if order:
                remarks.append("the grid was reordered so that row 0 is the top and column 0 the left")
            if where.any():
                pose = moved_pose(pose, where, stated)
            elif pose is not None:
                remarks.append(_VIEWPOINT)
            with np.errstate(over="ignore", invalid="ignore"):
                ranges = as_float32(np.linalg.norm(points, axis=-1)).reshape(shape)
            grids = [order.apply(grid) for grid in (rays, ranges, strength.reshape(shape))]
            return Scan(
                TabulatedGrid(grids[0]),
                grids[1],
                grids[2],
                color=None if color is None else order.apply(color.reshape(*shape, 3)),
                world_from_scanner=pose,
                name=name,
                notes=(*remarks, *unit_notes(ranges)),
            )
        remarks.append(f"the header says {shape[1]} x {shape[0]}, but the points are not in this order")
    scan = scan_of_cloud(
        points,
        strength,
        color,
        name=name,
        origin=origin,
        stated=stated,
        zero_is_stated=zero_is_stated,
        ring=_whole_rings(ring),
        world_from_scanner=pose,
        most_cells=most_cells,
        notes=remarks,
    )
    found_pose = scan.world_from_scanner
    if pose is not None and found_pose is not None and np.array_equal(found_pose.matrix, pose.matrix):
        return replace(scan, notes=(*scan.notes, _VIEWPOINT))
    return scan


def _organised(
    points: NDArray[np.float64], shape: tuple[int, int], stated: Sequence[tuple[str, NDArray[np.float64]]]
) -> tuple[NDArray[np.float64], NDArray[np.float64], list[str]] | None:
    """Return the points relative to the scanner, where it stood, and notes, if an organised cloud is its grid."""
    grid = points.reshape(*shape, 3)
    rays = unit_rays(grid)
    if not np.isfinite(rays[..., 0]).any():
        raise ShapeError("the scan has no returns: every point is missing or zero; it needs measured points")
    if is_scan_grid(rays):
        return points, np.zeros(3), []
    for words, place in stated:
        moved = np.where(grid.any(axis=-1, keepdims=True), grid - place, np.nan)
        if place.any() and is_scan_grid(unit_rays(moved)):
            return np.asarray(moved.reshape(-1, 3), dtype=np.float64), place, [in_world_note(words, place)]
    return None


def _unpack_rgb(packed: NDArray[Any]) -> ByteArray | None:
    """Return colours (N, 3) from four packed bytes, 0xAARRGGBB, which PCL stores as a float or an integer."""
    if packed.dtype.itemsize != 4:
        return None
    words = np.ascontiguousarray(packed).view(np.uint32)
    return np.stack([(words >> shift) & 255 for shift in (16, 8, 0)], axis=-1).astype(np.uint8)


def _whole_rings(ring: NDArray[Any] | None) -> NDArray[np.int64] | None:
    if ring is None or not np.isfinite(ring).all() or np.abs(ring.astype(np.float64)).max(initial=0) > 2**31:
        return None
    return ring.astype(np.int64)
