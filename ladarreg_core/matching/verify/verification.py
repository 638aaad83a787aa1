"""Image verification: the verdict on a finished pose, from the agreement of image regions.

`GateOptions` holds every threshold that decides acceptance on the image, including those of a second pose.
A region of this module is a window of `matching.agreement`: a block pooled with its neighbours.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ladarreg_core.camera import Camera, CameraModel
from ladarreg_core.camera.uncertainty import CameraUncertainty
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.frames import Rigid
from ladarreg_core.matching.verify.agreement import Agreement
from ladarreg_core.surface.uncertainty import pixel_sigma

_STANDARD_PIXELS = 1_000_000
_MAX_REGIONS = 250
_SAMPLE = 500
_NO_NUMBER = 10**6
_MEANINGFUL = 0.1  # of the longer side: the most uncertainty that is stated as a number

_COARSE_FEW_CONTRAST = 2.8  # `few_contrast` of a coarse scan, which is compared where it shows a shape or paint
_UNSURE_FRACTION, _UNSURE_CORRELATION = 0.7, 0.6  # `second_*` beside a pose that is not sure


@dataclass(frozen=True, slots=True)
class GateOptions:
    """Thresholds of image verification. A lower `fraction` accepts poses that are several pixels off."""

    least_regions: int = 12
    """Minimum number of regions that could be compared, unless agreement by chance is ruled out."""
    near_px: float = 3.0
    """Maximum distance of a region's correlation peak from zero shift at level 1 to agree, working pixels."""
    fine_near_px: float = 1.5
    """Maximum distance of the peak at level 0 to agree, working pixels."""
    far_px: float = 7.0
    """Shifts farther than this count as far for `contrast`, working pixels; those within `near_px` count as near."""
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
    least_chance: float = 0.25
    """Minimum probability assumed for one block to agree by chance: the most that agreed at refined wrong poses."""
    fewest_fraction: float = 0.8
    """Minimum fraction with fewer than `few` agreeing regions."""
    fewest_contrast: float = 2.5
    """Minimum contrast with fewer than `few` agreeing regions."""
    fine_fraction: float = 0.35
    """Minimum fraction of regions that agree at level 0, where the tolerance is half as large."""
    shape_many: int = 20
    """`many` for a coarse scan without intensity, of which outlines alone are compared: few regions, most of which
    agree."""
    shape_fraction: float = 0.60
    """`fraction` for such a scan."""
    shape_contrast: float = 2.3
    """`contrast` for such a scan."""
    shape_fine_fraction: float = 0.45
    """`fine_fraction` for such a scan: outlines may agree at level 1 beside the pose."""
    own_false_alarm: float = 1e-3
    """Of a coarse scan with too few agreeing regions for a verdict by their number: maximum probability of a false
    agreement, as measured at wrong poses of the pair itself."""
    own_margin: float = 1.6
    """Minimum correlation of such a pose at full resolution, relative to the highest at a wrong pose."""
    most_sigma_px: float = 1.0
    """Maximum median uncertainty of a pose accepted on fewer than `few` regions, px of a 1-megapixel photo; larger
    photos: more."""
    few_sigma_px: float = 4.0
    """The same for a pose accepted on `few` regions or more, but fewer than `many`; smaller photos: less."""
    coarse_sigma_px: float = 6.0
    """The same for any other pose of a scan that is coarse, if only between its lines; smaller photos: less. From
    half of the default on, the pose is called coarse."""
    any_sigma_px: float = 8.0
    """The same for every other pose; larger photos: more. The matches of such a pose do not agree on it."""
    same_pose_px: float = 8.0
    """Maximum median displacement in the photo of two poses that count as the same, px."""
    same_angle_rad: float = float(np.deg2rad(3.0))
    """Maximum angle between the pose and a second one that count as the same, rad."""
    second_fraction: float = 0.8
    """Minimum fraction of agreeing regions of a second pose that competes, relative to the first pose."""
    second_count: float = 0.6
    """Minimum number of agreeing regions of a second pose that competes, relative to the first pose."""
    second_correlation: float = 0.8
    """Minimum correlation of a second pose at the coarsest level, relative to the first pose."""
    second_peak: float = 0.4
    """Minimum correlation of the shifted image, relative to no shift, for a second pose to be sought there."""
    second_overlap: float = 0.4
    """Minimum share of the compared points inside the photo after that shift."""
    sure_fraction: float = 0.6
    """Minimum fraction of agreeing regions of a pose that is sure: given an initial pose, no second one is sought."""


