"""What a solver and a registration answer, and how good it is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from ladarreg_core.arrays import BoolArray, FloatArray
from ladarreg_core.camera import Camera
from ladarreg_core.frames import Rigid, ThesisParameters, rotation_from_rotvec
from ladarreg_core.matches import Matches
from ladarreg_core.progress import Step
from ladarreg_core.validation import require_number

Evidence = Literal["image", "statistics", "none"]
StageName = Literal["linear", "constrained_linear", "simplex", "simplex_outliers_removed", "default"]
"""The columns of thesis Tables 3.2-3.5, and the default method beside them."""
STATED_OFFSET_SIGMA_RAD = float(np.radians(0.2))
"""How well a mount's turn is taken to be known where nobody says."""
STATED_OFFSET_SIGMA_M = 0.005
"""How well a mount's shift is taken to be known where nobody says."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PoseResult:
    """A pose that explains itself."""

    camera_from_scanner: Rigid
    """The pose."""
    camera: Camera
    """Intrinsics used or estimated."""
    matches: Matches
    """All M matches that went in."""
    inliers: BoolArray
    """(M,) bool."""
    residuals_px: FloatArray
    """(M, 2) photo pixels, observed minus predicted from the measured range; NaN behind the camera.

    Of what is known across a line only, the part across it."""
    residuals_m: FloatArray
    """(M,) errors-in-variables range residual, measured minus adjusted, m; finite at zero baseline."""
    stereo_depth_error_m: FloatArray
    """(M,) laser minus stereo depth as in the thesis, m; NaN where undefined. Source: thesis Eq 2.19-2.21."""
    covariance: FloatArray
    """(6, 6) of (w, c): R_true = exp([w]x) R_estimated (rad), c = C_true - C_estimated in the scanner frame (m)."""
    chi2_per_dof: float
    """Over the inliers, with 2n - 6 degrees of freedom, less what is known across lines only and what
    of the camera is estimated; NaN: none."""
    sigma_px: float
    """Pixel noise used, given or estimated."""
    sigma_range_m: float
    """Range noise used, given or estimated."""
    camera_sigmas: Mapping[str, float] = field(default_factory=dict)
    """Standard deviations of the intrinsics that were estimated: `focal_px`, `k1`, `cx`, `cy`; empty: all as given."""
    accepted: bool = False
    """Whether there is enough evidence to show this as registered."""
    evidence: Evidence = "none"
    """`image`: verified on pixels; `statistics`: by the matches' own residuals; `none`."""
    reasons: tuple[str, ...] = ()
    """The verdict in sentences."""
    diagnostics: Mapping[str, Any] = field(default_factory=dict)
    """Planarity, baseline, spread and the reason the solver stopped, JSON-ready."""

    @property
    def thesis_parameters(self) -> ThesisParameters:
        """Tx, Ty, Tz (m) and alpha, beta, gamma (rad) of thesis 2.4."""
        return ThesisParameters.from_pose(self.camera_from_scanner)

    @property
    def thesis_sigmas(self) -> ThesisParameters:
        """Standard deviations of the thesis's parameters (m, rad), by the covariance's first-order propagation."""
        pose, steps = self.camera_from_scanner, 1e-6 * np.eye(6)
        columns = [_parameters(_moved(pose, d)) - _parameters(_moved(pose, -d)) for d in steps]
        J = np.stack(columns, axis=1) / 2e-6
        return ThesisParameters(*np.sqrt(np.diag(J @ self.covariance @ J.T)).tolist())

    @property
    def sigma_angle_rad(self) -> float:
        """Standard deviation of the rotation, root sum of squares over its three axes, rad."""
        return float(np.sqrt(np.trace(self.covariance[:3, :3])))

    @property
    def sigma_position_m(self) -> float:
        """Standard deviation of the camera centre, root sum of squares over its three axes, m."""
        return float(np.sqrt(np.trace(self.covariance[3:, 3:])))


@dataclass(frozen=True, kw_only=True, eq=False)
class Registration(PoseResult):
    """A pose with the story of how it was found."""

    method: str
    """`auto`, `thesis` or `manual`."""
    steps: tuple[Step, ...] = ()
    """Every step, in order."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """The options used, JSON-ready."""
    seed: int = 0
    """The seed used."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Stage:
    """One column of the thesis's tables: what an estimator answered, or why it gave nothing."""

    name: StageName
    """Which estimator on which matches."""
    result: PoseResult | None
    """Its answer with the matches it used; None where it gave none."""
    note: str = ""
    """A sentence on what happened, or why there is no answer."""


@dataclass(frozen=True, slots=True)
class Offset:
    """Where a second camera sits on the mount of a first, and how well that is known.

    Raises:
        OptionError: if a standard deviation is negative or not finite.
    """

    camera_b_from_camera_a: Rigid
    """From the calibration of the mount."""
    sigma_angle_rad: float = STATED_OFFSET_SIGMA_RAD
    """Standard deviation of its turn, about each axis."""
    sigma_position_m: float = STATED_OFFSET_SIGMA_M
    """Standard deviation of camera b's place in camera a's frame, along each axis."""

    def __post_init__(self) -> None:
        for name in ("sigma_angle_rad", "sigma_position_m"):
            require_number(getattr(self, name), f"the offset's {name}", least=0)


def _moved(pose: Rigid, change: FloatArray) -> Rigid:
    """Return the pose turned by exp([w]x) and with its centre moved by c."""
    return Rigid.from_centre(rotation_from_rotvec(change[:3]) @ pose.rotation, pose.centre + change[3:])


def _parameters(pose: Rigid) -> FloatArray:
    p = ThesisParameters.from_pose(pose)
    return np.array([p.Tx, p.Ty, p.Tz, p.alpha, p.beta, p.gamma])
