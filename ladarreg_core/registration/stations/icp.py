"""Alignment of two scans by their nearest surfaces, point to plane, from a pose that is off by up to half a metre."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.frames import Rigid, rotvec_from_rotation
from ladarreg_core.registration.stations.surfels import Surfels

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

GATES_M = (0.6, 0.4, 0.3, 0.2, 0.15, 0.1, 0.08, 0.06)
"""Largest distance of a surface from its partner, in turn."""
_SAME_FACING = 0.7  # cosine
_STEPS = 2
_SIGMA_UPRIGHT_RAD = float(np.radians(1.5))
_MIN_PARTNERS = 30


@dataclass(frozen=True, slots=True, eq=False)
class Target:
    """The surfaces that others are aligned to."""

    surfels: Surfels
    tree: cKDTree

    @staticmethod
    def of(surfels: Surfels) -> Target:
        """Return the target of a scan's surfaces."""
        from scipy.spatial import cKDTree

        return Target(surfels, cKDTree(surfels.points))


def aligned(
    target: Target, points: FloatArray, normals: FloatArray, start: Rigid, *, gates_m: tuple[float, ...] = GATES_M,
    sigma_upright_rad: float = _SIGMA_UPRIGHT_RAD,
) -> Rigid:  # fmt: skip
    """Return the pose of points with normals (N, 3), in their own frame, that brings them to the target's surfaces.

    Args:
        target: the surfaces.
        points: m.
        normals: unit.
        start: where to begin, `target_from_points`.
        gates_m: as `GATES_M`.
        sigma_upright_rad: how far either scanner's axis may be from the plumb line, 1 sigma.

    Source: Chen and Medioni 1992; Tukey's weight within the gate.
    """
    pose = start
    sigma_m = target.surfels.spacing_m * 0.3
    for gate in gates_m:
        for _ in range(_STEPS):
            moved, facing = pose @ points, normals @ pose.rotation.T
            distance, near = target.tree.query(moved, distance_upper_bound=1.5 * gate + target.surfels.spacing_m)
            found = np.isfinite(distance)
            index = near[found]
            moved, facing = moved[found], facing[found]
            n = target.surfels.normals[index]
            off = ((moved - target.surfels.points[index]) * n).sum(-1)
            scale = max(gate, 3 * sigma_m)
            use = ((n * facing).sum(-1) > _SAME_FACING) & (np.abs(off) < scale)
            if use.sum() < _MIN_PARTNERS:
                break
            n, off, moved = n[use], off[use], moved[use]
            weight = (1 - (off / scale) ** 2) ** 2 / sigma_m**2
            J = np.concatenate([np.cross(moved, n), n], axis=-1)
            H, g = (J * weight[:, None]).T @ J, (J * weight[:, None]).T @ off
            # Both stand upright: what is turned about a level axis is held, more loosely the more is seen.
            lean = rotvec_from_rotation(_leaning(pose))
            hold = len(off) / 100 / sigma_upright_rad**2
            H[0, 0] += hold
            H[1, 1] += hold
            g[:2] += hold * lean[:2]
            H[range(6), range(6)] += 1e-6 * np.trace(H)
            step = -np.linalg.solve(H, g)
            pose = Rigid.from_rotvec(step[:3], step[3:]) @ pose
    return pose


def _leaning(pose: Rigid) -> FloatArray:
    """Return the rotation (3, 3) that remains when the yaw is taken from a pose."""
    R = pose.rotation
    yaw = np.arctan2(R[1, 0] - R[0, 1], R[0, 0] + R[1, 1])
    c, s = np.cos(yaw), np.sin(yaw)
    return np.asarray(R @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]]))
