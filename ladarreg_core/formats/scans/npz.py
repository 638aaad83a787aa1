"""NPZ scans: `intensity` with `xyz` or with `counts` and its scalars; nothing is ever unpickled."""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import ExportError, FormatError, OptionError, ShapeError
from ladarreg_core.formats.parsing.budget import ReadBudget
from ladarreg_core.formats.parsing.byte_order import require_byte_order
from ladarreg_core.formats.parsing.npz_archive import ArrayMember, members_of, open_archive
from ladarreg_core.formats.parsing.untrusted import (
    PathLike,
    as_float32,
    one_line,
    reading,
    require_cells,
    shown_name,
    unit_notes,
)
from ladarreg_core.formats.scans.world_pose import world_pose
from ladarreg_core.foundations.progress import Progress, Report
from ladarreg_core.frames import Rigid
from ladarreg_core.scan import NO_INTENSITY_NOTE, IntensityKind, Scan
from ladarreg_core.scanner.grid_order import is_scan_grid, order_of, unit_rays
from ladarreg_core.scanner.grid_window import grid_rays
from ladarreg_core.scanner.grids import (
    AzimuthElevation,
    ScanGeometry,
    SphericalGrid,
    TabulatedGrid,
    range_from_counts,
)

SCALARS = ("r0_m", "dr_m", "d_azimuth_rad", "d_elevation_rad")
OFFSETS = ("azimuth_offset_rad", "elevation_offset_rad")
SPHERE = ("d_longitude_rad", "d_latitude_rad", "centre_longitude_rad", "top_latitude_rad")
"""Scalars of a panorama: with them the directions of its cells need no table."""
_TEXTS = ("intensity_is", "note")
_ARRAYS = frozenset(
    ("intensity", "xyz", "counts", "color", "rays", "world_from_scanner", *_TEXTS, *SCALARS, *OFFSETS, *SPHERE)
)
_LONGEST_NOTE = 600
_MAX_APART_RAD = 5e-3
_MAX_APART_SHARE = 0.01
# Measured peak memory per cell of a read, beyond the file's arrays.
_XYZ_BYTES = 330
_COUNTS_BYTES = 40
_SPHERE_BYTES = 24
_ROWS_AT_ONCE = 64


def sniff_npz(head: bytes) -> bool:
    """Return whether these are the first bytes of a zip archive."""
    return head[:4] in (b"PK\x03\x04", b"PK\x05\x06")


