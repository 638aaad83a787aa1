"""Poses that only a flat scene has: those between its two, and where its likelihood's own minimum lies.

Source: Schweighofer and Pinz, Robust pose estimation from a planar target (2006), for the two poses.
"""

from __future__ import annotations

import numpy as np

from ladarreg_core.arrays import FloatArray
from ladarreg_core.frames import Rigid, rotation_from_rotvec, rotvec_from_rotation
from ladarreg_core.pose.ambiguity import mirrored
from ladarreg_core.pose.bundle import (
    Measurements,
    States,
    linearise,
    normal_equations,
    residuals,
    rotations_from_rotvecs,
    settle,
)

_ON_THE_WAY = (0.25, 0.5, 0.75, 1.0)
_GENERALISED_STEPS, _MOST_TURN_RAD = 6, 0.3


def towards_mirrored(pose: Rigid, points: FloatArray) -> list[Rigid]:
    """Return poses on the way to the mirrored one, which keep the points' middle where it is seen.

    Where a plane is seen nearly face on both poses may have grown together to one minimum with a wide floor. They need
    not be minima to tell: six sigma away by the information, and no worse by the likelihood, is another place.
    """
    centroid = points.mean(axis=0)
    seen = pose @ centroid
    turn = rotvec_from_rotation(mirrored(pose, points).rotation @ pose.rotation.T)
    turned = [rotation_from_rotvec(share * turn) @ pose.rotation for share in _ON_THE_WAY]
    return [Rigid(R, seen - R @ centroid) for R in turned]


def generalised(measured: Measurements, states: States, gate: float) -> States:
    """Return where generalised least squares leads from states: the ranges as measured, their noise in the pixels.

    The errors-in-variables minimum of a small plane may lie degrees beside the likelihood's, since it gains by seeing
    the ranges' noise across (`likelihood_scores`); here nothing is gained by that.
    """
    members = (residuals(measured, states).s <= gate).astype(np.float64)
    moving = states
    for _ in range(_GENERALISED_STEPS):
        moving = moving.seeing(measured)
        seen = residuals(measured, moving)
        H, g = normal_equations(measured, seen, linearise(measured, moving, seen), members)
        diagonal = np.einsum("bii->bi", H)
        diagonal += 1e-9 * diagonal + 1e-12 * diagonal.max(axis=1, keepdims=True) + 1e-300
        step = np.nan_to_num(np.linalg.solve(H, g[..., None])[..., 0])
        length = np.linalg.norm(step[:, :3], axis=1, keepdims=True)
        step = step * np.minimum(1, _MOST_TURN_RAD / np.maximum(length, 1e-300))
        moving = States(
            rotations_from_rotvecs(step[:, :3]) @ moving.rotations, moving.centres + step[:, 3:], moving.rho
        )
    return settle(measured, moving.seeing(measured))[0]
