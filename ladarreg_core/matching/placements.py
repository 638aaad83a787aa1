"""Placements beside the true one, of photographs whose camera is only assumed.

The images are compared as seen by the stated camera. If its focal length is wrong, a pose some centimetres off makes up
for it in part, and refinement ends there. Where that may be, the search is repeated with other focal lengths; where the
images agree on two placements nearly alike, the uncertainty contains both.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from ladarreg_core.camera import Camera
from ladarreg_core.foundations.formatting import format_length
from ladarreg_core.frames import rotvec_from_rotation
from ladarreg_core.matching.auto_result import AutoResult

_SURE_FINE_FRACTION = 0.85  # of regions that agree: at true poses of simulated pairs .8-1, beside them up to .81
_AS_WELL = 0.25  # of that fraction: true poses had up to .17 less than others that were a tenth of a metre off
_ALIKE = 2.0  # standard deviations per parameter up to which two poses are the same
_BESIDE = 0.02  # of the focal length: such poses are 1 to 4 % off it


def may_be_beside(result: AutoResult) -> bool:
    """Return whether an accepted pose may be beside the true one: its camera was estimated, and many regions do not
    agree at full resolution."""
    verdict = result.verification
    if verdict is None or not result.accepted or result.camera is None:
        return False
    return (verdict.fine_fraction or 0.0) < _SURE_FINE_FRACTION


def cameras_beside(camera: Camera, stated: Camera) -> Iterator[Camera]:
    """Yield an estimated camera with longer and shorter focal lengths, first the one farther from what was stated."""
    farther = 1 if camera.fx >= stated.fx else -1
    for sign in (farther, -farther):
        by = 1 + sign * _BESIDE
        yield replace(camera, fx=camera.fx * by, fy=camera.fy * by)


def best_of_placements(found: Sequence[AutoResult], stated: Camera) -> AutoResult:
    """Return the best of several results; its uncertainty contains others on which the images agree nearly as well.

    The covariance is that of a mixture of equal parts about the best.

    Args:
        found: of the same pair, searched with different cameras.
        stated: the camera of a result that estimated none.
    """
    best = max(found, key=_rank)
    accepted, fine = _rank(best)
    pose, evidence, joint = best.camera_from_scanner, best.evidence, best.camera_uncertainty
    if not accepted or pose is None or evidence is None or not may_be_beside(best):
        return best
    names = () if joint is None else joint.names
    covariance = np.array(evidence.covariance if joint is None else joint.covariance)
    spread, farthest = np.zeros_like(covariance), best
    for other in found:
        there = other.camera_from_scanner
        if other is best or there is None or _rank(other) < (True, fine - _AS_WELL):
            continue
        camera, own = other.camera or stated, best.camera or stated
        values = [_intrinsic(camera, name) - _intrinsic(own, name) for name in names]
        turn = rotvec_from_rotation(there.rotation @ pose.rotation.T)
        apart = np.concatenate([turn, there.centre - pose.centre, values])
        if apart @ np.linalg.solve(covariance, apart) <= _ALIKE**2 * len(apart):
            continue
        spread += np.outer(apart, apart) / len(found)
        if pose.distance_to(there) > pose.distance_to(farthest.camera_from_scanner or pose):
            farthest = other
    if farthest is best or farthest.camera_from_scanner is None:
        return best
    there, focal_px = farthest.camera_from_scanner, (farthest.camera or stated).focal_px
    reason = (
        f"The images agree nearly as well {format_length(pose.distance_to(there))} and "
        f"{np.degrees(pose.angle_to(there)):.2g} deg away, with a focal length of {focal_px:.1f} px: the uncertainty "
        "of the pose contains both. Calibrate the camera, or draw a few matches."
    )
    covariance += spread
    if joint is not None:
        joint = replace(joint, covariance=covariance)
        best = replace(best, camera_sigmas={name: joint.sigmas.get(name, s) for name, s in best.camera_sigmas.items()})
    evidence = replace(evidence, covariance=covariance[:6, :6])
    return replace(best, evidence=evidence, camera_uncertainty=joint, reasons=(*best.reasons, reason))


def _intrinsic(camera: Camera, name: str) -> float:
    if name == "k1":
        return camera.distortion[0] if camera.distortion else 0.0
    return float(getattr(camera, name))


def _rank(result: AutoResult) -> tuple[bool, float]:
    verdict = result.verification
    return (False, 0.0) if verdict is None else (verdict.accepted, verdict.fine_fraction or 0.0)
