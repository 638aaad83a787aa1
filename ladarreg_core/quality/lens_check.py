"""Whether what is left over after the pose points at the focal length or the lens.

A focal length that is wrong by the share s moves every ideal pixel x by s x, a lens that bends more than was said by
k r^2 x. One Gauss-Newton step of the pose with either beside it tells how much of that the residuals hold, and how far
the pose would move with it. Most of such an error hides in the pose: a growth of the residuals with the radius alone
would show a fraction of it.

Source: Rao's score test (1948); the system is that of `bundle`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ladarreg_core.arrays import FloatArray
from ladarreg_core.pose.bundle import UNSEEN, Measurements, States, adjust_ranges, linearise
from ladarreg_core.results import PoseResult

LEAST_MATCHES_OF_LENS = 12
"""With fewer a noise of its own passes for a lens."""
MOST_SIGMA_AT_EDGE = 0.02
"""Of an ideal pixel's distance from the middle: a change known less well is far from linear, and no hint."""
_UNDETERMINED = 1e-6  # of the information that a held pose would leave


@dataclass(frozen=True, slots=True)
class LensHint:
    """A change of the camera that the residuals ask for."""

    kind: Literal["focal", "lens"]
    """`focal`: a longer or shorter focal length; `lens`: a stronger or weaker distortion."""
    change: float
    """Relative change of the focal length, or of k1."""
    sigma: float
    """Standard deviation of `change`, by the scatter that the matches show."""
    moves_sigmas: float
    """How far the camera's place would move with it, in the pose's own standard deviations."""

    @property
    def significance(self) -> float:
        """The change in its own standard deviations, at least 0."""
        return abs(self.change) / self.sigma


def lens_hint(result: PoseResult) -> LensHint | None:
    """Return the more significant of both changes; None where the matches tell neither.

    Args:
        result: a pose with its matches, their noise and inliers.
    """
    if np.count_nonzero(result.inliers) < LEAST_MATCHES_OF_LENS:
        return None
    matches = result.matches.subset(result.inliers)
    measured = Measurements.of(matches, result.camera, sigma_px=result.sigma_px, sigma_range_m=result.sigma_range_m)
    states, seen = adjust_ranges(measured, States.of([result.camera_from_scanner], measured))
    usable = seen.s[0] < UNSEEN
    if np.count_nonzero(usable) < LEAST_MATCHES_OF_LENS:
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
    hints = [
        hint
        for hint in (
            _hint("focal", H, g, chi2, 6, dof, 1.0),
            _hint("lens", H, g, chi2, 7, dof, farthest),
        )
        if hint is not None
    ]
    return max(hints, key=lambda hint: hint.significance, default=None)


def _hint(
    kind: Literal["focal", "lens"], H: FloatArray, g: FloatArray, chi2: float, k: int, dof: int, at_edge: float
) -> LensHint | None:
    """Return what parameter k beside the pose would be; None where the pose can do nearly all that it does."""
    scale = np.sqrt(np.maximum(np.diag(H)[:6], 1e-300))
    pose = H[:6, :6] / np.outer(scale, scale)
    if not np.linalg.eigvalsh(pose)[0] > _UNDETERMINED**2:
        return None
    inverse = np.linalg.inv(pose) / np.outer(scale, scale)
    follows = inverse @ H[:6, k]
    information = float(H[k, k] - H[k, :6] @ follows)
    if not information > _UNDETERMINED * H[k, k]:
        return None
    alone = inverse @ g[:6]
    change = float(g[k] - H[k, :6] @ alone) / information
    left = chi2 - float(g[:6] @ alone) - change * change * information
    noise = max(1.0, left / dof)
    position = np.sqrt(np.trace(inverse[3:, 3:]) * noise)
    sigma = float(np.sqrt(noise / information))
    if sigma * at_edge > MOST_SIGMA_AT_EDGE:
        return None
    return LensHint(kind, change, sigma, float(np.linalg.norm(follows[3:] * change) / position))
