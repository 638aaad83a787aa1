"""The adjustment: robust least squares over all poses, cameras and ties, and the covariance of what results.

The ties' points and lines are eliminated (`elimination`). Robust weights are graduated: the loss begins nearly
quadratic and narrows, so that ties which are wrong by much lose their weight before they have bent anything.

The covariance is that of a jackknife over regions of the surface, since ties of one region err alike (the laser's
surface, the lens, the light), and of what states a covariance of its own.

Source: Yang et al. 2020, 'Graduated non-convexity for robust spatial perception' (Geman-McClure); Bell and McCaffrey
2002 (jackknife over clusters, CR3).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ladarreg_core.foundations.arrays import BoolArray, IntArray
from ladarreg_core.survey.least_squares.elimination import Eliminated, Observations
from ladarreg_core.survey.least_squares.line_residuals import line_residuals, line_surface_residuals
from ladarreg_core.survey.least_squares.problem import (
    WORLD,
    Matrix,
    Problem,
    relative_residual,
    surface_residuals,
    tie_residuals,
)

_GRADUATION = (30.0, 10.0, 4.0, 2.0, 1.0)
"""Widths of the loss, relative to the last one."""
_WIDTH = 3.0  # standard deviations at which the last loss halves a weight's root
_MAX_STEPS = 12  # of each width
_CONVERGED = 0.01  # step in standard deviations
_MIN_SIGMA_PX, _START_SIGMA_PX = 0.1, 1.0
_MIN_SURFACE, _MAX_SURFACE = 0.7, 10.0  # noise of the surfaces, relative to what the ties state
_NORMAL_MEDIAN = 1.1774  # of the length of two standard normal deviates
_NORMAL_MEDIAN_1D = 0.6745  # of the size of one
_MAX_RELATIVE = 30.0  # squared Mahalanobis distance of a relative pose, with 6 degrees of freedom, at the last width
_REGION_M = 0.5
_LEFT_OUT = 0.9  # of a region's information: a pose in one region has to stay determined without it
_DAMPED = 1e-9
LOST = 0.05
"""Weight below which an observation counts as an outlier."""


@dataclass(frozen=True, slots=True)
class _Noise:
    px: float
    """Of the ties in photographs."""
    surface: float
    """Of the surfaces, relative to what the ties state."""


@dataclass(frozen=True, slots=True, eq=False)
class Adjusted:
    """The solution."""

    problem: Problem
    """At the values found."""
    covariance: Matrix
    """(Y, Y) of the unknowns in the order of `Problem.columns`."""
    tie_weights: Matrix
    """(N,) robust weights of the observations in photographs, 0 to 1."""
    surface_weights: Matrix
    """(K,) likewise of the places on surfaces."""
    relative_weights: Matrix
    """(F,) likewise of the relative poses."""
    tie_residuals_px: Matrix
    """(N, 2), NaN behind a camera."""
    sigma_px: float
    """Noise of the ties, estimated."""
    chi2_per_dof: float
    """Of all that was kept."""
    converged: bool
    line_weights: Matrix
    """(N,) robust weights of the observations of lines in photographs."""
    line_surface_weights: Matrix
    """(K,) likewise of the places of lines on surfaces."""
    line_residuals_px: Matrix
    """(N, 2) of the two drawn ends, NaN behind a camera."""

    @property
    def line_inliers(self) -> BoolArray:
        """(N,) which observations of lines in photographs were kept."""
        return np.asarray(self.line_weights > LOST)

    @property
    def tie_inliers(self) -> BoolArray:
        """(N,) which observations in photographs were kept."""
        return np.asarray(self.tie_weights > LOST)

    def covariance_of(self, body: int) -> Matrix:
        """Return the covariance (6, 6) of a body's (w, c); zeros of a fixed one."""
        return self.covariance_between(body, body)

    def covariance_between(self, first: int, second: int) -> Matrix:
        """Return the covariance (6, 6) between the (w, c) of two bodies."""
        of_body, _, _ = self.problem.columns
        a, b = of_body[first], of_body[second]
        if a < 0 or b < 0:
            return np.zeros((6, 6))
        return self.covariance[a : a + 6, b : b + 6]

    def camera_covariance(self, camera: int) -> Matrix:
        """Return the covariance of a camera's unknowns."""
        _, of_camera, _ = self.problem.columns
        at, size = of_camera[camera], self.problem.cameras[camera].size
        return self.covariance[at : at + size, at : at + size] if size else np.zeros((0, 0))

    def pose_and_camera_covariance(self, body: int) -> Matrix:
        """Return the joint covariance of a photograph's (w, c) and the values of its camera."""
        of_body, of_camera, _ = self.problem.columns
        view = self.problem.views[body]
        assert view is not None
        size, at = self.problem.cameras[view.camera].size, of_camera[view.camera]
        columns = [*range(of_body[body], of_body[body] + 6), *range(at, at + size)]
        return self.covariance[np.ix_(columns, columns)]


