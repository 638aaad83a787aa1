"""Registers a rig: the pairs of several places are solved together, and each is held out to verify the others.

Each pair is registered alone; the poses that it finds, accepted or not, are tried on all pairs. The pose that most
pairs agree on is refined on these together. Every pair then judges the pose that the others determine without it: a
pose that is not right for its images agrees there with no more regions than chance, since nothing was fitted to them.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace

import numpy as np
from threadpoolctl import threadpool_limits

from ladarreg_core.errors import OptionError
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.foundations.validation import require_type
from ladarreg_core.frames import Rigid, rotvec_from_rotation
from ladarreg_core.matching.auto import reason_against_scan
from ladarreg_core.matching.search.ambiguity import KnownPoses
from ladarreg_core.registration.rig.candidates import proposed_poses, tried_on_all
from ladarreg_core.registration.rig.evidence import ADVICE, Jury, held_out, joint_alarm, reasons_against
from ladarreg_core.registration.rig.joint import JointPairs, PairViews
from ladarreg_core.registration.rig.options import MIN_PAIRS, RigOptions
from ladarreg_core.registration.rig.results import PairEvidence, RigPair, RigResult
from ladarreg_core.registration.rig.time_offset import estimate_time_offset, paired_at
from ladarreg_core.results.steps import StepLog, StepReport

# Variance factors of the covariance from regions, for pairs with intensity and for those whose shape alone is compared;
# to it that of leaving out pairs is added. From simulated rigs of other seeds than those of the benchmark.
_LINES_VARIANCE, _OUTLINES_VARIANCE = 3.0, 4.5
_ROUNDS = 2
_RIVAL_EVIDENCE = 0.6  # of another pose, relative to the best, from which on the rig is ambiguous
_NAME = re.compile(r"[A-Za-z0-9_-]{1,60}")
_UNKNOWN = np.full((6, 6), np.nan)


def register_rig(
    pairs: Sequence[RigPair],
    *,
    initial: Rigid | Mapping[str, Rigid] | None = None,
    options: RigOptions | None = None,
    report: StepReport | None = None,
) -> RigResult:
    """Estimate the one pose of each camera relative to a scanner from pairs that they took at several places.

    Args:
        pairs: two or more of each camera, by `RigPair.camera_name`; the intrinsics are taken as calibrated.
        initial: a rough pose, `camera_from_scanner`; of several cameras, by their names.
        options: seed and thresholds.
        report: receives every finished `Step`; may raise `Cancelled`.

    Returns:
        The result. It is accepted if pairs that were held out verify the pose of the others; pairs that disagree are
        named and left out. Of several cameras, each has a result of its own, from its own pairs.

    Raises:
        OptionError: if there are fewer than two pairs of a camera, an argument is of a wrong type, or a photograph is
            thermal.
    """
    o = RigOptions() if options is None else require_type(options, RigOptions, "'options'")
    by_camera = _by_camera(pairs)
    initials = _initials(initial, list(by_camera))
    with threadpool_limits(limits=1, user_api="blas"):
        results = {name: _of_camera(own, initials[name], StepLog(report), o) for name, own in by_camera.items()}
    return next(iter(results.values())) if len(results) == 1 else _of_all(results)


def _by_camera(pairs: Sequence[RigPair]) -> dict[str, list[RigPair]]:
    """Return the pairs of each camera by its name, after checking them."""
    if not isinstance(pairs, Sequence) or not all(isinstance(pair, RigPair) for pair in pairs):
        raise OptionError("'pairs' must be a list of RigPair")
    found: dict[str, list[RigPair]] = {}
    for pair in pairs:
        found.setdefault(pair.camera_name, []).append(pair)
    for name, own in found.items() or [("", [])]:
        if len(own) < MIN_PAIRS:
            what = f"the camera {name}" if len(found) > 1 else "the rig"
            raise OptionError(f"{what} has {len(own)} pairs; it needs at least {MIN_PAIRS}, better five or more")
        if len(found) > 1 and not _NAME.fullmatch(name):
            raise OptionError(
                f"a camera is called {name[:40]!r}; of several in a rig, each has a name of letters, digits, _ and -"
            )
    for pair in pairs:
        if pair.photo.temperature_k is not None:
            raise OptionError(f"the photo of {pair.name} is thermal; register such pairs one by one")

    return found


def _initials(initial: Rigid | Mapping[str, Rigid] | None, names: Sequence[str]) -> dict[str, Rigid | None]:
    """Return the rough pose of each camera."""
    if initial is None or isinstance(initial, Rigid):
        if initial is not None and len(names) > 1:
            raise OptionError(
                f"one initial pose is given, but the rig has the cameras {', '.join(names)}; give one for each name"
            )
        return dict.fromkeys(names, initial)
    if not isinstance(initial, Mapping) or not all(isinstance(pose, Rigid) for pose in initial.values()):
        raise OptionError("'initial' must be a Rigid, or a mapping of names of cameras to Rigid")
    strangers = [str(name) for name in initial if name not in names]
    if strangers:
        has = f"the cameras {', '.join(names)}" if names != [""] else "one camera without a name"
        raise OptionError(f"there is an initial pose of {', '.join(strangers)}, but the rig has {has}")
    return {name: initial.get(name) for name in names}


def _of_all(results: Mapping[str, RigResult]) -> RigResult:
    """Return the results of several cameras as that of their rig."""
    first, every = next(iter(results.values())), results.values()
    return RigResult(
        None,
        _UNKNOWN,
        all(one.accepted for one in every),
        tuple(f"{name}: {one.reasons[0]}" for name, one in results.items()),
        tuple(pair for one in every for pair in one.pairs),
        max(one.false_alarm for one in every),
        tuple(camera for one in every for camera in one.cameras),
        tuple(step for one in every for step in one.steps),
        first.options,
        first.seed,
        by_camera=dict(results),
    )


def _of_camera(pairs: Sequence[RigPair], initial: Rigid | None, steps: StepLog, o: RigOptions) -> RigResult:
    """Return the result of one camera, with the photographs of the same moment if a time offset is asked for."""
    result = _registered(pairs, initial, steps, o)
    if not o.estimate_time_offset:
        return result
    starts = [pose for pose in (result.camera_from_scanner, initial) if pose is not None]
    with steps.step("rig time offset") as note:
        offset = estimate_time_offset(pairs, starts, seed=o.seed)
        note.update(seconds=round(offset.seconds, 4), known=offset.known)
    moved = [paired_at(pair, offset.seconds) if offset.known else pair for pair in pairs]
    if any(new.photo is not old.photo for new, old in zip(moved, pairs, strict=True)):
        result = _registered(moved, initial or result.camera_from_scanner, steps, o)
    return replace(result, reasons=(*result.reasons, f"{offset.sentence[0].upper()}{offset.sentence[1:]}."),
                   time_offset=offset)  # fmt: skip


def _registered(pairs: Sequence[RigPair], initial: Rigid | None, steps: StepLog, o: RigOptions) -> RigResult:
    reasons = {index: reason_against_scan(pair.scan) for index, pair in enumerate(pairs)}
    unfit = {index: reason for index, reason in reasons.items() if reason}
    views = [PairViews(pair, o.seed) for pair in pairs]
    poses, alone = _proposed(pairs, initial, unfit, steps, o)
    with steps.step("rig candidates") as note:
        tried = tried_on_all(poses, views, unfit, o)
        note.update(proposed=len(poses), evidence=[round(one.evidence, 1) for one in tried])
        steps.pose = tried[0].camera_from_scanner if tried else None
    if not tried:
        none = "No pair proposed a pose: too few features of the scans match features of the photos."
        return _result(pairs, None, _UNKNOWN, (), 1.0, (none, ADVICE), steps, o)

    pose = tried[0].camera_from_scanner
    joint = JointPairs(views, pose)

    def jury_at(pose: Rigid) -> Jury:
        return Jury(joint, pairs, pose, unfit=unfit, alone=alone, options=o)

    with steps.step("rig finish") as note:
        members = jury_at(pose).fitting()
        for _ in range(_ROUNDS):
            pose = joint.finish(joint.refine(pose, members, (1,)) or pose, members)
            jury = jury_at(pose)
            before, members = members, jury.fitting()
            if members == before:
                break
        note.update(pairs=[pairs[index].name for index in before])
        steps.pose = pose
    with steps.step("rig held out") as note:
        evidence, without = held_out(joint, jury, pose, before, len(pairs))
        used = [index for index, one in enumerate(evidence) if one.outcome == "agrees"]
        if len(used) >= MIN_PAIRS and used != before:  # once more, with those that turned out to agree
            pose = joint.finish(joint.refine(pose, used, (1,)) or pose, used)
            evidence, without = held_out(joint, jury_at(pose), pose, used, len(pairs))
        else:
            used = before
        note.update({one.name: one.outcome for one in evidence})
        steps.pose = pose
    with steps.step("rig covariance"):
        covariance = _covariance(joint, views, pose, used, without)
    known = KnownPoses(pairs[used[0]].scan, pairs[used[0]].photo.camera)
    has_rival = any(
        known.differ(pose, one.camera_from_scanner) and one.evidence >= _RIVAL_EVIDENCE * tried[0].evidence
        for one in tried[1:]
    )
    alarm = joint_alarm(evidence, o)
    against = reasons_against(evidence, alarm, covariance, o, has_rival=has_rival)
    return _result(pairs, pose, covariance, tuple(evidence), alarm, against, steps, o)


def _proposed(
    pairs: Sequence[RigPair], initial: Rigid | None, unfit: Mapping[int, str], steps: StepLog, options: RigOptions
) -> tuple[list[Rigid], list[bool]]:
    """Return the poses that the pairs propose, the likeliest first, and whether each pair was accepted alone."""
    found: list[tuple[float, Rigid]] = [] if initial is None else [(2.0, initial)]
    alone = [False] * len(pairs)
    for index, pair in enumerate(pairs):
        if index in unfit:
            continue
        with steps.step("rig pair") as note:
            own, alone[index] = proposed_poses(pair, initial, options)
            found += own
            note.update(pair=pair.name, accepted=alone[index], poses=len(own))
            steps.pose = own[0][1] if own else None
    found.sort(key=lambda item: -item[0])
    return [pose for _, pose in found], alone


def _covariance(
    joint: JointPairs, views: Sequence[PairViews], pose: Rigid, members: Sequence[int], without: Sequence[Rigid]
) -> FloatArray:
    """Return the (6, 6) covariance: that of leaving out regions, enlarged, and that of leaving out pairs."""
    covariance = joint.covariance(pose, members)
    if covariance is None:
        return _UNKNOWN
    apart = np.array([
        np.concatenate([rotvec_from_rotation(other.rotation @ pose.rotation.T), other.centre - pose.centre])
        for other in without
    ]).reshape(-1, 6)  # fmt: skip
    count = max(len(apart), 1)
    between = (count - 1) / count * apart.T @ apart
    silent = float(np.mean([views[index].channel_set == "geometry" for index in members]))
    factor = silent * _OUTLINES_VARIANCE + (1 - silent) * _LINES_VARIANCE
    return np.asarray(factor * covariance + between)


def _result(
    pairs: Sequence[RigPair], pose: Rigid | None, covariance: FloatArray, evidence: tuple[PairEvidence, ...],
    alarm: float, against: Sequence[str], steps: StepLog, options: RigOptions,
) -> RigResult:  # fmt: skip
    used = [one.name for one in evidence if one.outcome == "agrees"]
    left = [one.name for one in evidence if one.outcome == "disagrees"]
    reasons = list(against) or [
        f"{len(used)} of {len(pairs)} pairs agree, each judged at the pose of the others; the probability of that by "
        f"chance is below {max(alarm, 1e-99):.0e}."
    ]
    if left:
        reasons.append(f"Refused and not used: {', '.join(left)}.")
    cameras = tuple(pair.photo.camera for pair in pairs)
    return RigResult(
        pose,
        covariance,
        not against,
        tuple(reasons),
        evidence,
        alarm,
        cameras,
        steps.steps,
        asdict(options),
        options.seed,
    )
