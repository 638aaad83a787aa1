"""The middle of a black-and-white target in a scan, from its intensities on its own plane.

Such a target is a plate with four quadrants, two bright ones opposite each other and two dark ones; a checkerboard's
inner corner is the same. The beam blurs the edges, and the ranges hardly help along the plate: what counts is where the
intensities change. They are compared with a + b s(x / w) s(y / w), where x and y are turned by an angle in the plane
and s is a step that is blurred over w; all six, with the middle, are estimated.

Source: the model of Lucchese and Mitra 2002, 'Using saddle points for subpixel feature detection', with steps in place
of a saddle, on the plane in place of the picture.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import DegenerateGeometryError
from ladarreg_core.foundations.formatting import format_length
from ladarreg_core.foundations.validation import require_positive, require_type
from ladarreg_core.registration.stations.survey_target import SurveyTarget, picked_cell
from ladarreg_core.scan import Scan

_DISC = 0.42
"""Radius of what is compared, as a share of the side: a turned plate's corner must stay outside."""
_MIN_CELLS = 40
_MIN_EXPLAINED = 0.7
"""Share of the intensities' variance that the pattern must explain; an edge alone has a third of it at most."""
_NO_CONTRAST = 1e-9
"""Variance of intensities, of all on the plate 1, below which they are one."""
_FLAT_SIGMAS = 4.0
_STARTS_DEG = np.arange(0.0, 90.0, 10.0)
_OFF = np.arange(-3, 4) * 0.1
"""Where the middle is looked for around the pick, as shares of the side."""
_ROUNDS = 4
_MIN_BLUR, _MAX_BLUR = 0.005, 0.3
"""Of the side."""
_MIN_BLUR_CELLS = 0.2
"""Of the spacing of the cells: an edge that falls between two cells says no more than that."""
_SHARP_CELLS = 0.5
"""Blur, in spacings of the cells, from which on the cells say where an edge is."""
_ADVICE = "pick the middle of the target, or correct its side"

Array = NDArray[np.float64]


def fit_flat_target(
    scan: Scan, pick: tuple[int, int], *, side_m: float, least_explained: float = _MIN_EXPLAINED
) -> SurveyTarget:
    """Fit the middle of a black-and-white target of four quadrants.

    Args:
        scan: the scan, with intensities.
        pick: row and column of a cell near the middle, within a third of the side.
        side_m: side of the pattern of four quadrants, m.
        least_explained: share of the variance of the intensities that the quadrants must explain.

    Returns:
        the middle with its covariance: along the plate from the scatter of the intensities, across it from that of the
        ranges.

    Raises:
        OptionError: if an argument is of a wrong type, or the pick is outside of the scan.
        DegenerateGeometryError: if the pick has no return, or there is no such target around it.
    """
    require_type(scan, Scan, "the scan")
    require_positive(side_m, "side_m", most=5.0)
    row, column = picked_cell(scan, pick)
    if not scan.valid[row, column]:
        raise DegenerateGeometryError(f"row {row}, column {column} has no return; pick a cell on the target")
    side = float(side_m)
    d, r, light = _cells_near(scan, row, column, side)
    origin, across, sigma, on_plate = _plate(d * r[:, None], side, row, column)
    d, light = d[on_plate], light[on_plate]
    along = _axes(across)
    distance = float(origin @ across)
    uv = (d * (distance / (d @ across))[:, None] - origin) @ along.T  # where each ray meets the plate
    scale = float(np.std(light)) or 1.0
    found, covariance, used, explained = _pattern(uv, (light - light.mean()) / scale, side, row, column)
    if explained < least_explained:
        raise DegenerateGeometryError(
            f"there is no black-and-white target of {format_length(side)} around row {row}, column {column}: four "
            f"quadrants explain {explained:.0%} of its intensities; {_ADVICE}"
        )
    center = origin + found[0] * along[0] + found[1] * along[1]
    # If the plate lies nearer or farther there, its middle moves along its ray.
    sight, places = center / (center @ across), np.column_stack([np.ones(len(uv)), uv])
    here = np.array([1.0, *found])
    height = sigma**2 * float(here @ np.linalg.solve(places.T @ places, here))
    spread = along.T @ covariance @ along + height * np.outer(sight, sight)
    return SurveyTarget(center, spread, None, sigma, used, int(len(uv) - used), side_m=side)


def _cells_near(scan: Scan, row: int, column: int, side: float) -> tuple[Array, Array, Array]:
    """Return rays (N, 3), ranges (N,) and intensities (N,) of the cells within one side of a pick."""
    ray, at = scan.rays[row, column].astype(np.float64), float(scan.ranges[row, column])
    reach = np.arcsin(min(1.0, side / max(at, side)))
    near = (scan.rays @ ray.astype(scan.rays.dtype) >= np.cos(reach)) & scan.valid
    d, r = scan.rays[near].astype(np.float64), scan.ranges[near].astype(np.float64)
    close = np.linalg.norm(d * r[:, None] - ray * at, axis=1) < side
    return d[close], r[close], scan.intensity[near].astype(np.float64)[close]


