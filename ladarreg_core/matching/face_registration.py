"""Automatic registration of photographs of wide cameras (fisheye, equirectangular) through their pinhole faces.

The pose hypothesis of one face, refined as for any photograph, is the hypothesis for all: the pose is refined jointly
over all faces and verified once, over all their regions. What lies outside the scan counts neither way.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from ladarreg_core.camera import Camera
from ladarreg_core.frames import Rigid
from ladarreg_core.matching.auto import ADVICE, AutoOptions, reason_against_scan
from ladarreg_core.matching.auto_result import AutoResult
from ladarreg_core.matching.images.faces import Face, FaceSet
from ladarreg_core.matching.images.laser_images import CleanedScan
from ladarreg_core.matching.images.pyramid import ScanLevels, scan_levels, working_camera
from ladarreg_core.matching.images.views import direction_towards_overlap
from ladarreg_core.matching.refine.aligner import Aligner
from ladarreg_core.matching.refine.joint_aligner import JointAligner, aligners_of_faces
from ladarreg_core.matching.search.ambiguity import KnownPoses, ambiguity_sentence, competes
from ladarreg_core.matching.search.face_search import FaceHypothesis, FaceSearch
from ladarreg_core.matching.verify.verification import GateOptions, Verification, check_precision
from ladarreg_core.photo import Photo
from ladarreg_core.progress import StepLog
from ladarreg_core.scan import Scan
from ladarreg_core.surface.perspective import perspective_view

_SEARCH_PIXELS = 200_000
_MAX_TRIED = {False: 5, True: 6}  # hypotheses refined: upright ones, rolled ones
_MAX_JOINT = 3
_MIN_CHECKED = 0.3  # fraction of agreeing regions of the hypothesis's own face, below which it is not tried jointly
_FINE_POINTS = 8000  # of a face: only its own part of the picture counts, and there are many faces
# A regular floor or wall of another room agrees with nearly half of the regions; of the right rooms 62 % did at least.
_MIN_FRACTION = 0.57


def is_wide(photo: Photo) -> bool:
    """Return whether a photograph is registered through faces: its camera is not a pinhole."""
    return photo.camera.as_pinhole is None


def register_faces(
    scan: Scan, photo: Photo, steps: StepLog, *, initial: Rigid | None = None, options: AutoOptions | None = None
) -> AutoResult:
    """Find the pose of a photograph of a wide camera from the images alone.

    Args:
        scan: the scan.
        photo: the photograph; its intrinsics are not estimated.
        steps: receives every step.
        initial: an initial pose, tried first.
        options: thresholds and seed.
    """
    o = options or AutoOptions()
    registration = _FaceRegistration(scan, photo, steps, o)
    return registration.run(initial)


def verify_faces(
    scan: Scan, photo: Photo, camera_from_scanner: Rigid, *, gate: GateOptions | None = None, seed: int = 0
) -> Verification | None:
    """Verify a given pose of a wide photograph; return None if there is too little structure to compare.

    Args:
        scan: the scan.
        photo: the photograph.
        camera_from_scanner: the pose.
        gate: thresholds of verification.
        seed: random seed of the points drawn.
    """
    options = AutoOptions(seed=seed, gate=gate or GateOptions())
    joint = _FaceViews(scan, photo, options).joint_aligner(camera_from_scanner)
    return None if joint is None else joint.verify(camera_from_scanner)


class _FaceViews:
    """The faces of a photograph, and views of what they see of the scan at a pose."""

    def __init__(self, scan: Scan, photo: Photo, options: AutoOptions) -> None:
        self.faces = FaceSet(photo)
        self.working = working_camera(scan, self.faces.camera)
        self.cleaned = CleanedScan.of(scan, for_many_views=True)
        self._scan = scan
        self._options = options

    def of_face(self, face: Face, camera: Camera, pose: Rigid) -> ScanLevels | None:
        """Return the levels of what a face sees of the scan at a pose of the photograph; None if it sees too little."""
        direction = direction_towards_overlap(self._scan, camera, face.face_from_camera @ pose)
        if direction is None:
            return None
        view = perspective_view(self._scan, camera, view_from_scanner=direction)
        levels = scan_levels(self._scan, view, channel_set=self._options.channel_set, cleaned=self.cleaned)
        return levels if np.isfinite(levels.ranges).any() else None

    def aligner(self, face: Face, camera: Camera, pose: Rigid) -> Aligner | None:
        """Return the aligner of a face alone, with all that it shows; None if it sees too little at a pose."""
        levels = self.of_face(face, camera, pose)
        if levels is None:
            return None
        photo, o = self.faces.levels(face, camera, own=False), self._options
        aligner = Aligner(levels, photo, gate=o.gate, seed=o.seed, face=face)
        return aligner if aligner.usable else None

    def joint_aligner(self, pose: Rigid) -> JointAligner | None:
        """Return the aligner of all faces that see some of the scan at a pose; None if none does."""
        o = self._options
        views = [
            (face, levels, self.faces.levels(face, self.working, own=True))
            for face in self.faces.faces
            if (levels := self.of_face(face, self.working, pose)) is not None
        ]
        gate = replace(o.gate, fraction=max(o.gate.fraction, _MIN_FRACTION))
        aligners = aligners_of_faces(views, gate=gate, seed=o.seed, fine_points=_FINE_POINTS)
        return JointAligner(aligners, gate=gate) if aligners else None


class _FaceRegistration:
    def __init__(self, scan: Scan, photo: Photo, steps: StepLog, options: AutoOptions) -> None:
        self._scan = scan
        self._photo = photo
        self._steps = steps
        self._options = options
        self._known = KnownPoses(scan, photo.camera, options.gate)
        self._best_refused: AutoResult | None = None
        self._best_unfinished: tuple[Rigid, Verification] | None = None

    def run(self, initial: Rigid | None) -> AutoResult:
        """Return the accepted result, else the best refused one."""
        with self._steps.step("photo") as note:
            contrast = max(float(np.ptp(self._photo.pixels[..., k])) for k in range(3))
            self._views = _FaceViews(self._scan, self._photo, self._options)
            working = self._views.working
            note.update(width=working.width, height=working.height, focal_px=round(working.fx, 3))
        if contrast < 1:
            return AutoResult(initial, None, None, ("The photo is uniform and has no structure to match.",))
        reason = reason_against_scan(self._scan)
        if reason:
            return AutoResult(initial, None, None, (reason,))
        with self._steps.step("faces") as note:
            note.update(faces=len(self._views.faces.faces), size=self._views.faces.camera.width)

        if initial is not None:
            found = self._jointly([initial])
            if found is not None:
                return found
        if initial is not None and self._options.reach == "near_start":
            found = self._jointly(self._near(initial))
            return found or self._refused(initial)
        return self._everywhere() or self._refused(initial)

    def _everywhere(self) -> AutoResult | None:
        with self._steps.step("channels") as note:
            search = FaceSearch(
                self._scan,
                self._views.cleaned,
                self._views.faces,
                self._search_camera,
                channel_set=self._options.channel_set,
                seed=self._options.seed,
            )
            note.update(views=search.views)
        for rolled in (False, True):
            with self._steps.step("hypothesis") as note:
                found = search.hypotheses(rolled=rolled)
                note.update(rolled=rolled, found=len(found), support=[item.support for item in found[:8]])
                if found:
                    self._steps.pose = found[0].camera_from_scanner
            checked = self._checked(found[: _MAX_TRIED[rolled]])
            answer = self._jointly([pose for _, pose in checked[:_MAX_JOINT]], rivals=[pose for _, pose in checked])
            if answer is not None:
                return answer
        return None

    @property
    def _search_camera(self) -> Camera:
        """The camera of the search: half of the working resolution, unless that is low already."""
        working = self._views.working
        factor = max(0.5, float(np.sqrt(_SEARCH_PIXELS / (working.width * working.height))))
        return working if factor >= 1 else _square(working.scaled(factor))

    def _checked(self, hypotheses: Iterable[FaceHypothesis]) -> list[tuple[float, Rigid]]:
        """Refine every hypothesis on its own face; return the poses that most regions agree with, best first."""
        found = []
        for item in hypotheses:
            with self._steps.step("climb") as note:
                aligner = self._views.aligner(item.face, self._search_camera, item.camera_from_scanner)
                if aligner is None:
                    note["none"] = "the face sees too little of the scan"
                    continue
                candidate = aligner.refine(item.camera_from_scanner)
                note.update(face=item.face.number, inliers=item.inliers, support=item.support)
                if candidate is None:
                    continue
                note.update(candidate.coarse_verdict.as_dict())
                self._steps.pose = pose = candidate.camera_from_scanner
                verdict = candidate.coarse_verdict
                # regions and fraction: many regions that agree by half are worth more than a few that agree fully
                found.append((verdict.fraction * np.sqrt(verdict.agreeing), verdict.fraction, pose))
        found.sort(key=lambda entry: -entry[0])
        return [(score, pose) for score, fraction, pose in found if fraction >= _MIN_CHECKED]

    def _near(self, initial: Rigid) -> list[Rigid]:
        """Return the best pose that single faces lead to from a start near the pose sought."""
        found = []
        for face in self._views.faces.faces:
            with self._steps.step("climb") as note:
                aligner = self._views.aligner(face, self._search_camera, initial)
                candidate = None if aligner is None else aligner.refine(initial)
                note.update(face=face.number)
                if candidate is None:
                    continue
                note.update(candidate.coarse_verdict.as_dict())
                found.append((candidate.fraction, candidate.camera_from_scanner))
        found.sort(key=lambda entry: -entry[0])
        return [pose for fraction, pose in found[:_MAX_JOINT] if fraction >= self._options.least_fraction]

    def _jointly(self, poses: Iterable[Rigid], rivals: Iterable[Rigid] = ()) -> AutoResult | None:
        """Refine and verify poses over all faces until one is accepted; return it, or None."""
        for start in poses:
            joint, found = self._refined(start)
            if joint is None or found is None:
                continue
            pose, coarse = found
            if coarse.fraction < self._options.least_fraction:
                if self._best_unfinished is None or coarse.fraction > self._best_unfinished[1].fraction:
                    self._best_unfinished = found
                continue
            result = self._finished(joint, pose)
            if result.verification is not None and result.verification.accepted:
                return self._unless_ambiguous(joint, result, rivals)
            if self._best_refused is None or _fraction(result) > _fraction(self._best_refused):
                self._best_refused = result
        return None

    def _refined(self, start: Rigid) -> tuple[JointAligner | None, tuple[Rigid, Verification] | None]:
        with self._steps.step("all faces") as note:
            joint = self._views.joint_aligner(start)
            refined = None if joint is None else joint.refine(start)
            if joint is None or refined is None:
                note["none"] = "the faces see too little of the scan"
                return None, None
            self._steps.pose = pose = refined.camera_from_scanner
            verdict = joint.coarse_verdict(pose)
            note.update(faces=len(joint.aligners), **verdict.as_dict())
        return joint, (pose, verdict)

    def _finished(self, joint: JointAligner, start: Rigid) -> AutoResult:
        with self._steps.step("finish"):
            pose = joint.finish(start)
            self._steps.pose = pose
        with self._steps.step("verify") as note:
            verdict = joint.verify(pose)
            note.update(verdict.as_dict())
        with self._steps.step("evidence"):
            evidence, blocks = joint.evidence(pose), joint.block_matches(pose)
            self._steps.pose, self._steps.matches = pose, blocks.matches if blocks else None
        points = blocks.matches.points if blocks else np.zeros((0, 3))
        verdict = check_precision(verdict, points, self._photo.camera, pose, evidence.covariance, joint.gate)
        advice = () if verdict.accepted else (ADVICE,)
        return AutoResult(pose, verdict, evidence, (*verdict.reasons, *advice), blocks)

    def _unless_ambiguous(self, joint: JointAligner, result: AutoResult, rivals: Iterable[Rigid]) -> AutoResult:
        """Return an accepted result, refused if another pose explains all faces about as well."""
        pose, own = result.camera_from_scanner, result.verification
        assert pose is not None, "an accepted result has a pose"
        assert own is not None, "an accepted result has a verdict"
        with self._steps.step("second minimum") as note:
            second = None
            for rival in rivals:
                if not self._differs(pose, rival):
                    continue
                refined = joint.refine(rival)
                other = None if refined is None else refined.camera_from_scanner
                if other is None or not self._differs(pose, other):
                    continue
                if competes(joint.coarse_verdict(other), own, joint.gate):
                    second = other
                    break
            note.update(found=second is not None)
            self._steps.pose = pose
        if second is None:
            return result
        reasons = (ambiguity_sentence(pose, second), ADVICE)
        return replace(result, verification=replace(own, accepted=False, reasons=reasons), reasons=reasons)

    def _differs(self, first: Rigid, second: Rigid) -> bool:
        return self._known.differ(first, second) or first.angle_to(second) > self._options.gate.same_angle_rad

    def _refused(self, initial: Rigid | None) -> AutoResult:
        if self._best_refused is not None:
            return self._best_refused
        if self._best_unfinished is None:
            reason = "No initial pose was found: too few features of the scan match features of the photo."
            return AutoResult(initial, None, None, (reason, ADVICE))
        pose, verdict = self._best_unfinished
        reason = f"At the best candidate pose only {verdict.fraction:.0%} of the image regions agree."
        return AutoResult(pose, verdict, None, (reason, ADVICE))


def _fraction(result: AutoResult) -> float:
    return result.verification.fraction if result.verification is not None else -1.0


def _square(camera: Camera) -> Camera:
    return Camera.from_focal(camera.width, camera.height, camera.focal_px)