def small_regions_gate(gate: GateOptions) -> GateOptions:
    """Return the thresholds for smaller regions: `few` of them do not suffice without ruling out chance."""
    return replace(gate, few=gate.many)


def unsure_gate(gate: GateOptions) -> GateOptions:
    """Return the thresholds of a second pose beside one that is not sure: it competes more easily."""
    return replace(
        gate,
        second_fraction=min(gate.second_fraction, _UNSURE_FRACTION),
        second_correlation=min(gate.second_correlation, _UNSURE_CORRELATION),
    )


def coarse_gate(gate: GateOptions) -> GateOptions:
    """Return the thresholds for a coarse scan of which intensity and shape are compared, where they show anything."""
    return replace(gate, few_contrast=max(gate.few_contrast, _COARSE_FEW_CONTRAST))


def shape_alone_gate(gate: GateOptions) -> GateOptions:
    """Return the thresholds for a coarse scan of which the shape alone is compared: no fraction is lower."""
    return replace(
        gate,
        many=min(gate.many, gate.shape_many),
        fraction=max(gate.fraction, gate.shape_fraction),
        contrast=max(gate.contrast, gate.shape_contrast),
        fine_fraction=max(gate.fine_fraction, gate.shape_fine_fraction),
    )


def interpolated_gate(gate: GateOptions) -> GateOptions:
    """Return the thresholds for a coarse scan that is interpolated: wrong poses of the pair decide, and no number.

    Its regions are many, and what was not measured in them is alike.
    """
    return replace(gate, few=_NO_NUMBER, many=_NO_NUMBER, false_alarm=0.0)


def gate_for(gate: GateOptions, *, coarse: bool, shape_alone: bool, interpolated: bool) -> GateOptions:
    """Return the thresholds for a scan: a coarse one, of which the shape alone may be compared, or one interpolated."""
    if coarse:
        gate = shape_alone_gate(gate) if shape_alone else coarse_gate(gate)
    return interpolated_gate(gate) if interpolated else gate


