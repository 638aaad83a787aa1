"""Findings: what the figures of a pose mean to the operator who has to act on them.

Each finding has a level. `fair`: the standard deviation of the camera position or of pixel positions is 1.4 times that
of 48 ideal matches, as if half of them were missing. `poor`: it is twice that, as if three quarters were missing, or it
leaves out an error of that size, or the method used fails on such data. The factors stated at the thresholds are
medians over 40 rooms of `tests.scenes.room`.

Source: thesis 3.4 for the failures of its methods.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from math import comb
from typing import Any, Literal

import numpy as np

from ladarreg_core.foundations.formatting import format_length, format_number
from ladarreg_core.matches import count_picks
from ladarreg_core.pose.acceptance import DEFAULT_ACCEPTANCE, count_distinct
from ladarreg_core.pose.diagnostics import diagnose
from ladarreg_core.quality.camera_finding import camera_in_words
from ladarreg_core.quality.conditioning import Conditioning, assess_conditioning
from ladarreg_core.quality.lens_check import check_lens
from ladarreg_core.quality.limits import (
    CENTRAL_PERCENTILES,
    LITTLE_SPREAD,
    covered_share,
    has_usable_parallax,
    is_forward_baseline,
)
from ladarreg_core.quality.suspects import suspect_matches
from ladarreg_core.results.registration import PoseResult, Registration
from ladarreg_core.thesis.estimators.linear import MIN_PLANARITY

Level = Literal["good", "fair", "poor"]
LEVELS: tuple[Level, ...] = ("good", "fair", "poor")
"""Levels from the best to the worst."""

COST = (1.4, 2.0)
"""Factors on the standard deviation from which a finding is fair, and poor."""
FEW_MATCHES = (24, DEFAULT_ACCEPTANCE.least_inliers())
"""Numbers of matches below which the standard deviation is 1.43 and 2.6 times that of 48 matches."""
LITTLE_DEPTH = (1.8, 1.4)
"""Ratio of far to near ranges below which the standard deviation is 1.4 and 2 times as large."""
LITTLE_RELIEF = 0.15
"""Depth across the best plane over its width; below it the cost is 1.35 on a slanted plane and 4.6 on a frontal one."""
FEW_INLIERS = (0.8, DEFAULT_ACCEPTANCE.least_share)
"""Share of inliers: rejection loses 1 % of correct matches, so that 20 % are no accident; below half the others may be
the correct ones."""
LARGE_CHI2 = (1.69, DEFAULT_ACCEPTANCE.most_chi2_per_dof)
"""Chi-squared per degree of freedom: residuals of 1.3 times the noise, and the limit of acceptance."""
_CHI2_SPREAD = 3.0  # standard deviations by which chi^2/dof of few residuals may exceed 1
LENS_SIGNIFICANCE = 4.0
_SEEN_SIGMAS = 4.0  # an error as large would be significant
"""With a correct camera, 400 poses from 14 to 200 matches showed 3.3 at most; 3 % of focal length and 48 matches show
6."""
_BIAS_SIGNIFICANCE = 20.0  # Hotelling's T^2 of two components; false alarms: one in 10,000 with many picks
_MAX_NAMED = 5
_NOTABLE_SHARE = 0.5  # of the variance of the orientation: what costs as much as all the matches' noise
_REJECTED_SHARE = 0.01  # of correct matches, by the gate
_CHANCE = 5e-3
_LEVEL_WITHOUT_PARALLAX: Mapping[str, Level] = {"stereo_simplex": "poor", "epipolar_simplex": "fair"}
"""Effect of too little parallax on a method: one compares stereo depths, the other rejects outliers by them."""


@dataclass(frozen=True, slots=True)
class Finding:
    """A statement on one aspect of a pose's quality, with advice."""

    name: str
    """The aspect: `matches`, `inliers`, `residuals`, `spread`, `depth`, `relief`, `conditioning`, `baseline`,
    `disparity`, `bias`, `lens`, `camera` or `lengths`."""
    level: Level
    """`good`, `fair` or `poor`."""
    sentence: str
    """The statement."""
    what_to_do: str = ""
    """The advice, a sentence; empty where the level is good."""
    values: Mapping[str, Any] = field(default_factory=dict)
    """The figures, with units in their names; infinite where undetermined."""


