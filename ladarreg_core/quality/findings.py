"""What the figures of a pose mean to the one who has to act on them.

Each finding has a level. `fair`: the standard deviation of the camera's place or of the picture is 1.4 times what 48
well-placed matches would give, as if half of them were missing. `poor`: it is twice that, as if three of four were, or
an error of that size is not in it, or the method that was used fails there. The factors beside the thresholds are
medians over 40 rooms of `benchmarks.room`.

Source: thesis 3.4 for what its methods fail on.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from ladarreg_core.arrays import BoolArray
from ladarreg_core.pose.acceptance import LEAST_INLIERS, LEAST_SHARE, MOST_CHI2_PER_DOF, count_distinct
from ladarreg_core.pose.covariance import pose_jacobian
from ladarreg_core.pose.diagnostics import diagnose
from ladarreg_core.pose.thesis.linear import LEAST_PLANARITY
from ladarreg_core.quality.conditioning import Placement, placement
from ladarreg_core.quality.lens_check import lens_hint
from ladarreg_core.quality.stereo_limits import LEAST_ACROSS_OF_FORWARD, LEAST_DISPARITY_SIGMA, MOST_SIGMA_Z_OVER_Z
from ladarreg_core.results import PoseResult

Level = Literal["good", "fair", "poor"]
LEVELS: tuple[Level, ...] = ("good", "fair", "poor")
"""From the best to the worst."""

COST = (1.4, 2.0)
"""From which factors on the standard deviation makes a finding fair, and poor."""
FEW_MATCHES = (24, LEAST_INLIERS)
"""Below these many: against 48 the standard deviation is 1.43 and 2.1 times as large."""
LITTLE_SPREAD = (0.35, 0.18)
"""Of the photo's area: 1.4 and 2 times."""
LITTLE_DEPTH = (1.8, 1.4)
"""Far over near: 1.4 and 2 times."""
LITTLE_RELIEF = 0.15
"""Depth across the plane over its width: from 1.35 times on a plane seen at a slant to 4.6 on one seen head-on."""
FEW_AGREE = (0.8, LEAST_SHARE)
"""Share of inliers: the gate loses 1 % of good matches, so 20 % were no accident; below half the rest may be right."""
LARGE_CHI2 = (1.69, MOST_CHI2_PER_DOF)
"""Per degree of freedom: residuals 1.3 times the noise, and what no verdict accepts."""
_CHI2_SPREAD = 3.0  # standard deviations by which so few residuals may exceed 1
LENS_SIGNIFICANCE = 4.0
"""Of a right camera 400 poses from 14 to 200 matches showed 3.3 at most; 3 % of focal length and 48 matches show 6."""
_BIAS_SIGNIFICANCE = 20.0  # Hotelling's T^2 of two components: one in 10,000 with many picks
_NAMED = 5
_WITHIN = (5.0, 95.0)  # per cent: a few matches elsewhere spread nothing
_SPOILT: Mapping[str, Level] = {"stereo_simplex": "poor", "epipolar_simplex": "fair"}
"""What too little parallax does to a method: one compares stereo depths, the other rejects outliers by them."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that makes a pose good or not, and what to do about it."""

    name: str
    """What was looked at: `matches`, `inliers`, `residuals`, `spread`, `depth`, `relief`, `conditioning`, `baseline`,
    `disparity`, `bias` or `lens`."""
    level: Level
    """`good`, `fair` or `poor`."""
    sentence: str
    """What was found."""
    what_to_do: str = ""
    """A sentence; empty where the level is good."""
    values: Mapping[str, Any] = field(default_factory=dict)
    """The figures, with units in their names; infinite where nothing is determined."""


def findings(result: PoseResult) -> tuple[Finding, ...]:
    """Return what is to be said of a pose; what its matches have no answer to is left out.

    Args:
        result: a pose, accepted or not, with any matches or none.
    """
    figures = diagnose(
        result.camera_from_scanner, result.matches, result.inliers, result.camera, sigma_px=result.sigma_px
    )
    placed = placement(result)
    found = [_matches(result), _inliers(result), _residuals(result)]
    if placed is not None:
        found += [_spread(result, placed), _depth(result, placed), _relief(result, figures, placed), _held(placed)]
    found += [_baseline(result, figures), _disparity(result, figures), _bias(result), _lens(result)]
    return tuple(finding for finding in found if finding is not None)


