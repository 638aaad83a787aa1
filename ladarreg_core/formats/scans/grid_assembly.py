"""Puts the points of a file with row and column numbers on their grid, chunk by chunk as they are read."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.foundations.arrays import ByteArray, FloatArray, IntArray
from ladarreg_core.scanner.grid_order import order_of
from ladarreg_core.scanner.grids import TabulatedGrid

_LARGEST = float(np.finfo(np.float32).max)


class GridAssembly:
    """Rays, ranges, intensity and colour of a grid, filled in place: memory is that of the result and of one chunk.

    Args:
        shape: (H, W), cells.
        with_color: whether the points have colours.
    """

    def __init__(self, shape: tuple[int, int], *, with_color: bool) -> None:
        self.shape = shape
        self.rays = np.zeros((*shape, 3), np.float32)  # zero pages cost nothing until they are filled
        self.ranges = np.full(shape, np.nan, np.float32)
        self.intensity = np.zeros(shape, np.float32)
        self.color = np.zeros((*shape, 3), np.uint8) if with_color else None
        self._seen = np.zeros(shape, np.bool_)
        self._last = (-1, -1)

    @property
    def filled(self) -> int:
        """Number of cells that occurred."""
        return int(np.count_nonzero(self._seen))

    @property
    def has_returns(self) -> bool:
        """Whether any cell has a range."""
        return not all(np.isnan(row).all() for row in self.ranges)

    def add(
        self,
        row: IntArray,
        column: IntArray,
        points: tuple[FloatArray, FloatArray, FloatArray],
        *,
        state: IntArray | None,
        intensity: FloatArray,
        color: tuple[ByteArray, ByteArray, ByteArray] | None = None,
    ) -> None:
        """Add points; of several returns in one cell the nearest counts, and of equally near ones the last.

        Args:
            row: (N,) rows within the grid.
            column: (N,) columns within the grid.
            points: x, y and z (N,), scanner frame, m.
            state: (N,) 0 valid, 1 direction only, 2 invalid; None: all valid.
            intensity: (N,); NaN makes a point a direction only.
            color: red, green and blue (N,); None: without colours.
        """
        flat = row.astype(np.intp) * self.shape[1] + column
        x, y, z = points
        with np.errstate(over="ignore", invalid="ignore"):
            distance = np.sqrt(x * x + y * y + z * z)
            known = (distance > 0) & (distance < _LARGEST)  # false for NaN
            measured = np.isfinite(intensity)
            hit = known & measured if state is None else known & measured & (state == 0)
        self._seen.reshape(-1)[flat] = True
        in_order = self._is_in_order(row, column, flat)
        if not hit.all():
            directed = known & ~hit if state is None else known & ~hit & (state <= 1)
            self._direct(np.flatnonzero(directed), flat, points, distance)
            keep = np.flatnonzero(hit)
            flat, distance, intensity = flat[keep], distance[keep], intensity[keep]
            x, y, z = x[keep], y[keep], z[keep]
            color = None if color is None else (color[0][keep], color[1][keep], color[2][keep])
        if not in_order:
            ranges = distance.astype(np.float32)
            keep = np.argsort(-ranges, kind="stable")  # the last write wins
            keep = keep[~(self.ranges.reshape(-1)[flat[keep]] < ranges[keep])]
            flat, distance, intensity = flat[keep], distance[keep], intensity[keep]
            x, y, z = x[keep], y[keep], z[keep]
            color = None if color is None else (color[0][keep], color[1][keep], color[2][keep])
        self.rays.reshape(-1, 3)[flat] = _unit(x, y, z, distance)
        self.ranges.reshape(-1)[flat] = distance
        self.intensity.reshape(-1)[flat] = intensity
        if color is not None and self.color is not None:
            self.color.reshape(-1, 3)[flat] = np.stack(color, axis=-1)

    def cropped(self, rows: slice, columns: slice) -> GridAssembly:
        """Return the part of the grid that has points, if the file claimed a larger one."""
        part = object.__new__(GridAssembly)
        for name in ("rays", "ranges", "intensity", "color", "_seen"):
            values = getattr(self, name)
            setattr(part, name, None if values is None else np.ascontiguousarray(values[rows, columns]))
        part.shape, part._last = part.ranges.shape, self._last
        return part

    def finish(self) -> tuple[TabulatedGrid, NDArray[np.float32], NDArray[np.float32], ByteArray | None]:
        """Return geometry, ranges, intensity and colour, upright and from the left, read-only; ends the assembly.

        Raises:
            ShapeError: if there are too few rays for a grid, or most neighbours have the same ray.
        """
        rays, ranges, intensity, color = self.rays, self.ranges, self.intensity, self.color
        del self.rays, self.ranges, self.intensity, self.color, self._seen
        turn = order_of(rays)
        rays = turn.apply_in_place(rays)
        ranges, intensity = turn.apply_in_place(ranges), turn.apply_in_place(intensity)
        color = None if color is None else turn.apply_in_place(color)
        for array in (ranges, intensity, *(() if color is None else (color,))):
            array.flags.writeable = False
        return TabulatedGrid.taking_over(rays), ranges, intensity, color

    def _is_in_order(self, row: IntArray, column: IntArray, flat: IntArray) -> bool:
        """Return whether these points follow the former ones row by row, or column by column: no cell occurs twice."""
        before = self._last
        self._last = (int(flat[-1]), int(column[-1]) * self.shape[0] + int(row[-1]))
        if flat[0] > before[0] and (flat[1:] > flat[:-1]).all():
            return True
        other = column.astype(np.intp) * self.shape[0] + row
        return bool(other[0] > before[1] and (other[1:] > other[:-1]).all())

    def _direct(
        self, chosen: IntArray, flat: IntArray, points: tuple[FloatArray, FloatArray, FloatArray], distance: FloatArray
    ) -> None:
        """Set the rays of cells without a return."""
        chosen = chosen[np.isnan(self.ranges.reshape(-1)[flat[chosen]])]
        if len(chosen):
            x, y, z = (axis[chosen] for axis in points)
            self.rays.reshape(-1, 3)[flat[chosen]] = _unit(x, y, z, distance[chosen])


def _unit(x: FloatArray, y: FloatArray, z: FloatArray, distance: FloatArray) -> NDArray[np.float32]:
    rays = np.empty((len(x), 3), np.float32)
    for k, axis in enumerate((x, y, z)):
        np.divide(axis, distance, out=rays[:, k], casting="same_kind")
    return rays