def solve(
    problem: Problem, *, robust: bool = True, sigma_px: float | None = None, tick: Callable[[], None] | None = None
) -> Adjusted:
    """Adjust a problem.

    Args:
        problem: at a start from which at least most ties lie within some tens of pixels.
        robust: let what contradicts the rest lose its weight.
        sigma_px: noise of the ties, px; None: estimated from their residuals.
        tick: called before every step; may raise to stop.

    Raises:
        numpy.linalg.LinAlgError: if what is known does not determine the unknowns.
    """
    noise, converged = _Noise(sigma_px or _START_SIGMA_PX, 1.0), False
    for width in _GRADUATION if robust else (np.inf,):
        damping = _DAMPED
        system = _System.at(problem, noise, width)
        for _ in range(_MAX_STEPS):
            if tick is not None:
                tick()
            step, points, lines = system.step(damping)
            moved = problem.moved(step, points, lines)
            again = _System.at(moved, noise, width)
            if not again.cost <= system.cost * (1 + 1e-12) and damping < 1e6:
                damping = max(damping, 1e-6) * 100
                continue
            size = float(np.sqrt(np.abs(step @ system.reduced @ step) / max(len(step), 1)))
            problem, system, damping = moved, again, max(damping / 10, _DAMPED)
            converged = size < _CONVERGED
            if converged:
                break
        if sigma_px is None:
            noise = _estimated_noise(system, noise)
    system = _System.at(problem, noise, 1.0 if robust else np.inf)
    return Adjusted(
        problem, system.covariance(), system.tie_weights, system.surface_weights, system.relative_weights,
        system.residual, noise.px, system.chi2_per_dof, converged, system.line_weights, system.line_surface_weights,
        system.line_residual,
    )  # fmt: skip


def regions(points: Matrix) -> IntArray:
    """Return the number of the region, a cube of half a metre, in which each point (P, 3) lies."""
    if not len(points):
        return np.zeros(0, np.int64)
    _, region = np.unique(np.floor(points / _REGION_M).astype(np.int64), axis=0, return_inverse=True)
    return np.asarray(region.ravel())


@dataclass(frozen=True, slots=True, eq=False)
class _Weighted:
    """Observations with their weights."""

    rows: Observations
    squared: Matrix
    """(N,) squares in standard deviations; NaN: it cannot be seen."""
    weights: Matrix
    """(N,)."""

    @staticmethod
    def of(
        residual: Matrix, by_unknowns: Matrix, columns: IntArray, by_landmark: Matrix, landmark: IntArray,
        sigma: Matrix, limit: float,
    ) -> _Weighted:  # fmt: skip
        """Return observations (N, R) with their derivatives, as of `Observations`, whitened by `sigma` (N,)."""
        squared = np.einsum("nr,nr->n", residual, residual) / sigma**2
        seen = np.isfinite(squared) & np.isfinite(by_unknowns).all(axis=(1, 2))
        weights = np.where(seen, _weight(squared, limit), 0.0)
        scale = np.where(seen, np.sqrt(weights) / sigma, 0.0)[:, None, None]
        J, Jx = (np.where(seen[:, None, None], one, 0.0) * scale for one in (by_unknowns, by_landmark))
        off = np.where(seen[:, None], residual, 0.0) * scale[:, 0]
        return _Weighted(Observations(off, J, columns, Jx, landmark), np.where(seen, squared, np.nan), weights)

    def loss(self, limit: float) -> float:
        """Return the sum of the losses of all that is seen."""
        return float(_loss(self.squared[np.isfinite(self.squared)], limit).sum())

    @property
    def kept(self) -> BoolArray:
        """(N,) which are no outliers."""
        return np.asarray(self.weights > LOST)

    @property
    def chi2(self) -> float:
        """Of those."""
        return float((self.weights * self.squared)[self.kept].sum())

    @property
    def equations(self) -> int:
        """Number of their residuals."""
        return int(self.kept.sum()) * int(self.rows.residual.shape[1])


