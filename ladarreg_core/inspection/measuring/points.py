"""Points to be measured, with what they have wrong in common.

All points of a photograph are moved by the same error of its pose, so that a distance between two of them is known
better than either point. Each set of points therefore keeps its errors one by one, as derivatives by independent errors
of one sigma: those that all points of a photograph share, and those of each point alone.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ladarreg_core.camera.uncertainty import CameraUncertainty
from ladarreg_core.errors import OptionError, ShapeError
from ladarreg_core.foundations.arrays import BoolArray, FloatArray, read_only
from ladarreg_core.foundations.validation import require_number, require_type
from ladarreg_core.frames import Rigid
from ladarreg_core.results.registration import PoseResult
from ladarreg_core.scan import Scan
from ladarreg_core.surface.mesh.normals import cell_normals
from ladarreg_core.surface.ranges import measured_ranges, range_noise_m
from ladarreg_core.surface.texture.photo_points import photo_point_errors
from ladarreg_core.surface.uncertainty import away_from_zero

PICKED_PX = 0.5
"""Standard deviation of a picked pixel or cell along each axis, if none is stated."""
_EDGE_CELLS = 1.5  # around a picked cell, where another surface makes it uncertain what was picked
_GRAZING_COSINE = float(np.cos(np.radians(80)))
AT_EDGE = "lies at a depth edge, where another surface is within its uncertainty: pick farther inside the surface"
"""What is said of a point whose pixel or cell may belong to another surface."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class MeasuredPoints:
    """N points with their errors.

    Raises:
        ShapeError: if the arrays do not match.
    """

    xyz: FloatArray
    """(N, 3) float64, m."""
    own: FloatArray
    """(N, Q, 3) m: moved by each of Q independent errors of one sigma that no other point has."""
    shared: Mapping[str, FloatArray] = field(default_factory=dict)
    """(N, P, 3) m by each of P independent errors of one sigma that all points have in common, by their cause."""
    names: tuple[str, ...]
    """What each point is, for messages and files."""
    flags: tuple[tuple[str, ...], ...]
    """What is doubtful, of each point."""
    refusals: tuple[str, ...] = ()
    """Why there is no such point, of each; empty where there is one. Coordinates without a point are NaN."""

    def __post_init__(self) -> None:
        count = len(self.names)
        object.__setattr__(self, "refusals", tuple(self.refusals) or ("",) * count)
        if not len(self.flags) == len(self.refusals) == count:
            raise ShapeError(f"there are {count} names and flags of {len(self.flags)} points; give as many")
        object.__setattr__(self, "xyz", read_only(self.xyz, np.float64, (count, 3), "the points"))
        object.__setattr__(self, "own", read_only(self.own, np.float64, (count, None, 3), "the points' own errors"))
        common = {
            name: read_only(part, np.float64, (count, None, 3), "the points' shared errors")
            for name, part in self.shared.items()
        }
        object.__setattr__(self, "shared", common)

    def __len__(self) -> int:
        return len(self.names)

    @staticmethod
    def of_scan(
        scan: Scan,
        *,
        cells: ArrayLike | None = None,
        rays: ArrayLike | None = None,
        sigma_cells: float = PICKED_PX,
        sigma_rad: float = 0.0,
        sigma_range_m: float | None = None,
    ) -> MeasuredPoints:
        """Return points picked in a scan.

        Args:
            scan: the scan.
            cells: (N, 2) row and column, also between the centres of cells; or
            rays: (N, 3) directions of any length, scanner frame.
            sigma_cells: standard deviation of the place that was picked, along each axis, cells.
            sigma_rad: the same as an angle, where that is more: of what was picked in a picture of fewer pixels.
            sigma_range_m: noise of a range, m; None: that of the scan, by the light that returned.

        Returns:
            The points; those at a depth edge, outside the scan and without a return are refused, each with a reason.

        Raises:
            OptionError: unless either cells or rays are given, or a standard deviation is negative.
            ShapeError: if they are not (N, 2) or (N, 3), or a ray has no direction.
        """
        require_type(scan, Scan, "'scan'")
        require_number(sigma_cells, "sigma_cells", least=0)
        require_number(sigma_rad, "sigma_rad", least=0)
        if (cells is None) == (rays is None):
            raise OptionError("the points are given by both cells and rays, or neither; give one of them")
        if cells is not None:
            at = read_only(cells, np.float64, (None, 2), "the cells")
            names = tuple(f"cell ({row:g}, {column:g})" for row, column in at)
        else:
            assert rays is not None
            given = read_only(rays, np.float64, (None, 3), "the rays")
            length = np.linalg.norm(given, axis=1, keepdims=True)
            if not (np.isfinite(length) & (length > 0)).all():
                raise ShapeError("a ray has no direction; each needs three finite numbers that are not all zero")
            at = np.asarray(scan.geometry.cell_of(given / length), np.float64)
            names = tuple(f"ray ({x:.4g}, {y:.4g}, {z:.4g})" for x, y, z in given / length)
        with np.errstate(invalid="ignore"):
            inside = np.asarray(((at >= -0.5) & (at <= np.array(scan.shape) - 0.5)).all(axis=1))
        at = np.where(inside[:, None], at, 0.0)
        directions = np.asarray(scan.geometry.ray_at(at), np.float64)
        found = measured_ranges(scan, directions)
        missing = np.isnan(found.ranges)
        refusals = _refusals(
            (~inside, f"is outside the scan, which has {scan.shape[0]} rows and {scan.shape[1]} columns"),
            (missing & found.edge, "is at a depth edge, where two surfaces mix: pick beside it"),
            (missing, "has no return: pick on a surface that the scan measured"),
        )
        noise = range_noise_m(scan, directions) if sigma_range_m is None else np.full(len(at), _noise(sigma_range_m))
        mean = np.where(np.isfinite(found.sigma), found.sigma, noise * np.linalg.norm(found.shares, axis=1))
        nearest = np.stack([np.clip(np.rint(at[:, k]), 0, n - 1) for k, n in enumerate(scan.shape)], axis=1)
        normals = cell_normals(scan, nearest.astype(np.int32)).astype(np.float64)
        cosine = (normals * directions).sum(axis=1)
        xyz = np.where([[not one] for one in refusals], directions * found.ranges[:, None], np.nan).reshape(-1, 3)
        by_cell = _ray_by_cell(scan, at)
        steps_rad = np.maximum(np.linalg.norm(by_cell, axis=-1), 1e-12)
        sigmas = np.maximum(sigma_cells, sigma_rad / steps_rad)  # (N, 2) cells
        aside = by_cell * found.ranges[:, None, None]  # (N, 2, 3) m per cell
        along = (aside * normals[:, None]).sum(axis=-1) / away_from_zero(cosine)[:, None]
        picked = sigmas[..., None] * (aside - along[..., None] * directions[:, None])
        own = np.concatenate([picked, (directions * mean[:, None])[:, None]], axis=1)
        flags = _flags(_near_edge(scan, at, np.maximum(_EDGE_CELLS, 2.5 * sigmas)), cosine)
        return MeasuredPoints(xyz=xyz, own=own, names=names, flags=flags, refusals=refusals)

    @staticmethod
    def of_photo(
        scan: Scan,
        registration: PoseResult,
        uv: ArrayLike,
        *,
        sigma_uv_px: float = PICKED_PX,
        sigma_range_m: float | None = None,
        name: str = "photo",
    ) -> MeasuredPoints:
        """Return the laser's points under pixels of a registered photograph, see `xyz_of_photo`.

        Args:
            scan: the scan.
            registration: the result for the photograph, accepted or given.
            uv: (N, 2) pixels (u, v), also between pixel centres.
            sigma_uv_px: standard deviation of the pixels along each axis.
            sigma_range_m: as of `of_scan`.
            name: the photograph's, for messages.

        Returns:
            The points; those outside the photograph, and where the laser saw no surface, are refused with a reason.

        Raises:
            ExportError: if the pose was refused.
            OptionError: if a standard deviation is negative.
            ShapeError: if the pixels are not (N, 2).
        """
        require_type(scan, Scan, "'scan'")
        require_type(registration, PoseResult, "'registration'")
        at = read_only(uv, np.float64, (None, 2), "the pixels")
        names = tuple(f"{name} ({u:g}, {v:g})" for u, v in at)
        width, height = registration.camera.size
        inside = np.asarray(registration.camera.contains(at, border=-0.5))
        found = photo_point_errors(scan, registration, at, sigma_uv_px=sigma_uv_px)
        refusals = _refusals(
            (~inside, f"is outside the photograph, which has {width} x {height} pixels"),
            (np.isnan(found.xyz[:, 0]), "shows nothing that the laser measured: pick on a surface of the scan"),
        )
        noise = range_noise_m(scan, found.xyz) if sigma_range_m is None else np.full(len(at), _noise(sigma_range_m))
        by_range = found.errors.by_range * (noise * found.spread)[:, None]
        own = np.concatenate([sigma_uv_px * found.errors.by_pixel, by_range[:, None]], axis=1)
        by_pose = found.errors.by_pose
        unknown = np.full((len(at), 1, 3), np.nan)
        flags = [*_flags(found.at_edge, found.cosine)]
        if registration.caveat:
            flags = [(*one, f"rests on a pose that is {registration.caveat}") for one in flags]
        cause = _cause(registration)
        return MeasuredPoints(
            xyz=found.xyz, own=own, shared={cause: unknown if by_pose is None else by_pose}, names=names,
            flags=tuple(flags), refusals=refusals,
        )  # fmt: skip

    @staticmethod
    def given(xyz: ArrayLike, *, sigma_m: ArrayLike = 0.0, names: Sequence[str] | None = None) -> MeasuredPoints:
        """Return points with coordinates that are known, such as those of a surveyor.

        Args:
            xyz: (N, 3) m.
            sigma_m: standard deviation along each axis, one number or (N,) or (N, 3), m.
            names: of the points; None: their coordinates.

        Raises:
            ShapeError: if the shapes do not match, or a number is not finite.
            OptionError: if a standard deviation is negative.
        """
        points = read_only(xyz, np.float64, (None, 3), "the points")
        sigma = np.asarray(sigma_m, np.float64)
        sigma = sigma[:, None] if sigma.ndim == 1 else sigma
        if sigma.ndim > 2 or not np.isfinite(points).all() or not np.isfinite(sigma).all():
            raise ShapeError("the points and their standard deviations must be finite numbers, of (N, 3) and (N,)")
        if (sigma < 0).any():
            raise OptionError("a standard deviation is negative; it must be at least 0")
        try:
            own = np.broadcast_to(sigma, points.shape)[:, :, None] * np.eye(3)
        except ValueError:
            raise ShapeError(f"there are {len(points)} points and {len(sigma)} standard deviations") from None
        labels = tuple(names) if names is not None else tuple(f"({x:.9g}, {y:.9g}, {z:.9g})" for x, y, z in points)
        return MeasuredPoints(xyz=points, own=own, names=labels, flags=((),) * len(points))

    @staticmethod
    def joined(parts: Sequence[MeasuredPoints]) -> MeasuredPoints:
        """Return points of one frame in one set; what they have in common is the same where its cause is."""
        causes = {name: part.shared[name].shape[1] for part in parts for name in part.shared}
        widest = max((part.own.shape[1] for part in parts), default=0)
        return MeasuredPoints(
            xyz=np.concatenate([part.xyz for part in parts] or [np.zeros((0, 3))]),
            own=np.concatenate([_widened(part.own, widest) for part in parts] or [np.zeros((0, 0, 3))]),
            shared={
                name: np.concatenate([part.shared.get(name, np.zeros((len(part), size, 3))) for part in parts])
                for name, size in causes.items()
            },
            names=tuple(name for part in parts for name in part.names),
            flags=tuple(one for part in parts for one in part.flags),
            refusals=tuple(one for part in parts for one in part.refusals),
        )

    def moved(self, to_from_here: Rigid, *, sigma_m: float = 0.0, sigma_rad: float = 0.0) -> MeasuredPoints:
        """Return the same points in another frame, such as the world.

        Args:
            to_from_here: the pose of this frame in the other one.
            sigma_m: standard deviation of its position, m, of all axes together; 0: it counts as exact.
            sigma_rad: of its direction, rad.
        """
        turn = to_from_here.rotation.T
        shared = {name: part @ turn for name, part in self.shared.items()}
        if sigma_m or sigma_rad:
            axes = np.eye(3)
            turned = np.cross(axes, self.xyz[:, None]) * (sigma_rad / np.sqrt(3))  # (N, 3, 3) m, by each axis
            shifted = np.broadcast_to(axes * (sigma_m / np.sqrt(3)), turned.shape)
            shared["the place of its scan"] = np.concatenate([turned @ turn, shifted], axis=1)
        return replace(self, xyz=to_from_here @ self.xyz, own=self.own @ turn, shared=shared)

    def subset(self, chosen: Sequence[int]) -> MeasuredPoints:
        """Return some of the points, by their numbers."""
        rows = list(chosen)
        return MeasuredPoints(
            xyz=self.xyz[rows], own=self.own[rows], shared={name: part[rows] for name, part in self.shared.items()},
            names=tuple(self.names[k] for k in rows), flags=tuple(self.flags[k] for k in rows),
            refusals=tuple(self.refusals[k] for k in rows),
        )  # fmt: skip

    @property
    def covariance(self) -> NDArray[np.float64]:
        """(3 N, 3 N) of all coordinates together, m^2; NaN where the pose of a photograph was given."""
        count = len(self)
        result = np.zeros((3 * count, 3 * count))
        for part in self.shared.values():
            columns = np.moveaxis(part, 1, 2).reshape(3 * count, -1)
            result += columns @ columns.T
        for k, one in enumerate(self.own):
            result[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += one.T @ one
        return result


def _refusals(*reasons: tuple[BoolArray, str]) -> tuple[str, ...]:
    """Return the first reason that holds for each point; empty: none."""
    columns = [np.where(holds, why, "") for holds, why in reasons]
    return tuple(next(filter(None, one), "") for one in zip(*(column.tolist() for column in columns), strict=True))


def _noise(sigma_range_m: float) -> float:
    return require_number(sigma_range_m, "sigma_range_m", least=0)


def _flags(at_edge: BoolArray, cosine: FloatArray) -> tuple[tuple[str, ...], ...]:
    grazing = np.abs(cosine) < _GRAZING_COSINE
    words = (AT_EDGE, "lies on a surface that is seen at more than 80 degrees from its normal")
    pairs = zip(at_edge.tolist(), grazing.tolist(), strict=True)
    return tuple(tuple(word for word, one in zip(words, pair, strict=True) if one) for pair in pairs)


def _near_edge(scan: Scan, at: FloatArray, reach: FloatArray) -> BoolArray:
    """Return whether a depth edge or a hole is within `reach` (N, 2) rows and columns of places (N, 2) in a scan."""
    angle = np.arange(16) * (np.pi / 8)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    around = at[:, None] + reach[:, None] * np.concatenate([circle, circle / 2])
    highest = np.array(scan.shape) - 1.0
    rays = np.asarray(scan.geometry.ray_at(np.clip(around, 0, highest).reshape(-1, 2)), np.float64)
    return np.asarray(np.isnan(measured_ranges(scan, rays).ranges).reshape(len(at), -1).any(axis=1))


def _ray_by_cell(scan: Scan, at: FloatArray) -> NDArray[np.float64]:
    """Return the derivative of the rays by row and column (N, 2, 3), 1 / cell."""
    highest = np.array(scan.shape) - 1.0
    columns = []
    for step in np.eye(2) * 0.5:
        low, high = np.clip(at - step, 0, highest), np.clip(at + step, 0, highest)
        apart = np.maximum((high - low).sum(axis=1, keepdims=True), 1e-9)
        columns.append((np.asarray(scan.geometry.ray_at(high)) - np.asarray(scan.geometry.ray_at(low))) / apart)
    return np.stack(columns, axis=1).astype(np.float64)


def _cause(registration: PoseResult) -> str:
    """Return the same word for the same pose with the same uncertainty."""
    joint = registration.joint_covariance
    numbers = joint.covariance if isinstance(joint, CameraUncertainty) else joint
    digest = hashlib.sha256(np.ascontiguousarray(registration.camera_from_scanner.matrix).tobytes())
    digest.update(repr(registration.camera.as_fields()).encode())
    digest.update(b"" if numbers is None else np.ascontiguousarray(numbers).tobytes())
    return f"pose {digest.hexdigest()[:16]}"


def _widened(own: FloatArray, width: int) -> FloatArray:
    return np.concatenate([own, np.zeros((len(own), width - own.shape[1], 3))], axis=1)
