"""A camera on a pan/tilt unit, from photographs that it took at several positions: one mount with its covariance.

Each photograph is registered with the panorama by itself, with a verdict of its own; what the unit says of its position
turns the pose into one of the mount. Mounts that agree within their covariances are averaged.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from ladarreg_core.camera import CameraModel
from ladarreg_core.errors import ShapeError
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.foundations.formatting import format_angle, format_length
from ladarreg_core.foundations.progress import Progress, Report
from ladarreg_core.frames import Rigid, rotation_from_rotvec, rotvec_from_rotation
from ladarreg_core.matching.images.kept_channels import Channels
from ladarreg_core.photo import Photo
from ladarreg_core.registration.register import RegisterOptions, register
from ladarreg_core.results.registration import Registration
from ladarreg_core.scan import Scan

CAMERA_MOUNT_IS = (
    "mount: unit_from_camera, 4 x 4: where the camera is on the part of the unit that pans and tilts, X right, Y down, "
    "Z ahead; covariance of (rotation vector in the camera's axes, rad; camera centre in the unit's axes, m)"
)
"""Explanation of a camera's mount, written next to it."""
_CHI2_6_DOF = 27.86  # exceeded by chance once in 10,000
_STEPS = 20
_NU = 2.0  # degrees of freedom: errors of accepted poses have heavy tails
STATED_MOUNT_SIGMAS = (float(np.radians(0.23)), 0.012)
"""Standard deviations, rad and m, along each axis, of a scanner's mount that was measured with a ruler: off by .4 deg
and 20 mm at most, as those of the simulated units are. The camera is found where the scanner's points put it."""
_SAME_POSITION_RAD = float(np.radians(0.5))

PhotoOutcome = Literal["agrees", "disagrees", "refused"]


@dataclass(frozen=True, slots=True, eq=False)
class UnitCameraPhoto:
    """A photograph, and what it says of the mount."""

    name: str
    """Of its file."""
    registration: Registration
    """Its pose in the panorama, by itself."""
    outcome: PhotoOutcome
    """`agrees` or `disagrees` with the mount; `refused`: its own pose was not accepted."""
    off_rad: float
    """How far its direction is from that of the mount; NaN if it was refused."""
    off_m: float
    """How far its camera centre is from that of the mount."""

    def as_dict(self) -> dict[str, Any]:
        """Return the figures, JSON-ready."""
        refused = self.outcome == "refused"
        return {
            "file": self.name,
            "outcome": self.outcome,
            "off_deg": None if refused else round(float(np.degrees(self.off_rad)), 5),
            "off_mm": None if refused else round(1000 * self.off_m, 3),
            "reasons": list(self.registration.reasons),
        }


@dataclass(frozen=True, slots=True, eq=False)
class UnitCamera:
    """The mount of a camera on a pan/tilt unit."""

    accepted: bool
    """Whether the mount is verified."""
    reasons: tuple[str, ...]
    """Why it is not; or what limits it."""
    unit_from_camera: Rigid | None
    """The mount; None: no photograph was accepted."""
    covariance: FloatArray
    """(6, 6) of (w, c): w in rad with R_true = exp([w]x) R for the rotation camera_from_unit, c the error of the camera
    centre in the unit's axes, m; NaN without a mount."""
    chi2_per_dof: float
    """Of the photographs that agree; NaN for one alone. The covariance is raised by it where it exceeds 1."""
    camera: CameraModel
    """The camera."""
    photos: tuple[UnitCameraPhoto, ...]
    """In the order in which they were given."""

    @property
    def sigma_angle_rad(self) -> float:
        """Standard deviation of the direction."""
        return float(np.sqrt(np.trace(self.covariance[:3, :3])))

    @property
    def sigma_position_m(self) -> float:
        """Standard deviation of the position."""
        return float(np.sqrt(np.trace(self.covariance[3:, 3:])))

    @property
    def sentence(self) -> str:
        """The result in words."""
        agreeing = sum(one.outcome == "agrees" for one in self.photos)
        counted = f"{agreeing} of {len(self.photos)} photographs agree"
        if self.unit_from_camera is None:
            return "not found: no photograph was accepted"
        sigma = f"sigma {format_length(self.sigma_position_m)}, {format_angle(self.sigma_angle_rad)}"
        return f"{'verified' if self.accepted else 'not accepted'}: {counted}, {sigma}"

    def camera_from_world(self, world_from_unit: Rigid) -> Rigid:
        """Return the pose of the camera where the unit is at a position.

        Args:
            world_from_unit: of the part of the unit that pans and tilts.

        Raises:
            ShapeError: if there is no mount.
        """
        if self.unit_from_camera is None:
            raise ShapeError("the camera has no mount: no photograph was accepted")
        return (world_from_unit @ self.unit_from_camera).inverse

    def as_dict(self) -> dict[str, Any]:
        """Return the result, JSON-ready."""
        found = self.unit_from_camera is not None
        return {
            "accepted": self.accepted,
            "said": self.sentence,
            "reasons": list(self.reasons),
            "is": CAMERA_MOUNT_IS,
            "mount": None if self.unit_from_camera is None else self.unit_from_camera.matrix.tolist(),
            "covariance": self.covariance.tolist() if found else None,
            "sigma": {"position_mm": 1000 * self.sigma_position_m, "angle_deg": float(np.degrees(self.sigma_angle_rad))}
            if found
            else None,
            "chi2_per_dof": self.chi2_per_dof if np.isfinite(self.chi2_per_dof) else None,
            "camera": self.camera.as_fields(),
            "photos": [one.as_dict() for one in self.photos],
        }  # fmt: skip


