"""Check of the focal length and the lens distortion against the residuals of a pose.

A focal length wrong by the share s moves every ideal pixel x by s x; a wrong distortion coefficient moves it by
k r^2 x. One Gauss-Newton step of the pose together with either parameter estimates the parameter from the residuals,
and the shift of the pose that would follow. The pose has to be free in that step, since it absorbs most of such an
error: the growth of the residuals with the radius alone would show a fraction of it.

Source: Rao's score test (1948); the system is that of `bundle`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.pose.estimators.bundle import UNSEEN, States, adjust_ranges, linearise
from ladarreg_core.pose.estimators.measurements import Measurements
from ladarreg_core.results.registration import PoseResult

MIN_MATCHES_OF_LENS = 12
"""With fewer matches, noise can be mistaken for a lens error."""
MAX_SIGMA_AT_EDGE = 0.02
"""Largest standard deviation of the change, relative to the radius of the outermost ideal pixel; beyond it the step is
far from linear and is not reported."""
_UNDETERMINED = 1e-6  # of the information that a fixed pose would give


@dataclass(frozen=True, slots=True)
class LensCheck:
    """Change of the camera that would reduce the residuals most significantly."""

    kind: Literal["focal", "lens"]
    """`focal`: a longer or shorter focal length; `lens`: a stronger or weaker distortion."""
    change: float
    """Relative change of the focal length, or of k1."""
    sigma: float
    """Standard deviation of `change`, from the scatter of the matches."""
    shift_sigmas: float
    """Shift of the camera position that would follow, in standard deviations of the pose."""

    @property
    def significance(self) -> float:
        """The change over its standard deviation, at least 0."""
        return abs(self.change) / self.sigma


def check_lens(result: PoseResult) -> LensCheck | None:
    """Return the more significant of the two changes; None where the matches determine neither.

    Args:
        result: a pose with its matches, their noise and inliers.
    """
    if np.count_nonzero(result.inliers) < MIN_MATCHES_OF_LENS:
        return None
    matches = result.matches.subset(result.inliers)
    measured = Measurements.of(matches, result.camera, sigma_px=result.sigma_px, sigma_range_m=result.sigma_range_m)
    states, seen = adjust_ranges(measured, States.of([result.camera_from_scanner], measured))
    usable = seen.s[0] < UNSEEN
    if np.count_nonzero(usable) < MIN_MATCHES_OF_LENS:
        return None
    measured, dof = measured.subset(usable), int(matches.dimensions[usable].sum()) - 7
    states, seen = adjust_ranges(measured, states.with_ranges_of(measured))
    lin = linearise(measured, states, seen)
    x = seen.xy[0]
    squared = (x * x).sum(axis=0)
    J = np.concatenate([lin.j_pose[0], [x], [x * squared]])  # (8, 2, n)
    share = lin.m[0] / lin.h[0]
    diagonal = measured.information - lin.m[0] * share
    cross = measured.cross_information - lin.m[0, :1] * share[1:]
    K = diagonal * J + cross * J[:, ::-1]
    e = seen.e[0] - lin.j[0] * seen.range_error[0]
    by_match = diagonal * e + cross * e[::-1]
    H, g = K.reshape(8, -1) @ J.reshape(8, -1).T, K.reshape(8, -1) @ e.ravel()
    chi2 = float((by_match * e).sum())
    farthest = float(squared.max())
    checks = [
        check
        for check in (
            _check("focal", H, g, chi2, 6, dof, 1.0),
            _check("lens", H, g, chi2, 7, dof, farthest),
        )
        if check is not None
    ]
    return max(checks, key=lambda check: check.significance, default=None)


def _check(
    kind: Literal["focal", "lens"], H: FloatArray, g: FloatArray, chi2: float, k: int, dof: int, at_edge: float
) -> LensCheck | None:
    """Estimate parameter k together with the pose; None where the pose absorbs nearly all of its effect."""
    scale = np.sqrt(np.maximum(np.diag(H)[:6], 1e-300))
    pose = H[:6, :6] / np.outer(scale, scale)
    if not np.linalg.eigvalsh(pose)[0] > _UNDETERMINED**2:
        return None
    inverse = np.linalg.inv(pose) / np.outer(scale, scale)
    response = inverse @ H[:6, k]
    information = float(H[k, k] - H[k, :6] @ response)
    if not information > _UNDETERMINED * H[k, k]:
        return None
    pose_step = inverse @ g[:6]
    change = float(g[k] - H[k, :6] @ pose_step) / information
    remaining = chi2 - float(g[:6] @ pose_step) - change * change * information
    noise = max(1.0, remaining / dof)
    position = np.sqrt(np.trace(inverse[3:, 3:]) * noise)
    sigma = float(np.sqrt(noise / information))
    if sigma * at_edge > MAX_SIGMA_AT_EDGE:
        return None
    return LensCheck(kind, change, sigma, float(np.linalg.norm(response[3:] * change) / position))
