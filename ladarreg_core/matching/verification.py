"""Image verification: the verdict on a finished pose, from the agreement of image regions.

A region of this module is a window of `matching.agreement`: a block pooled with its neighbours.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ladarreg_core.arrays import FloatArray
from ladarreg_core.camera import Camera
from ladarreg_core.frames import Rigid
from ladarreg_core.matching.agreement import MIN_WINDOWS, Agreement
from ladarreg_core.surface.uncertainty import pixel_sigma

NEAR_PX = {1: 3.0, 0: 1.5}
"""Working pixels within which a region's correlation peak counts as agreeing, by level."""
_MAX_SIGMA_PX = 1.0  # two sigma: accepted poses are correct to 2 px
_STANDARD_PIXELS = 1_000_000
_MAX_REGIONS = 250
_SAMPLE = 500


@dataclass(frozen=True, slots=True)
class GateOptions:
    """Thresholds of image verification. A lower `fraction` accepts poses that are several pixels off."""

    fraction: float = 0.50
    """Minimum fraction of regions that agree at level 1."""
    contrast: float = 1.9
    """Minimum zb: correlation at near shifts above that at far shifts, in standard deviations."""
    many: int = 45
    """Number of agreeing regions that is sufficient on its own."""
    few: int = 25
    """Number of agreeing regions that is sufficient with `few_fraction` and `few_contrast`."""
    few_fraction: float = 0.8
    """Minimum fraction with at least `few` but fewer than `many` agreeing regions."""
    few_contrast: float = 2.5
    """Minimum contrast with at least `few` but fewer than `many` agreeing regions."""
    false_alarm: float = 1e-6
    """With still fewer regions: maximum bound on the probability of agreement by chance, levels 1 and 0 jointly."""
    fewest_fraction: float = 0.8
    """Minimum fraction with fewer than `few` agreeing regions."""
    fewest_contrast: float = 2.5
    """Minimum contrast with fewer than `few` agreeing regions."""
    fine_fraction: float = 0.35
    """Minimum fraction of regions that agree at level 0, where the tolerance is half as large."""


@dataclass(frozen=True, slots=True)
class Verification:
    """Verdict on a pose with the statistics it rests on."""

    windows: int
    """n: regions that could be compared at level 1."""
    agreeing: int
    """a: regions that agree."""
    fraction: float
    """f = a / n."""
    contrast: float
    """zb."""
    fine_fraction: float | None
    """f at level 0; None: not evaluated."""
    false_alarm: float
    """Bound on the probability of such agreement by chance, over all levels evaluated."""
    accepted: bool
    """Whether all thresholds are met."""
    reasons: tuple[str, ...]
    """Reasons, in sentences."""
    by_few: bool = False
    """Whether it is accepted on few regions, by their low false-alarm probability only."""
    regions: tuple[tuple[float, float, bool], ...] = ()
    """(u, v, agrees) of regions of a finished pose, photo pixels, spread over the photo; for display."""

    def as_dict(self) -> dict[str, Any]:
        """Return the statistics, JSON-ready."""
        return {
            "windows": self.windows,
            "agreeing": self.agreeing,
            "fraction": round(self.fraction, 4),
            "contrast": round(self.contrast, 3),
            "fine_fraction": None if self.fine_fraction is None else round(self.fine_fraction, 4),
            "false_alarm": float(f"{self.false_alarm:.3g}"),
            "by_few": self.by_few,
        }


