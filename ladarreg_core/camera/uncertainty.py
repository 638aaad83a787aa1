"""Derivatives of pixels by the pose, and what is not known of a camera that was not calibrated."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ladarreg_core.camera.model import CameraModel
from ladarreg_core.camera.pinhole import Camera
from ladarreg_core.errors import ShapeError
from ladarreg_core.foundations.arrays import FloatArray, read_only
from ladarreg_core.foundations.validation import require_number
from ladarreg_core.frames import Rigid

INTRINSICS = ("focal_px", "k1", "cx", "cy")
"""Names of the intrinsics that can be uncertain: px, 1, px, px; in the order of `Camera.intrinsics_jacobian`."""


def pose_jacobian(
    camera_from_scanner: Rigid, points_scanner: FloatArray, camera: CameraModel
) -> tuple[FloatArray, FloatArray]:
    """Project points and differentiate the pixels by the pose.

    Args:
        camera_from_scanner: the pose.
        points_scanner: (N, 3), m.
        camera: intrinsics.

    Returns:
        uv (N, 2), pixels, and J (N, 2, 6) = d uv / d (w, c), with R_true = exp([w]x) R and c the shift of the camera
        centre in the scanner frame; NaN behind the camera.
    """
    p = camera_from_scanner @ np.asarray(points_scanner, dtype=np.float64)
    uv, d_uv = camera.project_with_jacobian(p)
    by_rotation = np.zeros((*p.shape[:-1], 3, 3))  # d p / d w = -[p]x
    by_rotation[..., 0, 1], by_rotation[..., 0, 2] = p[..., 2], -p[..., 1]
    by_rotation[..., 1, 0], by_rotation[..., 1, 2] = -p[..., 2], p[..., 0]
    by_rotation[..., 2, 0], by_rotation[..., 2, 1] = p[..., 1], -p[..., 0]
    return uv, np.concatenate([d_uv @ by_rotation, -d_uv @ camera_from_scanner.rotation], axis=-1)


@dataclass(frozen=True, slots=True)
class CameraPrior:
    """Standard deviations of a camera's intrinsics before its photograph is registered.

    The defaults are those of a camera of which only the focal length is known, typed, nominal or from EXIF: lenses are
    mounted a per cent or two off the middle of the sensor, their distortion differs from none by a few per cent of the
    image at the corners, and a focal length is rounded, or changes with focus, by some per cent.
    """

    centre_of_width: float = 0.015
    """Of the principal point about the middle of the image, each way, as a share of its width; 0: exact."""
    k1: float = 0.05
    """Of the distortion coefficient k1; 0: exact."""
    focal: float = 0.03
    """Of the focal length, as a share of it; 0: exact."""

    def __post_init__(self) -> None:
        require_number(self.focal, "the camera prior's focal", least=0, most=1)
        require_number(self.centre_of_width, "the camera prior's centre_of_width", least=0, most=1)
        require_number(self.k1, "the camera prior's k1", least=0, most=10)

    def sigmas(self, camera: Camera) -> dict[str, float]:
        """Return the standard deviations for a camera, by name; those that are 0 are left out."""
        centre = self.centre_of_width * camera.width
        all_four = zip(INTRINSICS, (self.focal * camera.focal_px, self.k1, centre, centre), strict=True)
        return {name: sigma for name, sigma in all_four if sigma > 0}

    def covering(self, camera: Camera, others: Iterable[Camera]) -> CameraPrior:
        """Return the prior of a camera that may as well be one of others: wide enough to admit these."""
        focal, centre = self.focal, self.centre_of_width
        for other in others:
            focal = max(focal, abs(math.log(other.focal_px / camera.focal_px)))
            centre = max(centre, math.hypot(other.cx - camera.cx, other.cy - camera.cy) / camera.width)
        return replace(self, focal=focal, centre_of_width=centre)


DEFAULT_CAMERA_PRIOR = CameraPrior()
"""The prior of a camera of which only the focal length is known."""
CALIBRATED_CAMERA_PRIOR = CameraPrior(focal=0.003, centre_of_width=0.003, k1=0.01)
"""The prior of a calibrated camera whose file states no standard deviations."""


@dataclass(frozen=True, slots=True, eq=False)
class CameraUncertainty:
    """Uncertainty of a pose together with that of its camera, whose errors largely compensate in the image.

    Raises:
        ShapeError: if a name is unknown, or the covariance is not (6 + K, 6 + K).
    """

    names: tuple[str, ...]
    """K of `INTRINSICS`, in their order."""
    covariance: FloatArray
    """(6 + K, 6 + K) of (w, c) as `PoseResult.covariance`, then of the intrinsics, true minus estimated."""
    stated: Mapping[str, float]
    """Values of the intrinsics before the registration, by name."""
    prior: Mapping[str, float] = field(default_factory=dict)
    """Their standard deviations before the registration; those without one were estimated freely."""
    freed: tuple[str, ...] = ()
    """Those whose prior the matches contradict, and which were therefore estimated without it."""
    off: Mapping[str, float] = field(default_factory=dict)
    """Principal point from the matches alone minus the stated one (`cx`, `cy`), px; empty where unknown."""
    off_sigma: Mapping[str, float] = field(default_factory=dict)
    """Standard deviations of `off`, px."""

    def __post_init__(self) -> None:
        if list(self.names) != [name for name in INTRINSICS if name in self.names]:
            raise ShapeError(
                f"the uncertain intrinsics are {self.names!r:.80}; they must be among {INTRINSICS}, in order"
            )
        size = 6 + len(self.names)
        covariance = read_only(self.covariance, np.float64, (size, size), "the covariance of pose and camera")
        object.__setattr__(self, "covariance", covariance)

    @property
    def sigmas(self) -> dict[str, float]:
        """Standard deviations of the intrinsics after the registration, by name."""
        return dict(zip(self.names, np.sqrt(np.diag(self.covariance)[6:]).tolist(), strict=True))

    def with_scatter(self, scatter: FloatArray) -> CameraUncertainty:
        """Return it with something added to the covariance (6, 6) of the pose."""
        covariance = self.covariance.copy()
        covariance[:6, :6] += scatter
        return replace(self, covariance=covariance)

    def jacobian(self, camera: Camera, xy: FloatArray) -> FloatArray:
        """Return the derivative of pixels by the intrinsics, (N, 2, K), at undistorted tangents (N, 2)."""
        J = camera.intrinsics_jacobian(xy)
        J[..., 0] /= camera.focal_px
        return np.asarray(J[..., [INTRINSICS.index(name) for name in self.names]])

    def as_fields(self) -> dict[str, Any]:
        """Return the fields as JSON-ready values."""
        return {
            "names": list(self.names),
            "covariance": self.covariance.tolist(),
            "stated": dict(self.stated),
            "prior": dict(self.prior),
            "freed": list(self.freed),
            "off": dict(self.off),
            "off_sigma": dict(self.off_sigma),
        }

    @staticmethod
    def from_fields(fields: Mapping[str, Any]) -> CameraUncertainty:
        """Return what `as_fields` wrote.

        Raises:
            ShapeError: if it is damaged.
        """
        try:
            numbers = {
                name: {str(key): float(value) for key, value in dict(fields.get(name, {})).items()}
                for name in ("stated", "prior", "off", "off_sigma")
            }
            names, freed = (tuple(map(str, part)) for part in (fields["names"], fields.get("freed", ())))
            return CameraUncertainty(names, np.array(fields["covariance"], np.float64), freed=freed, **numbers)
        except (KeyError, TypeError, ValueError) as error:
            raise ShapeError(f"the uncertainty of the camera is damaged ({error})") from None
