"""The pose that mismatches have in common, where they are no accident: a window on, a shelf higher."""

from __future__ import annotations

import numpy as np

from ladarreg_core.arrays import BoolArray
from ladarreg_core.camera import Camera
from ladarreg_core.frames import Rigid
from ladarreg_core.matches import Matches
from ladarreg_core.pose.bundle import Measurements, States, settle
from ladarreg_core.pose.ransac import sample_pose

_RANSAC_SIGMA = 6.0
_RANSAC_ITERATIONS = 500
_RIVAL_SHARE, _LEAST_RIVAL = 0.5, 5


def pose_of_the_others(
    matches: Matches, measured: Measurements, others: BoolArray, camera: Camera, *, sigma_px: float, seed: int = 0
) -> Rigid | None:
    """Return a pose of matches that disagree with another, where they are enough to matter.

    Args:
        matches: M matches.
        measured: the same.
        others: (M,) those that disagree.
        camera: intrinsics.
        sigma_px: pixel noise, px.
        seed: of the samples.
    """
    count = int(np.count_nonzero(others))
    if count < least_rival(len(others) - count):
        return None
    ideal = camera.without_distortion()
    uv = (measured.xy[:, others] * [[ideal.fx], [ideal.fy]] + [[ideal.cx], [ideal.cy]]).T
    return sample_pose(
        matches.points[others], uv, ideal, threshold_px=_RANSAC_SIGMA * sigma_px, iterations=_RANSAC_ITERATIONS,
        seed=seed,
    )  # fmt: skip


def rival_of_the_others(
    matches: Matches, measured: Measurements, inliers: BoolArray, camera: Camera, *, sigma_px: float, gate: float
) -> Rigid | None:
    """Return a pose that half as many of the other matches agree on as agree with the pose found, or None.

    Args:
        matches: M matches.
        measured: the same.
        inliers: (M,) those that agree with the pose found.
        camera: intrinsics.
        sigma_px: pixel noise, px.
        gate: largest s of a match that agrees.
    """
    pose = pose_of_the_others(matches, measured, ~inliers, camera, sigma_px=sigma_px)
    if pose is None:
        return None
    _, seen = settle(measured, States.of([pose], measured))
    agree = int(np.count_nonzero((seen.s[0] <= gate) & ~inliers))
    return pose if agree >= least_rival(int(np.count_nonzero(inliers))) else None


def least_rival(agree: int) -> int:
    """Return how many other matches must agree on another pose to be no chance beside these."""
    return max(_LEAST_RIVAL, int(np.ceil(_RIVAL_SHARE * agree)))