def findings(result: PoseResult) -> tuple[Finding, ...]:
    """Return the findings of a pose; aspects that its matches do not determine are left out.

    Args:
        result: a pose, accepted or not, with any matches or none.
    """
    figures = diagnose(
        result.camera_from_scanner, result.matches, result.inliers, result.camera, sigma_px=result.sigma_px
    )
    conditioning = assess_conditioning(result)
    inliers, lens = _matches_first(_inliers(result), _lens(result) if result.is_determined else None)
    found = [_matches(result), inliers, _residuals(result), _lengths(result)]
    if conditioning is not None:
        found += [
            _spread(result, conditioning),
            _depth(result, conditioning),
            _relief(result, figures, conditioning),
            _conditioning(conditioning),
        ]
    if result.is_determined:
        found += [_baseline(result, figures), _disparity(result, figures), _bias(result), lens, _camera(result)]
    return tuple(finding for finding in found if finding is not None)


def _matches(result: PoseResult) -> Finding:
    inliers = result.matches.subset(result.inliers)
    agree, _ = count_picks(result.matches, result.inliers)
    different = count_distinct(inliers.points, inliers.uv) if len(inliers) else 0
    by_pick: dict[str, list[int]] = {}
    for name, known in zip(inliers.pick_ids, inliers.dimensions.tolist(), strict=True):
        by_pick.setdefault(name, []).append(known)
    # The two ends of a line were drawn independently; further samples share their errors, and add by their square root.
    as_points = sum(max(min(len(known), 2), np.sqrt(len(known))) * np.mean(known) / 2 for known in by_pick.values())
    count = min(different, int(as_points + 1e-9))
    level = _below(count, FEW_MATCHES)
    return Finding(
        "matches",
        level,
        f"{agree} {'match agrees' if agree == 1 else 'matches agree'} with the pose.",
        _unless_good(level, "Draw more matches, far apart: they make the pose more certain, and mistakes show."),
        {"different": different, "as_points": count, "picks": len(by_pick)},
    )


def _inliers(result: PoseResult) -> Finding | None:
    count = len(result.matches)
    if not count:
        return None
    suspects = suspect_matches(result)
    share = float(np.count_nonzero(result.inliers)) / count
    level = _below(share, FEW_INLIERS)
    drawn = _are_drawn(result)
    if level == "good" and (suspects.by_robust or (drawn and _rejected_by_chance(result) < _CHANCE)):
        level = "fair"
    words = "{} of {} matches agree".format(*count_picks(result.matches, result.inliers))
    advice = "Check the outliers; correct or remove the wrong ones."
    if suspects.pick_ids and drawn:
        named = list(suspects.pick_ids[:_MAX_NAMED])
        more = f" and {len(suspects.pick_ids) - _MAX_NAMED} more" if len(suspects.pick_ids) > _MAX_NAMED else ""
        whose = "those that 'robust' rejects" if suspects.by_robust else "outliers"
        words += f"; {whose}, worst first: {', '.join(named)}{more}"
        if suspects.by_robust:
            advice = "Correct or remove these first, or use the 'robust' method, which leaves them out."
    return Finding(
        "inliers",
        level,
        f"{words}.",
        _unless_good(level, advice),
        {"share": share, "disagreeing": list(suspects.pick_ids)},
    )


def _are_drawn(result: PoseResult) -> bool:
    """Return whether the ids of the matches are those of picks; detected matches have ids that nobody has seen."""
    return not isinstance(result, Registration) or result.method == "manual" or not result.steps


def _rejected_by_chance(result: PoseResult) -> float:
    """Return the probability that as many correct matches are rejected by chance."""
    count, rejected = len(result.matches), int(np.count_nonzero(~result.inliers))
    fewer = (comb(count, k) * _REJECTED_SHARE**k * (1 - _REJECTED_SHARE) ** (count - k) for k in range(rejected))
    return max(1.0 - sum(fewer), 0.0)


