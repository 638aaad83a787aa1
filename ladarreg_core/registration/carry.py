"""Transfers a pose to a second camera on the same mount, whose own image cannot be matched."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ladarreg_core.errors import DegenerateGeometryError
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.foundations.formatting import format_angle, format_length
from ladarreg_core.frames import Rigid, skew
from ladarreg_core.matches import Matches
from ladarreg_core.photo import Photo
from ladarreg_core.pose.estimate import STATED_SIGMA_PX, STATED_SIGMA_RANGE_M
from ladarreg_core.pose.result import describe_pose
from ladarreg_core.results.offset import Offset
from ladarreg_core.results.registration import PoseResult, Registration
from ladarreg_core.results.steps import Step


def carry_over(registration: Registration, offset: Offset | Rigid, photo_b: Photo) -> Registration:
    """Return the registration of a second camera's photo, from that of the first camera and the offset between them.

    The second photo itself is not used: gamma images, for example, show too little to be matched.

    Args:
        registration: of the first camera's photo, taken at the same moment, to the same scan.
        offset: `camera_b_from_camera_a` with its uncertainty; a bare transform gets the assumed one.
        photo_b: the second camera's photo.

    Returns:
        a registration by the method `carried`, without matches. It is accepted if the first one is, with the evidence
        `statistics`; its covariance is propagated from the first pose's and the offset's.

    Raises:
        DegenerateGeometryError: if the covariance of the first pose is not known, as of a given one.
    """
    if not np.isfinite(registration.covariance).all():
        raise DegenerateGeometryError(
            "the pose of the first camera was given, so its uncertainty, which would be carried over, is not known; "
            "register that photo, or multiply the poses and give this photo's own"
        )
    mount = Offset(offset) if isinstance(offset, Rigid) else offset
    between = mount.camera_b_from_camera_a
    pose = between @ registration.camera_from_scanner
    described = describe_pose(
        pose,
        Matches.none(),
        np.zeros(0, np.bool_),
        photo_b.camera,
        sigma_px=STATED_SIGMA_PX,
        sigma_range_m=STATED_SIGMA_RANGE_M,
        covariance=_propagated(registration, mount),
    )
    result = replace(
        described,
        world_from_scanner=registration.world_from_scanner,
        accepted=registration.accepted,
        evidence="statistics" if registration.accepted else "none",
        reasons=_reasons(registration, mount, described),
        diagnostics={
            **described.diagnostics,
            "carried": {
                "from_method": registration.method,
                "from_evidence": registration.evidence,
                "offset_sigma_angle_rad": mount.sigma_angle_rad,
                "offset_sigma_position_m": mount.sigma_position_m,
            },
        },
    )
    values = {name: getattr(result, name) for name in PoseResult.__dataclass_fields__}
    return Registration(**values, method="carried", steps=(Step("carry over", 0.0, pose=pose),), seed=registration.seed)


def _propagated(registration: Registration, mount: Offset) -> FloatArray:
    """Return the covariance (6, 6) of camera b's (w, c), to first order.

    With p the position of b in camera a's frame and R_a, R_o the rotations of a and of the offset:
    w_b = R_o w_a + w_o and c_b = c_a + R_a^T (p x w_a) + R_a^T dp.
    """
    between, rotation_a = mount.camera_b_from_camera_a, registration.camera_from_scanner.rotation
    J = np.eye(6)
    J[:3, :3] = between.rotation
    J[3:, :3] = rotation_a.T @ skew(between.centre)
    own = np.diag([mount.sigma_angle_rad**2] * 3 + [mount.sigma_position_m**2] * 3)
    total: FloatArray = J @ np.asarray(registration.covariance) @ J.T + own
    return (total + total.T) / 2


def _reasons(registration: Registration, mount: Offset, result: PoseResult) -> tuple[str, ...]:
    if not registration.accepted:
        return (
            "The registration of the first camera is not accepted, so neither is this pose; register that photo first.",
            *registration.reasons,
        )
    return (
        "Pose carried over from a camera on the same mount; this photo was not compared with the scan.",
        f"Uncertainty of the offset between the cameras (1 sigma per axis): {format_angle(mount.sigma_angle_rad)} and "
        f"{format_length(mount.sigma_position_m)}; together with that of the first pose: "
        f"{format_angle(result.sigma_angle_rad)} and {format_length(result.sigma_position_m)}.",
        *(f"First camera: {reason}" for reason in registration.reasons),
    )
