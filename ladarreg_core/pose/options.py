"""Options of pose estimation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, get_args

from ladarreg_core.camera.uncertainty import DEFAULT_CAMERA_PRIOR, CameraPrior
from ladarreg_core.errors import OptionError
from ladarreg_core.foundations.validation import LARGEST_INT, require_choice, require_int
from ladarreg_core.pose.acceptance import DEFAULT_ACCEPTANCE, AcceptanceOptions
from ladarreg_core.pose.estimators.ransac import Backend
from ladarreg_core.pose.estimators.unknown_intrinsics import Intrinsics
from ladarreg_core.thesis.estimators.stereo_simplex import DEFAULT_SIMPLEX, SimplexOptions

Method = Literal["robust", "linear", "stereo_simplex", "epipolar_simplex"]

STATED_SIGMA_PX = 1.0
"""Pixel noise assumed until it is estimated from the matches, px."""
STATED_SIGMA_RANGE_M = 0.015
"""Range noise assumed until it is estimated from the matches, m."""

_MIN_SIGMA, _MAX_SIGMA = 1e-6, 1e6


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseOptions:
    """Options of pose estimation."""

    method: Method = "robust"
    """`robust`, `linear` (thesis 2.4.1), `stereo_simplex` (Eq 2.21) or `epipolar_simplex` (Eq 2.21 without poles)."""
    sigma_px: float | None = None
    """Pixel noise, px; None: 1 px at first, then estimated from the matches."""
    sigma_range_m: float | None = None
    """Range noise, m; None: .015 m at first, then estimated from the matches."""
    gate_chi2: float = 9.21
    """Largest cost s of an inlier: the 99 % quantile of chi-squared with two degrees of freedom."""
    ransac_iterations: int = 5000
    """Maximum number of samples; 0: no RANSAC, which requires an initial pose."""
    ransac_backend: Backend = "auto"
    """`poselib`, `opencv`, or `auto`: whichever is installed."""
    simplex: SimplexOptions = DEFAULT_SIMPLEX
    """Options of the simplex; `method` determines its `residual`."""
    intrinsics: Intrinsics | Literal["auto"] = "auto"
    """Intrinsics that `robust` estimates; `auto`: those that improve the prediction of held-out matches."""
    camera_prior: CameraPrior = DEFAULT_CAMERA_PRIOR
    """What is assumed of a camera of which only the focal length is known; calibrated cameras are exact."""
    keep_better_start: bool = False
    """If true, `robust` keeps an initial pose that predicts held-out matches better than the fitted pose."""
    acceptance: AcceptanceOptions = DEFAULT_ACCEPTANCE
    """Thresholds of acceptance."""
    check_ambiguity: bool = True
    """If true, the verdict includes a quick search for a second pose; a test from many starting poses replaces it."""
    seed: int = 0
    """Random seed; equal seeds give equal results."""

    def __post_init__(self) -> None:
        require_choice(self.method, get_args(Method), "the pose method")
        for name, unit in (("sigma_px", "pixels"), ("sigma_range_m", "metres")):
            sigma = getattr(self, name)
            if sigma is not None and not _between(sigma, _MIN_SIGMA, _MAX_SIGMA):
                raise OptionError(
                    f"{name} is {sigma!r}; it must be a positive number of {unit} ({_MIN_SIGMA:g} to {_MAX_SIGMA:g})"
                )
        if not _between(self.gate_chi2, 1e-3, 1e6):
            raise OptionError(f"gate_chi2 is {self.gate_chi2!r}; it must be a positive number")
        if not isinstance(self.simplex, SimplexOptions):
            raise OptionError(f"simplex is a {type(self.simplex).__name__}; give SimplexOptions")
        if not isinstance(self.acceptance, AcceptanceOptions):
            raise OptionError(f"acceptance is a {type(self.acceptance).__name__}; give AcceptanceOptions")
        if not isinstance(self.camera_prior, CameraPrior):
            raise OptionError(f"camera_prior is a {type(self.camera_prior).__name__}; give a CameraPrior")
        if self.intrinsics not in ("auto", *get_args(Intrinsics)):
            known = ", ".join(("auto", *get_args(Intrinsics)))
            raise OptionError(f"intrinsics is {self.intrinsics!r}; it must be one of {known}")
        for name in ("ransac_iterations", "seed"):
            value = getattr(self, name)
            require_int(value, f"{name}", least=0, most=LARGEST_INT)


def _between(value: Any, low: float, high: float) -> bool:
    try:
        return not isinstance(value, bool) and low <= float(value) <= high
    except (TypeError, ValueError):
        return False
