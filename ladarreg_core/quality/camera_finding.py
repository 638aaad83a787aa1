"""What a camera that was not calibrated contributes to the uncertainty of a pose, and whether its photo was cropped.

Source: an offset of the principal point is compared with its prior by its predictive distribution, whose variance is
that of the prior and of the estimate from the matches together (Box, Sampling and Bayes' inference, 1980).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ladarreg_core.camera.uncertainty import CameraUncertainty
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.foundations.formatting import format_length, format_number
from ladarreg_core.pose.assumed_camera import is_beyond_prior
from ladarreg_core.pose.estimators.covariance import guarded_inverse
from ladarreg_core.results.registration import PoseResult

_ADVICE = "Give a calibrated camera file for the photo."
_UNCROPPED = (
    "Give the photo as the camera took it, or a camera file of this crop; the pose rests on the principal point "
    "estimated from the matches."
)
_NOT_ESTIMATED = (
    "Give the photo as the camera took it, or a camera file of this crop: the pose is off by more than its stated "
    "uncertainty."
)
_SIDES = {"cx": ("left", "right"), "cy": ("above", "below")}


@dataclass(frozen=True, slots=True)
class CameraWords:
    """The contribution of the camera in words and figures."""

    cropped: bool
    """Whether the principal point is farther off than the prior admits."""
    share_of_angle: float
    """Share of the variance of the orientation that comes from the camera."""
    sentence: str
    """The finding."""
    advice: str
    """What to do."""
    values: Mapping[str, Any]
    """The figures."""


def camera_in_words(result: PoseResult) -> CameraWords | None:
    """Return the contribution of the camera; None for a calibrated camera.

    Args:
        result: a pose with its matches.
    """
    joint = result.camera_uncertainty
    if joint is None:
        return None
    exact = _covariance_of_exact_camera(joint)
    angle, position = (float(np.sqrt(max(np.trace(exact[part, part]), 0.0))) for part in (slice(0, 3), slice(3, 6)))
    share = 1 - (angle / result.sigma_angle_rad) ** 2 if result.sigma_angle_rad > 0 else 0.0
    values = {
        "sigmas": joint.sigmas,
        "prior": dict(joint.prior),
        "off_px": dict(joint.off),
        "off_sigma_px": dict(joint.off_sigma),
        "share_of_angle_variance": share,
        "exact_angle_rad": angle,
        "exact_position_m": position,
    }
    cropped = [name for name in joint.off if _is_beyond(joint, name)]
    if cropped:
        where = " and ".join(
            f"{format_number(abs(joint.off[name]))} +- {format_number(joint.off_sigma[name])} px "
            f"{_SIDES[name][joint.off[name] > 0]}{' of' if name == 'cx' else ''} the middle"
            for name in cropped
        )
        advice = _UNCROPPED if set(cropped) <= set(joint.freed) else _NOT_ESTIMATED
        return CameraWords(
            True,
            share,
            f"The principal point is {where} of the photo, as if the photo had been cropped.",
            advice,
            values,
        )
    parts = []
    if "cx" in joint.prior:
        parts.append(f"principal point to {format_number(max(joint.prior[n] for n in ('cx', 'cy')))} px")
    if "k1" in joint.prior:
        parts.append(f"k1 to {format_number(joint.prior['k1'])}")
    sentence = (
        f"The camera is not calibrated ({', '.join(parts)}): with an exact one the pose would be known to "
        f"{format_length(position)} and {format_number(np.degrees(angle))} deg instead of "
        f"{format_length(result.sigma_position_m)} and {format_number(np.degrees(result.sigma_angle_rad))} deg."
    )
    return CameraWords(False, share, sentence, _ADVICE, values)


def _is_beyond(joint: CameraUncertainty, name: str) -> bool:
    return is_beyond_prior({name: joint.off[name]}, {name: joint.off_sigma[name]}, joint.prior)


def _covariance_of_exact_camera(joint: CameraUncertainty) -> FloatArray:
    """Return the covariance (6, 6) of the pose if the camera were known: conditional on the intrinsics."""
    C = joint.covariance
    scale = np.sqrt(np.diag(C)[6:])
    inverse = guarded_inverse(C[6:, 6:] / np.outer(scale, scale)) / np.outer(scale, scale)
    return np.asarray(C[:6, :6] - C[:6, 6:] @ inverse @ C[6:, :6])