def read_npz(path: PathLike, *, memory_bytes: int | None = None, report: Report | None = None) -> Scan:
    """Read an NPZ scan.

    Args:
        path: a file with `intensity` (H, W) and either `xyz` (H, W, 3), m, NaN or (0, 0, 0) = no return, or `counts`
            (H, W), 0 = no return, with `r0_m`, `dr_m`, `d_azimuth_rad`, `d_elevation_rad` and optional offsets;
            counts may come without intensity. Optional: `color` (H, W, 3) uint8, `rays` (H, W, 3), directions also of
            cells without a return (those of the points are their own), `world_from_scanner` (4, 4), `note`, a sentence
            on the scan. With the four scalars `SPHERE` the points lie on a spherical grid: row 0 at `top_latitude_rad`,
            the middle column at `centre_longitude_rad`.
        memory_bytes: memory that the read may use, bytes; None: see `budget`.
        report: receives the progress.

    Returns:
        The scan, in the file's order of rows and columns.

    Raises:
        FormatError: if it is damaged, incomplete, pickled, claims more than it contains, or would need more memory than
            it may use.
        ShapeError: if the arrays disagree or there is no return.
    """
    with reading(path) as file, open_archive(file) as archive:
        members = members_of(archive, _ARRAYS, _TEXTS)
        if "intensity" not in members and "counts" not in members:
            raise FormatError(
                f"the NPZ contains {_listed(members)} but no 'intensity'; a scan needs the laser's intensity (H, W)"
            )
        if ("xyz" in members) == ("counts" in members):
            found = "both 'xyz' and 'counts'" if "xyz" in members else f"{_listed(members)}"
            raise FormatError(f"the NPZ contains {found}; it needs either 'xyz' (H, W, 3) or 'counts' (H, W)")
        intensity = members.get("intensity", members.get("counts"))
        assert intensity is not None
        if len(intensity.shape) != 2:
            raise ShapeError(f"the scan has the shape {intensity.shape}; it must be (H, W)")
        require_cells(*intensity.shape)
        name = "xyz" if "xyz" in members else "counts"
        measured = members[name]
        wanted = (*intensity.shape, 3) if name == "xyz" else intensity.shape
        if measured.shape != wanted:
            raise ShapeError(f"'{name}' has the shape {measured.shape}, 'intensity' {intensity.shape}; they must agree")
        color = members.get("color")
        if color is not None and (color.shape != (*intensity.shape, 3) or color.dtype != np.uint8):
            raise ShapeError(f"'color' is {color.dtype} {color.shape}; it must be uint8 {(*intensity.shape, 3)}")
        rays = members.get("rays")
        if rays is not None and (rays.shape != (*intensity.shape, 3) or rays.dtype.kind != "f"):
            raise ShapeError(f"'rays' is {rays.dtype} {rays.shape}; it must be float {(*intensity.shape, 3)}")
        world_from_scanner = _world_pose(archive, members)
        arrays = sum(member.bytes_per_cell for member in (intensity, measured, color, rays) if member is not None)
        budget = ReadBudget.of(file.stat().st_size, memory_bytes)
        sphere = _sphere(archive, members, intensity.shape)
        in_tables = (name == "xyz" and sphere is None) or rays is not None
        more = _XYZ_BYTES if in_tables else _COUNTS_BYTES if sphere is None else _SPHERE_BYTES
        budget.require_cells(*intensity.shape, arrays + more)
        total = 2 + (color is not None)
        _report(report, 0, total)
        shown = np.zeros(intensity.shape, np.float32)  # counts alone are a shape
        if "intensity" in members:
            shown = as_float32(intensity.read(archive))
        _report(report, 1, total)
        values = measured.read(archive)
        _report(report, 2, total)
        directions = None if rays is None else rays.read(archive)
        geometry: ScanGeometry
        metres: NDArray[Any]
        notes: tuple[str, ...] = ()
        if sphere is not None:
            geometry, metres = sphere, _on_sphere(values, sphere)
        elif name == "xyz":
            geometry, metres, notes = _from_xyz(values, directions)
        else:
            geometry, metres = _from_counts(values, _scalars(archive, members))
            geometry = geometry if directions is None else TabulatedGrid(_unit(directions))
        ranges = as_float32(metres)
        del values, metres
        for array in (ranges, shown):
            array.flags.writeable = False  # handed over without a copy
        scan = Scan(
            geometry,
            ranges,
            shown,
            color=None if color is None else color.read(archive),
            intensity_is=_intensity_is(archive, members),
            world_from_scanner=world_from_scanner,
            name=file.stem,
            notes=(*notes, *unit_notes(ranges), *_note(archive, members)),
        )
        return scan if scan.has_intensity else replace(scan, notes=(*scan.notes, NO_INTENSITY_NOTE))


def write_npz_counts(
    path: PathLike, *, counts: NDArray[Any], intensity: NDArray[Any], geometry: AzimuthElevation, r0_m: float,
    dr_m: float, intensity_is: IntensityKind = "raw",
) -> None:  # fmt: skip
    """Write a scan in the counts form.

    Args:
        path: output file.
        counts: (H, W) uint16, 0 = no return.
        intensity: (H, W), any numeric type, which is kept.
        geometry: angles of the grid.
        r0_m: range of count 0, m.
        dr_m: range increment per count, m.
        intensity_is: `raw` or `range_normalised`.

    Raises:
        ShapeError: if the shapes of the arrays and the geometry differ.
        ExportError: if the file cannot be written.
    """
    if counts.shape != geometry.shape or intensity.shape != geometry.shape:
        raise ShapeError(f"counts {counts.shape} and intensity {intensity.shape} must have the shape {geometry.shape}")
    scalars = {
        "r0_m": r0_m,
        "dr_m": dr_m,
        "d_azimuth_rad": geometry.d_azimuth_rad,
        "d_elevation_rad": geometry.d_elevation_rad,
        "azimuth_offset_rad": geometry.azimuth_offset_rad,
        "elevation_offset_rad": geometry.elevation_offset_rad,
        "intensity_is": intensity_is,
    }
    _save(path, {"counts": counts.astype(np.uint16), "intensity": intensity, **scalars})