def _matches_first(inliers: Finding | None, lens: Finding | None) -> tuple[Finding | None, Finding | None]:
    """Return both findings such that doubtful matches are checked before the lens, since they also look like one."""
    if inliers is None or lens is None or "good" in (inliers.level, lens.level):
        return inliers, lens
    level = max(inliers.level, lens.level, key=LEVELS.index)
    advice = f"Check the outliers first. If it remains: {lens.what_to_do[:1].lower()}{lens.what_to_do[1:]}"
    return replace(inliers, level=level), replace(lens, what_to_do=advice)


def _residuals(result: PoseResult) -> Finding | None:
    chi2, dof = float(result.chi2_per_dof), int(result.matches.dimensions[result.inliers].sum()) - 6
    if not np.isfinite(chi2) or dof <= 0:
        return None
    by_chance = 1 + _CHI2_SPREAD * float(np.sqrt(2 / dof))
    level: Level = "good" if chi2 <= max(by_chance, LARGE_CHI2[0]) else "fair" if chi2 <= LARGE_CHI2[1] else "poor"
    return Finding(
        "residuals",
        level,
        f"The residuals are {np.sqrt(chi2):.2f} times the noise of {format_number(result.sigma_px)} px and "
        f"{format_length(result.sigma_range_m)} (chi^2/dof {chi2:.2f}).",
        _unless_good(
            level,
            "Check the matches with the largest residuals first, then the focal length and the lens distortion, or "
            "state a larger noise.",
        ),
        {"chi2_per_dof": chi2, "sigma_px": result.sigma_px, "sigma_range_m": result.sigma_range_m},
    )


def _lengths(result: PoseResult) -> Finding | None:
    """Return how the lengths that came with the matches compare with the scan's ranges; None without lengths."""
    check = result.diagnostics.get("lengths")
    if not check:
        return None
    count, compared = len(check["matches"]), int(check["compared"])
    if check["refusal"]:
        advice = "Correct or remove the matches named, check unit and frame, or state a larger tolerance."
        return Finding("lengths", "poor", " ".join(check["refusal"]), advice, _figures_of(check))
    if compared < count:
        level: Level = "fair"
        advice = "Give targets where the scan has returns, so that their lengths can be checked."
    else:
        level, advice = "good", ""
    if not compared:
        words = f"None of the {count} lengths of the matches could be compared with the scan, which has no range there."
    else:
        words = (
            f"{compared} of {count} lengths of the matches were compared with the scan's ranges; they differ by "
            f"{format_length(check['largest_m'])} at most."
        )
    return Finding("lengths", level, words, advice, _figures_of(check))


def _figures_of(check: Mapping[str, Any]) -> dict[str, Any]:
    """Return the figures of the lengths, with the difference of each match by its name."""
    return {
        **{name: check[name] for name in ("compared", "largest_m", "scale", "tolerance_m")},
        "difference_m": {str(one["name"]): one["difference_m"] for one in check["matches"]},
    }


def _spread(result: PoseResult, conditioning: Conditioning) -> Finding:
    share = covered_share(result.matches.uv[result.inliers], result.camera)
    level = _capped_by_cost(_below(share, LITTLE_SPREAD), conditioning)
    return Finding(
        "spread",
        level,
        f"The matches cover {share:.0%} of the photo.",
        _unless_good(level, "Add matches in the rest of the photo, towards its corners."),
        {"share_of_photo": share},
    )


def _depth(result: PoseResult, conditioning: Conditioning) -> Finding:
    near, far = (float(v) for v in np.percentile(result.matches.ranges[result.inliers], CENTRAL_PERCENTILES))
    level = _capped_by_cost(_below(far / near, LITTLE_DEPTH), conditioning)
    return Finding(
        "depth",
        level,
        f"The matches lie {near:.3g} to {far:.3g} m from the scanner.",
        _unless_good(level, "Add matches on objects much nearer or much farther away."),
        {"near_m": near, "far_m": far, "far_over_near": far / near},
    )


def _relief(result: PoseResult, figures: Mapping[str, Any], conditioning: Conditioning) -> Finding | None:
    planarity = figures.get("planarity")
    if planarity is None:
        return None
    linear = _method(result) == "linear"
    if linear and planarity < MIN_PLANARITY:
        level: Level = "poor"  # regardless of the cost: near a plane the linear method errs by metres
    else:
        level = _capped_by_cost("fair" if planarity < LITTLE_RELIEF else "good", conditioning)
    return Finding(
        "relief",
        level,
        f"The matches lie {'near one plane' if planarity < LITTLE_RELIEF else 'off any one plane'} "
        f"(relief {planarity:.2f} of their width).",
        _unless_good(
            level,
            "Add matches off that plane" + (", or use the 'robust' method: 'linear' fails here." if linear else "."),
        ),
        {"planarity": float(planarity)},
    )


