"""Lengths, angles, areas and heights between measured points, each with its standard deviation.

A measurement is a function f of all coordinates together. To first order its variance is g S g^T, with the gradient g
of f and the joint covariance S of the points, so that what all points have wrong in common cancels as far as f allows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ladarreg_core.errors import DegenerateGeometryError
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.foundations.validation import require_choice, require_type
from ladarreg_core.inspection.measuring.points import MeasuredPoints

MeasurementKind = Literal["point", "distance", "polyline", "angle", "area", "height"]
KINDS: tuple[MeasurementKind, ...] = get_args(MeasurementKind)
COVERAGE = 0.95
"""Probability that an interval contains the true value."""
_QUANTILE = 1.959964
_STEP = 1e-6  # of the extent, for derivatives
_FEW_SIGMAS = 3.0
_MIN_NORMAL = 1e-6  # of the extent squared: corners of a plane that are nearly on a line


@dataclass(frozen=True, slots=True)
class _Kind:
    """What a measurement needs and how it is computed."""

    least: int
    most: int | None
    needs: str
    unit: str
    value: Callable[[FloatArray], FloatArray]
    """Of coordinates (B, N, 3): (B,), or (B, 3) of a point."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Measurement:
    """A measured quantity."""

    kind: MeasurementKind
    value: float | NDArray[np.float64]
    """In `unit`; of a point its coordinates (3,)."""
    unit: str
    """`m`, `m2` or `deg`."""
    sigma: float | NDArray[np.float64]
    """Standard deviation; of a point (3,). NaN if a point rests on a pose that was given."""
    interval: tuple[float, float] | NDArray[np.float64]
    """Lower and upper bound of the value with a probability of 95 %; of a point (2, 3)."""
    points: MeasuredPoints
    """What it was measured between."""
    flags: tuple[str, ...]
    """Sentences on what is doubtful; empty: nothing."""

    def __repr__(self) -> str:
        flagged = f", {len(self.flags)} flag{'s' * (len(self.flags) > 1)}" if self.flags else ""
        return f"Measurement({self.kind}: {self.described}{flagged})"

    @property
    def described(self) -> str:
        """The value with its standard deviation, rounded by it, such as '1.2340 +- 0.0031 m'."""
        pairs = zip(np.atleast_1d(self.value), np.atleast_1d(self.sigma), strict=True)
        words = ", ".join(_rounded(float(value), float(sigma)) for value, sigma in pairs)
        return f"{words} {self.unit}"

    @property
    def described_interval(self) -> str:
        """The interval with the value's digits, such as '1.2279 to 1.2401 m'; empty where it is not known."""
        sigma = np.atleast_1d(self.sigma)
        if not np.isfinite(sigma).all():
            return ""
        low, high = np.asarray(self.interval, np.float64).reshape(2, -1)
        pairs = (
            f"{a:.{digits}f} to {b:.{digits}f}"
            for a, b, digits in zip(low, high, map(_decimals, sigma.tolist()), strict=True)
        )
        return f"{', '.join(pairs)} {self.unit}"

    def as_fields(self) -> dict[str, Any]:
        """Return the measurement as JSON-ready values."""
        return {
            "kind": self.kind, "value": _plain(self.value), "unit": self.unit, "sigma": _plain(self.sigma),
            "interval_95": _plain(self.interval), "points": self.points.xyz.tolist(),
            "names": list(self.points.names), "flags": list(self.flags),
        }  # fmt: skip


