"""The adjustment: robust least squares over all poses, cameras and ties, and the covariance of what results.

The ties' points are eliminated: with H the normal matrix, y the poses and cameras, x the points, which are independent
of each other, the reduced system is S = H_yy - H_yx H_xx^-1 H_xy. Robust weights are graduated: the loss begins nearly
quadratic and narrows, so that ties which are wrong by much lose their weight before they have bent anything.

The covariance is that of a jackknife over regions of the surface, since ties of one region err alike (the laser's
surface, the lens, the light), and of what states a covariance of its own.

Source: Triggs et al. 2000, 'Bundle adjustment - a modern synthesis' (Schur complement); Yang et al. 2020, 'Graduated
non-convexity for robust spatial perception' (Geman-McClure); Bell and McCaffrey 2002 (jackknife over clusters, CR3).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ladarreg_core.foundations.arrays import BoolArray, IntArray
from ladarreg_core.survey.least_squares.problem import (
    WORLD,
    Matrix,
    Problem,
    relative_residual,
    surface_residuals,
    tie_residuals,
)

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

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
_WORST_LOST = 0.05  # weight below which an observation counts as an outlier


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

    @property
    def tie_inliers(self) -> BoolArray:
        """(N,) which observations in photographs were kept."""
        return np.asarray(self.tie_weights > _WORST_LOST)

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
            step, points = system.step(damping)
            moved = problem.moved(step, points)
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
        system.residual, noise.px, system.chi2_per_dof, converged,
    )  # fmt: skip


def regions(points: Matrix) -> IntArray:
    """Return the number of the region, a cube of half a metre, in which each point (P, 3) lies."""
    if not len(points):
        return np.zeros(0, np.int64)
    _, region = np.unique(np.floor(points / _REGION_M).astype(np.int64), axis=0, return_inverse=True)
    return np.asarray(region.ravel())


@dataclass(frozen=True, slots=True, eq=False)
class _System:
    """The normal equations at some values, with the points eliminated."""

    problem: Problem
    cost: float
    reduced: Matrix
    """(Y, Y) S."""
    right: Matrix
    """(Y,)."""
    mixed: csr_matrix
    """(Y, 3 P) H_yx."""
    inverse: Matrix
    """(P, 3, 3) H_xx^-1."""
    right_points: Matrix
    """(P, 3)."""
    by_ties: csr_matrix
    """(2 N, Y): whitened derivatives of the observations in photographs."""
    by_surfaces: csr_matrix
    """(K, Y): likewise of the places on surfaces."""
    off: Matrix
    """(2 N,): whitened residuals."""
    off_surfaces: Matrix
    """(K,)."""
    of_relative: Matrix
    """(Y, Y): the information of relative poses and of the cameras' priors."""
    residual: Matrix
    tie_weights: Matrix
    surface_weights: Matrix
    relative_weights: Matrix
    chi2_per_dof: float

    @staticmethod
    def at(problem: Problem, noise: _Noise, width: float) -> _System:
        """Return the equations for a noise of the ties and a width of the loss relative to the last one."""
        of_body, of_camera, size = problem.columns
        ties, count = problem.ties, len(problem.ties.points)
        sigma_m = noise.surface * ties.sigma_m
        residual, by_pose, by_camera, by_point = tie_residuals(problem)
        sigma_px = np.where(np.isnan(ties.stated_px), noise.px, ties.stated_px)
        r2 = np.einsum("ni,ni->n", residual, residual) / sigma_px**2
        seen = np.isfinite(r2) & np.isfinite(by_pose).all(axis=(1, 2)) & np.isfinite(by_camera).all(axis=(1, 2))
        w = np.where(seen, _weight(r2, width * _WIDTH), 0.0)
        scale = np.sqrt(w) / sigma_px
        off = np.where(seen[:, None], residual, 0.0) * scale[:, None]
        J = np.concatenate([by_pose, by_camera], axis=2)
        J = np.where(seen[:, None, None], J, 0.0) * scale[:, None, None]
        Jx = np.where(seen[:, None, None], by_point, 0.0) * scale[:, None, None]
        distance, on_scan, on_point = surface_residuals(problem)
        d2 = (distance / sigma_m) ** 2
        v = _weight(d2, width * _WIDTH)
        scale_s = np.sqrt(v) / sigma_m
        off_s, Ks, Kx = -distance * scale_s, on_scan * scale_s[:, None], on_point * scale_s[:, None]

        H_xx = np.zeros((count, 3, 3))
        np.add.at(H_xx, ties.point, np.einsum("nia,nib->nab", Jx, Jx))
        np.add.at(H_xx, ties.on_point, np.einsum("ka,kb->kab", Kx, Kx))
        b_x = np.zeros((count, 3))
        np.add.at(b_x, ties.point, np.einsum("nia,ni->na", Jx, off))
        np.add.at(b_x, ties.on_point, Kx * off_s[:, None])
        trace = np.trace(H_xx, axis1=1, axis2=2)
        H_xx += (1e-9 * trace + 1e-12)[:, None, None] * np.eye(3)
        inverse = np.linalg.inv(H_xx)

        # Columns of the unknowns that each observation touches; those of what is fixed fall into an extra one.
        cameras = np.array([-1 if view is None else view.camera for view in problem.views], np.int64)
        sizes = np.array([one.size for one in problem.cameras], np.int64)
        at_body, camera = of_body[ties.photo], cameras[ties.photo]
        columns = np.full((len(ties.photo), 10), size, np.int64)
        columns[:, :6] = np.where(at_body[:, None] >= 0, at_body[:, None] + np.arange(6), size)
        if len(camera):
            estimated = sizes[camera] > 0
            columns[:, 6:] = np.where(estimated[:, None], of_camera[camera][:, None] + np.arange(4), size)
        at_scan = of_body[ties.scan]
        columns_s = np.where(at_scan[:, None] >= 0, at_scan[:, None] + np.arange(6), size)

        rows_J = _sparse(J.reshape(-1, 10), np.repeat(columns, 2, axis=0), size)
        rows_s = _sparse(Ks, columns_s, size)
        cross = np.einsum("nia,nib->nab", J, Jx)
        cross_s = np.einsum("ka,kb->kab", Ks, Kx)
        mixed = _mixed(cross, columns, ties.point, size, count) + _mixed(cross_s, columns_s, ties.on_point, size, count)
        H_yy = (rows_J.T @ rows_J + rows_s.T @ rows_s).toarray()
        b_y = rows_J.T @ off.ravel() + rows_s.T @ off_s

        of_relative, right, relative_weights, cost = _of_relative(problem, of_body, of_camera, size, width)
        solved = mixed @ _block_diagonal(inverse)
        S = H_yy + of_relative - (solved @ mixed.T).toarray()
        g = b_y + right - solved @ b_x.ravel()
        cost += float(_loss(r2[seen], width * _WIDTH).sum() + _loss(d2, width * _WIDTH).sum())
        kept, kept_s = w > _WORST_LOST, v > _WORST_LOST
        dof = 2 * kept.sum() + kept_s.sum() - 3 * len(np.unique(ties.point[kept])) + 6 * len(problem.relative) - size
        chi2 = float((w * r2)[kept].sum() + (v * d2)[kept_s].sum() + _of_kept(problem, relative_weights))
        return _System(
            problem, cost, S, g, mixed, inverse, b_x, rows_J, rows_s, off.ravel(), off_s, of_relative, residual, w, v,
            relative_weights, chi2 / max(int(dof), 1),
        )  # fmt: skip

    def step(self, damping: float) -> tuple[Matrix, Matrix]:
        """Return the step of the unknowns (Y,) and of the points (P, 3)."""
        from scipy.linalg import cho_factor, cho_solve

        S = self.reduced + damping * np.diag(np.diag(self.reduced))
        y = cho_solve(cho_factor(S), self.right) if len(S) else np.zeros(0)
        back = self.right_points - (self.mixed.T @ y).reshape(-1, 3)
        return np.asarray(y), np.einsum("pij,pj->pi", self.inverse, back)

    def covariance(self) -> Matrix:
        """Return the scatter of the solutions without one region each, and of what states its own covariance.

        To first order, leaving out a region with the score g and the information S_k moves the solution by
        (S - S_k)^-1 g: the jackknife, whose middle is the sandwich, and which counts that residuals are small where
        few regions determine a pose. It is never less than what independent ties would give, if all counted less by as
        much as regions scatter more: a close-up lies in one region or two, which say nothing of their own scatter.
        """
        from scipy.linalg import cho_factor, cho_solve

        if not len(self.reduced):
            return np.zeros((0, 0))
        bread = cho_solve(cho_factor(self.reduced), np.eye(len(self.reduced)))
        ties = self.problem.ties
        region = regions(ties.points)
        count = int(region.max(initial=-1)) + 1
        if not count:
            return np.asarray(bread)
        shifts, scores = np.zeros((len(bread), count)), np.zeros((len(bread), count))
        for k in range(count):
            own, g = self._of_points(region == k)
            scores[:, k] = g
            shifts[:, k] = cho_solve(cho_factor(self.reduced - _LEFT_OUT * own), g)
        by_region = shifts @ shifts.T * (1 - 1 / count) + bread @ self.of_relative @ bread
        # How much more the scores of whole regions scatter than those of independent ties would.
        of_ties = self.reduced - self.of_relative
        alike = np.einsum("ik,ij,jk->", scores, bread, scores) / max(np.sum(bread * of_ties), np.finfo(float).tiny)
        least = of_ties / max(float(alike), 1.0) + self.of_relative
        return _no_less(by_region, cho_solve(cho_factor(least), np.eye(len(least))))

    def _of_points(self, chosen: BoolArray) -> tuple[Matrix, Matrix]:
        """Return the information (Y, Y) of some points (P,) and their ties, and their score (Y,)."""
        ties = self.problem.ties
        seen, on = chosen[ties.point], chosen[ties.on_point]
        rows, rows_s = self.by_ties[np.repeat(seen, 2)], self.by_surfaces[on]
        at = np.flatnonzero(chosen)
        mixed = self.mixed[:, (3 * at[:, None] + np.arange(3)).ravel()]
        own = (rows.T @ rows + rows_s.T @ rows_s - mixed @ _block_diagonal(self.inverse[at]) @ mixed.T).toarray()
        g = rows.T @ self.off[np.repeat(seen, 2)] + rows_s.T @ self.off_surfaces[on]
        return np.asarray(own), np.asarray(g)


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