def write_npz_xyz(path: PathLike, scan: Scan, *, note: str = "") -> None:
    """Write a scan in the xyz form, float32 metres in the scanner frame, NaN = no return.

    With `rays`, the directions of all cells, and `world_from_scanner` if it is known; with `note`, a sentence that
    whoever reads the scan is to know.

    Raises:
        ExportError: if the file cannot be written.
    """
    arrays: dict[str, Any] = {
        "xyz": scan.points,
        "intensity": scan.intensity,
        "intensity_is": scan.intensity_is,
        "rays": scan.rays.astype(np.float32),
    }
    if scan.world_from_scanner is not None:
        arrays["world_from_scanner"] = scan.world_from_scanner.matrix
    if scan.color is not None:
        arrays["color"] = scan.color
    if note:
        arrays["note"] = note
    _save(path, arrays)


def write_npz_panorama(
    path: PathLike, scan: Scan, *, piece: NDArray[np.integer[Any]] | None = None, note: str = ""
) -> None:
    """Write a scan on a spherical grid in the xyz form, with the scalars `SPHERE`, in bounded memory.

    Args:
        path: output file.
        scan: the scan; its geometry is a `SphericalGrid`.
        piece: (H, W) the piece of a mosaic that each return is from; negative for none, which becomes the largest
            number of the type that is written.
        note: a sentence that whoever reads the scan is to know.

    Raises:
        ShapeError: if the scan has another geometry.
        ExportError: if the file cannot be written.
    """
    grid = scan.geometry
    if not isinstance(grid, SphericalGrid):
        raise ShapeError(f"the scan is on a {type(grid).__name__}; a panorama is on a SphericalGrid")
    rows, columns = scan.shape
    small: dict[str, Any] = {name: getattr(grid, name) for name in SPHERE}
    small["intensity_is"] = scan.intensity_is
    if note:
        small["note"] = note
    if scan.world_from_scanner is not None:
        small["world_from_scanner"] = scan.world_from_scanner.matrix
    large: dict[str, tuple[tuple[int, ...], Any, Callable[[slice], NDArray[Any]]]] = {
        "xyz": ((rows, columns, 3), np.float32, lambda part: scan.points_at(part, slice(None))),
        "intensity": ((rows, columns), np.float32, lambda part: scan.intensity[part]),
    }
    if scan.color is not None:
        color = scan.color
        large["color"] = ((rows, columns, 3), np.uint8, lambda part: color[part])
    if piece is not None:
        kind = np.uint8 if piece.max(initial=0) < 255 else np.uint16
        none = np.iinfo(kind).max
        large["piece"] = ((rows, columns), kind, lambda part: np.where(piece[part] < 0, none, piece[part]).astype(kind))
    try:
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, allowZip64=True, compresslevel=1) as archive:
            for name, value in small.items():
                with archive.open(f"{name}.npy", "w") as stream:
                    np.lib.format.write_array(stream, np.asarray(value), allow_pickle=False)
            for name, (shape, dtype, rows_of) in large.items():
                with archive.open(f"{name}.npy", "w", force_zip64=True) as stream:
                    header = {"descr": np.dtype(dtype).str, "fortran_order": False, "shape": shape}
                    np.lib.format.write_array_header_1_0(stream, header)
                    for first in range(0, rows, _ROWS_AT_ONCE):
                        part = rows_of(slice(first, first + _ROWS_AT_ONCE))
                        stream.write(np.ascontiguousarray(part, dtype).data)
    except OSError as error:
        raise ExportError(f"{shown_name(path)} cannot be written: {error.strerror}; check the folder") from error


def _save(path: PathLike, arrays: dict[str, Any]) -> None:
    try:
        with open(path, "wb") as stream:
            np.savez_compressed(stream, allow_pickle=False, **{k: np.asarray(v) for k, v in arrays.items()})
    except OSError as error:
        raise ExportError(f"{shown_name(path)} cannot be written: {error.strerror}; check the folder") from error


def _listed(members: dict[str, ArrayMember]) -> str:
    return ", ".join(sorted(members))