def measure(kind: MeasurementKind, points: MeasuredPoints, *, viewpoint: ArrayLike = (0.0, 0.0, 0.0)) -> Measurement:
    """Measure between points.

    Args:
        kind: `point`: the coordinates of one point; `distance` of two; `polyline`: length along two or more; `angle` at
            the second of three, 0 to 180 deg; `area` of a polygon of three or more corners, in its plane; `height` of
            the first point above the plane of three or more others, positive above it, or on the scanner's side of a
            vertical one.
        points: the points, in order.
        viewpoint: (3,) where the scanner stood, m, in the frame of the points.

    Returns:
        The value with its standard deviation and 95 % interval.

    Raises:
        DegenerateGeometryError: if a point was refused, there are too few or too many, two that need to differ are the
            same, corners of a plane are on a line, or sides of a polygon cross each other.
        OptionError: if the kind is unknown.

    Source: propagation of covariance to first order; the vector area of a polygon.
    """
    require_choice(kind, KINDS, "the kind of measurement")
    require_type(points, MeasuredPoints, "'points'")
    rule, count = _RULES[kind], len(points)
    if count < rule.least or (rule.most is not None and count > rule.most):
        raise DegenerateGeometryError(f"{count} points are given for {rule.needs}")
    refused = [f"{name} {why}" for name, why in zip(points.names, points.refusals, strict=True) if why]
    if refused:
        more = f"; and {len(refused) - 2} more points" if len(refused) > 2 else ""
        raise DegenerateGeometryError("; ".join(refused[:2]) + more)
    middle = points.xyz.mean(axis=0) if kind not in ("point", "height") else np.zeros(3)
    p = points.xyz - middle  # coordinates of a survey have too few digits for small steps
    if kind == "height":
        p, up = p - points.xyz.mean(axis=0), _upward(points.xyz, np.asarray(viewpoint, np.float64))
        value_of: Callable[[FloatArray], FloatArray] = lambda q: _height(q, up)  # noqa: E731
    else:
        value_of = rule.value
    _require_determined(kind, p)
    gradient = _gradient(value_of, p)
    covariance = gradient @ points.covariance @ gradient.T
    found = np.atleast_1d(value_of(p[None])[0])
    sigma = (
        np.sqrt(np.maximum(np.diag(covariance), 0)) if np.isfinite(covariance).all() else np.full(len(found), np.nan)
    )
    low, high = found - _QUANTILE * sigma, found + _QUANTILE * sigma
    flags = [f"{name} {flag}" for name, one in zip(points.names, points.flags, strict=True) for flag in one]
    flags += _own_flags(kind, p, float(found[0]), float(sigma[0]), points)
    if kind == "point":
        return Measurement(
            kind=kind, value=found, unit=rule.unit, sigma=sigma, interval=np.stack([low, high]), points=points,
            flags=tuple(dict.fromkeys(flags)),
        )  # fmt: skip
    least, most = (0.0, 180.0 if kind == "angle" else np.inf) if kind != "height" else (-np.inf, np.inf)
    return Measurement(
        kind=kind, value=float(found[0]), unit=rule.unit, sigma=float(sigma[0]),
        interval=(max(float(low[0]), least), min(float(high[0]), float(most))), points=points,
        flags=tuple(dict.fromkeys(flags)),
    )  # fmt: skip


def _gradient(value_of: Callable[[FloatArray], FloatArray], p: FloatArray) -> NDArray[np.float64]:
    """Return the derivative (K, 3 N) of a quantity by all coordinates (N, 3)."""
    size = p.size
    step = _STEP * max(float(np.ptp(p, axis=0).max()), 1e-3)
    moves = step * np.eye(size).reshape(size, *p.shape)
    ahead, behind = value_of(p + moves), value_of(p - moves)
    return np.asarray((ahead - behind).reshape(size, -1).T / (2 * step))


def _length(p: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.norm(np.diff(p, axis=1), axis=2).sum(axis=1))


def _angle(p: FloatArray) -> FloatArray:
    a, b = p[:, 0] - p[:, 1], p[:, 2] - p[:, 1]
    across = np.linalg.norm(np.cross(a, b), axis=1)
    return np.asarray(np.degrees(np.arctan2(across, (a * b).sum(axis=1))))


def _vector_area(p: FloatArray) -> FloatArray:
    from_first = p[:, 1:] - p[:, :1]
    return np.asarray(0.5 * np.cross(from_first[:, :-1], from_first[:, 1:]).sum(axis=1))


def _area(p: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.norm(_vector_area(p), axis=1))


def _plane_normals(corners: FloatArray) -> FloatArray:
    """Return the unit normals (B, 3) of the best planes through corners (B, K, 3)."""
    apart = corners - corners.mean(axis=1, keepdims=True)
    return np.asarray(np.linalg.eigh(np.einsum("bki,bkj->bij", apart, apart))[1][:, :, 0])


def _upward(p: FloatArray, viewpoint: FloatArray) -> NDArray[np.float64]:
    """Return the direction (3,) that the normal of the plane of points (N, 3), but the first, is turned to."""
    normal = _plane_normals(p[None, 1:])[0]
    up = np.array([0.0, 0.0, 1.0]) if abs(normal[2]) > 0.1 else viewpoint - p[1:].mean(axis=0)
    return np.asarray(normal if normal @ up >= 0 else -normal)


def _height(p: FloatArray, up: FloatArray) -> FloatArray:
    normal = _plane_normals(p[:, 1:])
    normal = normal * np.where(normal @ up >= 0, 1.0, -1.0)[:, None]
    return np.asarray(((p[:, 0] - p[:, 1:].mean(axis=1)) * normal).sum(axis=1))


def foot_of_height(xyz: FloatArray) -> NDArray[np.float64]:
    """Return the point (3,) of the plane of points (N, 3), but the first, that is nearest to the first."""
    normal = _plane_normals(xyz[None, 1:])[0]
    return np.asarray(xyz[0] - ((xyz[0] - xyz[1:].mean(axis=0)) @ normal) * normal)


