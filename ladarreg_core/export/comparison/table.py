"""Table of a comparison's numbers, in the layout of the thesis's Tables 3.2-3.5."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ladarreg_core.errors import ShapeError
from ladarreg_core.foundations.arrays import BoolArray, FloatArray
from ladarreg_core.registration.comparison import Column, Comparison
from ladarreg_core.results.registration import STAGE_LABELS, PoseResult
from ladarreg_core.scan import Scan

NOTHING = "-"
"""Placeholder for undefined numbers."""
_COMPARED_POINTS = 20_000


@dataclass(frozen=True, slots=True, kw_only=True)
class Difference:
    """Difference of a pose from that of the default method."""

    median_px: float
    """Median displacement in the photo, px, of the points coloured by the default; infinite if most of them fall behind
    the camera, NaN if it colours none."""
    position_m: float
    """Distance of the camera positions, m."""
    angle_rad: float
    """Angle between the camera orientations, rad."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """Table of text cells."""

    heads: tuple[str, ...]
    """Titles of the columns."""
    rows: tuple[tuple[str, ...], ...]
    """Rows: the row's name followed by one cell per column."""


def title_of(column: Column) -> str:
    """Return the title of a column."""
    return STAGE_LABELS.get(column.stage.name, str(column.stage.name))


def verdict_of(column: Column) -> str:
    """Return `accepted`, `not accepted` or `no pose`."""
    if column.stage.result is None:
        return "no pose"
    return "accepted" if column.stage.result.accepted else "not accepted"


def default_of(comparison: Comparison) -> Column | None:
    """Return the column of the default method; None if there is none."""
    return next((column for column in comparison.columns if column.stage.name == "default"), None)


def cautions_of(comparison: Comparison) -> tuple[str, ...]:
    """Return the cautions of the comparison, and one if the default itself is not accepted."""
    default = default_of(comparison)
    if default is None or verdict_of(default) != "not accepted":
        return comparison.cautions
    return (*comparison.cautions, "The default itself is not accepted, so the differences from it mean little.")


def rms_px(result: PoseResult) -> float:
    """Return the root mean square length of the inliers' residuals, photo pixels; NaN if there are none."""
    return _root_mean((result.residuals_px[result.inliers] ** 2).sum(axis=-1))


def rms_depth_m(result: PoseResult) -> float:
    """Return the root mean square of the inliers' stereo depth errors, m; NaN if there are none."""
    return _root_mean(result.stereo_depth_error_m[result.inliers] ** 2)


def check_comparison(comparison: Comparison, scan: Scan) -> None:
    """Refuse a comparison that cannot be shown on a scan.

    Raises:
        ShapeError: if there is no column, or an image is not on the scan's grid.
    """
    if not comparison.columns:
        raise ShapeError("the comparison has no columns; give at least one stage")
    for column in comparison.columns:
        if column.texture is not None and column.texture.labels.shape != scan.shape:
            found = " x ".join(map(str, column.texture.labels.shape))
            wanted = " x ".join(map(str, scan.shape))
            raise ShapeError(f"the image of {title_of(column)!r} has {found} cells, the scan {wanted}; they must agree")


def differences(comparison: Comparison, scan: Scan) -> tuple[Difference | None, ...]:
    """Return the difference of each column from the default; None where either has no pose, or an undetermined one.

    Args:
        comparison: the columns.
        scan: the scan that they share.

    Raises:
        ShapeError: as `check_comparison`.
    """
    check_comparison(comparison, scan)
    default = default_of(comparison)
    if default is None or default.stage.result is None or not default.stage.result.is_determined:
        return (None,) * len(comparison.columns)
    reference, points = default.stage.result, _seen_points(default, scan)
    return tuple(
        _difference(column.stage.result, reference, points)
        if column.stage.result is not None and column.stage.result.is_determined
        else None
        for column in comparison.columns
    )


