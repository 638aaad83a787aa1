"""Whether one single pick holds a pose that all others leave loose: a slip of it would go unseen.

A pick that nothing else checks has no residual, however wrong it is. Without pick k, A its part of the information H,

    covariance = (H - A)^-1

Source: Cook and Weisberg, Residuals and influence in regression (1982), for deletion; the system is that of `bundle`.
"""

from __future__ import annotations

import numpy as np

from ladarreg_core.arrays import BoolArray
from ladarreg_core.matches import Matches
from ladarreg_core.pose.bundle import UNSEEN, Measurements, States, linearise, residuals

_LEAST_OF_OWN = 1e-13
_LEAST_LEVERAGE = 0.9
_MOST_GROWTH = 6.0  # of a standard deviation without the pick: nothing else sees a slip of it


def single_hold(
    measured: Measurements,
    matches: Matches,
    state: States,
    inliers: BoolArray,
    *,
    most_angle_rad: float,
    most_position_m: float,
) -> str | None:
    """Return the pick without which the others determine the pose no better than this, or None.

    Args:
        measured: all matches.
        matches: the same.
        state: the pose (B = 1).
        inliers: (M,) those that agree.
        most_angle_rad: largest standard deviation of the rotation that is still a pose.
        most_position_m: of the camera centre.
    """
    seen = residuals(measured, state)
    lin = linearise(measured, state, seen)
    counts = inliers & (seen.s[0] < UNSEEN)
    share = lin.m[0] / lin.h[0]
    diagonal = measured.information - lin.m[0] * share
    cross = measured.cross_information - lin.m[0, :1] * share[1:]
    J = lin.j_pose[0]  # (6, 2, N)
    each = np.einsum("aen,ben->nab", diagonal * J + cross * J[:, ::-1], J) * counts[:, None, None]
    names, pick = np.unique(np.asarray(matches.pick_ids), return_inverse=True)
    parts = np.zeros((len(names), 6, 6))
    np.add.at(parts, pick, each)
    H = parts.sum(axis=0)
    unit = 1 / np.sqrt(np.maximum(np.diag(H), 1e-300))
    whole, axes = np.linalg.eigh(H * np.outer(unit, unit))
    inverse = (axes / np.maximum(whole, _LEAST_OF_OWN)) @ axes.T
    # a standard deviation grows only where a pick has nearly all the information of some direction
    leverage = np.einsum("kab,ab->k", parts * np.outer(unit, unit), inverse)
    heavy = np.flatnonzero(leverage > _LEAST_LEVERAGE)
    if not len(heavy):
        return None
    values, vectors = np.linalg.eigh((H - parts[heavy]) * np.outer(unit, unit))
    variance = np.einsum("kab,kb->ka", vectors**2, 1 / np.maximum(values, _LEAST_OF_OWN)) * unit**2
    angle, position = np.sqrt(variance[:, :3].sum(axis=1)), np.sqrt(variance[:, 3:].sum(axis=1))
    beyond = np.maximum(angle / most_angle_rad, position / most_position_m)
    with_all = np.diag(inverse) * unit**2
    grown = np.maximum(angle / np.sqrt(with_all[:3].sum()), position / np.sqrt(with_all[3:].sum()))
    worst = int(np.argmax(np.maximum(beyond, grown / _MOST_GROWTH)))
    return str(names[heavy[worst]]) if max(beyond[worst], grown[worst] / _MOST_GROWTH) > 1 else None
