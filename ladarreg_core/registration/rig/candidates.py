"""Poses that the pairs of a rig propose, and what all pairs say of each."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from ladarreg_core.frames import Rigid
from ladarreg_core.matching.auto_options import AutoOptions
from ladarreg_core.matching.modality import register_by_modality
from ladarreg_core.matching.search.ambiguity import KnownPoses
from ladarreg_core.matching.verify.verification import GateOptions
from ladarreg_core.registration.rig.joint import JointPairs, PairViews
from ladarreg_core.registration.rig.options import NEAR_PX, RigOptions
from ladarreg_core.registration.rig.results import RigPair
from ladarreg_core.results.steps import Step, StepLog

_STEPS = ("climb", "finish", "camera")
_MAX_DIGITS = 12.0  # of one pair: no pair outvotes all others


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A pose that was tried on all pairs."""

    camera_from_scanner: Rigid
    """The pose."""
    evidence: float
    """Digits of the improbability of the agreement, summed over the pairs, of which each counts up to a limit."""


def proposed_poses(pair: RigPair, initial: Rigid | None, options: RigOptions) -> tuple[list[tuple[float, Rigid]], bool]:
    """Return the poses that a pair finds when it is registered alone, and whether it is accepted.

    Args:
        pair: the pair.
        initial: a rough pose, near which it is then searched.
        options: seed and number of poses.

    Returns:
        poses with their share of agreeing regions, of an accepted one more than 1, the best first.
    """
    found: list[tuple[float, Rigid]] = []

    def heard(step: Step) -> None:
        if step.name in _STEPS and step.pose is not None:
            found.append((float(step.detail.get("fraction", 0.0)), step.pose))

    how = AutoOptions(
        seed=options.seed,
        gate=GateOptions(own_false_alarm=0.0),  # what comes of the pair alone is a candidate, accepted or not
        intrinsics="fixed",
        reach="everywhere" if initial is None else "near_start",
    )
    result = register_by_modality(pair.scan, pair.photo, StepLog(heard), initial=initial, options=how)
    accepted = result.verification is not None and result.verification.accepted
    if result.camera_from_scanner is not None and result.verification is not None:
        found.append((result.verification.fraction + accepted, result.camera_from_scanner))
    found.sort(key=lambda item: -item[0])
    return found[: options.candidates_per_pair], accepted


def tried_on_all(
    poses: Sequence[Rigid], views: Sequence[PairViews], unfit: Collection[int], options: RigOptions
) -> list[Candidate]:
    """Return the poses that most pairs agree on, refined on all of them, the best first.

    Args:
        poses: the likeliest first.
        views: the pairs.
        unfit: indices of pairs that cannot be compared.
        options: number of poses that are refined.
    """
    fit = [index for index in range(len(views)) if index not in unfit]
    if not fit:
        return []
    known = KnownPoses(views[fit[0]].pair.scan, views[fit[0]].pair.photo.camera)
    kept: list[tuple[float, Rigid, JointPairs]] = []
    for pose in poses:
        if any(not known.differ(pose, other) for _, other, _ in kept):
            continue
        joint = JointPairs(views, pose)
        kept.append((sum(_digits(joint, pose, fit, options)), pose, joint))
    kept.sort(key=lambda item: -item[0])
    found: list[Candidate] = []
    for before, pose, joint in kept[: options.refined]:
        ends = [(before, pose)]
        agreeing = [index for index, digits in zip(fit, _digits(joint, pose, fit, options), strict=True) if digits > 1]
        for members in [fit] if len(agreeing) < 2 else [fit, agreeing]:
            refined = joint.refine(pose, members)
            if refined is not None:
                ends.append((sum(_digits(joint, refined, fit, options)), refined))
        evidence, end = max(ends, key=lambda item: item[0])
        found.append(Candidate(end, evidence))
    found.sort(key=lambda item: -item.evidence)
    return found


def _digits(joint: JointPairs, pose: Rigid, fit: Sequence[int], options: RigOptions) -> list[float]:
    """Return the digits of the improbability of the agreement of each pair."""
    found = []
    for index in fit:
        maps = joint.agreement_at(pose, index, 1)
        alarm = 1.0 if maps is None else maps.false_alarm(NEAR_PX, least_chance=options.least_chance)
        found.append(min(_MAX_DIGITS, -float(np.log10(max(alarm, 1e-300)))))
    return found
