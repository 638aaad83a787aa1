"""Many starts descended at once, those that meet going on as one."""

from __future__ import annotations

import numpy as np

from ladarreg_core.arrays import BoolArray, FloatArray, IntArray
from ladarreg_core.pose.bundle import Descent, Measurements, States
from ladarreg_core.pose.gnc import DEFAULT_GNC, truncated_score

_STEPS, _FIRST_STEPS = 20, 2  # starts are gathered after the first
_SETTLED_SIGMA = 1.0  # on a sample; the places are settled on all matches later
_NEAR_RAD, _NEAR_OF_DISTANCE = np.deg2rad(0.5), 0.01  # starts so near to each other go on as one
_WIDEST, _ALMOST = 1e9, 1.5  # as in `gnc`


def joined(a: States, b: States) -> States:
    """Return the states of both, a first."""
    return States(*(np.concatenate([getattr(a, name), getattr(b, name)]) for name in ("rotations", "centres", "rho")))


def descended(few: Measurements, starts: States, *, gate: float, reach: float) -> tuple[States, IntArray]:
    """Return where starts end on a sample, and in which of those ends each start (B,) does.

    Starts that have come near to each other go on as one.
    """
    descent = Descent.start(few, starts)
    mu = np.maximum(_typical(descent.seen.s), DEFAULT_GNC.narrow * gate)[:, None]
    end_of: IntArray = np.arange(len(mu))

    def weigh(s: FloatArray) -> FloatArray:
        ratio = mu / (mu + s)
        return np.asarray(ratio * ratio)

    def cost(s: FloatArray) -> FloatArray:
        return np.asarray((mu * (s / (mu + s))).sum(axis=-1))

    for k in range(_STEPS):
        descent.step(weigh, cost)
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