def _plate(points: Array, side: float, row: int, column: int) -> tuple[Array, Array, float, NDArray[np.bool_]]:
    """Return a point of the plate, its normal, the scatter of points (N, 3) across it, m, and which are on it."""
    kept = np.ones(len(points), bool)
    origin, normal, sigma = np.zeros(3), np.zeros(3), 0.0
    for _ in range(_ROUNDS):
        if np.count_nonzero(kept) < _MIN_CELLS:
            raise DegenerateGeometryError(
                f"{np.count_nonzero(kept)} cells around row {row}, column {column} lie on a plate of "
                f"{format_length(side)}; at least {_MIN_CELLS} are needed: scan it more finely or from nearer, or "
                f"{_ADVICE}"
            )
        origin = points[kept].mean(axis=0)
        normal = np.linalg.svd(points[kept] - origin, full_matrices=False)[2][2]
        off = (points - origin) @ normal
        sigma = max(1.4826 * float(np.median(np.abs(off[kept]))), 1e-6)
        kept = np.abs(off) < _FLAT_SIGMAS * sigma
    return origin, normal if normal @ origin > 0 else -normal, sigma, kept


def _axes(normal: Array) -> Array:
    """Return two unit vectors (2, 3) in a plane."""
    first = np.cross(normal, np.eye(3)[int(np.argmin(np.abs(normal)))])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(normal, first)])


def _pattern(uv: Array, light: Array, side: float, row: int, column: int) -> tuple[Array, Array, int, float]:
    """Return the middle (2,) in the plane, its covariance (2, 2), the cells used and the share that is explained."""
    from scipy.optimize import least_squares

    state = _start(uv, light, side)
    used = np.zeros(len(uv), bool)
    fit = None
    for _ in range(_ROUNDS):
        inside = np.hypot(*(uv - state[:2]).T) < _DISC * side
        if np.count_nonzero(inside) < _MIN_CELLS or (fit is not None and np.array_equal(inside, used)):
            break
        used = inside
        spacing = _DISC * side * np.sqrt(np.pi / np.count_nonzero(used))
        least = min(max(_MIN_BLUR * side, _MIN_BLUR_CELLS * spacing), 0.9 * _MAX_BLUR * side)
        state[5] = max(state[5], 1.01 * least)
        fit = least_squares(
            lambda x, at=uv[used], seen=light[used]: _modelled(x, at) - seen, state,
            bounds=([-np.inf] * 5 + [least], [np.inf] * 5 + [_MAX_BLUR * side]),
            x_scale=[0.1 * side, 0.1 * side, 0.1, 1.0, 1.0, 0.1 * side],
        )  # fmt: skip
        state = fit.x
    if fit is None:
        raise DegenerateGeometryError(
            f"fewer than {_MIN_CELLS} cells around row {row}, column {column} are within the target; scan it more "
            f"finely or from nearer, or {_ADVICE}"
        )
    count = int(np.count_nonzero(used))
    variance = float(np.sum(fit.fun**2)) / (count - 6)
    of_all = float(np.var(light[used]))
    explained = 1.0 - float(np.mean(fit.fun**2)) / of_all if of_all > _NO_CONTRAST else 0.0
    information = fit.jac.T @ fit.jac
    covariance = variance * np.linalg.pinv(information)[:2, :2]
    # A sharp edge lies anywhere between two cells, evenly distributed; as many of these as cross it are averaged.
    spacing = _DISC * side * np.sqrt(np.pi / count)
    unseen = spacing * max(0.0, 1.0 - state[5] / (_SHARP_CELLS * spacing))
    covariance = covariance + np.eye(2) * unseen**2 / 12 / (2 * _DISC * side / spacing)
    return np.asarray(state[:2], np.float64), np.asarray(covariance, np.float64), count, explained


def _start(uv: Array, light: Array, side: float) -> Array:
    """Return the best of many middles and angles: u, v, angle, level, contrast, blur."""
    best, state = -1.0, np.zeros(6)
    for du in _OFF * side:
        for dv in _OFF * side:
            at = uv - (du, dv)
            inside = np.hypot(*at.T) < _DISC * side
            if np.count_nonzero(inside) < _MIN_CELLS:
                continue
            seen = light[inside] - light[inside].mean()
            for angle in np.radians(_STARTS_DEG):
                x, y = _turned(at[inside], angle)
                pattern = np.sign(x) * np.sign(y)
                pattern = pattern - pattern.mean()
                norm = float(np.linalg.norm(pattern) * np.linalg.norm(seen))
                score = abs(float(pattern @ seen)) / norm if norm > 0 else 0.0
                if score > best:
                    contrast = float(pattern @ seen) / float(pattern @ pattern)
                    best, state = score, np.array([du, dv, angle, light[inside].mean(), contrast, 0.05 * side])
    return state


def _turned(at: Array, angle: float) -> tuple[Array, Array]:
    cos, sin = np.cos(angle), np.sin(angle)
    return cos * at[:, 0] + sin * at[:, 1], cos * at[:, 1] - sin * at[:, 0]


def _modelled(state: Array, uv: Array) -> Array:
    x, y = _turned(uv - state[:2], state[2])
    return np.asarray(state[3] + state[4] * np.tanh(x / state[5]) * np.tanh(y / state[5]))
