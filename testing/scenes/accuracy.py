"""Accuracy of pose solvers over many cases, relative to the Cramer-Rao bound; the default solver, and its best case."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ladarreg_core.errors import LadarregError
from ladarreg_core.frames import Rigid
from ladarreg_core.matches import Matches
from ladarreg_core.pose.estimate import PoseOptions, solve_pose
from testing.scenes.pose_case import Case, difference

Answer = tuple[Rigid, np.ndarray | None]
"""A pose, and its covariance (6, 6) where one is given."""
Solver = Callable[[Case], "Answer | None"]


SUCCESS_SIGMAS = 6.0
"""Mahalanobis distance to the truth, by the bound, that still counts as a success."""
_RESAMPLED = 400


def default(
    case: Case, *, matches: Matches | None = None, initial: Rigid | None = None, **options: object
) -> Answer | None:
    chosen = PoseOptions(sigma_px=case.sigma_px, sigma_range_m=case.sigma_range_m, **options)  # type: ignore[arg-type]
    try:
        result = solve_pose(matches or case.matches, case.camera, chosen, initial=initial)
    except LadarregError:
        return None
    return result.camera_from_scanner, result.covariance


def known_inliers(case: Case) -> Answer | None:
    return default(case, matches=case.matches.subset(case.true), gate_chi2=1e6)


@dataclass(frozen=True)
class Figures:
    """Accuracy of a solver over many seeds."""

    success: float
    """Share within `SUCCESS_SIGMAS` of the truth."""
    efficiency: float
    """Bound / empirical variance, mean of the six parameters, over the successes."""
    efficiency_error: float
    """Its standard error, by resampling the cases."""
    consistency: float
    """RMS Mahalanobis distance / sqrt 6 by the reported covariance, over the successes; NaN where none is reported."""
    position_mm: float
    """Median over all cases."""
    milliseconds: float
    """Median processor time."""


@dataclass(frozen=True)
class Answers:
    """Poses that a solver found for some cases."""

    found: tuple[Answer | None, ...]
    milliseconds: np.ndarray
    """(N,) processor time."""


def ask(solver: Solver, cases: Sequence[Case]) -> Answers:
    """Solve every case."""
    found, spent = [], []
    for case in cases:
        start = time.process_time()
        found.append(solver(case))
        spent.append(1000 * (time.process_time() - start))
    return Answers(tuple(found), np.array(spent))


def measure(solver: Solver, cases: Sequence[Case]) -> Figures:
    """Measure success, efficiency, consistency and time of a solver over the cases."""
    return figures_of(ask(solver, cases), cases)


def figures_of(answers: Answers, cases: Sequence[Case]) -> Figures:
    """Compute the figures of answers to cases."""
    squares, bounds, distances, position = [], [], [], []
    for case, found in zip(cases, answers.found, strict=True):
        if found is None:
            position.append(np.inf)
            continue
        step, H = difference(case.pose, found[0]), case.bound()
        position.append(float(np.linalg.norm(step[3:])))
        if step @ H @ step > SUCCESS_SIGMAS**2:
            continue
        squares.append(step**2)
        bounds.append(np.diag(np.linalg.inv(H)))
        if found[1] is not None:
            distances.append(step @ np.linalg.solve(found[1], step))
    efficiency, error = _efficiency(np.array(squares), np.array(bounds))
    return Figures(
        len(squares) / len(cases),
        efficiency,
        error,
        float(np.sqrt(np.mean(distances) / 6)) if distances else np.nan,
        1000 * float(np.median(position)),
        float(np.median(answers.milliseconds)),
    )


def _efficiency(squares: np.ndarray, bounds: np.ndarray) -> tuple[float, float]:
    """Return the efficiency and its standard error from squared errors and bounds, (N, 6) each."""
    count = len(squares)
    if count < 2:
        return np.nan, np.nan
    again = np.random.default_rng(0).integers(count, size=(_RESAMPLED, count))
    resampled = (bounds[again].mean(axis=1) / squares[again].mean(axis=1)).mean(axis=1)
    return float(np.mean(bounds.mean(axis=0) / squares.mean(axis=0))), float(resampled.std(ddof=1))


def length_in_sigmas(step: np.ndarray, covariance: np.ndarray) -> float:
    """Return the Mahalanobis length of a step (6,) by a covariance (6, 6)."""
    return float(np.sqrt(step @ np.linalg.solve(covariance, step)))