def _matches(result: PoseResult) -> Finding:
    inliers = result.matches.subset(result.inliers)
    different = count_distinct(inliers.points, inliers.uv) if len(inliers) else 0
    by_pick: dict[str, list[int]] = {}
    for name, known in zip(inliers.pick_ids, inliers.dimensions.tolist(), strict=True):
        by_pick.setdefault(name, []).append(known)
    # The two ends of a line were drawn one by one; more samples of it share those, and tell as much as their root.
    told = sum(max(min(len(known), 2), np.sqrt(len(known))) * np.mean(known) / 2 for known in by_pick.values())
    count = min(different, int(told + 1e-9))
    lines = "" if count == different else f", which tell as much as {count} points"
    level = _below(count, FEW_MATCHES)
    return Finding(
        "matches",
        level,
        f"{different} different matches agree with the pose{lines}.",
        _unless_good(level, f"Add matches: {FEW_MATCHES[0]} or more make a good pose."),
        {"different": different, "as_points": count, "picks": len(by_pick)},
    )


def _inliers(result: PoseResult) -> Finding | None:
    count = len(result.matches)
    if not count:
        return None
    share = float(np.count_nonzero(result.inliers)) / count
    level = _below(share, FEW_AGREE)
    others = list(dict.fromkeys(result.matches.pick_ids[k] for k in np.flatnonzero(~result.inliers)))
    more = f" and {len(others) - _NAMED} more" if len(others) > _NAMED else ""
    names = f"; these do not: {', '.join(others[:_NAMED])}{more}" if others else ""
    return Finding(
        "inliers",
        level,
        f"{share:.0%} of {count} matches agree with the pose{names}.",
        _unless_good(level, "Look at them, and correct or remove what is wrong."),
        {"share": share, "disagreeing": others},
    )


def _residuals(result: PoseResult) -> Finding | None:
    chi2, dof = float(result.chi2_per_dof), int(result.matches.dimensions[result.inliers].sum()) - 6
    if not np.isfinite(chi2) or dof <= 0:
        return None
    accident = 1 + _CHI2_SPREAD * float(np.sqrt(2 / dof))
    level: Level = "good" if chi2 <= max(accident, LARGE_CHI2[0]) else "fair" if chi2 <= LARGE_CHI2[1] else "poor"
    return Finding(
        "residuals",
        level,
        f"The residuals are {np.sqrt(chi2):.2f} times the noise of {_number(result.sigma_px)} px and "
        f"{_length(result.sigma_range_m)} (chi^2/dof {chi2:.2f}).",
        _unless_good(level, "Check the focal length and the lens, or state a larger noise."),
        {"chi2_per_dof": chi2, "sigma_px": result.sigma_px, "sigma_range_m": result.sigma_range_m},
    )


def _spread(result: PoseResult, placed: Placement) -> Finding:
    low, high = np.percentile(result.matches.uv[result.inliers], _WITHIN, axis=0)
    whole = (_WITHIN[1] - _WITHIN[0]) / 100
    share = float(np.clip((high - low) / whole / result.camera.size, 0, 1).prod())
    level = _no_worse(_below(share, LITTLE_SPREAD), placed)
    return Finding(
        "spread",
        level,
        f"The matches cover {share:.0%} of the photo.",
        _unless_good(level, "Add matches in the rest of the photo, towards its corners."),
        {"share_of_photo": share},
    )


def _depth(result: PoseResult, placed: Placement) -> Finding:
    near, far = (float(v) for v in np.percentile(result.matches.ranges[result.inliers], _WITHIN))
    level = _no_worse(_below(far / near, LITTLE_DEPTH), placed)
    return Finding(
        "depth",
        level,
        f"The matches lie {near:.3g} to {far:.3g} m from the scanner.",
        _unless_good(level, "Add matches on things that are much nearer, or much farther."),
        {"near_m": near, "far_m": far, "far_over_near": far / near},
    )