def register_unit_camera(
    panorama: Scan,
    photos: Sequence[Photo],
    world_from_unit: Sequence[Rigid],
    *,
    names: Sequence[str] | None = None,
    initial: Rigid | None = None,
    is_scanner_mount_known: bool = False,
    options: RegisterOptions | None = None,
    report: Report | None = None,
) -> UnitCamera:
    """Estimate where a camera is mounted on a pan/tilt unit.

    Args:
        panorama: the scan that was composed of the run, in the frame that is called the world here.
        photos: photographs of one camera.
        world_from_unit: where the part of the unit that pans and tilts was for each of them.
        names: of the photographs, for messages; None: their own.
        initial: `unit_from_camera` as it is known roughly; None: searched for.
        is_scanner_mount_known: whether the mount of the scanner was estimated. If it was only stated, the camera's is
            as uncertain at least, by `STATED_MOUNT_SIGMAS`.
        options: of the registrations.
        report: receives the progress; may raise `Cancelled`.

    Returns:
        The mount, with a verdict: more than half of the photographs have to be accepted and agree, at two different
        positions at least.

    Raises:
        ShapeError: if there is no photograph, or not one position for each.
    """
    if not photos or len(photos) != len(world_from_unit):
        raise ShapeError(f"there are {len(photos)} photographs and {len(world_from_unit)} positions; give one for each")
    called = list(names or [photo.name for photo in photos])
    channels, found = Channels(), []
    known = initial
    for number, (photo, unit) in enumerate(zip(photos, world_from_unit, strict=True)):
        if report is not None:
            report(Progress(number, len(photos), f"registering {called[number]}"))
        start = None if known is None else (unit @ known).inverse
        result = register(panorama, photo, initial=start, options=options, channels=channels)
        found.append(result)
        if known is initial and result.accepted:
            known = unit.inverse @ result.camera_from_scanner.inverse
    if report is not None:
        report(Progress(len(photos), len(photos), "averaging the mounts"))
    made = _combined(called, photos[0].camera, found, world_from_unit)
    if is_scanner_mount_known:
        return made
    stated = np.repeat(np.square(STATED_MOUNT_SIGMAS), 3)
    return replace(made, covariance=made.covariance + np.diag(stated))


