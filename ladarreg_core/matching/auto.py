"""The automatic registration: from two pictures to a verified pose, without a first guess."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, get_args

import numpy as np

from ladarreg_core.camera import Camera
from ladarreg_core.errors import OptionError
from ladarreg_core.frames import Rigid
from ladarreg_core.matching.aligner import Aligner, Candidate
from ladarreg_core.matching.alike import Places, alike_in_words
from ladarreg_core.matching.ambiguity import second_minimum
from ladarreg_core.matching.block_matches import BlockMatches
from ladarreg_core.matching.covariance import WindowEvidence, window_evidence
from ladarreg_core.matching.density import density_in
from ladarreg_core.matching.pictures import Pictures
from ladarreg_core.matching.pyramid import ChannelSet
from ladarreg_core.matching.roll import Turn
from ladarreg_core.matching.self_calibration import FreeCamera, check_free_camera, finished, with_camera_free
from ladarreg_core.matching.verification import GateOptions, Verification
from ladarreg_core.matching.verify_finished import judged_by_precision, regions_of
from ladarreg_core.matching.view_search import ViewSearch
from ladarreg_core.matching.views import rolled, viewing_directions
from ladarreg_core.photo import Photo
from ladarreg_core.progress import StepLog
from ladarreg_core.scan import Scan

log = logging.getLogger(__name__)
Reach = Literal["everywhere", "near_start"]
_MOST_TURNED, _MOST_FROM_EVERYWHERE = 2, 3
_SURE_FRACTION = 0.6
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
    intrinsics: FreeCamera = "auto"
    """What of the camera may be estimated with the pose."""
    channel_set: ChannelSet = "both"
    """What of the scan the photo is compared with."""
    reach: Reach = "everywhere"
    """How far the photo's place is looked for; `near_start` needs a first pose, and takes a fraction of the time."""

    def __post_init__(self) -> None:
        check_free_camera(self.intrinsics)
        if self.reach not in get_args(Reach):
            raise OptionError(f"the reach is {self.reach!r}; it must be one of {', '.join(get_args(Reach))}")


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
    camera: Camera | None = None
    """The camera that was estimated with it; None: as stated."""
    camera_sigmas: Mapping[str, float] = field(default_factory=dict)
    """The standard deviations of what was estimated, as in `PoseResult`."""


def register_auto(
    scan: Scan,
    photo: Photo,
    steps: StepLog,
    *,
    initial: Rigid | None = None,
    options: AutoOptions | None = None,
    pictures: Pictures | None = None,
) -> AutoResult:
    """Find the photo's pose from the pictures alone.

    Channels, points, hypotheses, climbs, finish and verification, in that order; the first climb that convinces ends
    the search. Where nothing does, the photo is taken to be turned about its axis, if its corners say so, and then
    compared as a whole from a grid of places. The scan's view is what is rolled, so that all pixels stay the photo's.
    Views are tried one after the other where the scan is much wider than the photo, and all of them: a photo that is
    verified at two places is not accepted.

    Args:
        scan: the scan.
        photo: the photograph.
        steps: receives every step.
        initial: a rough pose to try first.
        options: thresholds and seed.
        pictures: of the pair, where it was looked at before.
    """
    o = options or AutoOptions()
    pictures = pictures or Pictures(scan, photo)
    working = pictures.working
    with steps.step("photo") as note:
        photo_side = pictures.photo
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

    search = ViewSearch(
        pictures,
        steps,
        gate=o.gate,
        good_fraction=o.good_fraction,
        seed=o.seed,
        channel_set=o.channel_set,
    )
    found = _Findings(search, photo, Places(scan, photo.camera), steps, o)
    directions = viewing_directions(scan, working, initial=initial)
    if initial is not None and o.reach == "near_start":
        _look_near(search, found, directions[0], initial)
    else:
        _look_everywhere(search, found, directions, initial)
    return _told_if_sparse(found.answer(initial), scan, photo, [*directions, *([initial] if initial else [])])