@dataclass(frozen=True, slots=True, eq=False)
class _System:
    """The normal equations at some values, with points and lines eliminated."""

    problem: Problem
    cost: float
    reduced: Matrix
    """(Y, Y) S."""
    right: Matrix
    """(Y,)."""
    points: Eliminated
    lines: Eliminated
    of_relative: Matrix
    """(Y, Y): the information of relative poses and of the cameras' priors."""
    residual: Matrix
    line_residual: Matrix
    tie_weights: Matrix
    surface_weights: Matrix
    line_weights: Matrix
    line_surface_weights: Matrix
    relative_weights: Matrix
    chi2_per_dof: float

    @staticmethod
    def at(problem: Problem, noise: _Noise, width: float) -> _System:
        """Return the equations for a noise of the ties and a width of the loss relative to the last one."""
        of_body, of_camera, size = problem.columns
        ties, lines, limit = problem.ties, problem.lines, width * _WIDTH
        residual, by_pose, by_camera, by_point = tie_residuals(problem)
        of_ties = _Weighted.of(
            residual, np.concatenate([by_pose, by_camera], axis=2), _photo_columns(problem, ties.photo), by_point,
            ties.point, np.where(np.isnan(ties.stated_px), noise.px, ties.stated_px), limit,
        )  # fmt: skip
        distance, by_scan, by_point = surface_residuals(problem)
        of_surfaces = _Weighted.of(
            -distance[:, None], by_scan[:, None], _scan_columns(problem, ties.scan), by_point[:, None], ties.on_point,
            noise.surface * ties.sigma_m, limit,
        )  # fmt: skip
        points = Eliminated.of([of_ties.rows, of_surfaces.rows], len(ties.points), 3, size)

        line_residual, by_pose, by_camera, by_line = line_residuals(problem)
        of_lines = _Weighted.of(
            line_residual, np.concatenate([by_pose, by_camera], axis=2), _photo_columns(problem, lines.photo), by_line,
            lines.line, lines.sigma_px, limit,
        )  # fmt: skip
        distance, by_scan, by_line = line_surface_residuals(problem)
        of_line_surfaces = _Weighted.of(
            -distance[:, None], by_scan[:, None], _scan_columns(problem, lines.scan), by_line[:, None], lines.on_line,
            lines.sigma_m, limit,
        )  # fmt: skip
        of_all = (of_ties, of_surfaces, of_lines, of_line_surfaces)
        eliminated = Eliminated.of([of_lines.rows, of_line_surfaces.rows], len(lines.points), 4, size)

        of_relative, right, relative_weights, cost = _of_relative(problem, of_body, of_camera, size, width)
        cost += sum(one.loss(limit) for one in of_all)
        dof = (
            sum(one.equations for one in of_all) - 3 * len(np.unique(ties.point[of_ties.kept]))
            - 4 * len(np.unique(lines.line[of_lines.kept])) + 6 * len(problem.relative) - size
        )  # fmt: skip
        chi2 = sum(one.chi2 for one in of_all) + _of_kept(problem, relative_weights)
        return _System(
            problem, cost, of_relative + points.reduced + eliminated.reduced, right + points.right + eliminated.right,
            points, eliminated, of_relative, residual, line_residual, of_ties.weights, of_surfaces.weights,
            of_lines.weights, of_line_surfaces.weights, relative_weights, chi2 / max(dof, 1),
        )  # fmt: skip

    def step(self, damping: float) -> tuple[Matrix, Matrix, Matrix]:
        """Return the step of the unknowns (Y,), of the points (P, 3) and of the lines (L, 4)."""
        from scipy.linalg import cho_factor, cho_solve

        S = self.reduced + damping * np.diag(np.diag(self.reduced))
        y = np.asarray(cho_solve(cho_factor(S), self.right) if len(S) else np.zeros(0))
        return y, self.points.step(y), self.lines.step(y)

    def covariance(self) -> Matrix:
        """Return the scatter of the solutions without one region each, and of what states its own covariance.

        To first order, leaving out a region with the score g and the information S_k moves the solution by
        (S - S_k)^-1 g: the jackknife, whose middle is the sandwich, and which counts that residuals are small where
        few regions determine a pose. It is never less than what independent ties would give, if all counted less by as
        much as regions scatter more: a close-up lies in one region or two, which say nothing of their own scatter.
        A line is part of the region of its middle.
        """
        from scipy.linalg import cho_factor, cho_solve

        if not len(self.reduced):
            return np.zeros((0, 0))
        bread = cho_solve(cho_factor(self.reduced), np.eye(len(self.reduced)))
        points = self.problem.ties.points
        region = regions(np.concatenate([points, self.problem.lines.points.mean(axis=1)]))
        of_points, of_lines = region[: len(points)], region[len(points) :]
        count = int(region.max(initial=-1)) + 1
        if not count:
            return np.asarray(bread)
        shifts, scores = np.zeros((len(bread), count)), np.zeros((len(bread), count))
        for k in range(count):
            own, g = self.points.of_some(of_points == k)
            if (of_lines == k).any():
                more, g_lines = self.lines.of_some(of_lines == k)
                own, g = own + more, g + g_lines
            scores[:, k] = g
            shifts[:, k] = cho_solve(cho_factor(self.reduced - _LEFT_OUT * own), g)
        by_region = shifts @ shifts.T * (1 - 1 / count) + bread @ self.of_relative @ bread
        # How much more the scores of whole regions scatter than those of independent ties would.
        of_ties = self.reduced - self.of_relative
        alike = np.einsum("ik,ij,jk->", scores, bread, scores) / max(np.sum(bread * of_ties), np.finfo(float).tiny)
        least = of_ties / max(float(alike), 1.0) + self.of_relative
        return _no_less(by_region, cho_solve(cho_factor(least), np.eye(len(least))))