def _scalars(archive: zipfile.ZipFile, members: dict[str, ArrayMember]) -> dict[str, float]:
    values = dict.fromkeys(OFFSETS, 0.0)
    for name in (*SCALARS, *OFFSETS):
        member = members.get(name)
        if member is None:
            if name in SCALARS:
                raise FormatError(f"the scalar {name!r} is missing; the counts form needs {', '.join(SCALARS)}")
            continue
        if member.shape not in ((), (1,)):
            raise ShapeError(f"{name!r} has the shape {member.shape}; it must be one number")
        values[name] = float(member.read(archive).reshape(()))
        if not np.isfinite(values[name]):
            raise FormatError(f"{name!r} is {values[name]}; it must be a finite number")
    return values


def counts_geometry(shape: tuple[int, int], scalars: dict[str, float]) -> AzimuthElevation:
    """Return the geometry of the counts form.

    Raises:
        FormatError: if `dr_m` is not positive, or an angle is invalid.
    """
    if scalars["dr_m"] <= 0:
        raise FormatError(f"'dr_m' is {scalars['dr_m']:g}; it must be the positive range increment per count in metres")
    try:
        return AzimuthElevation(
            *shape,
            scalars["d_azimuth_rad"],
            scalars["d_elevation_rad"],
            scalars["azimuth_offset_rad"],
            scalars["elevation_offset_rad"],
        )
    except OptionError as error:
        raise FormatError(str(error)) from error


def _from_counts(counts: NDArray[Any], scalars: dict[str, float]) -> tuple[ScanGeometry, NDArray[np.float64]]:
    if counts.dtype.kind not in "ui":
        raise FormatError(f"'counts' has the type {counts.dtype}; it must contain integers (uint16)")
    if counts.dtype.itemsize > 1:
        wanted = "read the raw file in the other order and save it again"
        require_byte_order(counts, counts.byteswap(), what="the counts", wanted=wanted)
    if counts.dtype.kind == "i" and counts.min(initial=0) < 0:
        raise FormatError(f"'counts' contains {counts.min()}; counts must not be negative, 0 = no return")
    geometry = counts_geometry((counts.shape[0], counts.shape[1]), scalars)
    return geometry, range_from_counts(counts, scalars["r0_m"], scalars["dr_m"])


