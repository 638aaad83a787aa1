"""The verdict on a finished pose, from the pictures alone."""

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
"""Photo pixels within which a window's peak counts as agreeing, by level."""
_MAX_SIGMA_PX = 1.0  # two sigma are the 2 px that an accepted pose stays below
_STANDARD_PIXELS = 1_000_000
_MAX_REGIONS = 250
_SAMPLE = 500


@dataclass(frozen=True, slots=True)
class GateOptions:
    """What a pose must show to be called verified. Lowering `fraction` lets near-misses through."""

    fraction: float = 0.50
    """Least share of windows that agree, level 1."""
    contrast: float = 1.9
    """Least zb: near shifts against far ones, in standard deviations."""
    many: int = 45
    """So many agreeing windows are enough..."""
    few: int = 25
    """...or so many, if both of the next hold."""
    few_fraction: float = 0.8
    """Share needed with few windows."""
    few_contrast: float = 2.5
    """Contrast needed with few windows."""
    false_alarm: float = 1e-6
    """With fewer still: largest bound on so much agreement by accident, level 1 times level 0..."""
    fewest_fraction: float = 0.8
    """...and this share..."""
    fewest_contrast: float = 2.5
    """...and this contrast."""
    fine_fraction: float = 0.35
    """Least share of windows that agree at level 0, where the tolerance is half as large."""


@dataclass(frozen=True, slots=True)
class Verification:
    """The figures behind the verdict."""

    windows: int
    """n: windows that could be judged at level 1."""
    agreeing: int
    """a: windows that agree."""
    fraction: float
    """f = a / n."""
    contrast: float
    """zb."""
    fine_fraction: float | None
    """f at level 0; None: not looked at."""
    false_alarm: float
    """A bound on so much agreement of single regions by accident, at all levels looked at."""
    accepted: bool
    """Whether the gate is passed."""
    reasons: tuple[str, ...]
    """Why, in sentences."""
    by_few: bool = False
    """Whether it is accepted only since so few regions cannot agree by accident."""
    regions: tuple[tuple[float, float, bool], ...] = ()
    """(u, v, agrees) of regions of a finished pose, photo pixels, spread over the photo; for showing."""

    def as_dict(self) -> dict[str, Any]:
        """Return the figures, JSON-ready."""
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
    """Judge a finished pose; without `fine` it is only a first look that a climb may stop at.

    Args:
        coarse: agreement at level 1.
        fine: agreement at level 0.
        options: the gate.
    """
    o = options or GateOptions()
    n = coarse.windows
    a = int(coarse.agreeing(NEAR_PX[1]).sum())
    f, zb = a / max(n, 1), coarse.contrast()
    f0 = None if fine is None else float(fine.agreeing(NEAR_PX[0]).sum() / max(fine.windows, 1))
    # Level 0 stands for half of the digits, and is missing where a climb is only looked at.
    alarm = coarse.false_alarm(NEAR_PX[1]) * (1.0 if fine is None else fine.false_alarm(NEAR_PX[0]))
    bound = o.false_alarm if fine is not None else o.false_alarm**0.5
    beyond_accident = alarm <= bound and f >= o.fewest_fraction and zb >= o.fewest_contrast
    enough = n >= MIN_WINDOWS and (a >= o.many or (a >= o.few and f >= o.few_fraction and zb >= o.few_contrast))
    reasons = []
    if n < MIN_WINDOWS and not (n and beyond_accident):
        reasons.append(
            f"Only {n} regions of the picture hold enough structure of the scan to compare; {MIN_WINDOWS} are "
            "needed, or fewer that nearly all agree."
        )
    else:
        if f < o.fraction:
            reasons.append(f"{a} of {n} regions agree ({f:.0%}); {o.fraction:.0%} are needed.")
        if zb < o.contrast:
            reasons.append(
                f"The agreement hardly stands out against shifted pictures ({zb:.1f} standard deviations; "
                f"{o.contrast:.1f} are needed)."
            )
        if not (enough or beyond_accident) and f >= o.fraction:
            reasons.append(
                f"Too few regions agree to be sure: {a}; {o.many} are needed, or fewer that agree at "
                f"{min(o.few_fraction, o.fewest_fraction):.0%} and {o.few_contrast:.1f} standard deviations and cannot "
                "do so by accident."
            )
        if f0 is not None and f0 < o.fine_fraction:
            reasons.append(
                f"At full resolution only {f0:.0%} of the regions agree within {NEAR_PX[0]:g} px; "
                f"{o.fine_fraction:.0%} are needed."
            )
    accepted = not reasons
    if accepted:
        reasons.append(f"{a} of {n} regions of the picture agree with the scan ({f:.0%}).")
    return Verification(n, a, f, zb, f0, alarm, accepted, tuple(reasons), by_few=accepted and not enough)


def check_precision(
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
    most = _MAX_SIGMA_PX * max(1.0, float(np.sqrt(camera.width * camera.height / _STANDARD_PIXELS)))
    if sigma_px <= most:
        return verdict
    reason = (
        f"The regions agree, but so few coarse ones tell the pose to {sigma_px:.1f} photo pixels only; {most:.1f} are "
        "needed: scan more finely."
    )
    return replace(verdict, accepted=False, reasons=(reason,))


def region_markers(fine: Agreement, working: Camera, camera: Camera) -> tuple[tuple[float, float, bool], ...]:
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
    every = -(-fine.windows // _MAX_REGIONS)
    shown = np.flatnonzero(np.isfinite(uv).all(axis=-1))
    shown = shown[fine.grid[shown].sum(axis=1) % every == 0]
    return tuple(
        (round(float(u), 1), round(float(v), 1), bool(a)) for (u, v), a in zip(uv[shown], agrees[shown], strict=True)
    )