COARSE_GATE = GateOptions(
    contrast=2.1, many=35, few=35, few_contrast=2.1, few_fraction=0.5, fine_fraction=0.30, false_alarm=0.0,
    own_false_alarm=0.0,
)  # fmt: skip
"""Thresholds for thermal images: fewer regions than for colour, since the images are small; poses are called coarse."""


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
    """Bound on the probability of such agreement by chance, over all levels evaluated; with `wrong_poses`, measured at
    these."""
    accepted: bool
    """Whether all thresholds are met."""
    reasons: tuple[str, ...]
    """Reasons, in sentences."""
    by_few: bool = False
    """Whether it is accepted on few regions, by their low false-alarm probability only."""
    wrong_poses: int = 0
    """Number of wrong poses of the pair that it was compared with; 0: none, since enough regions agree, or too few."""
    regions: tuple[tuple[float, float, bool], ...] = ()
    """(u, v, agrees) of regions of a finished pose, photo pixels, spread over the photo; for display."""

    def as_dict(self) -> dict[str, Any]:
        """Return the statistics, JSON-ready."""
        measured = {"wrong_poses": self.wrong_poses} if self.wrong_poses else {}
        return {
            "windows": self.windows,
            "agreeing": self.agreeing,
            "fraction": round(self.fraction, 4),
            "contrast": round(self.contrast, 3),
            "fine_fraction": None if self.fine_fraction is None else round(self.fine_fraction, 4),
            "false_alarm": float(f"{self.false_alarm:.3g}"),
            "by_few": self.by_few,
            **measured,
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
    a = int(coarse.agreeing(o.near_px).sum())
    f, zb = a / max(n, 1), coarse.contrast(near_px=o.near_px, far_px=o.far_px)
    f0 = None if fine is None else float(fine.agreeing(o.fine_near_px).sum() / max(fine.windows, 1))
    # Level 0 contributes half of the digits of the bound and is missing from a preliminary verdict.
    alarm = coarse.false_alarm(o.near_px, least_chance=o.least_chance)
    if fine is not None:
        alarm *= fine.false_alarm(o.fine_near_px, least_chance=o.least_chance)
    bound = o.false_alarm if fine is not None else o.false_alarm**0.5
    beyond_accident = alarm <= bound and f >= o.fewest_fraction and zb >= o.fewest_contrast
    enough = n >= o.least_regions and (a >= o.many or (a >= o.few and f >= o.few_fraction and zb >= o.few_contrast))
    reasons = []
    if n < o.least_regions and not (n and beyond_accident):
        reasons.append(
            f"Only {n} image regions have enough structure in the scan for a comparison: too few, unless nearly all of "
            "them agree."
        )
    else:
        if f < o.fraction:
            reasons.append(f"Only {a} of {n} image regions agree ({f:.0%}).")
        if zb < o.contrast:
            reasons.append(
                f"The agreement is not distinct enough from that of shifted images: {zb:.1f} standard deviations."
            )
        if not (enough or beyond_accident) and f >= o.fraction:
            reasons.append(
                f"Too few image regions agree: {a} of {n}; so few count only where nearly all agree beyond chance."
            )
        if f0 is not None and f0 < o.fine_fraction:
            reasons.append(f"At full resolution only {f0:.0%} of the image regions agree within {o.fine_near_px:g} px.")
    accepted = not reasons
    if accepted:
        reasons.append(f"{a} of {n} image regions agree with the scan ({f:.0%}).")
    return Verification(n, a, f, zb, f0, alarm, accepted, tuple(reasons), by_few=accepted and not enough)


def rests_on_number(verdict: Verification, options: GateOptions) -> bool:
    """Return whether a finished pose lacks nothing but agreeing regions, so that wrong poses of its pair decide.

    Args:
        verdict: of `verify` itself; what was refused for another reason since would be accepted.
        options: the thresholds.
    """
    if verdict.accepted:
        return verdict.by_few
    return (
        verdict.windows >= options.least_regions
        and verdict.fraction >= options.fraction
        and verdict.contrast >= options.contrast
        and verdict.fine_fraction is not None
        and verdict.fine_fraction >= options.fine_fraction
    )


def beside_wrong_poses(
    verdict: Verification, *, false_alarm: float, highest: float, count: int, options: GateOptions
) -> Verification:
    """Return the verdict on a pose that lacks nothing but agreeing regions: accepted if it stands out from wrong ones.

    Args:
        verdict: of `verify`.
        false_alarm: bound on the probability that a wrong pose agrees as well.
        highest: correlation of the best wrong pose, relative to this one.
        count: number of wrong poses.
        options: the thresholds.
    """
    what = f"{count} wrong poses of this pair, refined alike"
    if not count:
        return verdict
    if false_alarm > options.own_false_alarm or highest * options.own_margin > 1:
        reason = (
            f"It does not stand out from {what}: they correlate up to {highest:.0%} as well, and one as good has a "
            f"probability of {false_alarm:.1g}."
        )
        reasons = verdict.reasons if verdict.accepted else (*verdict.reasons, reason)
        return replace(verdict, reasons=reasons, wrong_poses=count)
    reasons = (
        f"{verdict.agreeing} of {verdict.windows} image regions agree with the scan ({verdict.fraction:.0%}), and "
        f"{what}, correlate at most {highest:.0%} as well: probability of a false agreement {false_alarm:.1g}.",
    )
    return replace(verdict, accepted=True, by_few=False, false_alarm=false_alarm, reasons=reasons, wrong_poses=count)


def check_precision(
    verdict: Verification,
    points: FloatArray,
    camera: CameraModel,
    pose: Rigid,
    covariance: FloatArray | CameraUncertainty,
    options: GateOptions | None = None,
    *,
    coarse: bool = False,
) -> Verification:
    """Return the verdict, refused if the pose is too uncertain, above all if it rests on few regions or a coarse scan.

    Regions of a coarse scan may all agree and still determine the pose only to one scan cell, which can be many pixels
    of the photo. With many regions of a dense scan, uncertainty means that other intrinsics lead to another pose.

    Args:
        verdict: of `verify`.
        points: (N, 3) scan points visible in the photo, scanner frame, m.
        camera: the photo's own camera.
        pose: `camera_from_scanner`.
        covariance: (6, 6) of the pose, or of pose and camera together.
        options: the thresholds.
        coarse: whether the scan's cells are wider than the pixels compared, in either direction.
    """
    gate = options or GateOptions()
    size = float(np.sqrt(camera.width * camera.height / _STANDARD_PIXELS))
    if verdict.by_few:
        most = gate.most_sigma_px * max(1.0, size)
    elif verdict.accepted and coarse:
        most = gate.coarse_sigma_px * size
    elif verdict.accepted and verdict.agreeing < gate.many:
        most = gate.few_sigma_px * size
    else:
        most = gate.any_sigma_px * max(1.0, size)
    if not (verdict.accepted and len(points)):
        return verdict
    some = points[:: max(1, len(points) // _SAMPLE)].astype(np.float64)
    sigma_px = float(np.nanmedian(pixel_sigma(pose @ some, camera, pose.rotation, covariance)))
    if sigma_px <= most:
        return verdict
    known = f"is known to {sigma_px:.1f} px of the photo only, {_times(sigma_px / most)} what is accepted"
    if not sigma_px <= _MEANINGFUL * max(camera.size):
        known = "is not determined"
    if coarse and not verdict.by_few:
        why, remedy = "the scan is coarse", "Scan at a higher resolution."
    elif verdict.by_few or verdict.agreeing < gate.many:
        why, remedy = "they are too few", "Scan at a higher resolution."
    else:
        why = "not all over the photo, or not for the stated camera"
        remedy = "Give a camera file, or draw a few matches."
    reason = f"The image regions agree, but {why}: the pose {known}. {remedy}"
    return replace(verdict, accepted=False, reasons=(reason,))


def _times(ratio: float) -> str:
    """Return a factor above 1 with enough digits to distinguish it from 1."""
    return f"{ratio:.2g} times" if ratio >= 1.1 else "slightly more than"


def region_markers(
    fine: Agreement, working: Camera, camera: Camera, options: GateOptions | None = None
) -> tuple[tuple[float, float, bool], ...]:
    """Return (u, v, agrees) of at most 250 compared regions, in the photo's own pixels.

    Args:
        fine: agreement at level 0.
        working: the ideal camera of that level.
        camera: the photo's own camera.
        options: the thresholds.
    """
    if not fine.windows:
        return ()
    middle = np.array([fine.uv[members].mean(axis=0) for members in fine.members])
    uv = camera.project(working.unproject(middle))
    agrees = fine.agreeing((options or GateOptions()).fine_near_px)
    every = -(-fine.windows // _MAX_REGIONS)
    shown = np.flatnonzero(np.isfinite(uv).all(axis=-1))
    shown = shown[fine.grid[shown].sum(axis=1) % every == 0]
    return tuple(
        (round(float(u), 1), round(float(v), 1), bool(a)) for (u, v), a in zip(uv[shown], agrees[shown], strict=True)
    )