def _from_xyz(
    xyz: NDArray[Any], directions: NDArray[Any] | None
) -> tuple[ScanGeometry, NDArray[np.float64], tuple[str, ...]]:
    points = xyz.astype(np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        ranges = np.linalg.norm(points, axis=-1)
    missing = ~(np.isfinite(ranges) & (ranges > 0))
    if missing.all():
        raise ShapeError(
            "the scan has no returns: every point is missing, zero or not finite; it needs measured points"
        )
    points[missing] = np.nan
    ranges[missing] = np.nan
    if directions is not None:
        table = _unit(directions)
        _require_same(points, ranges, table)
        points[missing] = table[missing]  # a point's own direction is exact, that of a table may be rounded
    rays = unit_rays(points) if directions is None else unit_rays(np.where(missing[..., None], np.nan, points))
    # The file's order is kept: the cells in matches files refer to it.
    wrong = is_scan_grid(rays) and order_of(rays)
    note = "row 0 is not the top or column 0 not the left: the scan is shown rotated or mirrored"
    return TabulatedGrid(points), ranges, (note,) if wrong else ()


def _sphere(archive: zipfile.ZipFile, members: dict[str, ArrayMember], shape: tuple[int, ...]) -> SphericalGrid | None:
    """Return the spherical grid that a file states; None if it states none."""
    given = [name for name in SPHERE if name in members]
    if not given:
        return None
    if len(given) < len(SPHERE) or "counts" in members or "rays" in members:
        missing = ", ".join(name for name in SPHERE if name not in members)
        why = f"{missing} is missing" if missing else "'xyz' must be given, without 'counts' or 'rays'"
        raise FormatError(f"the scalars of a spherical grid are incomplete: {why}")
    values = {}
    for name in SPHERE:
        if members[name].shape not in ((), (1,)):
            raise ShapeError(f"{name!r} has the shape {members[name].shape}; it must be one number")
        values[name] = float(members[name].read(archive).reshape(()))
        if not np.isfinite(values[name]):
            raise FormatError(f"{name!r} is {values[name]}; it must be a finite number")
    try:
        return SphericalGrid(shape[0], shape[1], **values)
    except OptionError as error:
        raise FormatError(str(error)) from error


def _on_sphere(xyz: NDArray[Any], grid: SphericalGrid) -> NDArray[np.float32]:
    """Return the ranges (H, W) of points on a spherical grid; NaN = no return.

    Raises:
        FormatError: if the points are not on the grid.
    """
    ranges = np.empty(xyz.shape[:2], np.float32)
    wrong = known = 0
    for first in range(0, len(xyz), _ROWS_AT_ONCE):
        part = slice(first, min(first + _ROWS_AT_ONCE, len(xyz)))
        points = as_float32(xyz[part])
        with np.errstate(over="ignore", invalid="ignore"):
            ranges[part] = np.linalg.norm(points, axis=-1)
            there = np.isfinite(ranges[part]) & (ranges[part] > 0)
            rays = grid_rays(grid, part, slice(None, None, 4))
            some = there[:, ::4]
            ahead = np.einsum("...k,...k->...", points[:, ::4], rays) / ranges[part][:, ::4]
        wrong += int((ahead[some] < np.cos(_MAX_APART_RAD)).sum())
        known += int(some.sum())
        ranges[part][~there] = np.nan
    if wrong > _MAX_APART_SHARE * known:
        raise FormatError(
            f"{100 * wrong / known:.0f} % of the points of 'xyz' are not on the spherical grid that the file states; "
            "leave the grid's scalars out, or correct them"
        )
    return ranges


def _unit(directions: NDArray[Any]) -> NDArray[np.float64]:
    """Return directions (H, W, 3) as unit vectors; NaN for those that are zero or not finite."""
    rays = directions.astype(np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        lengths = np.linalg.norm(rays, axis=-1, keepdims=True)
        rays /= lengths
    rays[~(np.isfinite(lengths) & (lengths > 0))[..., 0]] = np.nan
    return rays


def _require_same(points: NDArray[np.float64], ranges: NDArray[np.float64], table: NDArray[np.float64]) -> None:
    """Refuse directions that are not those of the points."""
    with np.errstate(invalid="ignore"):
        apart = np.linalg.norm(points / ranges[..., None] - table, axis=-1)
    apart = apart[np.isfinite(apart)]
    share = float(np.mean(apart > _MAX_APART_RAD)) if apart.size else 0.0
    if share > _MAX_APART_SHARE:
        raise FormatError(
            f"{100 * share:.0f} % of the points of 'xyz' do not lie on their 'rays' (median difference "
            f"{np.degrees(np.median(apart)):.2g} deg); both must be in the scanner's frame"
        )


def _world_pose(archive: zipfile.ZipFile, members: dict[str, ArrayMember]) -> Rigid | None:
    member = members.get("world_from_scanner")
    if member is None:
        return None
    if member.shape != (4, 4):
        raise ShapeError(f"'world_from_scanner' has the shape {member.shape}; it must be (4, 4)")
    return world_pose(member.read(archive), "'world_from_scanner'")


def _intensity_is(archive: zipfile.ZipFile, members: dict[str, ArrayMember]) -> IntensityKind:
    member = members.get("intensity_is")
    if member is None:
        return "raw"
    if member.shape not in ((), (1,)):
        raise ShapeError(f"'intensity_is' has the shape {member.shape}; it must be one string")
    value = member.read(archive).reshape(())[()]
    word = value.decode("ascii", "replace") if isinstance(value, bytes) else str(value)
    if word == "raw":
        return "raw"
    if word == "range_normalised":
        return "range_normalised"
    raise FormatError(f"'intensity_is' is {one_line(repr(word), 40)}; it must be 'raw' or 'range_normalised'")


def _note(archive: zipfile.ZipFile, members: dict[str, ArrayMember]) -> tuple[str, ...]:
    """Return what the program that wrote the scan has to say of it."""
    member = members.get("note")
    if member is None or member.shape != () or member.dtype.kind != "U" or member.dtype.itemsize > 4 * _LONGEST_NOTE:
        return ()
    return (one_line(str(member.read(archive).reshape(())[()]), _LONGEST_NOTE),)


def _report(report: Report | None, done: int, total: int) -> None:
    if report is not None:
        report(Progress(done, total, "reading the scan"))
