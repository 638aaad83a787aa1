"""A calibrated mount: its uncertainty, what is not determined, and the sentences for the operator."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.frames import Rigid

Parameter = Literal["x", "y", "z", "roll", "pitch", "yaw", "latency"]
MOUNT: tuple[Parameter, ...] = ("x", "y", "z", "roll", "pitch", "yaw")


@dataclass(frozen=True, slots=True)
class MountCalibration:
    """A mount with its uncertainty, or the reason why the one given stays."""

    unit_from_scanner: Rigid
    """The mount to use: calibrated if `accepted`, else the one given."""
    latency_s: float
    """Latency of the unit's readings to use."""
    accepted: bool
    """The calibrated mount describes surfaces that it was not fitted to better than the one given."""
    parameters: tuple[Parameter, ...]
    """Names of the unknowns: shift and rotation along and about the axes of the unit at `tilt_rad` (ahead, left, and
    the pan axis), and the latency if there is one."""
    determined: tuple[bool, ...]
    """(P,) whether the sweeps show each parameter; those they do not show keep the values given."""
    covariance: NDArray[np.float64]
    """(P, P), m and rad (and s), of the shift d and the rotation w with true point = exp([w]x) estimated point + d in
    these axes; infinite on the diagonal, and zero beside it, where a parameter is not determined."""
    tilt_rad: float
    """Mean tilt of the sweeps: at this tilt the axes of the parameters are level."""
    sigma_range_m: float
    """Noise of the ranges as the planes show it; NaN without planes."""
    held_out_before_m: float
    """RMS distance of points from planes that were not fitted to, with the mount given; NaN without planes."""
    held_out_after_m: float
    """The same with the calibrated mount."""
    planes: int
    """Planes that were seen twice."""
    points: int
    """Points on them."""
    reasons: tuple[str, ...] = field(default=())
    """Sentences for the operator: what is not determined, and why a calibration was not accepted."""

    @property
    def sigma(self) -> NDArray[np.float64]:
        """(P,) standard deviations; infinite where a parameter is not determined."""
        return np.sqrt(np.diag(self.covariance))

    def as_fields(self) -> dict[str, Any]:
        """Return the calibration as written to `panorama.json`: null for what is not determined or was not measured."""

        def number(value: float) -> float | None:
            return float(value) if np.isfinite(value) else None

        units = [1.0] * 3 + [float(np.degrees(1.0))] * 3 + [1.0]
        unit_names = ["m"] * 3 + ["deg"] * 3 + ["s"]
        sigma = {
            f"{name}_{unit}": number(value * factor)
            for name, value, factor, unit in zip(self.parameters, self.sigma, units, unit_names, strict=False)
        }
        return {
            "accepted": self.accepted, "reasons": list(self.reasons),
            "not_determined": [n for n, seen in zip(self.parameters, self.determined, strict=True) if not seen],
            "sigma": sigma, "axes_tilt_deg": float(np.degrees(self.tilt_rad)), "parameters": list(self.parameters),
            "covariance": [[number(value) for value in row] for row in self.covariance], "latency_s": self.latency_s,
            "planes": self.planes, "points": self.points, "sigma_range_m": number(self.sigma_range_m),
            "held_out_before_m": number(self.held_out_before_m), "held_out_after_m": number(self.held_out_after_m),
        }  # fmt: skip


def undetermined_reason(names: list[Parameter]) -> str:
    """Return the sentence about parameters that the sweeps do not determine, with what would."""
    words = {
        "x": "the shift ahead (x)", "y": "the shift to the left (y)", "z": "the height along the pan axis (z)",
        "roll": "the roll", "pitch": "the pitch", "yaw": "the yaw about the pan axis", "latency": "the latency",
    }  # fmt: skip
    listed = [words[name] for name in names]
    if len(listed) == 1:
        what = f"{listed[0]} is not determined by these sweeps and keeps its value"
    else:
        what = f"{', '.join(listed[:-1])} and {listed[-1]} are not determined by these sweeps and keep their values"
    return f"{what}; {_what_helps(names)}"


def _what_helps(names: list[Parameter]) -> str:
    if "latency" in names:
        return "sweep in both directions"
    if set(names) <= {"z", "yaw"}:
        return "they only move the whole cloud; sweeps at several tilts show them"
    return "set the tilt to about -45 deg, or sweep at several tilts, one of them about -45 deg"