def _relief(result: PoseResult, figures: Mapping[str, Any], placed: Placement) -> Finding | None:
    planarity = figures.get("planarity")
    if planarity is None:
        return None
    linear = _method(result) == "linear"
    if linear and planarity < LEAST_PLANARITY:
        level: Level = "poor"  # whatever it costs the others: near a plane this method errs by metres
    else:
        level = _no_worse("fair" if planarity < LITTLE_RELIEF else "good", placed)
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


def _held(placed: Placement) -> Finding:
    level, motion = _of_cost(placed), placed.worst_motion
    what, cost = "camera's place", placed.position_cost
    if placed.picture_cost > cost:
        what, cost = "picture", placed.picture_cost
    if not np.isfinite(cost):
        words = f"Nothing in the matches tells {motion} from standing still."
    elif level == "good":
        words = f"The matches hold every motion as well as their number can; least of all {motion}."
    else:
        words = (
            f"The {what} is {cost:.1f} times as uncertain as so many well-placed matches would leave it; least held is "
            f"{motion}."
        )
    return Finding(
        "conditioning",
        level,
        words,
        _unless_good(level, _hold(motion)),
        {
            "worst_over_best": placed.ratio,
            "worst_over_best_well_placed": placed.well_placed_ratio,
            "worst_motion": motion,
            "position_cost": placed.position_cost,
            "picture_cost": placed.picture_cost,
        },
    )


def _hold(motion: str) -> str:
    if "forward" in motion:
        return "Add matches near the photo's edges, and both near and far ones."
    if "rolling" in motion:
        return "Add matches far from the photo's middle."
    return "Add matches on things much nearer than the others, beside far ones."


def _baseline(result: PoseResult, figures: Mapping[str, Any]) -> Finding:
    across, along = float(figures["baseline_across_m"]), float(figures["baseline_forward_m"])
    length = float(figures["baseline_m"])
    ahead = length > 2 * result.sigma_position_m and across < LEAST_ACROSS_OF_FORWARD * abs(along)
    level: Level = "good"
    what, more = "", ""
    if ahead and _method(result) in _SPOILT:
        level = _SPOILT[_method(result)]
        what = "Use the 'robust' method, or take the photo from the side."
        more = ", where stereo disparities vanish in the middle of the picture"
    words = (
        f"Scanner and camera stand {_length(length)} apart, {_length(across)} across and {_length(abs(along))} "
        f"{'forward' if along >= 0 else 'back'}{more}."
    )
    return Finding("baseline", level, words, what, {"baseline_m": length, "across_m": across, "forward_m": along})


def _disparity(result: PoseResult, figures: Mapping[str, Any]) -> Finding | None:
    median, over = figures.get("disparity_median_px"), figures.get("disparity_over_sigma")
    if median is None or over is None:
        return None
    uncertain = float(figures.get("stereo_sigma_z_over_z", np.inf))
    values = {"median_px": median, "over_sigma": over, "stereo_sigma_z_over_z": uncertain}
    if over >= LEAST_DISPARITY_SIGMA and uncertain <= MOST_SIGMA_Z_OVER_Z:
        return Finding("disparity", "good", f"The parallax of the matches is {median:.0f} px.", "", values)
    words = f"The parallax of the matches is only {_number(median)} px"
    if _method(result) not in _SPOILT:
        words += ": stereo methods would fail, but this pose rests on the laser's ranges and loses nothing by it."
        return Finding("disparity", "good", words, "", values)
    return Finding(
        "disparity",
        _SPOILT[_method(result)],
        f"{words}, too little for the stereo depths that this method compares.",
        "Use the 'robust' method, which needs no parallax, or take the photo from further aside.",
        values,
    )


