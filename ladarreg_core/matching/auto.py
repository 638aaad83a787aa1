"""Automatic registration: from a scan and a photo to a verified pose, without an initial pose."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from ladarreg_core.camera import Camera
from ladarreg_core.camera.uncertainty import DEFAULT_CAMERA_PRIOR, CameraPrior
from ladarreg_core.foundations.parallel import Begun, OtherCore
from ladarreg_core.frames import Rigid
from ladarreg_core.matching.auto_options import AutoOptions
from ladarreg_core.matching.auto_result import ADVICE, AutoResult, Unverified
from ladarreg_core.matching.face_registration import FaceViews, register_faces
from ladarreg_core.matching.images.kept_channels import Channels
from ladarreg_core.matching.images.pair import PairLevels
from ladarreg_core.matching.images.support import is_coarse
from ladarreg_core.matching.images.views import rolled_view, scan_density, viewing_directions
from ladarreg_core.matching.placements import best_of_placements, cameras_beside, may_be_beside
from ladarreg_core.matching.refine.aligner import Aligner, Candidate
from ladarreg_core.matching.refine.covariance import window_evidence
from ladarreg_core.matching.refine.self_calibration import (
    FreeCamera,
    estimate_camera,
    may_estimate_camera,
    verify_finished,
)
from ladarreg_core.matching.search.ambiguity import KnownPoses, ambiguity_sentence, second_minimum, second_starts
from ladarreg_core.matching.search.roll import Roll
from ladarreg_core.matching.search.view_search import ViewSearch
from ladarreg_core.matching.verify.verification import Verification, check_precision, region_markers
from ladarreg_core.matching.wrong_poses import WrongPoses, verdict_beside_wrong_poses, wrong_poses_decide
from ladarreg_core.photo import Photo
from ladarreg_core.results.steps import StepLog
from ladarreg_core.scan import Scan

_MAX_ROLLED_VIEWS, _MAX_GRID_VIEWS = 2, 3
_MEDIAN_CELLS = 100_000
_RANGE_M = (1e-6, 1e7)  # generous, to allow for wrong units; the limits of the estimator of matches


def compared_pair(scan: Scan, photo: Photo, channels: Channels | None = None) -> PairLevels | FaceViews:
    """Return the images of a pair, computed once for several registrations: the photograph's, or those of its faces.

    Args:
        scan: the scan.
        photo: the photograph.
        channels: those that are kept for further registrations.
    """
    if photo.camera.as_pinhole is None:
        return FaceViews(scan, photo)
    return PairLevels(scan, photo) if channels is None else PairLevels(scan, photo, levels_of=channels.photo_levels)


def register_auto(
    pair: PairLevels | FaceViews,
    photo: Photo,
    steps: StepLog,
    *,
    initial: Rigid | None = None,
    options: AutoOptions | None = None,
    prior: CameraPrior = DEFAULT_CAMERA_PRIOR,
    channels: Channels | None = None,
) -> AutoResult:
    """Find the pose of a photo from the images alone.

    The steps are channels, points, hypotheses, refinement, finish and verification; the first sufficient candidate ends
    the search. Without one, a roll of the camera is detected from corners and the search repeated in a rolled view;
    after that, the photo is compared as a whole with the scan as seen from a grid of camera positions. The view of the
    scan is rolled, never the photo, so that all pixels remain those of the photo. If the scan is much wider than the
    photo, all views are searched: a photo that is verified at two poses is not accepted. A photograph of a wide camera
    is searched face by face, see `register_faces`; its intrinsics are not estimated.

    Args:
        pair: the images of the pair.
        photo: the photograph.
        steps: receives every step.
        initial: an initial pose, tried first.
        options: thresholds and seed.
        prior: what is known of an assumed camera.
        channels: those that are kept for further registrations; None: only those of the last view are.
    """
    o = options or AutoOptions()
    with steps.step("photo") as note:
        contrast, working = pair.contrast, pair.working
        note.update(width=working.width, height=working.height, focal_px=round(working.fx, 3))
    if contrast < 1:
        return AutoResult(initial, None, None, ("The photo is uniform and has no structure to match.",))
    reason = reason_against_scan(pair.scan)
    if reason:
        return AutoResult(initial, None, None, (reason,))
    if isinstance(pair, FaceViews):
        return register_faces(pair, photo, steps, initial, o)

    prior = o.calibrated_prior if photo.calibrated else prior
    prior = prior.covering(photo.pinhole, filter(None, (other.as_pinhole for other in photo.alternatives)))
    result = _searched(pair, photo.pinhole, photo, steps, initial, o, prior, channels)
    if photo.assumed and may_be_beside(result):
        assert result.camera is not None, "it was estimated"
        found = [result]
        for camera in cameras_beside(result.camera, photo.pinhole):
            found.append(_searched(pair.with_camera(camera), camera, photo, steps, initial, o, prior, channels))
            if not may_be_beside(found[-1]):
                break
        result = best_of_placements(found, photo.pinhole)
    directions = viewing_directions(pair.scan, working, initial=initial)
    return _explain_if_sparse(result, pair.scan, photo, [*directions, *([initial] if initial else [])])


def _searched(
    pair: PairLevels,
    camera: Camera,
    photo: Photo,
    steps: StepLog,
    initial: Rigid | None,
    options: AutoOptions,
    prior: CameraPrior,
    channels: Channels | None,
) -> AutoResult:
    """Return the best pose of one search, in which the images are compared as seen by a camera."""
    with OtherCore() as other_core:
        search = ViewSearch(
            pair,
            steps,
            other_core,
            gate=options.gate,
            good_fraction=options.good_fraction,
            seed=options.seed,
            channel_set=options.channel_set,
            channels=channels,
        )
        directions = viewing_directions(pair.scan, pair.working, initial=initial)
        known = KnownPoses(pair.scan, camera, options.gate)
        found = CandidateSet(search, photo, camera, known, steps, other_core, options, initial, prior)
        if initial is not None and options.reach == "near_start":
            _search_near(search, found, directions[0], initial)
        else:
            _search_everywhere(search, found, directions, initial)
        return found.result()


def reason_against_scan(scan: Scan) -> str:
    """Return why a scan cannot determine a pose; empty if nothing speaks against it."""
    nearest, farthest = float(np.fmin.reduce(scan.ranges, axis=None)), float(np.fmax.reduce(scan.ranges, axis=None))
    if nearest == farthest:
        return f"All returns of the scan have the same range, {nearest:g} m, so the scan does not determine a pose."

    returns = scan.ranges[scan.valid]
    median = float(np.median(returns[:: max(1, len(returns) // _MEDIAN_CELLS)]))
    if not _RANGE_M[0] <= median <= _RANGE_M[1]:
        return f"The median range of the scan is {median:.3g} m, which is implausible: check its unit and scale."
    return ""


class CandidateSet:
    """Candidates of all views: the verified poses, and the best of those that were not verified."""

    def __init__(
        self,
        search: ViewSearch,
        photo: Photo,
        camera: Camera,
        known: KnownPoses,
        steps: StepLog,
        other_core: OtherCore,
        options: AutoOptions,
        initial: Rigid | None,
        prior: CameraPrior,
    ) -> None:
        self.known = known
        self._prior = prior
        self._search = search
        self._photo = photo
        self._camera = camera
        self._steps = steps
        self._other_core = other_core
        self._options = options
        self._initial = initial
        self._starts: tuple[Aligner, Begun[list[Rigid]]] | None = None
        self._wrong: WrongPoses | None = None
        self._accepted: AutoResult | None = None
        self._accepted_by: Aligner | None = None
        self._ambiguous_poses: tuple[Rigid, Rigid] | None = None
        self._unverified = Unverified(initial)

    @property
    def is_ambiguous(self) -> bool:
        """Whether two different poses were verified, so that no further view can change the result."""
        return self._ambiguous_poses is not None

    def add_candidate(self, aligner: Aligner, candidate: Candidate | None) -> None:
        """Finish and verify the best candidate of a view, if enough regions agree."""
        if candidate is None:
            return
        if candidate.fraction < self._options.least_fraction:
            self._unverified.add_unfinished(candidate.camera_from_scanner, candidate.coarse_verdict)
            return
        aligner, candidate = self._search.with_full_overlap(aligner, candidate)
        settled = self._search.settled(aligner, candidate)
        result, finished_by = self._finished(*settled)
        if not result.accepted and settled[0] is not aligner:
            result, finished_by = self._finished(aligner, candidate)
        pose = result.camera_from_scanner
        if pose is None or not result.accepted:
            return
        other = self.known.different_from(pose)
        if other is not None:
            self._ambiguous_poses = (other, pose)
        self.known.add(pose)
        if self._accepted is None or result.fraction > self._accepted.fraction:
            self._accepted, self._accepted_by = result, finished_by

    def _finished(self, aligner: Aligner, candidate: Candidate) -> tuple[AutoResult, Aligner]:
        """Return the finished and verified result of a candidate, and the aligner of its camera; keep a refused one."""
        self._begin_second_minimum(aligner, candidate)
        result, aligner, self._wrong = _finish(
            aligner, candidate, self._photo, self._camera, self._steps, self._options.intrinsics, self._prior,
            self._wrong,
        )  # fmt: skip
        if not result.accepted:
            self._unverified.add_refused(result)
        return result, aligner

    def _begin_second_minimum(self, aligner: Aligner, candidate: Candidate) -> None:
        """Begin the search for a second minimum beside a candidate that will be accepted, most likely.

        On the coarsest level, a candidate is where its finished pose will be.
        """
        verdict = candidate.coarse_verdict
        if verdict.accepted and not self._is_sure(verdict) and not self.known:
            starts = self._other_core.begin(partial(second_starts, aligner, candidate.camera_from_scanner))
            self._starts = aligner, starts

    def _is_sure(self, verdict: Verification | None) -> bool:
        """Return whether a given pose decides which of several similar places is meant: if most regions agree there.

        Few regions of a coarse scan are never sure.
        """
        if verdict is None or verdict.wrong_poses:
            return False
        return self._initial is not None and verdict.fraction >= self._options.gate.sure_fraction

    def result(self) -> AutoResult:
        """Return the accepted result, else the best refused one."""
        if self._accepted is None:
            return self._unverified.result
        if self._ambiguous_poses is None and not self._is_sure(self._accepted.verification):
            self._ambiguous_poses = self._second_minimum()
        if self._ambiguous_poses is not None:
            return self._accepted.refused(ambiguity_sentence(*self._ambiguous_poses))
        return self._accepted

    def _second_minimum(self) -> tuple[Rigid, Rigid] | None:
        """Return the accepted pose and a second one that explains the image as well; None if there is none."""
        accepted, aligner = self._accepted, self._accepted_by
        if accepted is None or aligner is None or accepted.verification is None:
            return None
        pose = accepted.camera_from_scanner
        assert pose is not None, "an accepted result has a pose"
        with self._steps.step("second minimum") as note:
            begun = self._starts
            starts = begun[1].result() if begun is not None and begun[0] is aligner else None
            other = second_minimum(aligner, pose, accepted.verification, self.known, starts)
            note.update(found=other is not None)
            self._steps.pose = pose
        return None if other is None else (pose, other)


def _explain_if_sparse(result: AutoResult, scan: Scan, photo: Photo, poses: Sequence[Rigid]) -> AutoResult:
    """Return a refused result with a sparse scan as its first reason, or as its only one if nothing was verified.

    Of a scan that is coarse only, what to do about it is added.
    """
    if result.accepted:
        return result
    density = scan_density(scan, photo.pinhole, poses)
    if density is None:
        return result
    if not density.too_sparse:
        if not is_coarse(scan, photo.pinhole):
            return result
        rest = tuple(reason for reason in result.reasons if reason != ADVICE)
        return replace(result, reasons=(*rest, density.advice(), ADVICE))
    if result.verification is None:
        return replace(result, reasons=(density.summary(), ADVICE))
    return replace(result, reasons=(density.summary(), *result.reasons))


def _search_near(search: ViewSearch, found: CandidateSet, direction: Rigid, initial: Rigid) -> None:
    """Search from the given pose, then from a grid around it."""
    aligner = search.view(direction, name="the given pose")
    if aligner is None:
        return
    found.add_candidate(aligner, search.from_start(aligner, found.known, initial))
    if not found.known:
        found.add_candidate(aligner, search.from_grid(aligner, found.known, around=initial))


def _search_everywhere(
    search: ViewSearch, found: CandidateSet, directions: Sequence[Rigid], initial: Rigid | None
) -> None:
    """Search every upright view; then rolled views, if corners indicate a roll; then from a grid of positions.

    With one view of the scan, one verified pose ends the search. With several views the others are searched as well,
    because a similar place elsewhere would be verified there.
    """
    upright = directions[0 if initial is None else 1 :]
    several = len(upright) > 1
    rolls: list[tuple[Roll, Rigid]] = []
    aligner: Aligner | None
    for number, direction in enumerate(directions):
        given = initial if number == 0 else None
        aligner = None  # frees the channels of the last view before those of the next are made
        aligner = search.view(direction, name=number, for_corners=given is None)
        if aligner is None:
            continue
        found.add_candidate(aligner, search.from_corners(aligner, found.known, given=given))
        if given is not None and not found.known:
            found.add_candidate(aligner, search.from_grid(aligner, found.known, around=given))
        # A given pose decides which of several similar places is meant.
        if found.is_ambiguous or (found.known and (given is not None or not several)):
            return
        roll = None if found.known else search.detect_roll(aligner)
        if roll is not None:
            rolls.append((roll, direction))
    if found.known:
        return

    rolls.sort(key=lambda item: -item[0].matches)
    likely = [rolled_view(direction, roll.angle_rad) for roll, direction in rolls[:_MAX_ROLLED_VIEWS]]
    others = [rolled_view(direction, rolls[0][0].angle_rad) for direction in upright if several and likely]
    _search_views(search, found, "rolled", likely, others, search.from_corners, for_corners=True)
    if not found.known:
        likely, others = list(upright[:_MAX_GRID_VIEWS]), list(upright[_MAX_GRID_VIEWS:])
        _search_views(search, found, "again", likely, others, search.from_grid)


def _search_views(
    search: ViewSearch,
    found: CandidateSet,
    name: str,
    likely: Sequence[Rigid],
    others: Sequence[Rigid],
    find: Callable[[Aligner, KnownPoses], Candidate | None],
    *,
    for_corners: bool = False,
) -> None:
    """Search the likely views, and after a verified pose all others for a second one."""
    aligner: Aligner | None
    for number, direction in enumerate([*likely, *others]):
        if found.is_ambiguous or (number >= len(likely) and not found.known):
            return
        aligner = None
        aligner = search.view(direction, name=f"{name} {number}", for_corners=for_corners)
        if aligner is not None:
            found.add_candidate(aligner, find(aligner, found.known))


def _finish(
    aligner: Aligner,
    candidate: Candidate,
    photo: Photo,
    camera: Camera,
    steps: StepLog,
    intrinsics: FreeCamera,
    prior: CameraPrior,
    wrong: WrongPoses | None,
) -> tuple[AutoResult, Aligner, WrongPoses | None]:
    """Return the finished and verified result, the aligner of its camera, and wrong poses if they are known."""
    start = candidate.camera_from_scanner
    with steps.step("finish"):
        pose = aligner.finish(start)
        steps.pose = pose
    with steps.step("verify") as note:
        found = verify_finished(
            aligner,
            camera,
            pose,
            try_camera=intrinsics == "auto"
            and not (photo.assumed or photo.alternatives)
            and may_estimate_camera(photo, intrinsics),
        )
        note.update(found.verification.as_dict())
    of_images = found.verification
    if intrinsics != "fixed":
        with steps.step("camera") as note:
            found = estimate_camera(found, photo, start, intrinsics, prior)
            note.update(estimated=bool(found.free), focal_px=round(found.camera.focal_px, 3))
            note.update(found.verification.as_dict())
            steps.pose = found.camera_from_scanner
    # Another camera is one more thing that was fitted, and a contradicted one a reason of its own to refuse.
    if found.verification is of_images and wrong_poses_decide(of_images, found.aligner):
        with steps.step("wrong poses") as note:
            tried = sum(step.name == "climb" for step in steps.steps)
            verdict, wrong = verdict_beside_wrong_poses(
                found.verification, found.fine, found.aligner, found.camera_from_scanner, tried=tried, known=wrong
            )
            found = replace(found, verification=verdict)
            note.update(found.verification.as_dict())
    with steps.step("evidence"):
        aligner, camera, pose = found.aligner, found.camera, found.camera_from_scanner
        evidence = window_evidence(found.fine, aligner.verification_points, aligner.photo.cameras[0], camera, pose)
        factor = aligner.common_variance
        joint = found.covariance()
        evidence = replace(evidence, covariance=factor * evidence.covariance if joint is None else joint[:6, :6])
        blocks = aligner.block_matches(pose)
        steps.pose, steps.matches = pose, blocks.matches if blocks else None
    points = aligner.verification_points.points[found.fine.visible]
    uncertainty = found.camera_uncertainty(photo.pinhole)
    verification = check_precision(
        found.verification, points, camera, pose, uncertainty or evidence.covariance, aligner.gate, coarse=factor > 1
    )
    verification = replace(
        verification, regions=region_markers(found.fine, aligner.photo.cameras[0], camera, aligner.gate)
    )
    reasons: tuple[Any, ...] = verification.reasons
    advice = () if verification.accepted else (ADVICE,)
    return AutoResult(
        pose, verification, evidence, (*reasons, *found.summary(photo.pinhole), *advice), blocks,
        camera if found.free else None, found.camera_sigmas, uncertainty,
    ), aligner, wrong  # fmt: skip
