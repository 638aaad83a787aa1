"""Cases of pose estimation: matches with their true pose and outliers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ladarreg_core.camera import Camera
from ladarreg_core.frames import Rigid, rotation_from_rotvec, rotvec_from_rotation
from ladarreg_core.matches import Matches
from ladarreg_core.pose.estimators.bundle import States, information_matrix
from ladarreg_core.pose.estimators.measurements import Measurements


@dataclass(frozen=True)
class Case:
    """Matches with their true pose and noise."""

    rays: np.ndarray
    ranges: np.ndarray
    uv: np.ndarray
    camera: Camera
    pose: Rigid
    true: np.ndarray
    """(N,) bool: true matches."""
    sigma_px: float
    sigma_range_m: float

    @property
    def matches(self) -> Matches:
        return Matches(self.rays, self.ranges, self.uv)

    def bound(self) -> np.ndarray:
        """The Fisher information (6, 6) of the true matches at the true pose."""
        measured = Measurements.of(
            self.matches.subset(self.true), self.camera, sigma_px=self.sigma_px, sigma_range_m=self.sigma_range_m
        )
        return information_matrix(measured, States.of([self.pose], measured))[0]


def difference(truth: Rigid, found: Rigid) -> np.ndarray:
    """Return the difference (6,) of two poses: w and c as in `PoseResult.covariance`."""
    return np.concatenate([rotvec_from_rotation(truth.rotation @ found.rotation.T), truth.centre - found.centre])


def start_near(case: Case, seed: int, degrees: float, metres: float) -> Rigid:
    """Return a start at this distance from the truth, in random directions."""
    rng = np.random.default_rng([seed, 5])
    axis, way = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    turn = rotation_from_rotvec(axis * np.deg2rad(degrees))
    return Rigid.from_centre(turn @ case.pose.rotation, case.pose.centre + metres * way)


def picture_difference_px(case: Case, a: Rigid, b: Rigid) -> float:
    """Return the median displacement of the points between two poses, photo pixels."""
    points = case.matches.points
    return float(
        np.nanmedian(np.linalg.norm(case.camera.project(a @ points) - case.camera.project(b @ points), axis=1))
    )
