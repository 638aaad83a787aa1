"""The photographs of a survey as registrations on one of its scans, as if each had been registered by itself."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np

from ladarreg_core.export.json import plain
from ladarreg_core.frames import skew
from ladarreg_core.matches import Matches
from ladarreg_core.pose.result import describe_pose
from ladarreg_core.registration.register import RegisterOptions
from ladarreg_core.results.registration import PoseResult, Registration
from ladarreg_core.survey.adjust import Solved
from ladarreg_core.survey.adjustment import Adjustment
from ladarreg_core.survey.least_squares.problem import Matrix
from ladarreg_core.survey.survey import Survey

METHOD = "survey"
"""Method of a registration that a survey gave."""


def photo_registration(survey: Survey, solved: Solved, k: int, scan: int, options: RegisterOptions) -> Registration:
    """Return the registration of an accepted photograph on a scan that has a place in the world.

    Args:
        survey: the survey.
        solved: its solution.
        k: index of the photograph.
        scan: index of the scan; its image need not have verified the photograph.
        options: of the registrations.
    """
    state, adjustment = solved.states[k], solved.adjustment
    photo, name = adjustment.photos[state.given.id], survey.scans[scan].id
    world = adjustment.scans[name].world_from_scanner
    assert photo.camera_from_world is not None
    assert world is not None
    found = state.pairs.get(scan)
    described = describe_pose(
        photo.camera_from_world @ world,
        Matches.none() if found is None else found.matches,
        np.zeros(0, np.bool_) if found is None else found.inliers,
        photo.camera,
        covariance=relative_covariance(adjustment, state.given.id, name),
        sigma_px=1.0 if found is None else found.sigma_px,
        sigma_range_m=0.015 if found is None else found.sigma_range_m,
    )
    fields = {name: getattr(described, name) for name in PoseResult.__dataclass_fields__}
    fields |= {
        "accepted": True, "evidence": photo.evidence, "reasons": photo.reasons, "world_from_scanner": world,
    }  # fmt: skip
    return Registration(**fields, method=METHOD, options=plain(asdict(options)), seed=options.seed)


def main_scan(survey: Survey, solved: Solved, k: int) -> int:
    """Return the scan that a photograph's results are of: the one that determines it best, or stood nearest."""
    state, scans = solved.states[k], solved.adjustment.scans
    photo = solved.adjustment.photos[state.given.id]
    assert photo.camera_from_world is not None
    placed = [j for j, one in enumerate(survey.scans) if scans[one.id].accepted]
    by_image = [j for j in placed if j in state.pairs]
    if by_image:
        return min(by_image, key=lambda j: float(np.trace(state.pairs[j].covariance[3:, 3:])))
    centre = photo.camera_from_world.centre

    def away(j: int) -> float:
        pose = scans[survey.scans[j].id].world_from_scanner
        assert pose is not None
        return float(np.linalg.norm(pose.translation - centre))

    return min(placed, key=away)


def relative_covariance(adjustment: Adjustment, photo: str, scan: str) -> Matrix:
    """Return the covariance (6, 6) of a photograph's pose relative to a scanner, (w, c) in that scanner's frame.

    With R the rotation of `camera_from_scanner` and C its centre, w = w_photo - R w_scan and c = R_scan (c_photo -
    c_scan) - [C]x w_scan, with the scanner's own w about its axes.
    """
    one, base = adjustment.photos[photo], adjustment.scans[scan]
    assert one.camera_from_world is not None
    assert base.world_from_scanner is not None
    pose = one.camera_from_world @ base.world_from_scanner
    scanner = base.world_from_scanner.rotation.T
    J = np.zeros((6, 12))
    J[:3, :3], J[:3, 6:9] = np.eye(3), -pose.rotation
    J[3:, 3:6], J[3:, 9:] = scanner, -scanner
    J[3:, 6:9] = -skew(pose.centre)
    rows = [
        row for key in (("photo", photo), ("scan", scan))
        for row in range(6 * adjustment.joint_ids.index(key), 6 * adjustment.joint_ids.index(key) + 6)
    ]  # fmt: skip
    found = J @ adjustment.joint[np.ix_(rows, rows)] @ J.T
    return np.asarray((found + found.T) / 2)