def verify(coarse: Agreement, fine: Agreement | None, options: GateOptions | None = None) -> Verification:
    """Return the verdict on a pose; without `fine` it is a preliminary one, for ending the search early.

    Args:
        coarse: agreement at level 1.
        fine: agreement at level 0, of a finished pose.
        options: the thresholds.
    """
    o = options or GateOptions()
    n = coarse.windows
    a = int(coarse.agreeing(NEAR_PX[1]).sum())
    f, zb = a / max(n, 1), coarse.contrast()
    f0 = None if fine is None else float(fine.agreeing(NEAR_PX[0]).sum() / max(fine.windows, 1))
    # Level 0 contributes half of the digits of the bound and is missing from a preliminary verdict.
    alarm = coarse.false_alarm(NEAR_PX[1]) * (1.0 if fine is None else fine.false_alarm(NEAR_PX[0]))
    bound = o.false_alarm if fine is not None else o.false_alarm**0.5
    beyond_accident = alarm <= bound and f >= o.fewest_fraction and zb >= o.fewest_contrast
    enough = n >= MIN_WINDOWS and (a >= o.many or (a >= o.few and f >= o.few_fraction and zb >= o.few_contrast))
    reasons = []
    if n < MIN_WINDOWS and not (n and beyond_accident):
        reasons.append(
            f"Only {n} image regions have enough structure in the scan for a comparison; at least {MIN_WINDOWS} are "
            "needed, or fewer if nearly all of them agree."
        )
    else:
        if f < o.fraction:
            reasons.append(f"{a} of {n} image regions agree ({f:.0%}); at least {o.fraction:.0%} is needed.")
        if zb < o.contrast:
            reasons.append(
                f"The agreement is not distinct from that of shifted images: {zb:.1f} standard deviations; at least "
                f"{o.contrast:.1f} are needed."
            )
        if not (enough or beyond_accident) and f >= o.fraction:
            reasons.append(
                f"Too few image regions agree: {a}; at least {o.many} are needed, or fewer if "
                f"{min(o.few_fraction, o.fewest_fraction):.0%} agree at {o.few_contrast:.1f} standard deviations and "
                "chance agreement is ruled out."
            )
        if f0 is not None and f0 < o.fine_fraction:
            reasons.append(
                f"At full resolution only {f0:.0%} of the image regions agree within {NEAR_PX[0]:g} px; at least "
                f"{o.fine_fraction:.0%} is needed."
            )
    accepted = not reasons
    if accepted:
        reasons.append(f"{a} of {n} image regions agree with the scan ({f:.0%}).")
    return Verification(n, a, f, zb, f0, alarm, accepted, tuple(reasons), by_few=accepted and not enough)


def check_precision(
    verdict: Verification, points: FloatArray, camera: Camera, pose: Rigid, covariance: FloatArray
) -> Verification:
    """Return the verdict, refused if it rests on few regions and the pose is too uncertain.

    A few regions of a coarse scan may all agree and still determine the pose only to one scan cell, which can be many
    pixels of the photo.

    Args:
        verdict: of `verify`.
        points: (N, 3) scan points visible in the photo, scanner frame, m.
        camera: the photo's own camera.
        pose: `camera_from_scanner`.
        covariance: (6, 6) of the pose.
    """
    if not verdict.by_few or not len(points):
        return verdict
    some = points[:: max(1, len(points) // _SAMPLE)].astype(np.float64)
    sigma_px = float(np.nanmedian(pixel_sigma(pose @ some, camera, pose.rotation, covariance)))
    most = _MAX_SIGMA_PX * max(1.0, float(np.sqrt(camera.width * camera.height / _STANDARD_PIXELS)))
    if sigma_px <= most:
        return verdict
    reason = (
        f"The image regions agree, but they are too few: the pose is known to {sigma_px:.1f} px of the photo only, and "
        f"{most:.1f} px are needed. Scan at a higher resolution."
    )
    return replace(verdict, accepted=False, reasons=(reason,))


def region_markers(fine: Agreement, working: Camera, camera: Camera) -> tuple[tuple[float, float, bool], ...]:
    """Return (u, v, agrees) of at most 250 compared regions, in the photo's own pixels.

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
    every = -(-fine.windows // _MAX_REGIONS)
    shown = np.flatnonzero(np.isfinite(uv).all(axis=-1))
    shown = shown[fine.grid[shown].sum(axis=1) % every == 0]
    return tuple(
        (round(float(u), 1), round(float(v), 1), bool(a)) for (u, v), a in zip(uv[shown], agrees[shown], strict=True)
    )
