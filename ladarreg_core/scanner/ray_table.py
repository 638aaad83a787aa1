"""Tables of one ray per cell: filling of holes, interpolation between cells, and inversion."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ladarreg_core.errors import ShapeError
from ladarreg_core.foundations.arrays import BoolArray, FloatArray
from ladarreg_core.frames import wrap_angle

_MIN_RAYS = 12
_RESIDUAL_REACH_CELLS = 8.0
_FIT_CELLS = 20_000
_TREE_NODES = 100_000
_NEWTON_STEPS = 12
_NODES_A_BIN, _MAX_BINS = 2.0, 1500
_EXTRAPOLATED_CELLS = 16.0
_SETTLED_CELLS = 1e-9
MAX_FITTED_CELLS = 1_000_000
"""Largest number of cells that holes are fitted from; of larger tables every n-th row and column is taken."""
_HOLES_AT_ONCE = 500_000


def complete_ray_table(table: FloatArray, law_rays: FloatArray | None) -> NDArray[np.float64]:
    """Return unit rays for every cell.

    Args:
        table: (H, W, 3) rays of any length; NaN or zero for none.
        law_rays: (H, W, 3) rays for the holes; None: a smooth fit of longitude and latitude over the grid, plus the
            residuals of nearby cells, decaying within about ten cells.

    Raises:
        ShapeError: if there are too few rays for the fit.
    """
    length = np.linalg.norm(table, axis=-1)
    known = np.isfinite(length) & (length > 0)
    if law_rays is None and np.count_nonzero(known) < max(1, min(_MIN_RAYS, known.size)):
        raise ShapeError(f"the ray table has {np.count_nonzero(known)} rays; it needs at least {_MIN_RAYS}")
    with np.errstate(divide="ignore", invalid="ignore"):
        rays = np.array(table / length[..., None], dtype=np.float64)
    if known.all():
        return rays
    filling = law_rays if law_rays is not None else _smooth_rays(rays, known)
    rays[~known] = filling[~known]
    return rays


def complete_unit_rays(rays: NDArray[np.float32]) -> None:
    """Fill the holes of a table of unit rays in place, as `complete_ray_table` does without a law.

    The fit of a large table is made of every n-th row and column and interpolated at the holes.

    Args:
        rays: (H, W, 3); zero for none.

    Raises:
        ShapeError: if there are too few rays for the fit.
    """
    height, width = rays.shape[:2]
    holes = np.flatnonzero((rays[..., 0] == 0) & (rays[..., 1] == 0) & (rays[..., 2] == 0))
    count = height * width - len(holes)
    if count < max(1, min(_MIN_RAYS, height * width)):
        raise ShapeError(f"the ray table has {count} rays; it needs at least {_MIN_RAYS}")
    if not len(holes):
        return
    stride = max(1, int(np.ceil(np.sqrt(height * width / MAX_FITTED_CELLS))))
    some = rays[::stride, ::stride].astype(np.float64)
    known: BoolArray = np.asarray(some.any(axis=-1))
    if np.count_nonzero(known) < _MIN_RAYS:
        stride, some = 1, rays.astype(np.float64)
        known = np.asarray(some.any(axis=-1))
    angles = np.stack(_smooth_angles(some, known, _RESIDUAL_REACH_CELLS / stride), axis=-1)
    del some, known
    flat = rays.reshape(-1, 3)
    for first in range(0, len(holes), _HOLES_AT_ONCE):
        part = holes[first : first + _HOLES_AT_ONCE]
        cells = np.stack(np.divmod(part, width), axis=-1) / stride
        at = interpolate_rays(angles, cells, beyond=1.0) if stride > 1 else angles.reshape(-1, 2)[part]
        flat[part] = _rays_of(at[..., 0], at[..., 1])


def _smooth_rays(rays: NDArray[np.float64], known: BoolArray) -> NDArray[np.float64]:
    return _rays_of(*_smooth_angles(rays, known, _RESIDUAL_REACH_CELLS))


def _rays_of(longitude: FloatArray, latitude: FloatArray) -> NDArray[np.float64]:
    level = np.cos(latitude)
    return np.stack([level * np.cos(longitude), level * np.sin(longitude), np.sin(latitude)], axis=-1)


def _smooth_angles(
    rays: NDArray[np.float64], known: BoolArray, reach: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return longitude and latitude (H, W) of a smooth fit; not wrapped."""
    return (
        _fit_angle(np.arctan2(rays[..., 1], rays[..., 0]), known, reach),
        _fit_angle(np.arcsin(np.clip(rays[..., 2], -1, 1)), known, reach),
    )