def _bias(result: PoseResult) -> Finding | None:
    """Tell whether the matches lie aside of where the pose puts them, beyond their scatter."""
    assert result.matches.across is not None
    usable = result.inliers & ~result.matches.across & np.isfinite(result.residuals_px).all(axis=1)
    by_pick: dict[str, list[int]] = {}
    for k in np.flatnonzero(usable).tolist():
        by_pick.setdefault(result.matches.pick_ids[k], []).append(k)
    count = len(by_pick)
    if count < LEAST_INLIERS:
        return None
    # The samples of one line err together.
    residuals = np.array([result.residuals_px[members].mean(axis=0) for members in by_pick.values()])
    mean = residuals.mean(axis=0)
    scatter = np.cov(residuals.T) + 1e-12 * np.eye(2)
    significance = float(count * mean @ np.linalg.solve(scatter, mean))
    off, allowed = float(np.linalg.norm(mean)), _sigma_at_matches_px(result, usable)
    values = {"u_px": float(mean[0]), "v_px": float(mean[1]), "hotelling_t2": significance, "picture_sigma_px": allowed}
    level: Level = "good"
    if significance > _BIAS_SIGNIFICANCE:
        level = "poor" if off > 2 * allowed else "fair" if off > allowed else "good"
    if level == "good":
        return Finding("bias", level, "The residuals have no common direction that matters.", "", values)
    way = f"{_number(abs(mean[0]))} px {'right' if mean[0] > 0 else 'left'} and {_number(abs(mean[1]))} px " + (
        "down" if mean[1] > 0 else "up"
    )
    return Finding(
        "bias",
        level,
        f"All matches together lie {way} of where the pose puts them, {_number(off / max(allowed, 1e-12))} times the "
        "picture's own uncertainty.",
        "Check the camera's principal point, or use the 'robust' method, which leaves no common shift.",
        values,
    )


def _lens(result: PoseResult) -> Finding | None:
    hint = lens_hint(result)
    if hint is None:
        return None
    values = {"kind": hint.kind, "change": hint.change, "sigma": hint.sigma, "moves_sigmas": hint.moves_sigmas}
    level: Level = "good"
    if hint.significance >= LENS_SIGNIFICANCE:
        level = "poor" if hint.moves_sigmas >= COST[1] else "fair" if hint.moves_sigmas >= 1 else "good"
    if level == "good":
        return Finding("lens", level, "The residuals ask for no other focal length or lens.", "", values)
    if hint.kind == "focal":
        now = result.camera.focal_px
        words = (
            f"The residuals grow towards the edges as with a focal length of {now * (1 + hint.change):.0f} instead of "
            f"{now:.0f} px ({hint.change:+.1%} +- {hint.sigma:.1%})"
        )
    else:
        words = f"The residuals bend towards the edges as by a lens with k1 {hint.change:+.3f} +- {hint.sigma:.3f}"
    return Finding(
        "lens",
        level,
        f"{words}, which would move the camera by {_number(hint.moves_sigmas)} of its standard deviations.",
        "Give the photo's calibrated camera file, or check its focal length: zoom and cropping change it.",
        values,
    )


def _sigma_at_matches_px(result: PoseResult, usable: BoolArray) -> float:
    """Return the median standard deviation of the picture at some matches, px; infinite where the pose has none."""
    _, J = pose_jacobian(result.camera_from_scanner, result.matches.points[usable], result.camera)
    J = J[np.isfinite(J).all(axis=(1, 2))]
    if not len(J) or not np.isfinite(result.covariance).all():
        return float("inf")
    variance = np.einsum("nij,jk,nik->n", J, result.covariance, J)
    return float(np.sqrt(max(float(np.median(variance)), 0.0)))


def _method(result: PoseResult) -> str:
    return str(result.diagnostics.get("method", ""))


def _below(value: float, limits: tuple[float, float]) -> Level:
    return "poor" if value < limits[1] else "fair" if value < limits[0] else "good"


def _of_cost(placed: Placement) -> Level:
    cost = max(placed.position_cost, placed.picture_cost)
    return "poor" if cost >= COST[1] else "fair" if cost >= COST[0] else "good"


def _no_worse(level: Level, placed: Placement) -> Level:
    """Return the level, unless it costs less: a wide lens makes up for matches in a part of the photo."""
    return min(level, _of_cost(placed), key=LEVELS.index)


def _unless_good(level: Level, sentence: str) -> str:
    return "" if level == "good" else sentence


def _number(value: float) -> str:
    return f"{value:.2g}" if value < 99.5 else f"{value:.0f}"


def _length(metres: float) -> str:
    return f"{metres * 1000:.0f} mm" if metres < 0.0995 else f"{metres:.2f} m"
