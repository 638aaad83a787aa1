"""A pose carried over to a second camera on the same mount, where that camera's own picture cannot be matched."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ladarreg_core.arrays import FloatArray
from ladarreg_core.frames import Rigid, skew
from ladarreg_core.matches import Matches
from ladarreg_core.photo import Photo
from ladarreg_core.pose.describe import describe_pose
from ladarreg_core.pose.estimate import STATED_SIGMA_PX, STATED_SIGMA_RANGE_M
from ladarreg_core.progress import Step
from ladarreg_core.results import Offset, PoseResult, Registration


def carry_over(registration: Registration, offset: Offset | Rigid, photo_b: Photo) -> Registration:
    """Return the registration of a second camera's photo, from that of the first camera and the mount between them.

    Nothing of the second photo is looked at: gamma pictures, for one, show too little to be matched.

    Args:
        registration: of the first camera's photo, to the same scan, taken at the same moment.
        offset: `camera_b_from_camera_a`, with how well it is known; a bare transform has the stated uncertainties.
        photo_b: the second camera's photo.

    Returns:
        a registration by `carried`, without matches. It is accepted where the first one is, by `statistics`: its
        covariance is the first one's and the offset's, propagated.
    """
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

    With p the place of b in camera a's frame and R_a, R_o the turns of a and of the offset: w_b = R_o w_a + w_o and
    c_b = c_a + R_a^T (p x w_a) + R_a^T dp.
    """
    between, turn_a = mount.camera_b_from_camera_a, registration.camera_from_scanner.rotation
    J = np.eye(6)
    J[:3, :3] = between.rotation
    J[3:, :3] = turn_a.T @ skew(between.centre)
    own = np.diag([mount.sigma_angle_rad**2] * 3 + [mount.sigma_position_m**2] * 3)
    total: FloatArray = J @ np.asarray(registration.covariance) @ J.T + own
    return (total + total.T) / 2


def _reasons(registration: Registration, mount: Offset, result: PoseResult) -> tuple[str, ...]:
    turn, shift = np.degrees(mount.sigma_angle_rad), 1000 * mount.sigma_position_m
    if not registration.accepted:
        return (
            "The registration that this pose would be carried over from is not accepted; accept that one first.",
            *registration.reasons,
        )
    return (
        "Carried over from a camera on the same mount; nothing of this photo was compared with the scan.",
        f"The offset between the cameras is taken as known to {turn:.2g} deg and {shift:.2g} mm about and along each "
        f"axis; with the first pose's own uncertainty that gives {np.degrees(result.sigma_angle_rad):.2g} deg and "
        f"{1000 * result.sigma_position_m:.2g} mm.",
        *(f"Of the first camera: {reason}" for reason in registration.reasons),
    )
