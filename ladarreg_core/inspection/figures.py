"""The figures of an answer that stand side by side with those of others. Source: thesis Tables 3.2-3.5."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ladarreg_core.frames import Rigid, look_along
from ladarreg_core.results import PoseResult
from ladarreg_core.scan import Scan

_NAMES = ("Tx", "Ty", "Tz", "alpha", "beta", "gamma")
_MOST_DECIMALS = 6


@dataclass(frozen=True, slots=True)
class Parameter:
    """One of the thesis's six parameters, to the decimals that mean something."""

    name: str
    """Tx, Ty, Tz, alpha, beta or gamma."""
    unit: str
    """m or deg."""
    value: str
    """Its value."""
    sigma: str
    """Its standard deviation; `unknown` where there is none."""


@dataclass(frozen=True, slots=True)
class Figures:
    """How well the matches agree with a pose; NaN: there are none."""

    inliers: int
    """How many count."""
    median_px: float
    """Their median pixel residual."""
    rms_px: float
    """Root mean square of them."""
    rms_depth_m: float
    """Root mean square of laser minus stereo depth, m."""


def figures(result: PoseResult) -> Figures:
    """Return the figures of an answer's inliers."""
    lengths = np.linalg.norm(result.residuals_px[result.inliers], axis=1)
    depth = result.stereo_depth_error_m[result.inliers]
    depth = depth[np.isfinite(depth)]
    return Figures(
        int(result.inliers.sum()),
        float(np.median(lengths)) if len(lengths) else math.nan,
        float(np.sqrt(np.mean(lengths**2))) if len(lengths) else math.nan,
        float(np.sqrt(np.mean(depth**2))) if len(depth) else math.nan,
    )


def parameters(result: PoseResult) -> tuple[Parameter, ...]:
    """Return Tx, Ty, Tz in m and alpha, beta, gamma in degrees, with two digits of their standard deviations."""
    values, sigmas = result.thesis_parameters, result.thesis_sigmas
    found = []
    for name in _NAMES:
        value, sigma = getattr(values, name), getattr(sigmas, name)
        length = name.startswith("T")
        if not length:
            value, sigma = math.degrees(value), math.degrees(sigma)
        decimals = _decimals(sigma)
        said = f"{sigma:.{decimals}f}" if math.isfinite(sigma) else "unknown"
        found.append(Parameter(name, "m" if length else "deg", f"{value:.{decimals}f}", said))
    return tuple(found)


def scanners_place(scan: Scan) -> Rigid:
    """Return the pose of a camera that stands where the scanner does and looks at what it saw."""
    return Rigid(look_along(scan.mean_direction), np.zeros(3))


def _decimals(sigma: float) -> int:
    if not (math.isfinite(sigma) and sigma > 0):
        return 4
    return min(max(1 - math.floor(math.log10(sigma)), 0), _MOST_DECIMALS)
