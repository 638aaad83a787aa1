"""Automatic registration of photographs of wide cameras (fisheye, equirectangular) through their pinhole faces.

The pose hypothesis of one face, refined as for any photograph, is the hypothesis for all: the pose is refined jointly
over all faces and verified once, over all their regions. What lies outside the scan counts neither way.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import cached_property

import numpy as np

from ladarreg_core.camera import Camera
from ladarreg_core.frames import Rigid
from ladarreg_core.matching.auto_options import AutoOptions
from ladarreg_core.matching.auto_result import ADVICE, AutoResult, Unverified
from ladarreg_core.matching.images.faces import Face, FaceSet
from ladarreg_core.matching.images.laser_images import CleanedScan
from ladarreg_core.matching.images.photo_levels import working_camera
from ladarreg_core.matching.images.scan_levels import ScanLevels, scan_levels
from ladarreg_core.matching.images.views import direction_towards_overlap
from ladarreg_core.matching.refine.aligner import Aligner
from ladarreg_core.matching.refine.joint_aligner import JointAligner, aligners_of_faces
from ladarreg_core.matching.search.ambiguity import KnownPoses, ambiguity_sentence, competes
from ladarreg_core.matching.search.face_search import FaceHypothesis, FaceSearch
from ladarreg_core.matching.verify.verification import Verification, check_precision
from ladarreg_core.photo import Photo
from ladarreg_core.results.steps import StepLog
from ladarreg_core.scan import Scan
from ladarreg_core.surface.perspective import perspective_view

_SEARCH_PIXELS = 200_000
_MAX_TRIED = {False: 5, True: 6}  # hypotheses refined: upright ones, rolled ones
_MAX_JOINT = 3
_MIN_CHECKED = 0.3  # fraction of agreeing regions of the hypothesis's own face, below which it is not tried jointly
_FINE_POINTS = 8000  # of a face: only its own part of the picture counts, and there are many faces
# A regular floor or wall of another room agrees with nearly half of the regions; of the right rooms 62 % did at least.
_MIN_FRACTION = 0.57


class FaceViews:
    """The faces of a wide photograph, and views of what they see of the scan at a pose.

    Args:
        scan: the scan.
        photo: the photograph.
    """

    coarse = False
    """Whether the scan is compared as a coarse one: never with faces."""

    def __init__(self, scan: Scan, photo: Photo) -> None:
        self.scan = scan
        self.faces = FaceSet(photo)
        self.working = working_camera(scan, self.faces.camera)
        """The ideal camera of the comparison, of every face."""

    @cached_property
    def cleaned(self) -> CleanedScan:
        """The scan's images."""
        return CleanedScan.of(self.scan, for_many_views=True)

    @property
    def contrast(self) -> float:
        """Difference between the brightest and the darkest pixel of the photograph, of its channels the largest."""
        pixels = self.faces.photo.pixels
        return max(float(np.ptp(pixels[..., k])) for k in range(pixels.shape[-1]))

    def aligner(self, face: Face, camera: Camera, pose: Rigid, options: AutoOptions) -> Aligner | None:
        """Return the aligner of a face alone, with all that it shows; None if it sees too little at a pose.

        Args:
            face: the face.
            camera: the ideal camera of the comparison.
            pose: `camera_from_scanner` of the photograph.
            options: channels, thresholds and seed.
        """
        levels = self._seen(face, camera, pose, options)
        if levels is None:
            return None
        photo, o = self.faces.levels(face, camera, own=False), options
        aligner = Aligner(levels, photo, gate=o.gate, seed=o.seed, face=face)
        return aligner if aligner.usable else None

    def joint_aligner(self, pose: Rigid, options: AutoOptions) -> JointAligner | None:
        """Return the aligner of all faces that see some of the scan at a pose; None if none does.

        Args:
            pose: `camera_from_scanner` of the photograph, near the one sought.
            options: channels, thresholds and seed.
        """
        o = options
        views = [
            (face, levels, self.faces.levels(face, self.working, own=True))
            for face in self.faces.faces
            if (levels := self._seen(face, self.working, pose, o)) is not None
        ]
        gate = replace(o.gate, fraction=max(o.gate.fraction, _MIN_FRACTION))
        aligners = aligners_of_faces(views, gate=gate, seed=o.seed, fine_points=_FINE_POINTS)
        return JointAligner(aligners, gate=gate) if aligners else None

    def _seen(self, face: Face, camera: Camera, pose: Rigid, options: AutoOptions) -> ScanLevels | None:
        """Return the levels of what a face sees of the scan at a pose of the photograph; None if it sees too little."""
        direction = direction_towards_overlap(self.scan, camera, face.face_from_camera @ pose)
        if direction is None:
            return None
        view = perspective_view(self.scan, camera, view_from_scanner=direction)
        levels = scan_levels(self.scan, view, channel_set=options.channel_set, cleaned=self.cleaned)
        return levels if np.isfinite(levels.ranges).any() else None


def register_faces(
    views: FaceViews, photo: Photo, steps: StepLog, initial: Rigid | None, options: AutoOptions
) -> AutoResult:
    """Find the pose of a photograph of a wide camera from the images alone.

    Args:
        views: the photograph's faces and the scan.
        photo: the photograph; its intrinsics are not estimated.
        steps: receives every step.
        initial: an initial pose, tried first.
        options: thresholds and seed.
    """
    return _FaceRegistration(views, photo, steps, initial, options).result()


class _FaceRegistration:
    def __init__(
        self, views: FaceViews, photo: Photo, steps: StepLog, initial: Rigid | None, options: AutoOptions
    ) -> None:
        self._views = views
        self._photo = photo
        self._steps = steps
        self._initial = initial
        self._options = options
        self._known = KnownPoses(views.scan, photo.camera, options.gate)
        self._unverified = Unverified(initial)

    def result(self) -> AutoResult:
        """Return the accepted result, else the best refused one."""
        with self._steps.step("faces") as note:
            note.update(faces=len(self._views.faces.faces), size=self._views.faces.camera.width)
            _ = self._views.cleaned
        found = None if self._initial is None else self._jointly([self._initial])
        if found is None and self._initial is not None and self._options.reach == "near_start":
            found = self._jointly(self._near(self._initial))
        elif found is None:
            found = self._everywhere()
        return found or self._unverified.result

    def _everywhere(self) -> AutoResult | None:
        with self._steps.step("channels") as note:
            search = FaceSearch(
                self._views.scan,
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
                aligner = self._views.aligner(item.face, self._search_camera, item.camera_from_scanner, self._options)
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
                aligner = self._views.aligner(face, self._search_camera, initial, self._options)
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
                self._unverified.add_unfinished(pose, coarse)
                continue
            result = self._finished(joint, pose)
            if result.accepted:
                return self._unless_ambiguous(joint, result, rivals)
            self._unverified.add_refused(result)
        return None

    def _refined(self, start: Rigid) -> tuple[JointAligner | None, tuple[Rigid, Verification] | None]:
        with self._steps.step("all faces") as note:
            joint = self._views.joint_aligner(start, self._options)
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
        return result if second is None else result.refused(ambiguity_sentence(pose, second))

    def _differs(self, first: Rigid, second: Rigid) -> bool:
        return self._known.differ(first, second) or first.angle_to(second) > self._options.gate.same_angle_rad


def _square(camera: Camera) -> Camera:
    return Camera.from_focal(camera.width, camera.height, camera.focal_px)
