"""Graduated non-convexity: a robust cost whose scale shrinks until outliers no longer count.

Source: Blake and Zisserman, Visual Reconstruction (1987), with the Geman-McClure function; Yang et al., Graduated
non-convexity for robust spatial perception (2020).
"""

from __future__ import annotations

import numpy as np

from ladarreg_core.foundations.arrays import BoolArray, FloatArray, IntArray
from ladarreg_core.pose.estimators.bundle import CostFunction, Descent, States, adjust_ranges
from ladarreg_core.pose.estimators.measurements import Measurements

DIVIDE_BY = 3.0
"""Factor by which the scale shrinks from one step to the next."""
_TOLERANCE_SIGMA = 0.1  # iteration stops when no pose moves by more than this many of its standard deviations
_NARROW, _WIDE = 10.0, 4.0  # initial scales: of a narrow start relative to the gate, of a wide one to the median s
_WIDEST = 1e9
_CLOSED = 1.5
_STEPS, _FIRST_STEPS = 20, 2  # starts are merged after the first steps
_SETTLED_SIGMA = 1.0  # on a sample; the final states are refined on all matches by the caller
_NEAR_RAD, _NEAR_OF_DISTANCE = np.deg2rad(0.5), 0.01  # starts within these are merged


def geman_mcclure(scale: float | FloatArray) -> CostFunction:
    """Return the cost function of Geman-McClure for a scale, () or (B, 1), in units of s."""

    def cost(s: FloatArray) -> tuple[FloatArray, FloatArray]:
        ratio = scale / (scale + s)
        return ratio * ratio, (scale * (s * ratio)).sum(axis=-1)

    return cost


def narrow_scales(states: States, gate: float) -> FloatArray:
    """Return the scales (B,) of narrow starts, for good starting poses and any share of outliers."""
    return np.full(len(states.centres), _NARROW * gate)


def wide_scales(measured: Measurements, states: States, gate: float) -> FloatArray:
    """Return the scales (B,) of wide starts, for poor starting poses and mostly inliers."""
    _, seen = adjust_ranges(measured, states, rounds=1)
    return np.asarray(np.clip(_WIDE * np.median(seen.s, axis=1), gate, _WIDEST))


def graduate(
    measured: Measurements, states: States, scales: FloatArray, gate: float, *, last_steps: int = 12
) -> tuple[States, FloatArray]:
    """Refine starting poses while the scale of each shrinks to the gate.

    Args:
        measured: the matches.
        states: B starting poses.
        scales: (B,) initial scales, in units of s.
        gate: final scale: the largest cost s of an inlier.
        last_steps: maximum number of steps after the scale has reached the gate.

    Returns:
        The refined states, and their truncated scores sum min(s, gate) (B,).
    """
    descent = Descent.start(measured, states)
    mu = np.maximum(np.asarray(scales, dtype=np.float64), gate)[:, None]
    while (mu > gate).any():
        descent.step(geman_mcclure(mu))
        mu = mu / DIVIDE_BY
        mu = np.where(mu < _CLOSED * gate, gate, mu)  # a scale just above the gate would repeat the last one
    cost = geman_mcclure(mu)
    for _ in range(last_steps):
        descent.step(cost)
        if (descent.step_sigma < _TOLERANCE_SIGMA).all():
            break
    return descent.states, truncated_score(descent.residuals.s, gate)


def truncated_score(s: FloatArray, gate: float) -> FloatArray:
    """Return sum min(s, gate) over the last axis: lower is better, and every outlier costs the same."""
    return np.asarray(np.minimum(s, gate).sum(axis=-1))


def graduate_merging(few: Measurements, starts: States, *, gate: float, reach: float) -> tuple[States, IntArray]:
    """Refine starting poses on a sample of the matches, merging those that converge.

    Args:
        few: the sample.
        starts: B starting poses.
        gate: largest cost s of an inlier.
        reach: distance of the matches from the camera, m.

    Returns:
        The final states, and the index of the final state of each start (B,).
    """
    descent = Descent.start(few, starts)
    mu = np.maximum(_scale(descent.residuals.s), _NARROW * gate)[:, None]
    end_of: IntArray = np.arange(len(mu))
    for k in range(_STEPS):
        descent.step(geman_mcclure(mu))
        if k >= _FIRST_STEPS and len(mu) > 1:
            near = near_pairs(descent.states, _NEAR_RAD, _NEAR_OF_DISTANCE * reach)
            label, leaders = group_by_leader(near, truncated_score(descent.residuals.s, gate))
            if len(leaders) < len(mu):
                end_of, mu = label[end_of], mu[leaders]
                descent = _subset(descent, leaders)
        if (mu <= gate).all() and (descent.step_sigma < _SETTLED_SIGMA).all():
            break
        # as in `graduate`, but shrink at once where the data already fit better
        mu = np.minimum(mu / DIVIDE_BY, _scale(descent.residuals.s)[:, None])
        mu = np.where(mu < _CLOSED * gate, gate, mu)
    return descent.states, end_of


def _scale(s: FloatArray) -> FloatArray:
    """Return the scale (B,) at which most matches count."""
    middle = s.shape[1] // 2
    return np.asarray(np.minimum(_WIDE * np.partition(s, middle, axis=1)[:, middle], _WIDEST))


def _subset(descent: Descent, starts: IntArray) -> Descent:
    """Return the descent of some of the starts in its current state."""
    some = Descent.start(descent.measured, descent.states.subset(starts))
    some.damping, some.step_sigma = descent.damping[starts], descent.step_sigma[starts]
    return some


def near_pairs(states: States, angle_rad: float, distance_m: float) -> BoolArray:
    """Return which pairs of states (B, B) are within an angle and a distance of each other."""
    R = states.rotations.reshape(-1, 9)
    apart = states.centres[:, None] - states.centres
    near = np.cos(angle_rad) <= (R @ R.T - 1) / 2
    return np.asarray(near & ((apart * apart).sum(axis=-1) <= distance_m**2))


def group_by_leader(near: BoolArray, scores: FloatArray) -> tuple[IntArray, IntArray]:
    """Group states greedily: the best state takes all states near it, then the next best of the rest.

    Args:
        near: (B, B) states near each leader.
        scores: (B,) lower is better; groups are in this order.

    Returns:
        The group of each state (B,), and the leader of each group (G,).
    """
    group = np.full(len(scores), -1)
    leaders: list[int] = []
    for k in np.argsort(scores, kind="stable").tolist():
        if group[k] < 0:
            group[near[k] & (group < 0)] = group[k] = len(leaders)
            leaders.append(k)
    return group, np.array(leaders, dtype=np.intp)
