"""The colours of an E57's point records: their fields, and the values that photographs give them.

Colours that a file has keep their fields, so that points which no photograph shows keep theirs bit by bit. Where a file
has none, three fields of 8 bits are added with `isColorInvalid`: 1 where no photograph shows the point, whose colour is
then the gray of its laser intensity (dimmed, as in clouds and models), for the many programs that ignore that field.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.export.e57.tree import RECORDS_AT_ONCE, Buffers, library
from ladarreg_core.export.registered_scan import RegisteredScan
from ladarreg_core.formats.e57.header import E57ScanInfo
from ladarreg_core.formats.e57.records import E57Field, read_records
from ladarreg_core.formats.e57.tree import E57File, E57Node
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.frames import Rigid
from ladarreg_core.scan import Scan
from ladarreg_core.surface.texture.best_photo import NO_PHOTO
from ladarreg_core.surface.texture.registered_texture import dimmed_levels

COLORS = ("colorRed", "colorGreen", "colorBlue")
INVALID = "isColorInvalid"
_INDICES = ("rowIndex", "columnIndex")
_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
_LEVELS = 255
_WIDEST = 2**32
_SAME_RANGE = 1e-6
_SAME_PLACE = 1e-4
_MIN_SAME = 0.9
_DARKEST, _BRIGHTEST = 0.15 * 0.45, 0.45  # of white: darker than any photograph of the same place


@dataclass(frozen=True, slots=True)
class Channel:
    """How one colour of a file is stored."""

    low: float
    """Value of black."""
    high: float
    """Value of the brightest."""
    is_whole: bool
    """Whether the stored values are whole numbers."""
    scale: float = 1.0
    """Value of a whole number: `scale * n + offset`."""
    offset: float = 0.0
    """See `scale`."""

    def stored(self, levels: NDArray[np.uint8]) -> NDArray[Any]:
        """Return levels of 0 to 255 as they are stored."""
        values = self.low + levels * ((self.high - self.low) / _LEVELS)
        return np.rint((values - self.offset) / self.scale) if self.is_whole else values


PLAIN = Channel(0, _LEVELS, True)
"""Whole numbers from 0 to 255."""


def add_color_fields(prototype: Any, file: Any) -> None:
    """Add the fields of colours to a prototype that has none."""
    e57 = library()
    for name in COLORS:
        prototype.set(name, e57.IntegerNode(file, 0, 0, _LEVELS))
    if not prototype.isDefined(INVALID):
        prototype.set(INVALID, e57.IntegerNode(file, 0, 0, 1))


def color_limits(file: Any, channels: tuple[Channel, ...] = (PLAIN,) * 3) -> Any:
    """Return the structure that states the values of black and of the brightest colour."""
    e57 = library()
    made = e57.StructureNode(file)
    plain = all(one.is_whole and (one.scale, one.offset) == (1, 0) for one in channels)
    for name, one in zip(COLORS, channels, strict=True):
        for end, value in (("Minimum", one.low), ("Maximum", one.high)):
            made.set(f"{name}{end}", e57.IntegerNode(file, int(value)) if plain else e57.FloatNode(file, value))
    return made


def _channels_of(scan: E57Node, fields: Mapping[str, E57Field]) -> tuple[Channel, ...] | None:
    """Return how a scan's colours are stored; None if it has none, or only constants."""
    if not all(name in fields and fields[name].stored for name in COLORS):
        return None
    found = []
    for name in COLORS:
        field = fields[name]
        low, high = 0.0, float(_LEVELS)
        is_whole = field.stored in ("integer", "scaled")
        if is_whole and field.maximum - field.minimum < _WIDEST:
            low, high = (value * field.scale + field.offset for value in (field.minimum, field.maximum))
        stated = _stated_limits(scan, name)
        if stated is not None and (not is_whole or _holds(field, stated)):
            low, high = stated
        if is_whole and (field.bits == 0 or not _holds(field, (low, high))):
            return None
        found.append(Channel(low, high, is_whole, field.scale, field.offset))
    return tuple(found)


def _holds(field: E57Field, limits: tuple[float, float]) -> bool:
    if field.scale == 0:
        return False
    stored = [(value - field.offset) / field.scale for value in limits]
    return all(math.isfinite(value) and field.minimum <= round(value) <= field.maximum for value in stored)


def _stated_limits(scan: E57Node, name: str) -> tuple[float, float] | None:
    nodes = [scan.child("colorLimits", f"{name}{end}") for end in ("Minimum", "Maximum")]
    kinds = ("Integer", "ScaledInteger", "Float")
    values = [node.number() for node in nodes if node is not None and node.kind in kinds]
    return (values[0], values[1]) if len(values) == 2 and np.isfinite(values).all() and values[0] < values[1] else None


