"""Scatter between lines drawn by hand: what their residuals do not show of the error of a pose.

The two ends of a line are not two measurements: whoever takes the wrong edge of a shelf for the right one errs alike at
both. So most of the covariance of independent ends is added once more, as if one end of a line said what the other one
says. The lines themselves are independent; how far the pose moves when each is left out in turn adds what they disagree
by:

    d_k = (H - A_k)^-1 g_k,    sum of d_k d_k^T (n - 1) / n

with the information H and the part A_k and gradient g_k of line k. It counts twice: what one line in ten does wrong
shows in few of the lines that are left out.

Both factors are from simulated hands (`benchmarks.drawn_hands`).

Source: Bell and McCaffrey, Bias reduction in standard errors for linear regression with multi-stage samples (2002);
Efron, The jackknife, the bootstrap and other resampling plans (1982).
"""

from __future__ import annotations

import numpy as np

from ladarreg_core.foundations.arrays import BoolArray, FloatArray
from ladarreg_core.matches import Matches
from ladarreg_core.pose.acceptance import information_of, parts_of_information
from ladarreg_core.pose.estimators.bundle import Evaluation
from ladarreg_core.pose.estimators.covariance import guarded_inverse

_SHARED_BY_ENDS = 0.8
_BETWEEN_LINES = 2.0
_MIN_SIGMA_PX = 0.5
"""Noise of the most careful hand, px."""
_MIN_LEFT = 0.02
"""Least information that the other lines count as having in any direction, as a share of that of all."""


def scatter_between_lines(at: Evaluation, matches: Matches, inliers: BoolArray, *, sigma_px: float) -> FloatArray:
    """Return what is to be added to the covariance (6, 6) of a pose that was fitted to drawn lines.

    Args:
        at: all matches at the pose.
        matches: the same matches; those of one pick are left out together.
        inliers: (M,) bool, the matches that the pose was fitted to.
        sigma_px: the noise that was estimated from them, px; below a floor, it is that of a lucky hand.
    """
    J, K = parts_of_information(at, inliers)
    H, unit, inverse = information_of(J, K)
    square = np.outer(unit, unit)
    e = at.seen.e[0] - at.lin.j[0] * at.seen.range_error[0]  # at the measured range
    _, pick = matches.numbered_picks()
    used = np.unique(pick[inliers])
    moves = []
    for k in used:
        mine = pick == k
        A = K[..., mine].reshape(6, -1) @ J[..., mine].reshape(6, -1).T
        g = K[..., mine].reshape(6, -1) @ e[:, mine].ravel()
        moves.append(guarded_inverse((H - A) * square, least=_MIN_LEFT) * square @ g)
    d = np.array(moves).reshape(-1, 6)
    between = d.T @ d * (len(used) - 1) / max(len(used), 1)
    below_floor = max((_MIN_SIGMA_PX / sigma_px) ** 2 - 1, 0.0)
    return np.asarray((_SHARED_BY_ENDS + below_floor) * inverse * square + _BETWEEN_LINES * between)
