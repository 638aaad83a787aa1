"""Graduated non-convexity: a cost that starts wide and closes until mismatches no longer count.

Source: Blake and Zisserman, Visual Reconstruction (1987), with the Geman-McClure function; Yang et al., Graduated
non-convexity for robust spatial perception (2020).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ladarreg_core.arrays import FloatArray
from ladarreg_core.pose.bundle import Descent, Measurements, States, settle


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

    def weigh(s: FloatArray) -> FloatArray:
        ratio = mu / (mu + s)
        return np.asarray(ratio * ratio)

    def cost(s: FloatArray) -> FloatArray:
        return np.asarray((mu * (s / (mu + s))).sum(axis=-1))

    while (mu > gate).any():
        descent.step(weigh, cost)
        mu = mu / options.divide_by
        mu = np.where(mu < _ALMOST * gate, gate, mu)  # a stage just above the gate would be the last one twice
    for _ in range(options.last_steps):
        descent.step(weigh, cost)
        if (descent.moved_sigma < options.tolerance_sigma).all():
            break
    return descent.states, truncated_score(descent.seen.s, gate)


def truncated_score(s: FloatArray, gate: float) -> FloatArray:
    """Return sum min(s, gate) over the last axis: lower is better, and a mismatch costs the same however bad."""
    return np.asarray(np.minimum(s, gate).sum(axis=-1))