class _Findings:
    """What the views gave: the verified poses, and the best of what was not verified."""

    def __init__(self, search: ViewSearch, photo: Photo, places: Places, steps: StepLog, options: AutoOptions) -> None:
        self.places = places
        self._search = search
        self._photo = photo
        self._steps = steps
        self._options = options
        self._accepted: AutoResult | None = None
        self._accepted_by: Aligner | None = None
        self._alike: tuple[Rigid, Rigid] | None = None
        self._refused: AutoResult | None = None
        self._unfinished: Candidate | None = None

    @property
    def settled(self) -> bool:
        """Whether two places are known to look alike, so that no further view can change the answer."""
        return self._alike is not None

    def consider(self, aligner: Aligner, candidate: Candidate | None) -> None:
        """Finish and judge the best climb of a view, if it is worth it."""
        if candidate is None:
            return
        if candidate.fraction < self._options.least_fraction:
            if self._unfinished is None or candidate.fraction > self._unfinished.fraction:
                self._unfinished = candidate
            return
        aligner, candidate = self._search.seen_whole(aligner, candidate)
        result, aligner = _finish(aligner, candidate, self._photo, self._steps, self._options.intrinsics)
        pose = result.camera_from_scanner
        if result.verification is None or not result.verification.accepted or pose is None:
            if self._refused is None or _fraction(result) > _fraction(self._refused):
                self._refused = result
            return
        other = self.places.other_than(pose)
        if other is not None:
            self._alike = (other, pose)
        self.places.add(pose)
        if self._accepted is None or _fraction(result) > _fraction(self._accepted):
            self._accepted, self._accepted_by = result, aligner

    def answer(self, initial: Rigid | None) -> AutoResult:
        """Return the result."""
        if self._accepted is not None:
            # Which of alike places is meant, a given pose tells; not that there is one of which much agrees.
            if self._alike is None and (initial is None or _fraction(self._accepted) < _SURE_FRACTION):
                self._alike = self._second_minimum()
            return self._accepted if self._alike is None else _undecided(self._accepted, *self._alike)
        if self._refused is not None:
            return self._refused
        if self._unfinished is None:
            reason = "No start could be found: too few features of the scan and the photo look alike."
            return AutoResult(initial, None, None, (reason, _ADVICE))
        best = self._unfinished
        reason = f"The best start found agrees in only {best.fraction:.0%} of the picture."
        return AutoResult(best.camera_from_scanner, best.first_look, None, (reason, _ADVICE))

    def _second_minimum(self) -> tuple[Rigid, Rigid] | None:
        """Return the accepted pose and another one near it that is verified, too."""
        accepted, aligner = self._accepted, self._accepted_by
        if accepted is None or aligner is None or accepted.verification is None:
            return None
        pose = accepted.camera_from_scanner
        assert pose is not None, "what was accepted has a pose"
        with self._steps.step("second minimum") as note:
            other = second_minimum(aligner, pose, accepted.verification, self.places)
            note.update(found=other is not None)
            self._steps.pose = pose
        return None if other is None else (pose, other)


def _told_if_sparse(result: AutoResult, scan: Scan, photo: Photo, poses: Sequence[Rigid]) -> AutoResult:
    """Return a refusal with the scan's want of points as its first reason, and the only one where nothing was tried."""
    if result.verification is not None and result.verification.accepted:
        return result
    density = density_in(scan, photo.camera, poses)
    if density is None or not density.too_sparse:
        return result
    if result.verification is None:
        return replace(result, reasons=(density.in_words(), _ADVICE))
    return replace(result, reasons=(density.in_words(), *result.reasons))


def _look_near(search: ViewSearch, found: _Findings, direction: Rigid, initial: Rigid) -> None:
    """Look from the given pose, and from places around it."""
    aligner = search.view(direction, name="the given pose")
    if aligner is None:
        return
    found.consider(aligner, search.from_start(aligner, found.places, initial))
    if not found.places:
        found.consider(aligner, search.from_places(aligner, found.places, around=initial))