class PointPainter:
    """Colours the points of a file, chunk by chunk in the file's order.

    Args:
        handed: the scan that was read from the file, and its photographs.
        info: the scan's header.
        file: the file.
        scan: the scan in the file.
        report: called at least every second; may raise `Cancelled`.
    """

    def __init__(
        self, handed: RegisteredScan, info: E57ScanInfo, file: E57File, scan: E57Node, report: Callable[[int], None]
    ) -> None:
        self._handed, self._scan = handed, handed.scan
        fields = {field.name: field for field in info.fields}
        self.channels = _channels_of(scan, fields)
        """How the scan's colours are stored; None: it has none."""
        self._channels, self._keeps = self.channels or (PLAIN,) * 3, self.channels is not None
        self._scales = {name: (field.scale, field.offset) for name, field in fields.items() if field.stored == "scaled"}
        self._has = set(fields)
        self._scanner_from_file = _scanner_from_file(self._scan, info)
        self._cells = _FileCells(self._scan, info, file, scan, report)
        self._others = handed.point_colorer()
        self._gray = Gray(self._scan)

    def __call__(self, count: int, values: Buffers) -> None:
        """Set the colours of the first points of a chunk."""
        points, known = self._points(count, values)
        color = np.zeros((count, 3), np.uint8)
        shown = np.zeros(count, np.bool_)
        row, column, on_cell = self._cells.find(count, values, points, known)
        cells = self._handed.colors
        if row is not None and column is not None:
            shown = on_cell & (cells.photo[row, column] != NO_PHOTO)
            color[shown] = cells.image[row[shown], column[shown]]
        others = np.flatnonzero(known & ~on_cell)
        if len(others):
            found = self._others.colors_of(points[others])
            seen = found.photo != NO_PHOTO
            color[others[seen]] = found.color[seen]
            shown[others[seen]] = True
        if not self._keeps:
            self._paint_gray(count, values, color, known & ~shown)
        for k, (name, channel) in enumerate(zip(COLORS, self._channels, strict=True)):
            stored = channel.stored(color[:, k])
            target = values[name][:count]
            with np.errstate(over="ignore", invalid="ignore"):
                if self._keeps:
                    target[shown] = stored[shown]
                else:
                    target[:] = stored
        if INVALID in values:
            flag = values[INVALID][:count]
            if INVALID in self._has:
                flag[shown] = 0
            else:
                flag[:] = ~shown

    def _paint_gray(self, count: int, values: Buffers, color: NDArray[np.uint8], dark: NDArray[np.bool_]) -> None:
        if "intensity" in values:
            gray = self._gray.levels(self._number("intensity", count, values)[dark])
            color[dark] = gray[:, None]

    def _number(self, name: str, count: int, values: Buffers) -> NDArray[Any]:
        scale, offset = self._scales.get(name, (1.0, 0.0))
        raw = values[name][:count]
        return raw if (scale, offset) == (1.0, 0.0) else raw * scale + offset

    def _points(self, count: int, values: Buffers) -> tuple[FloatArray, NDArray[np.bool_]]:
        """Return the points (n, 3) in the scanner's frame, and which of them were measured."""
        cartesian = all(name in values for name in _CARTESIAN)
        a, b, c = (self._number(name, count, values) for name in (_CARTESIAN if cartesian else _SPHERICAL))
        points: FloatArray = np.empty((count, 3), np.float64)
        with np.errstate(invalid="ignore", over="ignore"):
            if cartesian:
                points[:, 0], points[:, 1], points[:, 2] = a, b, c
            else:
                level = a * np.cos(c)
                points[:, 0], points[:, 1], points[:, 2] = level * np.cos(b), level * np.sin(b), a * np.sin(c)
            known = np.isfinite(points).all(axis=1) & (points != 0).any(axis=1)
            state = "cartesianInvalidState" if cartesian else "sphericalInvalidState"
            if state in values:
                known &= values[state][:count] == 0
            if self._scanner_from_file is not None:
                points = self._scanner_from_file @ points
        return points, known


class Gray:
    """The laser intensity as gray levels, dimmed so that nobody takes it for a photograph."""

    def __init__(self, scan: Scan) -> None:
        self._low, self._high = dimmed_levels(scan)

    def levels(self, intensity: NDArray[Any]) -> NDArray[np.uint8]:
        """Return gray levels; black where the intensity is not a number."""
        share = np.clip((np.nan_to_num(intensity, nan=-np.inf) - self._low) / max(self._high - self._low, 1e-12), 0, 1)
        bright = _DARKEST + share * (_BRIGHTEST - _DARKEST)
        return np.asarray(np.rint(_LEVELS * np.where(np.isnan(intensity), 0, bright)), dtype=np.uint8)