def _photo_columns(problem: Problem, photo: IntArray) -> IntArray:
    """Return the columns (N, 10) of poses and cameras of photographs (N,), by their bodies.

    Those of what is fixed fall into an extra one.
    """
    _, of_camera, size = problem.columns
    columns = np.full((len(photo), 10), size, np.int64)
    columns[:, :6] = _scan_columns(problem, photo)
    if len(photo):
        camera = np.array([-1 if view is None else view.camera for view in problem.views], np.int64)[photo]
        estimated = np.array([one.size for one in problem.cameras], np.int64)[camera] > 0
        columns[:, 6:] = np.where(estimated[:, None], of_camera[camera][:, None] + np.arange(4), size)
    return columns


def _scan_columns(problem: Problem, body: IntArray) -> IntArray:
    """Return the columns (N, 6) of the poses of bodies (N,); those of fixed ones fall into an extra one."""
    of_body, _, size = problem.columns
    at = of_body[body]
    return np.where(at[:, None] >= 0, at[:, None] + np.arange(6), size)


def _of_relative(
    problem: Problem, of_body: IntArray, of_camera: IntArray, size: int, width: float
) -> tuple[Matrix, Matrix, Matrix, float]:
    """Return information (Y, Y), right-hand side (Y,), weights (F,) and cost of relative poses and priors."""
    H, b = np.zeros((size + 1, size + 1)), np.zeros(size + 1)
    weights, cost = np.ones(len(problem.relative)), 0.0
    for k, known in enumerate(problem.relative):
        view = problem.views[known.body]
        values = None if view is None else problem.cameras[view.camera].values
        residual, by_body, by_base = relative_residual(known, problem.poses, values)
        root = np.linalg.cholesky(np.linalg.inv(known.covariance)).T
        e = root @ residual
        squared, limit = float(e @ e), width * np.sqrt(_MAX_RELATIVE)
        weights[k] = float(_weight(np.array([squared]), limit)[0])
        cost += float(_loss(np.array([squared]), limit)[0])
        J = np.zeros((6, size + 1))
        if of_body[known.body] >= 0:
            J[:, of_body[known.body] : of_body[known.body] + 6] += by_body
        if known.base != WORLD and of_body[known.base] >= 0:
            J[:, of_body[known.base] : of_body[known.base] + 6] += by_base
        if view is not None and known.by_camera is not None and problem.cameras[view.camera].size:
            at = of_camera[view.camera]
            J[:, at : at + 4] -= known.by_camera
        J = np.sqrt(weights[k]) * root @ J
        H += J.T @ J
        b -= J.T @ (np.sqrt(weights[k]) * e)
    for camera, at in zip(problem.cameras, of_camera.tolist(), strict=True):
        if camera.size:
            information = np.linalg.inv(camera.covariance)
            off = camera.values - camera.prior
            rows = slice(at, at + camera.size)
            H[rows, rows] += information
            b[rows] -= information @ off
            cost += float(off @ information @ off)
    return H[:size, :size], b[:size], weights, cost


