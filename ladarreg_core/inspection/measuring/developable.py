"""Surfaces that are laid flat without stretching: planes and cylinders, given or fitted to a scan.

Both give every point three coordinates in metres: to the right and up in the flat picture, and above the surface toward
the viewer.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ladarreg_core.errors import DegenerateGeometryError
from ladarreg_core.foundations.arrays import FloatArray, read_only
from ladarreg_core.foundations.validation import require_number, require_positive
from ladarreg_core.frames import Rigid
from ladarreg_core.scan import Scan
from ladarreg_core.surface.mesh.normals import cell_normals
from ladarreg_core.surface.ranges import usual_noise_m

_MIN_POINTS = 30
_SAMPLES = 20_000  # points that a surface is fitted to
_TRIALS = 200
_INLIER_SIGMAS = 3.0
_MIN_INLIERS = 0.3
_MIN_ANGLE_SIN = 1e-3  # of three points of a plane that are nearly on a line
_UPRIGHT = 0.95  # cosine of the normal with the vertical, from which a plane counts as level
_STRAIGHT = 0.15  # share of the smallest spread of a cylinder's normals in the next one


class Developable(Protocol):
    """A surface that is laid flat."""

    @property
    def kind(self) -> str:
        """Its name in files."""

    def flattened(self, points: FloatArray) -> NDArray[np.float64]:
        """Return (..., 3): right, up and above, m, of points (..., 3), scanner frame."""

    def raised(self, flat: FloatArray) -> NDArray[np.float64]:
        """Return the points (..., 3), scanner frame, of flat coordinates (..., 3): the inverse of `flattened`."""

    def axes(self, flat: FloatArray) -> NDArray[np.float64]:
        """Return the unit vectors right and up (..., 2, 3), scanner frame, at flat coordinates (..., 3)."""

    @property
    def seam_m(self) -> float:
        """Where it goes on at the other side, half its length to the right, m; infinite if nowhere."""

    def as_fields(self) -> dict[str, Any]:
        """Return it as JSON-ready values, scanner frame."""


@dataclass(frozen=True, slots=True, eq=False)
class Plane:
    """A plane with axes.

    Raises:
        DegenerateGeometryError: if the axes are no unit vectors at a right angle.
    """

    origin: FloatArray
    """(3,) a point of it, m, where both flat coordinates are zero."""
    right: FloatArray
    """(3,) unit vector to the right in the picture."""
    up: FloatArray
    """(3,) unit vector up in the picture."""
    rms_m: float = float("nan")
    """Root mean square distance of the points that it was fitted to; NaN: it was given."""

    def __post_init__(self) -> None:
        for name in ("origin", "right", "up"):
            object.__setattr__(self, name, read_only(getattr(self, name), np.float64, (3,), f"`{name}` of the plane"))
        axes = np.stack([self.right, self.up])
        if not np.abs(axes @ axes.T - np.eye(2)).max() < 1e-6:
            raise DegenerateGeometryError("the axes of a plane must be unit vectors at a right angle to each other")

    @staticmethod
    def facing(origin: ArrayLike, normal: ArrayLike, *, rms_m: float = float("nan")) -> Plane:
        """Return the plane of a point and a normal, seen from the scanner: up is up, as far as the plane rises.

        A level plane, such as a floor, is seen from the scanner's side with X to the right.
        """
        p, n = np.asarray(origin, np.float64), np.asarray(normal, np.float64)
        n = n / np.linalg.norm(n)
        n = n if n @ p <= 0 else -n
        vertical = np.array([0.0, 0.0, 1.0])
        right = np.array([1.0, 0.0, 0.0]) - n[0] * n if abs(n[2]) > _UPRIGHT else np.cross(vertical, n)
        right = right / np.linalg.norm(right)
        return Plane(p, right, np.cross(n, right), rms_m)

    @staticmethod
    def through(points: ArrayLike) -> Plane:
        """Return the plane through three points (3, 3), scanner frame, m, its origin in the first one.

        Raises:
            DegenerateGeometryError: if they are on a line.
        """
        p = read_only(points, np.float64, (3, 3), "the points of the plane")
        a, b = p[1] - p[0], p[2] - p[0]
        normal, lengths = np.cross(a, b), np.linalg.norm(a) * np.linalg.norm(b)
        if not np.linalg.norm(normal) > _MIN_ANGLE_SIN * lengths:
            raise DegenerateGeometryError("the three points of the plane lie on a line; pick them apart")
        return Plane.facing(p[0], normal)

    @staticmethod
    def fitted(scan: Scan, at: ArrayLike, *, radius_m: float = 0.5, seed: int = 0) -> Plane:
        """Return the plane of most points of a scan around one, robustly fitted; what stands on it is left out.

        Args:
            scan: the scan.
            at: (3,) the point, scanner frame, m.
            radius_m: of the ball around it.
            seed: of the trials.

        Raises:
            DegenerateGeometryError: if there are too few points, or less than a third of them lie on one plane.
        """
        points, _ = _around(scan, at, radius_m)
        allowed = _INLIER_SIGMAS * usual_noise_m(scan)
        best = np.zeros(len(points), np.bool_)
        rng = np.random.default_rng(seed)
        for _ in range(_TRIALS):
            three = points[rng.choice(len(points), 3, replace=False)]
            normal = np.cross(three[1] - three[0], three[2] - three[0])
            length = np.linalg.norm(normal)
            if length > 0:
                near = np.abs((points - three[0]) @ normal) <= allowed * length
                best = near if near.sum() > best.sum() else best
        if best.sum() < max(3, _MIN_INLIERS * len(points)):
            raise DegenerateGeometryError(
                f"only {best.mean():.0%} of the points within {radius_m:g} m lie on one plane; pick elsewhere, or take "
                "a smaller radius"
            )
        for _ in range(3):
            middle = points[best].mean(axis=0)
            normal = np.linalg.svd(points[best] - middle, full_matrices=False)[2][2]
            off = (points - middle) @ normal
            best = np.abs(off) <= allowed
        return Plane.facing(middle, normal, rms_m=float(np.sqrt(np.mean(off[best] ** 2))))

    @staticmethod
    def level(height_m: float, *, world_from_scanner: Rigid | None = None) -> Plane:
        """Return the level plane of a plan, seen from above.

        Args:
            height_m: Z of the plane, m.
            world_from_scanner: the frame that the height is in, and whose X is to the right and Y up: flat coordinates
                are those of the world; None: the scanner's.
        """
        require_number(height_m, "the height", unit="metres")
        if world_from_scanner is None:
            return Plane(np.array([0.0, 0.0, height_m]), np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]))
        R = world_from_scanner.rotation  # rows: the axes of the world in the scanner's
        origin = world_from_scanner.inverse @ np.array([0.0, 0.0, height_m])
        return Plane(origin, R[0], R[1])

    @property
    def kind(self) -> str:
        """`plane`."""
        return "plane"

    @property
    def normal(self) -> NDArray[np.float64]:
        """(3,) toward the viewer."""
        return np.cross(self.right, self.up)

    @property
    def seam_m(self) -> float:
        """Infinite."""
        return float("inf")

    def flattened(self, points: FloatArray) -> NDArray[np.float64]:
        """As of `Developable`."""
        return np.asarray((points - self.origin) @ np.stack([self.right, self.up, self.normal], axis=1))

    def raised(self, flat: FloatArray) -> NDArray[np.float64]:
        """As of `Developable`."""
        return np.asarray(self.origin + flat @ np.stack([self.right, self.up, self.normal]))

    def axes(self, flat: FloatArray) -> NDArray[np.float64]:
        """As of `Developable`."""
        return np.broadcast_to(np.stack([self.right, self.up]), (*flat.shape[:-1], 2, 3))

    def as_fields(self) -> dict[str, Any]:
        """As of `Developable`."""
        return {
            "kind": self.kind, "origin": self.origin.tolist(), "right": self.right.tolist(), "up": self.up.tolist(),
            "normal": self.normal.tolist(), "fit_rms_m": None if np.isnan(self.rms_m) else self.rms_m,
        }  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Cylinder:
    """A pipe or column, seen from outside; its flat picture is opened at the side that is away from the scanner."""

    origin: FloatArray
    """(3,) a point of the axis, m."""
    axis: FloatArray
    """(3,) unit vector, up in the picture."""
    radius_m: float
    rms_m: float = float("nan")
    """Root mean square distance of the points that it was fitted to."""

    def __post_init__(self) -> None:
        for name in ("origin", "axis"):
            object.__setattr__(
                self, name, read_only(getattr(self, name), np.float64, (3,), f"`{name}` of the cylinder")
            )
        require_positive(self.radius_m, "the radius of the cylinder", unit="metres")

    @staticmethod
    def fitted(scan: Scan, at: ArrayLike, *, radius_m: float = 0.3) -> Cylinder:
        """Return the cylinder of the points of a scan around one, robustly fitted.

        The axis is first across all normals, then adjusted with the radius, with large residuals counted less.

        Args:
            scan: the scan.
            at: (3,) a point on it, scanner frame, m.
            radius_m: of the ball around it whose points are used.

        Raises:
            DegenerateGeometryError: if there are too few points, or they are not curved about one axis.
        """
        from scipy.optimize import least_squares

        points, normals = _around(scan, at, radius_m)
        values, vectors = np.linalg.eigh(normals.T @ normals / len(normals))
        if values[0] > _STRAIGHT * values[1] or values[1] < 1e-3:
            raise DegenerateGeometryError(
                f"the surface within {radius_m:g} m is not curved about one axis as a pipe is; pick on the pipe, or "
                "take another radius"
            )
        axis = vectors[:, 0]
        side, noise = np.linalg.svd(axis[None])[2][1:], usual_noise_m(scan)
        middle = points.mean(axis=0)
        flat, across = (points - middle) @ side.T, normals @ side.T
        rows = np.concatenate([2 * flat, np.ones((len(flat), 1))], axis=1)
        start = np.linalg.lstsq(rows, (flat**2).sum(axis=1), rcond=None)[0]
        radius = float(np.sqrt(max(start[2] + start[0] ** 2 + start[1] ** 2, 1e-6)))

        def off(x: FloatArray) -> FloatArray:
            direction = axis + x[2:4] @ side
            direction = direction / np.linalg.norm(direction)
            apart = points - (middle + x[:2] @ side)
            return np.asarray(np.linalg.norm(apart - np.outer(apart @ direction, direction), axis=1) - x[4])

        found = least_squares(off, [start[0], start[1], 0.0, 0.0, radius], loss="soft_l1", f_scale=2 * noise)
        residual = off(found.x)
        rms, size = float(np.sqrt(np.mean(np.minimum(residual**2, (6 * noise) ** 2)))), float(found.x[4])
        outward = ((flat - found.x[:2]) * across).sum(axis=1) > 0
        if not 0 < size < 20 * radius_m or rms > 4 * noise or outward.mean() < 0.8:
            raise DegenerateGeometryError(
                f"the surface within {radius_m:g} m is no pipe seen from outside: pick on the pipe, or take another "
                "radius"
            )
        direction = axis + found.x[2:4] @ side
        direction = direction / np.linalg.norm(direction)
        up = direction if direction[np.abs(direction).argmax()] > 0 else -direction
        origin = middle + found.x[:2] @ side
        origin = origin + (np.asarray(at, np.float64) - origin) @ up * up
        return Cylinder(origin, up, size, rms)

    @property
    def kind(self) -> str:
        """`cylinder`."""
        return "cylinder"

    @property
    def seam_m(self) -> float:
        """Half its circumference."""
        return float(np.pi * self.radius_m)

    @property
    def _front(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Unit vectors from the axis toward the scanner, and to the right of it as seen from there."""
        toward = -self.origin + (self.origin @ self.axis) * self.axis
        length = float(np.linalg.norm(toward))
        if length < 1e-9:  # the scanner is on the axis
            toward, length = np.linalg.svd(self.axis[None])[2][1], 1.0
        front = toward / length
        return front, np.cross(self.axis, front)

    def flattened(self, points: FloatArray) -> NDArray[np.float64]:
        """As of `Developable`."""
        front, right = self._front
        apart = points - self.origin
        x, y = apart @ front, apart @ right
        return np.stack([self.radius_m * np.arctan2(y, x), apart @ self.axis, np.hypot(x, y) - self.radius_m], axis=-1)

    def raised(self, flat: FloatArray) -> NDArray[np.float64]:
        """As of `Developable`."""
        front, right = self._front
        angle, out = flat[..., :1] / self.radius_m, self.radius_m + flat[..., 2:]
        return np.asarray(
            self.origin + out * (np.cos(angle) * front + np.sin(angle) * right) + flat[..., 1:2] * self.axis
        )

    def axes(self, flat: FloatArray) -> NDArray[np.float64]:
        """As of `Developable`."""
        front, right = self._front
        angle = flat[..., :1] / self.radius_m
        around = np.cos(angle) * right - np.sin(angle) * front
        return np.stack([around, np.broadcast_to(self.axis, around.shape)], axis=-2)

    def as_fields(self) -> dict[str, Any]:
        """As of `Developable`."""
        return {
            "kind": self.kind, "origin": self.origin.tolist(), "axis": self.axis.tolist(), "radius_m": self.radius_m,
            "fit_rms_m": None if np.isnan(self.rms_m) else self.rms_m,
        }  # fmt: skip


def _around(scan: Scan, at: ArrayLike, radius_m: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return points (N, 3) of a scan within a radius of one, and their normals (N, 3)."""
    require_positive(radius_m, "the radius", unit="metres")
    middle = read_only(at, np.float64, (3,), "the point")
    if not np.isfinite(middle).all():
        raise DegenerateGeometryError("the point that a surface is fitted around is not finite; pick another one")
    near = np.linalg.norm(scan.points - middle.astype(np.float32), axis=-1) <= radius_m
    cells = np.argwhere(near)
    if len(cells) < _MIN_POINTS:
        raise DegenerateGeometryError(
            f"there are {len(cells)} points of the scan within {radius_m:g} m; {_MIN_POINTS} are needed: take a larger "
            "radius, or pick elsewhere"
        )
    cells = cells[:: max(1, len(cells) // _SAMPLES)].astype(np.int32)
    return scan.points[cells[:, 0], cells[:, 1]].astype(np.float64), cell_normals(scan, cells).astype(np.float64)