def _scanner_from_file(scan: Scan, info: E57ScanInfo) -> Rigid | None:
    """Return what moves points of the file to the scanner; None where they are the same.

    The scanner of a cloud without a grid may stand elsewhere than at the zero point of its coordinates.
    """
    world_from_file = info.world_from_scanner or Rigid.identity()
    world_from_scanner = scan.world_from_scanner or Rigid.identity()
    moved = world_from_file.rotation.T @ (world_from_scanner.translation - world_from_file.translation)
    return None if np.abs(moved).max() < _SAME_RANGE else Rigid(np.eye(3), -moved)


class _FileCells:
    """Finds the cells of points by the row and column that the file states.

    The scan has row 0 on top and column 0 on the left, whatever the file's order, which is found from the first points.
    Every point is compared with the range of its cell, so that points whose cell kept another one are not confused.
    """

    def __init__(
        self, scan: Scan, info: E57ScanInfo, file: E57File, source: E57Node, report: Callable[[int], None]
    ) -> None:
        self._scan = scan
        self._order: tuple[bool, bool, bool] | None = None
        self._is_usable = set(_INDICES) <= info.field_names
        self._shape, self._first = info.grid, info.first_cell
        if self._is_usable and info.grid not in (scan.shape, scan.shape[::-1]):
            # The reader leaves out empty rows and columns at the borders, and does not rely on bounds that are wrong.
            self._shape, self._first = _index_bounds(file, source, info, report)
            self._is_usable = self._shape in (scan.shape, scan.shape[::-1])

    def find(
        self, count: int, values: Buffers, points: FloatArray, known: NDArray[np.bool_]
    ) -> tuple[NDArray[np.intp] | None, NDArray[np.intp] | None, NDArray[np.bool_]]:
        """Return rows and columns (n,) of the scan, and for which points they are right; None where there are none."""
        none = np.zeros(count, np.bool_)
        if not self._is_usable:
            return None, None, none
        if self._order is None and not self._find_order(count, values, points, known):
            return None, None, none
        assert self._order is not None, "it has been found"
        row, column, inside = self._cells(count, values, self._order)
        with np.errstate(invalid="ignore", over="ignore"):
            length = np.sqrt(np.einsum("ij,ij->i", points, points))
            near = np.abs(self._scan.ranges[row, column] - length) <= _SAME_RANGE * length
        return row, column, inside & near & known

    def _find_order(self, count: int, values: Buffers, points: FloatArray, known: NDArray[np.bool_]) -> bool:
        with np.errstate(invalid="ignore", over="ignore"):
            length = np.linalg.norm(points, axis=1)
        if not known.any():
            return False
        for code in range(8):
            order = bool(code & 4), bool(code & 2), bool(code & 1)
            if (self._shape != self._scan.shape) != order[0] and self._scan.shape[0] != self._scan.shape[1]:
                continue
            row, column, inside = self._cells(count, values, order)
            cells = np.stack([row, column], axis=-1)
            here = self._scan.geometry.ray_at(cells) * self._scan.ranges[row, column, None]
            with np.errstate(invalid="ignore", over="ignore"):
                same = inside & (np.linalg.norm(here - points, axis=1) <= _SAME_PLACE * length)
            if np.count_nonzero(same & known) >= _MIN_SAME * np.count_nonzero(known):
                self._order = order
                return True
        self._is_usable = False
        return False

    def _cells(
        self, count: int, values: Buffers, order: tuple[bool, bool, bool]
    ) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.bool_]]:
        transpose, flip_rows, flip_columns = order
        row = values["rowIndex"][:count] - self._first[0]
        column = values["columnIndex"][:count] - self._first[1]
        if transpose:
            row, column = column, row
        height, width = self._scan.shape
        inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
        row, column = np.where(inside, row, 0), np.where(inside, column, 0)
        row = height - 1 - row if flip_rows else row
        column = width - 1 - column if flip_columns else column
        return row, column, inside


def _index_bounds(
    file: E57File, source: E57Node, info: E57ScanInfo, report: Callable[[int], None]
) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the numbers of rows and columns that points have, and the first ones."""
    buffers = {name: np.zeros(max(1, min(RECORDS_AT_ONCE, info.points)), "q") for name in _INDICES}
    low, high = [2**62, 2**62], [-(2**62), -(2**62)]
    points = source.child("points")
    assert points is not None, "the table of contents has it"
    for count in read_records(file.pages, points, buffers, f"scan {info.name!r}", scaled=False):
        report(0)
        for k, values in enumerate(buffers.values()):
            low[k], high[k] = min(low[k], int(values[:count].min())), max(high[k], int(values[:count].max()))
    return (high[0] - low[0] + 1, high[1] - low[1] + 1), (low[0], low[1])
