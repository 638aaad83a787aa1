"""How measurements are drawn: their lines in space, and those in a photograph or from the scanner."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.foundations.arrays import BoolArray, FloatArray
from ladarreg_core.inspection.measuring.measurement import Measurement, foot_of_height
from ladarreg_core.results.registration import PoseResult
from ladarreg_core.surface.visibility.visible_points import Occluder

_SAMPLES = 13  # along each line: lenses bend it, and an end may be behind the camera


@dataclass(frozen=True, slots=True, eq=False)
class DrawnMeasurement:
    """A measurement in a picture; NaN where nothing is drawn."""

    ends: NDArray[np.float64]
    """(N, D) of its points: pixels (D = 2) of a photograph, or unit rays (D = 3) of the scanner frame."""
    lines: NDArray[np.float64]
    """(M, S, D) along its lines."""


def lines_of(measurement: Measurement) -> NDArray[np.float64]:
    """Return the lines (M, 2, 3) of a measurement, m, in the frame of its points; none of a point.

    A height is drawn as the outline of its plane's corners, and the line from the point down to the plane.
    """
    xyz = measurement.points.xyz
    if measurement.kind == "point":
        return np.zeros((0, 2, 3))
    if measurement.kind == "height":
        corners = xyz[1:]
        down = np.stack([xyz[0], foot_of_height(xyz)])[None]
        return np.concatenate([down, np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)])
    ahead = np.roll(xyz, -1, axis=0)
    lines = np.stack([xyz, ahead], axis=1)
    return lines if measurement.kind == "area" else lines[:-1]


def drawn_from_scanner(measurement: Measurement) -> DrawnMeasurement:
    """Return a measurement, whose points are in the scanner frame, as rays of the scanner."""
    return DrawnMeasurement(_directions(measurement.points.xyz), _directions(_along(lines_of(measurement))))


def drawn_in_photo(
    measurement: Measurement,
    registration: PoseResult,
    occluder: Occluder | None = None,
    *,
    seen: Sequence[bool] | None = None,
) -> DrawnMeasurement:
    """Return a measurement, whose points are in the scanner frame, as pixels of a registered photograph.

    A point outside of the photograph, or hidden by the surface, is not drawn; a line of two such points neither.

    Args:
        measurement: the measurement.
        registration: the result for the photograph.
        occluder: the surface as this camera sees it; None: nothing is hidden.
        seen: (N,) which points are known to be seen, as they were picked in this photograph; None: none.
    """
    xyz, lines = measurement.points.xyz, lines_of(measurement)
    ends = _pixels(registration, xyz)
    known = np.zeros(len(xyz), np.bool_) if seen is None else np.asarray(seen, np.bool_)
    ends[~(known | _unhidden(xyz, occluder))] = np.nan
    along = _pixels(registration, _along(lines))
    if len(lines):
        tips = lines.reshape(-1, 3)
        of_point = (tips[:, None] == xyz[known]).all(axis=2).any(axis=1)
        visible = np.isfinite(_pixels(registration, tips)[:, 0]) & (of_point | _unhidden(tips, occluder))
        along[~visible.reshape(-1, 2).any(axis=1)] = np.nan
        # around a panorama's seam a line leaves the picture at one border and returns at the other
        jumps = np.abs(np.diff(along[..., 0], axis=1)) > registration.camera.width / 2
        along[:, 1:][jumps] = np.nan
    return DrawnMeasurement(ends, along)


def may_be_drawn(measurement: Measurement, registration: PoseResult) -> bool:
    """Return whether any point of a measurement is inside a photograph, hidden or not."""
    tips = np.concatenate([measurement.points.xyz, lines_of(measurement).reshape(-1, 3)])
    return bool(np.isfinite(_pixels(registration, tips)[:, 0]).any())


def _unhidden(xyz: FloatArray, occluder: Occluder | None) -> BoolArray:
    return np.ones(len(xyz), np.bool_) if occluder is None else ~occluder.hides(xyz)


def _along(lines: FloatArray) -> NDArray[np.float64]:
    """Return points (M, S, 3) along lines (M, 2, 3)."""
    t = np.linspace(0.0, 1.0, _SAMPLES)[None, :, None]
    return np.asarray((1 - t) * lines[:, :1] + t * lines[:, 1:])


def _directions(xyz: FloatArray) -> NDArray[np.float64]:
    length = np.linalg.norm(xyz, axis=-1, keepdims=True)
    return np.asarray(np.divide(xyz, length, out=np.full_like(xyz, np.nan), where=length > 0))


def _pixels(registration: PoseResult, xyz: FloatArray) -> NDArray[np.float64]:
    """Return pixels (..., 2) of points (..., 3) of the scanner frame; NaN outside of the photograph."""
    uv = np.array(registration.camera.project(registration.camera_from_scanner @ xyz), np.float64)
    with np.errstate(invalid="ignore"):
        inside = np.asarray(registration.camera.contains(uv, border=-0.5))
    uv[~inside] = np.nan
    return uv