def _look_everywhere(search: ViewSearch, found: _Findings, directions: Sequence[Rigid], initial: Rigid | None) -> None:
    """Look upright in every view; then rolled, where corners speak for a roll; then from everywhere.

    One verified pose ends the search where the scan has one view. Where it has several the others are looked at, too:
    what looks alike elsewhere would be verified there as well.
    """
    upright = directions[0 if initial is None else 1 :]
    several = len(upright) > 1
    turns: list[tuple[Turn, Rigid]] = []
    for number, direction in enumerate(directions):
        given = initial if number == 0 else None
        aligner = search.view(direction, name=number)
        if aligner is None:
            continue
        found.consider(aligner, search.from_corners(aligner, found.places, given=given))
        if given is not None and not found.places:
            found.consider(aligner, search.from_places(aligner, found.places, around=given))
        # Which of alike places is meant is told by a pose that was given.
        if found.settled or (found.places and (given is not None or not several)):
            return
        turn = None if found.places else search.turn(aligner)
        if turn is not None:
            turns.append((turn, direction))
    if found.places:
        return

    turns.sort(key=lambda item: -item[0].matches)
    likely = [rolled(direction, turn.angle_rad) for turn, direction in turns[:_MOST_TURNED]]
    others = [rolled(direction, turns[0][0].angle_rad) for direction in upright if several and likely]
    _compare(search, found, "rolled", likely, others, search.from_corners)
    if not found.places:
        likely, others = list(upright[:_MOST_FROM_EVERYWHERE]), list(upright[_MOST_FROM_EVERYWHERE:])
        _compare(search, found, "again", likely, others, search.from_places)


def _compare(
    search: ViewSearch,
    found: _Findings,
    name: str,
    likely: Sequence[Rigid],
    others: Sequence[Rigid],
    find: Callable[[Aligner, Places], Candidate | None],
) -> None:
    """Look in the likely views, and after a verified pose in all others for what looks alike."""
    for number, direction in enumerate([*likely, *others]):
        if found.settled or (number >= len(likely) and not found.places):
            return
        aligner = search.view(direction, name=f"{name} {number}")
        if aligner is not None:
            found.consider(aligner, find(aligner, found.places))


def _undecided(result: AutoResult, first: Rigid, second: Rigid) -> AutoResult:
    """Return a verified result as not accepted, since another place was verified as well."""
    assert result.verification is not None, "only what was verified can look alike"
    reasons = (alike_in_words(first, second), _ADVICE)
    return replace(result, verification=replace(result.verification, accepted=False, reasons=reasons), reasons=reasons)


_ADVICE = "Draw a few matching lines by hand, or give a rough pose."


def _fraction(result: AutoResult) -> float:
    return result.verification.fraction if result.verification is not None else -1.0


def _finish(
    aligner: Aligner, candidate: Candidate, photo: Photo, steps: StepLog, intrinsics: FreeCamera
) -> tuple[AutoResult, Aligner]:
    """Return the finished and judged pose, and the pair as its camera sees it."""
    start = candidate.camera_from_scanner
    with steps.step("finish"):
        pose = aligner.finish(start)
        steps.pose = pose
    with steps.step("verify") as note:
        found = finished(aligner, photo.camera, pose)
        note.update(found.verification.as_dict())
    if intrinsics != "fixed":
        with steps.step("camera") as note:
            found = with_camera_free(found, photo, start, intrinsics)
            note.update(estimated=bool(found.free), focal_px=round(found.camera.focal_px, 3))
            note.update(found.verification.as_dict())
            steps.pose = found.camera_from_scanner
    with steps.step("evidence"):
        aligner, camera, pose = found.aligner, found.camera, found.camera_from_scanner
        evidence = window_evidence(found.fine, aligner.judged_points, aligner.photo.cameras[0], camera, pose)
        if found.regions is not None:
            evidence = replace(evidence, covariance=found.regions.of_pose)
        blocks = aligner.block_matches(pose)
        steps.pose, steps.matches = pose, blocks.matches if blocks else None
    points = aligner.judged_points.points[found.fine.visible]
    verification = judged_by_precision(found.verification, points, camera, pose, evidence.covariance)
    verification = replace(verification, regions=regions_of(found.fine, aligner.photo.cameras[0], camera))
    reasons: tuple[Any, ...] = verification.reasons
    advice = () if verification.accepted else (_ADVICE,)
    return AutoResult(
        pose, verification, evidence, (*reasons, *found.in_words(photo.camera), *advice), blocks,
        camera if found.free else None, found.camera_sigmas,
    ), aligner  # fmt: skip
