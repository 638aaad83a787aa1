"""The automatic registration: from two pictures to a verified pose, without a first guess."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ladarreg_core.frames import Rigid
from ladarreg_core.matches import Matches
from ladarreg_core.matching.aligner import Aligner, Candidate
from ladarreg_core.matching.block_matches import BlockMatches
from ladarreg_core.matching.evidence import WindowEvidence, window_evidence
from ladarreg_core.matching.hypotheses import Hypothesis, hypotheses
from ladarreg_core.matching.levels import PhotoLevels, ScanLevels, photo_levels, scan_levels, working_camera
from ladarreg_core.matching.verify import GateOptions, Verification
from ladarreg_core.matching.views import towards_seen, viewing_directions
from ladarreg_core.perspective import View, perspective_view
from ladarreg_core.photo import Photo
from ladarreg_core.scan import Scan
from ladarreg_core.steps import StepLog

log = logging.getLogger(__name__)
_RANGE_M = (1e-6, 1e7)  # generous, for millimetres taken for metres; the estimator of matches ends there, too


@dataclass(frozen=True, slots=True)
class AutoOptions:
    """How the automatic method works."""

    seed: int = 0
    """Of every draw."""
    good_fraction: float = 0.6
    """A climb that reaches this share of agreeing windows ends the search, if it passes the gate."""
    least_fraction: float = 0.35
    """A best climb below this is not worth finishing."""
    gate: GateOptions = field(default_factory=GateOptions)
    """What a pose must show."""


@dataclass(frozen=True, slots=True, eq=False)
class AutoResult:
    """The best pose found, and what is to be said for it."""

    camera_from_scanner: Rigid | None
    """None where nothing could even be tried."""
    verification: Verification | None
    """The verdict on it; None where no pose was worth verifying."""
    evidence: WindowEvidence | None
    """How uncertain it is."""
    reasons: tuple[str, ...]
    """The verdict in sentences."""
    blocks: BlockMatches | None = None
    """Its sub-pixel point matches."""


def register_auto(
    scan: Scan, photo: Photo, steps: StepLog, *, initial: Rigid | None = None, options: AutoOptions | None = None
) -> AutoResult:
    """Find the photo's pose from the pictures alone.

    Channels, points, hypotheses, climbs, finish and verification, in that order; the first climb that convinces ends
    the search. Views are tried one after the other where the scan is much wider than the photo.

    Args:
        scan: the scan.
        photo: the photograph.
        steps: receives every step.
        initial: a rough pose to try first.
        options: thresholds and seed.
    """
    o = options or AutoOptions()
    working = working_camera(scan, photo.camera)
    with steps.step("photo") as note:
        photo_side = photo_levels(photo, working)
        contrast = max(float(plane.max() - plane.min()) for plane in photo_side.planes[0])
        note.update(width=working.width, height=working.height, focal_px=round(working.fx, 3))
    if contrast < 1:
        return AutoResult(initial, None, None, ("The photo is one flat colour: there is nothing in it to match.",))

    nearest, farthest = float(np.nanmin(scan.ranges)), float(np.nanmax(scan.ranges))
    if nearest == farthest:
        reason = f"Every return of the scan has the same range, {nearest:g} m: nothing was measured that fixes a pose."
        return AutoResult(initial, None, None, (reason,))

    median = float(np.nanmedian(scan.ranges))
    if not _RANGE_M[0] <= median <= _RANGE_M[1]:
        reason = f"The scan's median range is {median:.3g} m, which no laser measures: check its unit and scale."
        return AutoResult(initial, None, None, (reason,))

    best: tuple[float, Aligner, Candidate] | None = None
    last = AutoResult(initial, None, None, ())
    for number, direction in enumerate(viewing_directions(scan, working, initial=initial)):
        with steps.step("channels") as note:
            view = perspective_view(scan, working, view_from_scanner=direction)
            aligner = Aligner(_with_channels(scan, view, photo_side), photo_side, gate=o.gate, seed=o.seed)
            note.update(view=number, points={level: len(p) for level, p in aligner.points.items()})
        if not aligner.usable:
            continue
        candidate = _search(aligner, steps, initial=initial if number == 0 else None, options=o)
        if candidate is None or candidate.fraction < o.least_fraction:
            if candidate is not None and (best is None or candidate.fraction > best[0]):
                best = (candidate.fraction, aligner, candidate)
            continue
        aligner, candidate = _seen_whole(scan, aligner, candidate, steps, o)
        result = _finish(aligner, candidate, photo, steps)
        if result.verification is not None and result.verification.accepted:
            return result
        if last.verification is None or _fraction(result) > _fraction(last):
            last = result
    if last.verification is not None:
        return last
    if best is None:
        reason = "No start could be found: too few features of the scan and the photo look alike."
        return AutoResult(initial, None, None, (reason, _ADVICE))
    fraction, _, candidate = best
    reason = f"The best start found agrees in only {fraction:.0%} of the picture."
    return AutoResult(candidate.camera_from_scanner, candidate.first_look, None, (reason, _ADVICE))


def _seen_whole(
    scan: Scan, aligner: Aligner, candidate: Candidate, steps: StepLog, options: AutoOptions
) -> tuple[Aligner, Candidate]:
    """Return the pair as seen in a view of all that the photo sees, where the present view shows only part of it."""
    photo_side, pose = aligner.photo, candidate.camera_from_scanner
    turn = towards_seen(scan, photo_side.cameras[0], pose, view=aligner.scan.view)
    if turn is None:
        return aligner, candidate
    with steps.step("channels") as note:
        view = perspective_view(scan, photo_side.cameras[0], view_from_scanner=turn)
        whole = Aligner(_with_channels(scan, view, photo_side), photo_side, gate=options.gate, seed=options.seed)
        note.update(view="what the photo sees", points={level: len(p) for level, p in whole.points.items()})
    if not whole.usable:
        return aligner, candidate
    with steps.step("climb") as note:
        again = whole.approach(pose)
        note["start"] = "the pose found in another view"
        if again is not None:
            note.update(again.first_look.as_dict())
            steps.pose = again.camera_from_scanner
    if again is None or again.first_look.agreeing <= candidate.first_look.agreeing:
        return aligner, candidate
    return whole, again


def _with_channels(scan: Scan, view: View, photo_side: PhotoLevels) -> ScanLevels:
    """Return the scan's levels with the channels of both sides made, on two cores where there are two."""
    with ThreadPoolExecutor(1) as other_core:
        of_photo = other_core.submit(lambda: (photo_side.channels, photo_side.fine_channels))
        levels = scan_levels(scan, view)
        of_geometry = other_core.submit(lambda: levels.geometry_channels)
        _ = levels.intensity_channels, levels.fine_channels
        of_photo.result()
        of_geometry.result()
    return levels