def _fit_angle(angle: NDArray[np.float64], known: BoolArray, reach: float) -> NDArray[np.float64]:
    """Fit a quadratic to an angle over the grid, with 2 pi jumps removed, and add the smoothed residuals."""
    height, width = angle.shape
    row, column = np.mgrid[:height, :width].astype(np.float64)
    steps = []
    for axis in (0, 1):
        difference = wrap_angle(np.diff(angle, axis=axis))
        both = np.take(known, range(1, known.shape[axis]), axis) & np.take(known, range(known.shape[axis] - 1), axis)
        steps.append(float(np.median(difference[both])) if both.any() else 0.0)
    trend = steps[0] * row + steps[1] * column
    rest = angle - trend
    offset = np.angle(np.exp(1j * rest[known]).mean())
    rest = wrap_angle(rest - offset)

    r, c = row / max(height - 1, 1) * 2 - 1, column / max(width - 1, 1) * 2 - 1
    sample = np.flatnonzero(known)[:: max(1, np.count_nonzero(known) // _FIT_CELLS)]
    basis, values = _quadratic(r.ravel()[sample], c.ravel()[sample]), rest.ravel()[sample]
    use = np.ones(len(sample), np.bool_)
    for _ in range(3):  # trimmed, so that a few bad points do not distort the fit
        coefficients, *_ = np.linalg.lstsq(basis[use], values[use], rcond=None)
        error = np.abs(values - basis @ coefficients)
        use = error <= 4 * np.median(error[use]) + 1e-12
    smooth = _quadratic(r, c) @ coefficients
    residual = np.where(known, rest - smooth, 0.0)
    blurred = cv2.GaussianBlur(residual, (0, 0), reach)
    share = cv2.GaussianBlur(known.astype(np.float64), (0, 0), reach)
    return np.asarray(trend + offset + smooth + blurred / (share + 1e-3))


def _quadratic(r: FloatArray, c: FloatArray) -> NDArray[np.float64]:
    return np.stack([np.ones_like(r), r, c, r * c, r * r, c * c], axis=-1)


def interpolate_rays(rays: FloatArray, cells: FloatArray, *, beyond: float = 0.5) -> NDArray[np.float64]:
    """Interpolate a ray table bilinearly.

    Args:
        rays: (H, W, 3), unit.
        cells: (..., 2), fractional (row, column).
        beyond: cells outside the outermost centres that are extrapolated.

    Returns:
        rays (..., 3), not normalised; NaN further outside.
    """
    corners, a, b, inside = _around(rays, cells[..., 0], cells[..., 1], beyond)
    p00, p01, p10, p11 = corners
    a, b = a[..., None], b[..., None]
    value = (1 - a) * ((1 - b) * p00 + b * p01) + a * ((1 - b) * p10 + b * p11)
    value[~inside] = np.nan
    return np.asarray(value)


def _around(
    rays: FloatArray, r: FloatArray, c: FloatArray, beyond: float
) -> tuple[tuple[FloatArray, FloatArray, FloatArray, FloatArray], FloatArray, FloatArray, BoolArray]:
    """Return the rays of the four cells around fractional rows and columns, in rows, how far on from the first of them
    that is, down and to the right, and what is within or near the table.
    """
    height, width = rays.shape[:2]
    with np.errstate(invalid="ignore"):
        inside = (r >= -beyond) & (r <= height - 1 + beyond) & (c >= -beyond) & (c <= width - 1 + beyond)
    r, c = np.where(inside, r, 0.0), np.where(inside, c, 0.0)
    i = np.clip(np.floor(r).astype(np.intp), 0, max(height - 2, 0))
    j = np.clip(np.floor(c).astype(np.intp), 0, max(width - 2, 0))
    flat, first = rays.reshape(-1, rays.shape[-1]), i * width + j
    right, down = min(1, width - 1), width * min(1, height - 1)
    corners = flat[first], flat[first + right], flat[first + down], flat[first + down + right]
    return corners, r - i, c - j, np.asarray(inside)


class RayTableInverse:
    """Inverse of a ray table: a ray beside from a map, or the nearest one from a tree, then Newton's method."""

    def __init__(self, rays: FloatArray) -> None:
        from scipy.spatial import cKDTree

        self._rays = rays
        stride = max(1, int(np.ceil(np.sqrt(rays.shape[0] * rays.shape[1] / _TREE_NODES))))
        rows = np.unique(np.append(np.arange(0, rays.shape[0], stride), rays.shape[0] - 1))
        columns = np.unique(np.append(np.arange(0, rays.shape[1], stride), rays.shape[1] - 1))
        self._cells = np.stack(np.meshgrid(rows, columns, indexing="ij"), axis=-1).reshape(-1, 2).astype(np.float64)
        self._tree = cKDTree(rays[np.ix_(rows, columns)].reshape(-1, 3))
        # No node is farther from a direction that has a cell; without the limit, the search for directions on the far
        # side of the sphere, from which all nodes are about equally far, takes a hundred times as long.
        widest = max(float(np.linalg.norm(np.diff(rays, axis=axis), axis=-1).max(initial=0.0)) for axis in (0, 1))
        self._reach = (_EXTRAPOLATED_CELLS + 2 * stride) * widest
        # Most directions that are asked for lie outside a narrow table, and need not be sought in the tree.
        nodes = rays[np.ix_(rows, columns)]
        self._middle = nodes.reshape(-1, 3).mean(axis=0)
        self._middle /= max(float(np.linalg.norm(self._middle)), 1e-9)
        widest_angle = np.arccos(np.clip((nodes @ self._middle).min(), -1, 1)) + 2 * self._reach
        self._least_along = float(np.cos(min(widest_angle, np.pi)))
        spacing = np.sqrt(np.prod([_median_step(nodes, axis) for axis in (0, 1)]))
        self._side = int(np.clip(np.sqrt(4 * np.pi) / max(_NODES_A_BIN * spacing, 1e-9), 1, _MAX_BINS))
        self._beside = np.full(self._side**2, -1, np.int32)
        self._beside[_bins(nodes.reshape(-1, 3), self._side)] = np.arange(len(self._cells), dtype=np.int32)

    def cell_of(self, directions: ArrayLike) -> NDArray[np.float64]:
        """Return the fractional cells (..., 2) of directions (..., 3); NaN more than 16 cells outside the table."""
        d = np.asarray(directions, dtype=np.float64)
        shape = d.shape[:-1]
        d = d.reshape(-1, 3)
        with np.errstate(divide="ignore", invalid="ignore"):
            d = d / np.sqrt(_dots(d, d))[:, None]
        result = np.full((len(d), 2), np.nan)
        with np.errstate(invalid="ignore"):
            finite = np.flatnonzero(d @ self._middle >= self._least_along)
        d = d[finite]
        beside = self._beside[_bins(d, self._side)]
        near = np.flatnonzero(beside >= 0)
        cells = np.full((len(d), 2), np.nan)
        cells[near] = self._settled(d[near], self._cells[beside[near]])
        # What lies outside when begun beside it may lie inside when begun at the nearest ray: a whole turn has a seam.
        height, width = self._rays.shape[:2]
        with np.errstate(invalid="ignore"):
            outside = np.flatnonzero(~((cells > -0.5) & (cells < np.array([height, width]) - 0.5)).all(axis=-1))
        if len(outside):
            distance, found = self._tree.query(d[outside], distance_upper_bound=self._reach)
            again, found = outside[np.isfinite(distance)], found[np.isfinite(distance)]
            cells[outside] = np.nan
            cells[again] = self._settled(d[again], self._cells[found])
        result[finite] = cells
        return result.reshape(*shape, 2)

    def _settled(self, d: FloatArray, cells: FloatArray) -> NDArray[np.float64]:
        """Return the cells (N, 2) of unit directions (N, 3), from cells beside them; NaN where none is found."""
        cells = np.array(cells)
        # Two tangent vectors of each direction: at the cell sought the table's ray has no component along them.
        helper = np.where(np.abs(d[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
        e1 = np.cross(helper, d)
        e1 /= np.sqrt(_dots(e1, e1))[:, None]
        e2 = np.cross(d, e1)
        moved = np.full(len(d), np.inf)
        active = np.arange(len(d))
        for _ in range(_NEWTON_STEPS):
            step = _newton_step(self._rays, cells[active], e1[active], e2[active])
            cells[active] -= step
            moved[active] = np.abs(step).max(axis=-1)
            active = active[moved[active] >= _SETTLED_CELLS]  # NaN, outside the table, stays so
            if not len(active):
                break
        # With jitter in the table the iteration may oscillate within a cell, which is then still the right one.
        # The opposite direction has no component along the tangents, either.
        (ray, *_), _, _, inside = _around(self._rays, cells[:, 0], cells[:, 1], _EXTRAPOLATED_CELLS)
        with np.errstate(invalid="ignore"):
            cells[~((moved < 1.0) & inside & (_dots(ray, d) > 0))] = np.nan
        return np.asarray(cells, np.float64)


def _median_step(rays: FloatArray, axis: int) -> float:
    steps = np.linalg.norm(np.diff(rays, axis=axis), axis=-1)
    return float(np.median(steps)) if steps.size else 1.0


def _bins(rays: FloatArray, side: int) -> NDArray[np.intp]:
    """Return the bin (N,) of each unit ray (N, 3) on the octahedron, unfolded to a square of so many bins a side.

    Source: octahedral maps, Praun and Hoppe 2003; bins are alike in size to a factor of about two, without poles.
    """
    x, y, z = np.asarray(rays, np.float64).T
    total = np.abs(x) + np.abs(y) + np.abs(z)
    u, v = x / total, y / total
    below = z < 0
    u, v = (
        np.where(below, np.copysign(1 - np.abs(v), u), u), np.where(below, np.copysign(1 - np.abs(u), v), v)
    )  # fmt: skip
    row, column = (np.minimum(((one + 1) * (side / 2)).astype(np.intp), side - 1) for one in (u, v))
    return np.asarray(row * side + column)


def _newton_step(rays: FloatArray, cells: FloatArray, e1: FloatArray, e2: FloatArray) -> NDArray[np.float64]:
    """Return by how much cells (N, 2) are to be reduced for their rays to have no component along two vectors."""
    corners, a, b, inside = _around(rays, cells[:, 0], cells[:, 1], _EXTRAPOLATED_CELLS)
    off, by_row, by_column = [], [], []
    for along in (e1, e2):
        p00, p01, p10, p11 = (_dots(corner, along) for corner in corners)
        left, right = p10 - p00, p11 - p01
        off.append(p00 + a * left + b * (p01 - p00) + a * b * (right - left))
        by_row.append(left + b * (right - left))
        by_column.append(p01 - p00 + a * (right - left))
    (r1, r2), (c1, c2) = by_row, by_column
    with np.errstate(divide="ignore", invalid="ignore"):
        det = r1 * c2 - c1 * r2
        step = np.stack([(c2 * off[0] - c1 * off[1]) / det, (r1 * off[1] - r2 * off[0]) / det], axis=-1)
    step[~inside] = np.nan
    return np.clip(step, -64, 64)


def _dots(a: FloatArray, b: FloatArray) -> NDArray[np.float64]:
    return np.asarray(np.einsum("ij,ij->i", a, b))
