"""Conditioning of a pose: its uncertainty compared with that of an ideal layout of as many matches.

The ideal layout spreads the matches evenly over the photo, and in range from near to far as in a room. Both
uncertainties come from the Fisher information, so that the comparison holds for any camera, noise and number of
matches.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ladarreg_core.camera import CameraModel
from ladarreg_core.camera.uncertainty import pose_jacobian
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.frames import Rigid
from ladarreg_core.matches import Matches
from ladarreg_core.pose.estimators.bundle import UNSEEN, States, information_matrix, residuals
from ladarreg_core.pose.estimators.measurements import Measurements
from ladarreg_core.pose.preconditions import MIN_MATCHES
from ladarreg_core.results.registration import PoseResult

FAR_OVER_NEAR = 2.8
"""Range ratio of the ideal layout; nine tenths of the matches then span a factor of 2.5, as in a room 2 to 6 m deep."""
_IDEAL_COUNT = 192
_R3 = np.array([0.8191725133961645, 0.6710436067037893, 0.5497004779019703])
_UNDETERMINED = 1e-12  # of the largest eigenvalue; below it rounding dominates
_CONTRIBUTES = 0.5  # of the largest component
_MOTIONS = (
    "tilting up or down",
    "turning about the vertical",
    "rolling",
    "moving sideways",
    "moving up or down",
    "moving forward or backward",
)


@dataclass(frozen=True, slots=True)
class Conditioning:
    """Cost of the layout of the matches, relative to an ideal layout."""

    position_cost: float
    """Standard deviation of the camera position over that of the ideal layout; infinite where undetermined."""
    picture_cost: float
    """The same ratio for pixel positions, median over the photo."""
    ratio: float
    """Standard deviation of the worst determined motion over that of the best, lengths in mean ranges (rad)."""
    ideal_ratio: float
    """The same ratio for the ideal layout; it exceeds 1, since panning resembles moving sideways."""
    worst_motion: str
    """The worst determined motion in camera axes: 'moving forward or backward', or two that are confounded."""


def assess_conditioning(result: PoseResult) -> Conditioning | None:
    """Compare the inliers with an ideal layout; None with fewer than 4 visible inliers, or where the photo sees
    nothing.

    Args:
        result: a pose with its matches, their noise and inliers.
    """
    camera, pose = result.camera, result.camera_from_scanner
    if np.count_nonzero(result.inliers) < MIN_MATCHES:
        return None
    matches = result.matches.subset(result.inliers)
    measured = Measurements.of(matches, camera, sigma_px=result.sigma_px, sigma_range_m=result.sigma_range_m)
    seen = residuals(measured, States.of([pose], measured)).s[0] < UNSEEN
    if np.count_nonzero(seen) < MIN_MATCHES:
        return None
    matches = matches.subset(seen)
    reach = float(np.median(np.linalg.norm(pose @ matches.points, axis=1)))
    ideal = _ideal_matches(matches, camera, pose, reach)
    if len(ideal) < MIN_MATCHES:
        return None
    _, J = pose_jacobian(pose, ideal.points, camera)
    J = J[np.isfinite(J).all(axis=(1, 2))]
    actual, best = (_Determined.by(some, result, reach) for some in (matches, ideal))
    return Conditioning(
        actual.position / best.position,
        actual.picture(J) / best.picture(J),
        actual.ratio,
        best.ratio,
        actual.worst_motion(),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Determined:
    """Principal motions (w, R c / reach), rad, that matches determine, from the worst to the best."""

    sigmas: FloatArray
    """(6,) standard deviations, descending."""
    motions: FloatArray
    """(6, 6), one motion per column."""
    to_pose: FloatArray
    """(6, 6) map to (w, c)."""

    @staticmethod
    def by(matches: Matches, result: PoseResult, reach: float) -> _Determined:
        """Return the motions that the matches determine at the result's pose."""
        measured = Measurements.of(matches, result.camera, sigma_px=result.sigma_px, sigma_range_m=result.sigma_range_m)
        H = information_matrix(measured, States.of([result.camera_from_scanner], measured))[0]
        to_pose = np.eye(6)
        to_pose[3:, 3:] = reach * result.camera_from_scanner.rotation.T
        values, motions = np.linalg.eigh(to_pose.T @ H @ to_pose)
        known = values > _UNDETERMINED * values[-1]
        sigmas = np.where(known, 1 / np.sqrt(np.where(known, values, 1.0)), np.inf)
        return _Determined(sigmas, motions, to_pose)

    @property
    def position(self) -> float:
        """Standard deviation of the camera position, m."""
        return self._spread(self.to_pose[3:])

    @property
    def ratio(self) -> float:
        """Worst standard deviation over best."""
        return float(self.sigmas[0] / self.sigmas[-1])

    def picture(self, J: FloatArray) -> float:
        """Return the median over pixels with derivatives J (N, 2, 6) of the root mean square error, px."""
        if not np.isfinite(self.sigmas).all():
            return float("inf")
        by_motion = J @ (self.to_pose @ self.motions * self.sigmas)
        return float(np.sqrt(np.median((by_motion * by_motion).sum(axis=(1, 2)))))

    def worst_motion(self) -> str:
        """Return the name of the worst determined motion."""
        parts = np.abs(self.motions[:, 0])
        chosen = [k for k in np.argsort(-parts).tolist() if parts[k] >= _CONTRIBUTES * parts.max()][:2]
        return " together with ".join(_MOTIONS[k] for k in sorted(chosen, reverse=True))

    def _spread(self, rows: FloatArray) -> float:
        if not np.isfinite(self.sigmas).all():
            return float("inf")
        parts = rows @ self.motions * self.sigmas
        return float(np.sqrt((parts * parts).sum()))


def _ideal_matches(matches: Matches, camera: CameraModel, pose: Rigid, reach: float) -> Matches:
    """Return the ideal layout: matches all over the photo, around the same distance and of the same total information.

    It consists of many matches of little weight; the quality of a few random ones would depend on chance.
    """
    # Roberts' sequence for three dimensions: even, and the same at every call.
    even = np.mod(0.5 + np.arange(1, _IDEAL_COUNT + 1)[:, None] * _R3, 1)
    uv = even[:, :2] * camera.size - 0.5
    rays = camera.unproject(uv)
    points = pose.inverse @ (rays * (reach * FAR_OVER_NEAR ** (even[:, 2:] - 0.5)))
    ranges = np.linalg.norm(points, axis=1)
    usable = np.isfinite(ranges) & (ranges > 0)
    points, ranges, uv = points[usable], ranges[usable], uv[usable]
    count = len(points)
    total = float((matches.weights * matches.dimensions / 2).sum())
    return Matches(
        points / ranges[:, None],
        ranges,
        uv,
        weights=np.full(count, total / max(count, 1)),
        range_weights=np.full(count, float(np.average(matches.range_weights, weights=matches.weights))),
    )
