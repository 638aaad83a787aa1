"""Change between two scans of one place, with its significance: distances along the normals of the first.

At points spread over the first scan, the surface of both scans is fitted by a plane within a cylinder around the
normal; the distance is that between the two planes on its axis. Its variance is that of both fits, from the noise of
the ranges, what a surface is rougher than that, and what the uncertainty of the second scan's pose moves it by. All
points share that one error of the pose, so that a pair of scans that are off by chance shows change at many points or
at none; over many pairs, where nothing has changed, one in twenty points is called significant.

What the second scanner did not see has not changed: a point that something beside it hides is not compared.

Source: D. Lague et al., Accurate 3D comparison of complex topography, ISPRS J. 82, 2013 (M3C2); L. Winiwarter et al.,
M3C2-EP, ISPRS J. 178, 2021, for the propagation. The planes instead of means, and the roughness, are ours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import DegenerateGeometryError
from ladarreg_core.foundations.arrays import BoolArray, FloatArray, IntArray, read_only
from ladarreg_core.foundations.progress import Progress, Report
from ladarreg_core.foundations.validation import require_positive, require_type
from ladarreg_core.frames import Rigid
from ladarreg_core.scan import Scan
from ladarreg_core.surface.mesh.normals import cell_normals
from ladarreg_core.surface.ranges import range_noise_m

_QUANTILE = 1.959964
_MIN_POINTS = 8
_OFF_SIGMAS = 6.0
_ROUGH_SIGMAS = 3.0
_MIN_COSINE = 0.1
_REPORTED = 500


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Change:
    """What has changed at N points."""

    points: FloatArray
    """(N, 3) on the first scan, in its frame, m."""
    cells: IntArray
    """(N, 2) their cells in the first scan."""
    normals: FloatArray
    """(N, 3) unit, toward the first scanner."""
    distance_m: FloatArray
    """(N,) of the second scan's surface from the first's, along the normal: positive where something was added; NaN
    where one of both has too few points."""
    sigma_m: FloatArray
    """(N,) standard deviation of the distance."""

    @property
    def known(self) -> BoolArray:
        """(N,) bool: there is a distance."""
        return np.asarray(np.isfinite(self.distance_m))

    @property
    def detectable_m(self) -> NDArray[np.float64]:
        """(N,) smallest distance that is significant, m."""
        return np.asarray(_QUANTILE * self.sigma_m)

    @property
    def significant(self) -> BoolArray:
        """(N,) bool: where nothing has changed, one in twenty is."""
        with np.errstate(invalid="ignore"):
            return np.asarray(np.abs(self.distance_m) > self.detectable_m)

    def as_fields(self) -> dict[str, Any]:
        """Return a summary as JSON-ready values."""
        known, significant = self.known, self.significant
        found = self.distance_m[significant]
        return {
            "points": len(self.points), "compared": int(known.sum()), "significant": int(significant.sum()),
            "significant_share": float(significant.sum() / max(known.sum(), 1)),
            "expected_share_without_change": 0.05,
            "median_detectable_m": float(np.median(self.detectable_m[known])) if known.any() else None,
            "largest_m": float(found[np.abs(found).argmax()]) if len(found) else None,
        }  # fmt: skip


def change(
    before: Scan,
    after: Scan,
    *,
    before_from_after: Rigid | None = None,
    covariance: FloatArray | None = None,
    spacing_m: float = 0.1,
    radius_m: float = 0.1,
    reach_m: float = 0.5,
    report: Report | None = None,
) -> Change:
    """Compare two scans of one place.

    Args:
        before: the first scan.
        after: the second scan.
        before_from_after: the pose of the second scanner in the frame of the first; None: by what both scans state of
            the world, or the same place where neither states anything.
        covariance: (6, 6) of (w, c) of that pose: R_true = exp([w]x) R, c = C_true - C in the frame of the first, as of
            `StationPair.covariance`; None: the pose is exact.
        spacing_m: between points that are compared, m.
        radius_m: of the cylinders, m; large against the spacing of the scans' points, small against what changes.
        reach_m: largest distance that is looked for, m.
        report: receives the progress.

    Raises:
        DegenerateGeometryError: if only one scan states where it stands, or the scans share no surface.
        ShapeError: if the covariance is no finite, positive (6, 6).
        OptionError: if a length is not positive.
    """
    from scipy.spatial import cKDTree

    from ladarreg_core.surface.uncertainty import covariance_factor

    require_type(before, Scan, "'before'")
    require_type(after, Scan, "'after'")
    for name, value in (("spacing_m", spacing_m), ("radius_m", radius_m), ("reach_m", reach_m)):
        require_positive(value, name)
    pose = stated_pose(before, after) if before_from_after is None else before_from_after
    factor = np.zeros((6, 6)) if covariance is None else covariance_factor(read_only(
        covariance, np.float64, (6, 6), "the covariance"))  # fmt: skip
    first, second = _Cloud.of(before, Rigid.identity()), _Cloud.of(after, pose)
    cells = _spread(before, spacing_m)
    points = before.points[cells[:, 0], cells[:, 1]].astype(np.float64)
    normals = cell_normals(before, cells).astype(np.float64)
    reach = float(np.hypot(reach_m, radius_m))
    trees = cKDTree(first.points), cKDTree(second.points)
    seen = _seen_heights(after, pose, points, normals, radius_m)
    fits: dict[int, tuple[_Fit, _Fit]] = {}
    for k, (point, normal) in enumerate(zip(points, normals, strict=True)):
        if report is not None and k % _REPORTED == 0:
            report(Progress(k, len(points), "comparing the scans"))
        if not np.abs(seen[k]) <= reach_m:
            continue
        own = first.plane_at(trees[0].query_ball_point(point, 2 * radius_m), point, normal, radius_m, 0.0)
        other = second.plane_at(trees[1].query_ball_point(point, reach), point, normal, radius_m, float(seen[k]))
        if own is not None and other is not None:
            fits[k] = own, other
    if not fits:
        raise DegenerateGeometryError("the scans share no surface within reach; check the pose of the second one")
    rows = list(fits)
    distance, variance = np.full(len(points), np.nan), np.full(len(points), np.nan)
    distance[rows] = [other.height - own.height for own, other in fits.values()]
    variance[rows] = _variances([own for own, _ in fits.values()]) + _variances([other for _, other in fits.values()])
    arm = points + distance[:, None] * normals - pose.translation
    moved = np.concatenate([np.cross(arm, normals), normals], axis=1)  # of the distance by (w, c)
    with np.errstate(invalid="ignore"):
        variance += ((moved @ factor) ** 2).sum(axis=1)
    return Change(points=points, cells=cells, normals=normals, distance_m=distance, sigma_m=np.sqrt(variance))


def stated_pose(before: Scan, after: Scan) -> Rigid:
    """Return the pose of a second scanner in the frame of the first by what both scans state of the world.

    It is the identity where neither states anything.

    Raises:
        DegenerateGeometryError: if only one states where it stands.
    """
    one, other = before.world_from_scanner, after.world_from_scanner
    if (one is None) != (other is None):
        raise DegenerateGeometryError(
            "only one of both scans states where it stands; give the pose of the second one in the frame of the first"
        )
    return Rigid.identity() if one is None or other is None else one.inverse @ other


@dataclass(frozen=True, slots=True, eq=False)
class _Cloud:
    """The returns of a scan in the frame of the first one."""

    points: NDArray[np.float64]
    """(N, 3)."""
    rays: NDArray[np.float64]
    """(N, 3) unit, from its own scanner."""
    noise: NDArray[np.float64]
    """(N,) of the ranges, m."""

    @staticmethod
    def of(scan: Scan, pose: Rigid) -> _Cloud:
        own = scan.points[scan.valid].astype(np.float64)
        rays = own / np.linalg.norm(own, axis=1, keepdims=True)
        return _Cloud(np.asarray(pose @ own, np.float64), rays @ pose.rotation.T, np.asarray(range_noise_m(scan, rays)))

    def plane_at(
        self, near: list[int], point: FloatArray, normal: FloatArray, radius: float, about: float
    ) -> _Fit | None:
        """Return the plane of the surface on the axis of a cylinder; None: too few points.

        It is the surface near a height, `about`: within 45 degrees of the normal, others are farther off.
        """
        rows = np.array(near, np.intp)
        apart = self.points[rows] - point
        height = apart @ normal
        across = apart - height[:, None] * normal
        cosine = np.maximum(np.abs(self.rays[rows] @ normal), _MIN_COSINE)
        sigma = self.noise[rows] * cosine
        kept = (across * across).sum(axis=1) <= radius**2
        kept &= np.abs(height - about) <= radius + _OFF_SIGMAS * sigma
        if kept.sum() < _MIN_POINTS:
            return None
        side = np.linalg.svd(normal[None])[2][1:]
        A = np.concatenate([np.ones((int(kept.sum()), 1)), across[kept] @ side.T / radius], axis=1)
        weighted = A / sigma[kept, None]
        information = weighted.T @ weighted
        if np.linalg.cond(information) > 1e6:  # all on one line
            return None
        inverse = np.linalg.inv(information)
        fit = inverse @ (weighted.T @ (height[kept] / sigma[kept]))
        chi2 = float((((height[kept] - A @ fit) / sigma[kept]) ** 2).sum())
        return _Fit(float(fit[0]), float(inverse[0, 0]), float(np.mean(sigma[kept] ** 2)), chi2, len(A) - 3)


class _Fit(NamedTuple):
    """A plane on the axis of a cylinder."""

    height: float
    variance: float
    """Of the height, by the noise of the ranges as it was estimated before."""
    noise: float
    """Mean variance of a point along the normal, likewise."""
    chi2: float
    dof: int


def _variances(fits: Sequence[_Fit]) -> NDArray[np.float64]:
    """Return the variance of each height: by the noise that all fits of a scan show together, and their own roughness.

    Two scans sample other parts of a rough surface. Neighbouring points of it are alike, distant ones are not: its
    roughness is taken to average out with the fourth root of the number of points, more slowly than noise.
    """
    variance, noise, chi2, dof = np.array([one[1:] for one in fits], np.float64).reshape(-1, 4).T
    scale = float(np.median(chi2 / dof))
    ratio = chi2 / dof / scale
    rough = np.where(ratio > 1 + _ROUGH_SIGMAS * np.sqrt(2 / dof), ratio - 1, 0.0)
    return np.asarray(scale * (variance + rough * noise / np.sqrt(dof + 3)))


def _seen_heights(
    after: Scan, pose: Rigid, points: FloatArray, normals: FloatArray, radius: float
) -> NDArray[np.float64]:
    """Return the height (N,) above points (N, 3), along their normals, of what the second scanner met there; NaN: none.

    It looked elsewhere, had no return, met a surface beside the cylinder first, or looks at the back of the surface.
    Of the nine cells around a point the least height counts: at the rim of an object the next cell meets another one.
    """
    own = pose.inverse @ points
    length = np.linalg.norm(own, axis=1)
    rays = own / length[:, None]
    cell = np.rint(np.nan_to_num(np.asarray(after.geometry.cell_of(rays), np.float64), nan=-9.0)).astype(np.int64)
    steps = np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1], indexing="ij"), axis=-1).reshape(-1, 2)
    around = cell[:, None] + steps  # (N, 9, 2)
    inside = ((around >= 0) & (around < np.array(after.shape))).all(axis=-1)
    row, column = np.moveaxis(np.where(inside[..., None], around, 0), -1, 0)
    met = pose @ after.points[row, column].astype(np.float64)
    apart = met - points[:, None]
    height = np.einsum("nkj,nj->nk", apart, normals)
    beside = np.linalg.norm(apart - height[..., None] * normals[:, None], axis=-1)
    with np.errstate(invalid="ignore"):
        hides = (after.ranges[row, column] < length[:, None]) & (beside > radius)
        height = np.where(inside & ~hides & np.isfinite(height), height, np.inf)
    least = np.take_along_axis(height, np.abs(height).argmin(axis=1)[:, None], axis=1)[:, 0]
    facing = ((pose.translation - points) * normals).sum(axis=1) > 0
    return np.where(np.isfinite(least) & facing, least, np.nan)


def _spread(scan: Scan, spacing: float) -> NDArray[np.int32]:
    """Return one cell (N, 2) with a return for each cube of a size."""
    cells = np.argwhere(scan.valid)
    cubes = np.floor(scan.points[scan.valid].astype(np.float64) / spacing).astype(np.int64)
    _, chosen = np.unique(cubes, axis=0, return_index=True)
    return np.asarray(cells[np.sort(chosen)], np.int32)