def _of_kept(problem: Problem, weights: Matrix) -> float:
    total = 0.0
    for known, weight in zip(problem.relative, weights, strict=True):
        view = problem.views[known.body]
        values = None if view is None else problem.cameras[view.camera].values
        residual, _, _ = relative_residual(known, problem.poses, values)
        total += float(weight * residual @ np.linalg.solve(known.covariance, residual))
    return total


def _weight(squared: Matrix, limit: float) -> Matrix:
    """Return Geman and McClure's weights for squared residuals in standard deviations."""
    return np.ones_like(squared) if not np.isfinite(limit) else (limit**2 / (limit**2 + squared)) ** 2


def _loss(squared: Matrix, limit: float) -> Matrix:
    return squared if not np.isfinite(limit) else limit**2 * squared / (limit**2 + squared)


def _estimated_noise(system: _System, before: _Noise) -> _Noise:
    """Return the noise of the ties that were kept: by the medians, corrected for the points that were fitted."""
    ties = system.problem.ties
    found = np.isnan(ties.stated_px)  # of what was drawn by hand the noise is stated
    kept, on = (system.tie_weights > 0.25) & found, system.surface_weights > 0.25
    if kept.sum() < 20:
        return before
    length = np.linalg.norm(system.residual[kept], axis=1)
    equations = 2 * int(kept.sum()) + int(on.sum())
    share = np.sqrt(max(1 - 3 * len(np.unique(ties.point[kept])) / equations, 0.1))
    px = max(float(np.median(length)) / _NORMAL_MEDIAN / share, _MIN_SIGMA_PX)
    if on.sum() < 20:
        return _Noise(px, before.surface)
    distance = np.abs(surface_residuals(system.problem)[0] / ties.sigma_m)[on]
    surface = float(np.median(distance)) / _NORMAL_MEDIAN_1D / share
    return _Noise(px, float(np.clip(surface, _MIN_SURFACE, _MAX_SURFACE)))


def _no_less(found: Matrix, least: Matrix) -> Matrix:
    """Return a covariance enlarged where it is smaller than another one."""
    L = np.linalg.cholesky(least)
    inside = np.linalg.solve(L, np.linalg.solve(L, found).T)
    values, vectors = np.linalg.eigh((inside + inside.T) / 2)
    return np.asarray(L @ (vectors * np.maximum(values, 1.0)) @ vectors.T @ L.T)