_ADVICE = "Draw a few matching lines by hand, or give a rough pose."


def _fraction(result: AutoResult) -> float:
    return result.verification.fraction if result.verification is not None else -1.0


def _search(aligner: Aligner, steps: StepLog, *, initial: Rigid | None, options: AutoOptions) -> Candidate | None:
    """Climb from each hypothesis until one convinces; return the best."""
    best: Candidate | None = None
    stream = _starts(aligner, steps, initial, options.seed)
    for source, start in stream:
        with steps.step("climb") as note:
            candidate = aligner.approach(start)
            note["start"] = source
            if candidate is not None:
                note.update(candidate.first_look.as_dict())
                steps.pose = candidate.camera_from_scanner
        if candidate is None:
            continue
        if best is None or candidate.fraction > best.fraction:
            best = candidate
        if candidate.fraction >= options.good_fraction and candidate.first_look.accepted:
            break
    return best


def _starts(aligner: Aligner, steps: StepLog, initial: Rigid | None, seed: int) -> Iterator[tuple[str, Rigid]]:
    if initial is not None:
        yield "the given pose", initial
    found = hypotheses(aligner.scan, aligner.photo, seed=seed)
    while True:
        with steps.step("hypothesis") as note:
            item = next(found, None)
            if isinstance(item, Hypothesis):
                note.update(source=item.source, matches=len(item.points), inliers=item.inliers)
                steps.matches, steps.pose = _as_matches(item, aligner), item.camera_from_scanner
            else:
                note["none"] = item or "no further hypotheses"
        if item is None:
            return
        if isinstance(item, Hypothesis):
            yield item.source, item.camera_from_scanner


def _as_matches(hypothesis: Hypothesis, aligner: Aligner) -> Matches:
    ranges = (hypothesis.points**2).sum(axis=-1) ** 0.5
    camera = aligner.photo.source
    uv = camera.project(aligner.photo.cameras[0].unproject(hypothesis.uv))
    return Matches(hypothesis.points / ranges[:, None], ranges, uv)


def _finish(aligner: Aligner, candidate: Candidate, photo: Photo, steps: StepLog) -> AutoResult:
    with steps.step("finish"):
        pose = aligner.finish(candidate.camera_from_scanner)
        steps.pose = pose
    with steps.step("verify") as note:
        verification, _, fine = aligner.judge(pose)
        evidence = window_evidence(fine, aligner.judged_points, aligner.photo.cameras[0], photo.camera, pose)
        blocks = aligner.block_matches(pose)
        note.update(verification.as_dict())
        steps.pose, steps.matches = pose, blocks.matches if blocks else None
    reasons: tuple[Any, ...] = verification.reasons
    advice = () if verification.accepted else (_ADVICE,)
    return AutoResult(pose, verification, evidence, (*reasons, *advice), blocks)
