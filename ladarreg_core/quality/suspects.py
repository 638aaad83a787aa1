"""Matches to be suspected first when a pose fits poorly: those that the robust estimator rejects.

A pose that was fitted to all matches spreads the error of a wrong one over the correct ones, so that neither its
inliers nor its residuals show which one is wrong.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ladarreg_core.errors import LadarregError
from ladarreg_core.foundations.arrays import BoolArray
from ladarreg_core.pose.estimate import PoseOptions, solve_pose
from ladarreg_core.results.registration import PoseResult

_NOT_ROBUST = ("linear", "stereo_simplex", "epipolar_simplex")
_MIN_SHARE = 0.5  # below it the robust pose may itself rest on the wrong matches


@dataclass(frozen=True, slots=True)
class Suspects:
    """Matches that are probably wrong."""

    pick_ids: tuple[str, ...]
    """Picks with an outlier, the largest residual first."""
    by_robust: bool
    """True if they are outliers of the robust estimator although the pose is that of another method."""


def robust_result(result: PoseResult) -> PoseResult:
    """Return a pose whose inliers can be trusted: the pose itself, or the robust one of the same matches.

    Args:
        result: a pose by any method; one that the robust estimator cannot improve on is returned as it is.
    """
    if result.diagnostics.get("method") not in _NOT_ROBUST:
        return result
    options = PoseOptions(intrinsics="fixed", check_ambiguity=False)
    try:
        robust = solve_pose(result.matches, result.camera, options)
    except LadarregError:
        return result
    return robust if np.mean(robust.inliers) >= _MIN_SHARE else result


def suspect_matches(result: PoseResult) -> Suspects:
    """Return the matches to be checked before anything else."""
    robust = robust_result(result)
    pick_ids = _rejected(robust, ~robust.inliers)
    return Suspects(pick_ids, robust is not result and bool(pick_ids))


def agreeing_picks(result: PoseResult) -> dict[str, bool]:
    """Return which picks agree with the robust pose, with all of their matches."""
    robust = robust_result(result)
    found: dict[str, bool] = {}
    for name, inlier in zip(robust.matches.pick_ids, robust.inliers.tolist(), strict=True):
        found[name] = inlier and found.get(name, True)
    return found


def _rejected(result: PoseResult, outliers: BoolArray) -> tuple[str, ...]:
    size = np.nan_to_num(np.linalg.norm(result.residuals_px, axis=1), nan=np.inf)
    index = np.flatnonzero(outliers)
    order = index[np.argsort(-size[index], kind="stable")]
    return tuple(dict.fromkeys(result.matches.pick_ids[k] for k in order.tolist()))
