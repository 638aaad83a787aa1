"""Graduated non-convexity: a cost that starts wide and closes until mismatches no longer count.

Source: Blake and Zisserman, Visual Reconstruction (1987), with the Geman-McClure function; Yang et al., Graduated
non-convexity for robust spatial perception (2020).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ladarreg_core.arrays import BoolArray, FloatArray, IntArray
from ladarreg_core.pose.bundle import Cost, Descent, Measurements, States, Weigh, settle


@dataclass(frozen=True, slots=True)
class GncOptions:
    """How the cost closes."""

    divide_by: float = 3.0
    """The scale's factor from one step to the next."""
    narrow: float = 10.0
    """The narrow start's scale, over the gate."""
    wide: float = 4.0
    """The wide start's scale, over the median s."""
    last_steps: int = 12
    """Steps after the scale has closed, at most."""
    tolerance_sigma: float = 0.1
    """It ends when no pose moves further than this many of its standard deviations."""


DEFAULT_GNC = GncOptions()
_WIDEST = 1e9
_ALMOST = 1.5
_STEPS, _FIRST_STEPS = 20, 2  # starts are gathered after the first
_SETTLED_SIGMA = 1.0  # on a sample; the places are settled on all matches later
_NEAR_RAD, _NEAR_OF_DISTANCE = np.deg2rad(0.5), 0.01  # starts so near to each other go on as one


def geman_mcclure(scale: float | FloatArray) -> tuple[Weigh, Cost]:
    """Return the weights and the cost of the Geman-McClure function of a scale, () or (B, 1), in units of s."""

    def weigh(s: FloatArray) -> FloatArray:
        ratio = scale / (scale + s)
        return np.asarray(ratio * ratio)

    def cost(s: FloatArray) -> FloatArray:
        return np.asarray((scale * (s / (scale + s))).sum(axis=-1))

    return weigh, cost


def narrow_scales(states: States, gate: float, options: GncOptions = DEFAULT_GNC) -> FloatArray:
    """Return the scales (B,) of narrow starts: right where the start is good, whatever the share of mismatches."""
    return np.full(len(states.centres), options.narrow * gate)


def wide_scales(measured: Measurements, states: States, gate: float, options: GncOptions = DEFAULT_GNC) -> FloatArray:
    """Return the scales (B,) of wide starts: right where the start is poor and most matches are true."""
    _, seen = settle(measured, states, rounds=1)
    return np.asarray(np.clip(options.wide * np.median(seen.s, axis=1), gate, _WIDEST))


def graduate(
    measured: Measurements, states: States, scales: FloatArray, gate: float, options: GncOptions = DEFAULT_GNC
) -> tuple[States, FloatArray]:
    """Descend from each start while its scale closes to the gate.

    Args:
        measured: what is fitted.
        states: the starts, B of them.
        scales: (B,) where each start's scale begins, in units of s.
        gate: where every scale ends: the largest s of an inlier.
        options: how it closes.

    Returns:
        The states, and their truncated scores sum min(s, gate) (B,).
    """
    descent = Descent.start(measured, states)
    mu = np.maximum(np.asarray(scales, dtype=np.float64), gate)[:, None]
    while (mu > gate).any():
        descent.step(*geman_mcclure(mu))
        mu = mu / options.divide_by
        mu = np.where(mu < _ALMOST * gate, gate, mu)  # a stage just above the gate would be the last one twice
    for _ in range(options.last_steps):
        descent.step(*geman_mcclure(mu))
        if (descent.moved_sigma < options.tolerance_sigma).all():
            break
    return descent.states, truncated_score(descent.seen.s, gate)


def truncated_score(s: FloatArray, gate: float) -> FloatArray:
    """Return sum min(s, gate) over the last axis: lower is better, and a mismatch costs the same however bad."""
    return np.asarray(np.minimum(s, gate).sum(axis=-1))


def descended(few: Measurements, starts: States, *, gate: float, reach: float) -> tuple[States, IntArray]:
    """Return where starts end on a sample, and in which of those ends each start (B,) does.

    Starts that have come near to each other go on as one.
    """
    descent = Descent.start(few, starts)
    mu = np.maximum(_typical(descent.seen.s), DEFAULT_GNC.narrow * gate)[:, None]
    end_of: IntArray = np.arange(len(mu))
    for k in range(_STEPS):
        descent.step(*geman_mcclure(mu))
        if k >= _FIRST_STEPS and len(mu) > 1:
            near = near_pairs(descent.states, _NEAR_RAD, _NEAR_OF_DISTANCE * reach)
            label, leaders = gathered(near, truncated_score(descent.seen.s, gate))
            if len(leaders) < len(mu):
                end_of, mu = label[end_of], mu[leaders]
                descent = _of_some(descent, leaders)
        if (mu <= gate).all() and (descent.moved_sigma < _SETTLED_SIGMA).all():
            break
        # as `graduate` closes, and at once where the data already fit better than that
        mu = np.minimum(mu / DEFAULT_GNC.divide_by, _typical(descent.seen.s)[:, None])
        mu = np.where(mu < _ALMOST * gate, gate, mu)
    return descent.states, end_of


def _typical(s: FloatArray) -> FloatArray:
    """Return the scale (B,) that counts most matches."""
    middle = s.shape[1] // 2
    return np.asarray(np.minimum(DEFAULT_GNC.wide * np.partition(s, middle, axis=1)[:, middle], _WIDEST))


def _of_some(descent: Descent, starts: IntArray) -> Descent:
    """Return the descent of some of the starts, where it stands."""
    some = Descent.start(descent.measured, descent.states.subset(starts))
    some.damping, some.moved_sigma = descent.damping[starts], descent.moved_sigma[starts]
    return some


def near_pairs(states: States, angle_rad: float, distance_m: float) -> BoolArray:
    """Return which states (B, B) are no further apart than this."""
    R = states.rotations.reshape(-1, 9)
    apart = states.centres[:, None] - states.centres
    near = np.cos(angle_rad) <= (R @ R.T - 1) / 2
    return np.asarray(near & ((apart * apart).sum(axis=-1) <= distance_m**2))


def gathered(near: BoolArray, scores: FloatArray) -> tuple[IntArray, IntArray]:
    """Return the group (B,) of each state, and the leaders (G,): the best gathers what is near it, then the next.

    Args:
        near: (B, B) which states belong to each as its leader.
        scores: (B,) lower is better; groups are in this order.
    """
    group = np.full(len(scores), -1)
    leaders: list[int] = []
    for k in np.argsort(scores, kind="stable").tolist():
        if group[k] < 0:
            group[near[k] & (group < 0)] = group[k] = len(leaders)
            leaders.append(k)
    return group, np.array(leaders, dtype=np.intp)