def _conditioning(conditioning: Conditioning) -> Finding:
    level, motion = _cost_level(conditioning), conditioning.worst_motion
    what, cost = "camera position", conditioning.position_cost
    if conditioning.picture_cost > cost:
        what, cost = "photo position", conditioning.picture_cost
    if not np.isfinite(cost):
        words = f"The matches do not determine {motion} at all."
    elif level == "good":
        words = f"The matches determine every motion as well as an ideal layout would; least certain: {motion}."
    else:
        words = f"The {what} has {cost:.1f}x the uncertainty of an ideal layout; least certain: {motion}."
    return Finding(
        "conditioning",
        level,
        words,
        _unless_good(level, _conditioning_advice(motion)),
        {
            "worst_over_best": conditioning.ratio,
            "worst_over_best_well_placed": conditioning.ideal_ratio,
            "worst_motion": motion,
            "position_cost": conditioning.position_cost,
            "picture_cost": conditioning.picture_cost,
        },
    )


def _conditioning_advice(motion: str) -> str:
    if "forward" in motion:
        return "Add matches near the edges of the photo, both near and far ones."
    if "rolling" in motion:
        return "Add matches far from the middle of the photo."
    return "Add matches on objects much nearer than the others, beside far ones."


def _baseline(result: PoseResult, figures: Mapping[str, Any]) -> Finding:
    across, along = float(figures["baseline_across_m"]), float(figures["baseline_forward_m"])
    length = float(figures["baseline_m"])
    ahead = length > 2 * result.sigma_position_m and is_forward_baseline(across, along)
    level: Level = "good"
    advice, more = "", ""
    if ahead and _method(result) in _LEVEL_WITHOUT_PARALLAX:
        level = _LEVEL_WITHOUT_PARALLAX[_method(result)]
        advice = "Use the 'robust' method, or take the photo from further to the side."
        more = ", where stereo disparities vanish in the middle of the picture"
    words = (
        f"Scanner and camera are {format_length(length)} apart, {format_length(across)} across and "
        f"{format_length(abs(along))} {'forward' if along >= 0 else 'back'}{more}."
    )
    return Finding("baseline", level, words, advice, {"baseline_m": length, "across_m": across, "forward_m": along})


def _disparity(result: PoseResult, figures: Mapping[str, Any]) -> Finding | None:
    median, over = figures.get("disparity_median_px"), figures.get("disparity_over_sigma")
    if median is None or over is None:
        return None
    uncertain = float(figures.get("stereo_sigma_z_over_z", np.inf))
    values = {"median_px": median, "over_sigma": over, "stereo_sigma_z_over_z": uncertain}
    if has_usable_parallax(over, uncertain):
        return Finding("disparity", "good", f"The parallax of the matches is {median:.0f} px.", "", values)
    words = f"The parallax of the matches is only {format_number(median)} px"
    if _method(result) not in _LEVEL_WITHOUT_PARALLAX:
        words += ": stereo methods would fail, but this pose uses the laser ranges and loses nothing."
        return Finding("disparity", "good", words, "", values)
    return Finding(
        "disparity",
        _LEVEL_WITHOUT_PARALLAX[_method(result)],
        f"{words}, too little for the stereo depths that this method compares with the laser ranges.",
        "Use the 'robust' method, which needs no parallax, or take the photo from further to the side.",
        values,
    )