def _sparse(rows: Matrix, columns: IntArray, size: int) -> csr_matrix:
    """Return rows (N, C) at columns (N, C) of a matrix (N, size); the column `size` is dropped."""
    from scipy.sparse import csr_matrix

    at = np.repeat(np.arange(len(rows)), rows.shape[1])
    whole = csr_matrix((rows.ravel(), (at, columns.ravel())), shape=(len(rows), size + 1))
    return whole[:, :size]


def _mixed(blocks: Matrix, columns: IntArray, point: IntArray, size: int, count: int) -> csr_matrix:
    """Return blocks (N, C, 3) at rows (N, C) and the columns of points (N,), of (size, 3 count)."""
    from scipy.sparse import csr_matrix

    n, c = columns.shape
    rows = np.repeat(columns.ravel(), 3)
    at = (3 * point[:, None, None] + np.arange(3)).repeat(c, axis=1).ravel()
    return csr_matrix((blocks.reshape(n * c * 3), (rows, at)), shape=(size + 1, 3 * count))[:size]


def _block_diagonal(blocks: Matrix) -> csr_matrix:
    from scipy.sparse import csr_matrix

    count = len(blocks)
    rows = np.repeat(np.arange(3 * count), 3)
    columns = (3 * np.arange(count)[:, None, None] + np.arange(3)).repeat(3, axis=1).ravel()
    return csr_matrix((blocks.ravel(), (rows, columns)), shape=(3 * count, 3 * count))