def comparison_table(comparison: Comparison, scan: Scan) -> Table:
    """Return the table of a comparison as text.

    Args:
        comparison: the columns.
        scan: the scan that they share.

    Raises:
        ShapeError: as `check_comparison`.

    Source: thesis Tables 3.2-3.5, with residuals, verdicts and the difference from the default beside them.
    """
    results = [column.stage.result for column in comparison.columns]
    thesis = [r.thesis_parameters if r is not None and r.is_determined else None for r in results]
    apart = differences(comparison, scan)

    def lengths(name: str) -> list[str]:
        return [NOTHING if t is None else f"{getattr(t, name):.4f}" for t in thesis]

    def angles(name: str) -> list[str]:
        return [NOTHING if t is None else f"{np.degrees(getattr(t, name)):.4f}" for t in thesis]

    cells = {
        **{f"{name}, m": lengths(name) for name in ("Tx", "Ty", "Tz")},
        **{f"{name}, deg": angles(name) for name in ("alpha", "beta", "gamma")},
        "points": [
            f"{int(r.inliers.sum())} of {len(r.matches)}" if r is not None and len(r.matches) else NOTHING
            for r in results
        ],
        "rms residual, px": [NOTHING if r is None else _number(rms_px(r), 2) for r in results],
        "stereo depth rms, m": [NOTHING if r is None else _number(rms_depth_m(r), 4) for r in results],
        "from default, px": [NOTHING if d is None else _number(d.median_px, 2) for d in apart],
        "from default, mm": [NOTHING if d is None else _number(1000 * d.position_m, 1) for d in apart],
        "from default, deg": [NOTHING if d is None else _number(np.degrees(d.angle_rad), 3) for d in apart],
        "verdict": [verdict_of(column) for column in comparison.columns],
    }
    return Table(
        heads=tuple(title_of(column) for column in comparison.columns),
        rows=tuple((name, *row) for name, row in cells.items()),
    )


def markdown_table(table: Table) -> str:
    """Return a table as Markdown."""
    lines = [
        " | ".join(("", *table.heads)),
        "|".join(("---", *("---:" for _ in table.heads))),
        *(" | ".join(row) for row in table.rows),
    ]
    return "\n".join(f"| {line} |" if k != 1 else f"|{line}|" for k, line in enumerate(lines)) + "\n"


def _seen_points(default: Column, scan: Scan) -> FloatArray:
    """Return scan points (N, 3) coloured by the default, or any points of the scan if it has no texture."""
    seen: BoolArray = scan.valid if default.texture is None else default.texture.colored & scan.valid
    index = np.flatnonzero(seen)
    index = index[:: max(1, len(index) // _COMPARED_POINTS)]
    rows, columns = np.divmod(index, scan.shape[1])
    return np.asarray(scan.points[rows, columns], dtype=np.float64)


def _difference(result: PoseResult, reference: PoseResult, points: FloatArray) -> Difference:
    shift = np.full(0, np.nan)
    if len(points):
        here, there = (r.camera.project(r.camera_from_scanner @ points) for r in (result, reference))
        apart = np.hypot(*(here - there).T)[np.isfinite(there).all(axis=-1)]
        shift = np.where(np.isfinite(apart), apart, np.inf)
    return Difference(
        median_px=float(np.median(shift)) if len(shift) else float("nan"),
        position_m=result.camera_from_scanner.distance_to(reference.camera_from_scanner),
        angle_rad=result.camera_from_scanner.angle_to(reference.camera_from_scanner),
    )


def _root_mean(squares: FloatArray) -> float:
    known = squares[np.isfinite(squares)]
    return float(np.sqrt(known.mean())) if len(known) else float("nan")


def _number(value: float, digits: int) -> str:
    """Return a number formatted to fit a cell, however large."""
    if not np.isfinite(value):
        return NOTHING
    return f"{value:.{digits}f}" if abs(value) < 1e5 else f"{value:.1e}"
