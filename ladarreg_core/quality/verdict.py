"""The verdict on a pose, to be read: a light, one sentence, two figures, and the next step.

Everything that a page says of a pose at a glance is of this one summary, so that no two parts of it can disagree.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from ladarreg_core.foundations.formatting import format_length, format_number
from ladarreg_core.matches import count_picks
from ladarreg_core.quality.assessment import Assessment
from ladarreg_core.results.registration import PoseResult, StageId
from ladarreg_core.results.verdict_words import verdict_words

Light = Literal["verified", "matches_only", "given", "not_accepted", "out_of_date"]
Action = Literal["", "solve", "verify", "register", "use_stage", "frames", "export"]

LIGHT_WORDS: dict[Light, str] = {
    "verified": "verified",
    "matches_only": "accepted on matches only",
    "given": "given, not verified",
    "not_accepted": "not accepted",
    "out_of_date": "out of date",
}
"""Each light in words, as on a tab or in a list."""
FROM_IMAGES: tuple[StageId, ...] = ("auto", "survey", "carried")
"""Stages that matches do not solve again."""
_MAX_SHOWN_M = 1e4
_NOTHING_AGREES = 0.25
"""Share of the image regions, and of the matches, below which hardly anything agrees."""


@dataclass(frozen=True, slots=True)
class NextStep:
    """What to do next."""

    sentence: str
    """In words."""
    action: Action = ""
    """What does it: `solve` or `register` again, `verify` against the images, `use_stage`, add `frames`, `export`;
    empty: no single press does."""
    stage: StageId | None = None
    """The stage to use."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """Verdict on a pose."""

    light: Light
    """Its colour and mark."""
    line: str
    """The verdict as one sentence."""
    position: str
    """Standard deviation of the camera position with its unit, such as `2.3 mm`; empty: unknown."""
    pixels: str
    """Median standard deviation of the photograph's pixels, such as `0.4 px`; empty: unknown, or not computed yet."""
    matches: str
    """How many matches agree with the pose; empty without any."""
    next_step: NextStep
    """What to do next."""
    other: NextStep | None = None
    """Another choice that is one press away: the pose as drawn, or that of the images."""


def verdict_of(
    result: PoseResult,
    *,
    stage: StageId,
    stale: str = "",
    stages: Sequence[StageId] = (),
    wants_frames: bool = False,
    assessment: Assessment | None = None,
) -> Verdict:
    """Return the verdict on a pose.

    Args:
        result: the pose.
        stage: its stage.
        stale: why it is out of date; empty: it is not.
        stages: all stages that the photograph has a pose of.
        wants_frames: whether its reasons advise further clouds.
        assessment: its assessment, once there is one.
    """
    light = light_of(accepted=result.accepted, evidence=result.evidence, stale=stale)
    words = verdict_words(result.accepted, result.evidence, result.diagnostics, coarse=result.is_coarse)
    known = result.is_determined and np.isfinite(result.sigma_position_m)
    uncertainty = None if assessment is None else assessment.uncertainty
    count, total = count_picks(result.matches, result.inliers)
    return Verdict(
        light=light,
        line=f"Out of date: {stale.partition(':')[0]}." if stale else words,  # what to do is the next step
        position=format_length(result.sigma_position_m) if known else "",
        pixels=f"{format_number(uncertainty.median_px)} px" if known and uncertainty is not None else "",
        matches=f"{count} of {total} matches agree" if total else "",
        next_step=_next_step(result, stage, light, stages, wants_frames=wants_frames),
        other=_other_choice(result, stage, light, stages),
    )


def position_of(covariance: ArrayLike) -> str:
    """Return the standard deviation of a camera position as text, by the covariance (6, 6) of its pose, rad and m.

    Empty where it is not known, or says that the position is not determined.
    """
    variance = np.asarray(covariance, dtype=np.float64)
    if variance.shape != (6, 6) or not np.isfinite(variance).all():
        return ""
    sigma_m = float(np.sqrt(max(float(np.trace(variance[3:, 3:])), 0.0)))
    return format_length(sigma_m) if sigma_m < _MAX_SHOWN_M else ""


def light_of(*, accepted: bool, evidence: str, stale: str) -> Light:
    """Return the light of a pose."""
    if stale:
        return "out_of_date"
    if evidence == "given":
        return "given"
    if not accepted:
        return "not_accepted"
    return "verified" if evidence in ("image", "ties", "rig") else "matches_only"


def _next_step(
    result: PoseResult, stage: StageId, light: Light, stages: Sequence[StageId], *, wants_frames: bool
) -> NextStep:
    if light == "out_of_date":
        return NextStep("Register again.", "register") if stage in FROM_IMAGES else NextStep("Solve again.", "solve")
    if light == "verified":
        return NextStep("Check the model, then export.", "export")
    if light == "matches_only" and not _is_compared(result):
        return NextStep("Compare it with the images.", "verify")
    if light == "matches_only":
        return NextStep("Check the overlay of photograph and scan before you rely on it.")
    if light == "given":
        return NextStep("Register automatically to verify it.", "register")
    if _is_contradicted(result) and "refined" in stages:
        return NextStep("Use the images' pose, or correct the matches.", "use_stage", "refined")
    if wants_frames:
        return NextStep("Add frames of the same standpoint.", "frames")
    if _nothing_agrees(result):
        return NextStep("Is it the right pair? If so, draw matches by hand.")
    if len(result.matches) and stage not in FROM_IMAGES:
        return NextStep("Add or correct matches, or register automatically.", "register")
    return NextStep("Draw a few matches by hand: lines along edges, far apart.")


def _other_choice(result: PoseResult, stage: StageId, light: Light, stages: Sequence[StageId]) -> NextStep | None:
    """Return the pose beside the one that is proposed; None if there is none, or it is the next step itself."""
    if light == "out_of_date":
        return None
    if stage == "refined" and "robust" in stages:
        return NextStep("Use the pose as drawn", "use_stage", "robust")
    if stage == "robust" and "refined" in stages and not _is_contradicted(result):
        return NextStep("Use the pose refined against the image", "use_stage", "refined")
    return None


def _is_compared(result: PoseResult) -> bool:
    return bool((result.diagnostics.get("verification") or {}).get("outcome"))


def _is_contradicted(result: PoseResult) -> bool:
    return (result.diagnostics.get("verification") or {}).get("outcome") == "contradicted"


def _nothing_agrees(result: PoseResult) -> bool:
    """Return whether neither the images nor the matches agree with the pose in more than a small part."""
    verification = result.diagnostics.get("verification") or {}
    fraction = verification.get("fraction")
    of_images = fraction is None or float(fraction) < _NOTHING_AGREES
    agree, total = count_picks(result.matches, result.inliers)
    return of_images and (not total or agree / total < _NOTHING_AGREES)