def _combined(
    names: Sequence[str], camera: CameraModel, found: Sequence[Registration], units: Sequence[Rigid]
) -> UnitCamera:
    """Return the mount that most photographs agree on."""
    used = [k for k, one in enumerate(found) if one.accepted and np.isfinite(one.covariance).all()]
    if not used:
        reason = "no photograph of the run was accepted; check the camera, and see the reasons of each"
        photos = tuple(
            UnitCameraPhoto(name, one, "refused", np.nan, np.nan) for name, one in zip(names, found, strict=True)
        )
        return UnitCamera(False, (reason,), None, np.full((6, 6), np.nan), np.nan, camera, photos)
    poses = [found[k].camera_from_scanner @ units[k] for k in used]  # camera_from_unit
    covariances = np.stack([_in_unit(found[k].covariance, units[k]) for k in used])
    weights = np.linalg.inv(covariances)
    mean, share = _mean(poses, covariances)
    squared = _squared(poses, mean, weights)
    agreeing = squared <= _CHI2_6_DOF
    offsets = np.stack([_offset(pose, mean) for pose in poses])
    count = int(agreeing.sum())
    kept = share[:, None, None] * weights
    chi2_per_dof = float((share * squared)[agreeing].sum() / (6 * (count - 1))) if count > 1 else np.nan
    covariance = np.linalg.inv(kept[agreeing].sum(axis=0) if count else kept.sum(axis=0))
    covariance = covariance * max(1.0, 1.0 if count < 2 else chi2_per_dof)
    outcomes: dict[int, tuple[PhotoOutcome, FloatArray]] = {
        k: ("agrees" if agrees else "disagrees", offset)
        for k, agrees, offset in zip(used, agreeing, offsets, strict=True)
    }
    photos = tuple(
        UnitCameraPhoto(
            name, one, outcomes[k][0], float(np.linalg.norm(outcomes[k][1][:3])),
            float(np.linalg.norm(outcomes[k][1][3:])),
        )
        if k in outcomes
        else UnitCameraPhoto(name, one, "refused", np.nan, np.nan)
        for k, (name, one) in enumerate(zip(names, found, strict=True))
    )  # fmt: skip
    reasons = _reasons(count, len(found), _positions([units[k] for k, ok in zip(used, agreeing, strict=True) if ok]))
    return UnitCamera(not reasons, reasons, mean.inverse, covariance, chi2_per_dof, camera, photos)


def _reasons(agreeing: int, photos: int, positions: int) -> tuple[str, ...]:
    if 2 * agreeing <= photos and photos > 1:
        return (
            f"only {agreeing} of {photos} photographs are verified and agree on one mount: the camera's focal length "
            "or the scanner's mount is wrong, something moved on the unit, or photographs belong to other stops",
        )
    if positions < 2:
        return (
            "one position of the unit alone cannot show whether its angles are right; take photographs at others, too",
        )
    return ()


def _positions(units: Sequence[Rigid]) -> int:
    """Return at how many different positions the unit was."""
    seen: list[Rigid] = []
    for unit in units:
        if all(unit.angle_to(other) > _SAME_POSITION_RAD for other in seen):
            seen.append(unit)
    return len(seen)


def _in_unit(covariance: FloatArray, unit: Rigid) -> FloatArray:
    """Return the covariance of a pose with the camera centre in the unit's axes in place of the world's."""
    turn = np.eye(6)
    turn[3:, 3:] = unit.rotation.T
    return turn @ covariance @ turn.T


def _offset(pose: Rigid, mean: Rigid) -> FloatArray:
    """Return the change (6,), (w, c), that leads from a mean to a pose."""
    w = rotvec_from_rotation(pose.rotation @ mean.rotation.T)
    return np.concatenate([w, pose.centre - mean.centre])


def _mean(poses: Sequence[Rigid], covariances: FloatArray) -> tuple[Rigid, FloatArray]:
    """Return the robust mean of poses, and the weight (K,) of each, at most 1.

    A pose that is accepted may still be off by several of its standard deviations: weights are those of Student's t
    with few degrees of freedom, in Gauss-Newton steps from the pose that most others are near to.
    """
    weights = np.linalg.inv(covariances)
    capped = [np.minimum(_squared(poses, pose, weights), _CHI2_6_DOF).sum() for pose in poses]
    mean, share = poses[int(np.argmin(capped))], np.ones(len(poses))
    for _ in range(_STEPS):
        share = np.minimum(1.0, (_NU + 6) / (_NU + _squared(poses, mean, weights)))
        offsets, scaled = np.stack([_offset(pose, mean) for pose in poses]), share[:, None, None] * weights
        step = np.linalg.solve(scaled.sum(axis=0), np.einsum("kij,kj->i", scaled, offsets))
        mean = Rigid.from_centre(rotation_from_rotvec(step[:3]) @ mean.rotation, mean.centre + step[3:])
    return mean, share


def _squared(poses: Sequence[Rigid], mean: Rigid, weights: FloatArray) -> FloatArray:
    """Return the squared Mahalanobis distances (K,) of poses from a mean."""
    offsets = np.stack([_offset(pose, mean) for pose in poses])
    return np.asarray(np.einsum("ki,kij,kj->k", offsets, weights, offsets))
