"""Scenes, poses and errors that the rows of stations share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.frames import Rigid, rotvec_from_rotation
from ladarreg_core.simulate.stations import upright_pose

SCENES = ("office", "boxes", "people", "desk", "plain")
FIRST_SEED = 7000
Show = Callable[[str], None]


def random_pose(rng: np.random.Generator, xy: FloatArray | Sequence[float], yaw: float | None = None) -> Rigid:
    lean = rng.normal(0, 0.008, 2)
    turn = rng.uniform(-np.pi, np.pi) if yaw is None else yaw
    return upright_pose(np.array([xy[0], xy[1], rng.uniform(-0.1, 0.2)]), turn, (float(lean[0]), float(lean[1])))


def pose_error(truth: Rigid, pose: Rigid, covariance: FloatArray) -> tuple[float, float, float]:
    """Return the error in mm and deg, and the Mahalanobis distance / sqrt 6."""
    turn = rotvec_from_rotation(truth.rotation @ pose.rotation.T)
    error = np.concatenate([turn, truth.translation - pose.translation])
    known = bool(np.isfinite(covariance).all())
    distance = float(np.sqrt(error @ np.linalg.solve(covariance, error) / 6)) if known else float("nan")
    return 1000 * float(np.linalg.norm(error[3:])), float(np.degrees(np.linalg.norm(turn))), distance


def rms(found: Sequence[dict[str, Any]]) -> float:
    return float(np.sqrt(np.mean(np.square([d for one in found for d in one["distances"]])))) if found else np.nan