def _bias(result: PoseResult) -> Finding | None:
    """Return whether all matches share an offset from their predicted pixels beyond their scatter."""
    usable = result.inliers & ~result.matches.across & np.isfinite(result.residuals_px).all(axis=1)
    by_pick: dict[str, list[int]] = {}
    for k in np.flatnonzero(usable).tolist():
        by_pick.setdefault(result.matches.pick_ids[k], []).append(k)
    count = len(by_pick)
    if count < DEFAULT_ACCEPTANCE.least_inliers():
        return None
    # The errors of the samples of one line are correlated.
    residuals = np.array([result.residuals_px[members].mean(axis=0) for members in by_pick.values()])
    mean = residuals.mean(axis=0)
    scatter = np.cov(residuals.T) + 1e-12 * np.eye(2)
    significance = float(count * mean @ np.linalg.solve(scatter, mean))
    off, allowed = float(np.linalg.norm(mean)), result.median_pixel_sigma(usable)
    values = {"u_px": float(mean[0]), "v_px": float(mean[1]), "hotelling_t2": significance, "picture_sigma_px": allowed}
    level: Level = "good"
    if significance > _BIAS_SIGNIFICANCE:
        level = "poor" if off > 2 * allowed else "fair" if off > allowed else "good"
    if level == "good":
        return Finding("bias", level, "The residuals have no significant common offset.", "", values)
    way = (
        f"{format_number(abs(mean[0]))} px {'right' if mean[0] > 0 else 'left'} and {format_number(abs(mean[1]))} px "
        + ("down" if mean[1] > 0 else "up")
    )
    return Finding(
        "bias",
        level,
        f"All matches share an offset of {way} from their predicted pixels, "
        f"{format_number(off / max(allowed, 1e-12))} times the uncertainty of these.",
        "Check the principal point of the camera, or use the 'robust' method, which leaves no common offset.",
        values,
    )


def _lens(result: PoseResult) -> Finding | None:
    check = check_lens(result)
    if check is None:
        return None
    values = {"kind": check.kind, "change": check.change, "sigma": check.sigma, "moves_sigmas": check.shift_sigmas}
    level: Level = "good"
    if check.significance >= LENS_SIGNIFICANCE:
        level = "poor" if check.shift_sigmas >= COST[1] else "fair" if check.shift_sigmas >= 1 else "good"
    if level == "good":
        beyond = (
            f"{_SEEN_SIGMAS * check.sigma:.1%}" if check.kind == "focal" else f"k1 {_SEEN_SIGMAS * check.sigma:.2f}"
        )
        what = "the focal length" if check.kind == "focal" else "the lens distortion"
        words = f"The residuals show no error of {what} beyond {beyond}; a smaller one would not be seen."
        return Finding("lens", level, words, "", values)
    if check.kind == "focal":
        now = result.camera.focal_px
        words = (
            f"The residuals grow towards the edges, as if the focal length were {now * (1 + check.change):.0f} instead "
            f"of {now:.0f} px ({check.change:+.1%} +- {check.sigma:.1%})"
        )
    else:
        words = f"The residuals grow towards the edges, as if the lens had k1 {check.change:+.3f} +- {check.sigma:.3f}"
    return Finding(
        "lens",
        level,
        f"{words}; that would shift the camera by {format_number(check.shift_sigmas)} of its standard deviations.",
        "Give a calibrated camera file for the photo, or check its focal length: zooming and cropping change it.",
        values,
    )


def _camera(result: PoseResult) -> Finding | None:
    """Return what is not known of a camera that was not calibrated, and its share of the uncertainty."""
    words = camera_in_words(result)
    if words is None:
        return None
    level: Level = "poor" if words.cropped else "fair" if words.share_of_angle >= _NOTABLE_SHARE else "good"
    return Finding("camera", level, words.sentence, _unless_good(level, words.advice), words.values)


def _method(result: PoseResult) -> str:
    return str(result.diagnostics.get("method", ""))


def _below(value: float, limits: tuple[float, float]) -> Level:
    return "poor" if value < limits[1] else "fair" if value < limits[0] else "good"


def _cost_level(conditioning: Conditioning) -> Level:
    cost = max(conditioning.position_cost, conditioning.picture_cost)
    return "poor" if cost >= COST[1] else "fair" if cost >= COST[0] else "good"


def _capped_by_cost(level: Level, conditioning: Conditioning) -> Level:
    """Return the level, or that of its cost if that is better: a wide lens makes up for matches in a part of the
    photo."""
    return min(level, _cost_level(conditioning), key=LEVELS.index)


def _unless_good(level: Level, sentence: str) -> str:
    return "" if level == "good" else sentence
