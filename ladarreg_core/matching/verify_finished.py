"""What a verdict takes from a finished pose: how precisely it is known, and where in the photo it agrees."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ladarreg_core.arrays import FloatArray
from ladarreg_core.camera import Camera
from ladarreg_core.frames import Rigid
from ladarreg_core.matching.agreement import Agreement
from ladarreg_core.matching.verification import NEAR_PX, Verification
from ladarreg_core.surface.uncertainty import pixel_sigma

_MOST_SIGMA_PX = 1.0  # two sigma are the 2 px that an accepted pose stays below
_STANDARD_PIXELS = 1_000_000
_MOST_REGIONS = 250
_SAMPLE = 500


def judged_by_precision(
    verdict: Verification, points: FloatArray, camera: Camera, pose: Rigid, covariance: FloatArray
) -> Verification:
    """Return a verdict that rests on few regions as refused where they tell the pose too roughly.

    Few regions of a coarse scan may all be right, and yet fix a pose to a cell only, which is many pixels of the photo.

    Args:
        verdict: of the gate.
        points: (N, 3) what the photo sees, scanner frame, m.
        camera: the photo's own camera.
        pose: `camera_from_scanner`.
        covariance: (6, 6) of the pose.
    """
    if not verdict.by_few or not len(points):
        return verdict
    some = points[:: max(1, len(points) // _SAMPLE)].astype(np.float64)
    sigma_px = float(np.nanmedian(pixel_sigma(pose @ some, camera, pose.rotation, covariance)))
    most = _MOST_SIGMA_PX * max(1.0, float(np.sqrt(camera.width * camera.height / _STANDARD_PIXELS)))
    if sigma_px <= most:
        return verdict
    reason = (
        f"The regions agree, but so few coarse ones tell the pose to {sigma_px:.1f} photo pixels only; {most:.1f} are "
        "needed: scan more finely."
    )
    return replace(verdict, accepted=False, reasons=(reason,))


def regions_of(fine: Agreement, working: Camera, camera: Camera) -> tuple[tuple[float, float, bool], ...]:
    """Return where the photo agrees with the scan, (u, v, agrees) in the photo's own pixels: 250 places at the most.

    Args:
        fine: agreement at level 0.
        working: the ideal camera of that level.
        camera: the photo's own camera.
    """
    if not fine.windows:
        return ()
    middle = np.array([fine.uv[members].mean(axis=0) for members in fine.members])
    uv = camera.project(working.unproject(middle))
    agrees = fine.agreeing(NEAR_PX[0])
    every = -(-fine.windows // _MOST_REGIONS)
    shown = np.flatnonzero(np.isfinite(uv).all(axis=-1))
    shown = shown[fine.grid[shown].sum(axis=1) % every == 0]
    return tuple(
        (round(float(u), 1), round(float(v), 1), bool(a)) for (u, v), a in zip(uv[shown], agrees[shown], strict=True)
    )