_RULES: dict[MeasurementKind, _Kind] = {
    "point": _Kind(1, 1, "the coordinates of a point; give one", "m", lambda p: p[:, 0]),
    "distance": _Kind(2, 2, "a distance; give two", "m", _length),
    "polyline": _Kind(2, None, "a polyline; give two or more", "m", _length),
    "angle": _Kind(3, 3, "an angle; give three, its vertex second", "deg", _angle),
    "area": _Kind(3, None, "an area; give its corners in order, three or more", "m2", _area),
    "height": _Kind(4, None, "a height; give the point, then three or more of the plane", "m", _area),
}


def _require_determined(kind: MeasurementKind, p: FloatArray) -> None:
    """Raise DegenerateGeometryError unless the points (N, 3) determine the quantity and its derivative."""
    if kind == "point":
        return
    sides = np.diff(p[[*range(len(p)), 0]] if kind == "area" else p, axis=0)
    if kind != "height" and (np.linalg.norm(sides, axis=1) == 0).any():
        raise DegenerateGeometryError(f"two neighbouring points of the {kind} are the same; pick different ones")
    if kind in ("area", "height"):
        corners = p[1:] if kind == "height" else p
        spread = np.linalg.svd(corners - corners.mean(axis=0), compute_uv=False)
        if spread[1] <= _MIN_NORMAL**0.5 * spread[0]:
            raise DegenerateGeometryError(
                f"the corners of the {'plane' if kind == 'height' else 'area'} lie on one line; pick them apart"
            )
    if kind == "area" and _crosses_itself(p):
        raise DegenerateGeometryError("sides of the area cross each other; give its corners in order around it")


def _crosses_itself(p: FloatArray) -> bool:
    """Return whether two sides of a polygon (N, 3) that are not neighbours cross, in its plane."""
    axes = np.linalg.svd(p - p.mean(axis=0), full_matrices=False)[2][:2]
    flat = (p - p.mean(axis=0)) @ axes.T
    count = len(flat)

    def side(a: FloatArray, b: FloatArray, c: FloatArray) -> float:
        return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))

    for i in range(count):
        a, b = flat[i], flat[(i + 1) % count]
        for j in range(i + 2, count):
            if (j + 1) % count == i:
                continue
            c, d = flat[j], flat[(j + 1) % count]
            if side(a, b, c) * side(a, b, d) < 0 and side(c, d, a) * side(c, d, b) < 0:
                return True
    return False


def _own_flags(kind: MeasurementKind, p: FloatArray, value: float, sigma: float, points: MeasuredPoints) -> list[str]:
    """Return sentences on the measurement itself, of points p (N, 3)."""
    if not np.isfinite(sigma):
        return ["its standard deviation is not known, since a point rests on a pose that was given"]
    flags = []
    near_zero = kind in ("distance", "polyline", "area") and value < _FEW_SIGMAS * sigma
    if near_zero or (kind == "angle" and min(value, 180 - value) < _FEW_SIGMAS * sigma):
        flags.append(f"the {kind} is within three standard deviations of its limit: its interval is a rough one")
    corners = {"area": slice(0, None), "height": slice(1, None)}.get(kind)
    if corners is not None and len(p[corners]) > 3:
        chosen = p[corners]
        normal = _plane_normals(chosen[None])[0]
        off = np.abs((chosen - chosen.mean(axis=0)) @ normal)
        joint = points.covariance
        first = 3 * (corners.start or 0)
        blocks = [joint[k : k + 3, k : k + 3] for k in range(first, first + 3 * len(chosen), 3)]
        allowed = np.array([np.sqrt(max(float(normal @ block @ normal), 0.0)) for block in blocks])
        if (off > _FEW_SIGMAS * allowed + 1e-9).any():
            flags.append(f"its corners lie up to {1000 * off.max():.0f} mm off their plane")
    return flags


def _rounded(value: float, sigma: float) -> str:
    if not np.isfinite(sigma):
        return f"{value:.4f}"
    return f"{value:.{_decimals(sigma)}f} +- {sigma:.{_decimals(sigma)}f}"


def _decimals(sigma: float) -> int:
    """Return the decimals that show two digits of a standard deviation."""
    return min(max(1 - int(np.floor(np.log10(sigma))), 0), 9) if sigma > 0 else 6


def _plain(value: Any) -> Any:
    """Return numbers as JSON-ready values, None for those that are not finite."""
    if isinstance(value, (list, tuple, np.ndarray)):
        return [_plain(one) for one in value]
    return float(value) if np.isfinite(value) else None
