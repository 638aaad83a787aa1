"""Joint alignment of several pairs that share one pose: one refinement, evidence for each pair, one covariance.

Each pair is compared with a view of its own scan. The normal equations of all are summed: blocks that correlate well
weigh more, so that each pair counts by its own evidence.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from ladarreg_core.camera import Camera
from ladarreg_core.foundations.arrays import BoolArray, FloatArray
from ladarreg_core.frames import Rigid
from ladarreg_core.matching.images.blocks import Target
from ladarreg_core.matching.images.faces import Face, FaceSet
from ladarreg_core.matching.images.pair import PairLevels
from ladarreg_core.matching.images.photo_levels import PhotoLevels, photo_levels
from ladarreg_core.matching.images.scan_levels import ChannelSet
from ladarreg_core.matching.images.support import carries_intensity
from ladarreg_core.matching.images.views import direction_towards_overlap, viewing_directions
from ladarreg_core.matching.refine.aligner import Aligner
from ladarreg_core.matching.refine.joint_aligner import JointAligner, aligners_of_faces
from ladarreg_core.matching.verify.agreement import Agreement, agreement, joined
from ladarreg_core.matching.verify.verification import GateOptions
from ladarreg_core.matching.wrong_poses import mirrored_photo
from ladarreg_core.photo import Photo
from ladarreg_core.registration.rig.results import RigPair

_SAME_VIEW_RAD = np.radians(4.0)
_KEPT_VIEWS = 3
_RADIUS = 6
_LEVEL_OF_SWAPPED = 1
_MOVED_SHARE = 0.25


@dataclass(eq=False)
class PairViews:
    """A pair with the views in which it was compared, the latest ones kept."""

    pair: RigPair
    seed: int
    channel_set: ChannelSet = field(init=False)
    _faces: FaceSet | None = field(init=False)
    _levels: list[PairLevels] = field(init=False)
    _kept: list[tuple[Rigid, list[Aligner]]] = field(init=False, default_factory=list)

    def __post_init__(self) -> None:
        scan, photo = self.pair.scan, self.pair.photo
        self.channel_set = "both" if carries_intensity(scan) else "geometry"
        self._faces = FaceSet(photo) if photo.camera.as_pinhole is None else None
        self._levels = (
            [PairLevels(scan, photo)]
            if self._faces is None
            else [
                PairLevels(scan, face.photo, levels_of=partial(_levels_of_face, self._faces, face))
                for face in self._faces.faces
            ]
        )

    def at(self, pose: Rigid) -> list[Aligner]:
        """Return the aligners of the photograph, or of its faces, with what they see at a pose; none if too little."""
        direction = (
            viewing_directions(self.pair.scan, self._levels[0].working, initial=pose)[0]
            if self._faces is None
            else Rigid(pose.rotation, np.zeros(3))
        )
        for kept, aligners in self._kept:
            if kept.angle_to(direction) < _SAME_VIEW_RAD:
                return aligners
        if len(self._kept) == _KEPT_VIEWS:
            self._kept.pop(0)
        aligners = self._of_photo(direction) if self._faces is None else self._of_faces(self._faces, pose)
        self._kept.append((direction, aligners))
        return aligners

    def side(self, number: int, working: Camera, harmonics: int) -> PhotoLevels | None:
        """Return the levels of the photograph, or of its face of a number; None if it has no such face."""
        if self._faces is None:
            return photo_levels(self.pair.photo, working, harmonics=harmonics)
        face = next((face for face in self._faces.faces if face.number == number), None)
        return None if face is None else self._faces.levels(face, working, own=True, harmonics=harmonics)

    def _of_photo(self, direction: Rigid) -> list[Aligner]:
        levels = self._levels[0]
        view = levels.view(direction, self.channel_set)
        aligner = Aligner(view, levels.photo, gate=GateOptions(), seed=self.seed)
        return [aligner] if aligner.usable else []

    def _of_faces(self, faces: FaceSet, pose: Rigid) -> list[Aligner]:
        views = []
        for face, levels in zip(faces.faces, self._levels, strict=True):
            direction = direction_towards_overlap(self.pair.scan, levels.working, face.face_from_camera @ pose)
            view = None if direction is None else levels.view(direction, self.channel_set)
            if view is not None and np.isfinite(view.ranges).any():
                views.append((face, view, levels.photo))
        return aligners_of_faces(views, gate=GateOptions(), seed=self.seed)


def _levels_of_face(faces: FaceSet, face: Face, photo: Photo, working: Camera, *, harmonics: int) -> PhotoLevels:
    """Return the levels of a face whose own pixels alone count."""
    del photo
    return faces.levels(face, working, own=True, harmonics=harmonics)


class JointPairs:
    """The pairs of a rig, each in its view at about one pose.

    Args:
        pairs: the pairs.
        pose: `camera_from_scanner`, near the one sought.
    """

    def __init__(self, pairs: Sequence[PairViews], pose: Rigid) -> None:
        self._pairs = pairs
        self._swapped: dict[tuple[int, int, bool, Camera, int], Target] = {}
        self.aligners = [pair.at(pose) for pair in pairs]

    def refine(self, start: Rigid, members: Sequence[int], levels: Sequence[int] = (2, 1)) -> Rigid | None:
        """Refine a pose on some pairs at some levels; None if too little of their scans is visible."""
        result = self._of(members).refine(start, levels)
        return None if result is None else result.camera_from_scanner

    def finish(self, start: Rigid, members: Sequence[int]) -> Rigid:
        """Refine a pose on some pairs at level 0, then at fine points, until it stops moving."""
        return self._of(members).finish(start)

    def agreement_at(self, pose: Rigid, index: int, level: int) -> Agreement | None:
        """Return the agreement of a pair at a pose; None if it has too little to compare."""
        return self._of([index]).agreement_at(pose, level) if self.aligners[index] else None

    def moved(self, pose: Rigid, index: int, others: Sequence[int]) -> dict[int, list[BoolArray]]:
        """Return which points of a scan are of things that stand where no other scan of the place has any.

        Args:
            pose: `camera_from_scanner`.
            index: the pair of the scan.
            others: pairs of the same place, the rig not having moved between them.

        Returns:
            for levels 1 and 0, a mask (N,) for each picture of the pair: the points of blocks of which a quarter
            lies before the nearest surface of every other scan.
        """
        found: dict[int, list[BoolArray]] = {1: [], 0: []}
        for aligner in self.aligners[index]:
            own = aligner.pose(pose)
            occluders = [
                other.occluder for k in others for other in self.aligners[k] if _number(other) == _number(aligner)
            ]
            for level, masks in found.items():
                points = aligner.compared_points(level)
                in_camera = own @ points.points.astype(np.float64)
                before = [occluder.in_front(in_camera, occluder.depth_buffer(own)) for occluder in occluders]
                new = np.logical_and.reduce(before) if before else np.zeros(len(in_camera), np.bool_)
                # Whole blocks, since the outline of a thing is half of what stands behind it.
                blocks = points.blocks
                share = blocks.sum(new.astype(np.float32)) / np.maximum(blocks.sum(np.ones(len(new), np.float32)), 1)
                masks.append((share >= _MOVED_SHARE)[blocks.of_point])
        return found

    def agreement_of(
        self, pose: Rigid, index: int, level: int, only: Sequence[BoolArray], *, photo: int, mirrored: bool = False
    ) -> Agreement | None:
        """Return the agreement of some points of a scan with a photograph; None if none can be compared.

        Args:
            pose: `camera_from_scanner`.
            index: the pair of the scan.
            level: 1, or 0 with its own photograph.
            only: a mask (N,) of the points for each picture, as of `moved`.
            photo: the pair of the photograph.
            mirrored: whether left and right of the photograph, or of each of its faces, are exchanged.
        """
        found = []
        for aligner, mask in zip(self.aligners[index], only, strict=True):
            swapped = photo != index or mirrored
            target = self._swapped_target(aligner, photo, mirrored) if swapped else aligner.targets[level]
            if target is not None:
                points, own = aligner.compared_points(level), aligner.pose(pose)
                found.append(agreement(points, target, aligner.occluder, own, level=level, radius=_RADIUS, only=mask))
        return joined(found) if found else None

    def swapped_agreement(self, pose: Rigid, index: int, other: int, *, mirrored: bool = False) -> Agreement | None:
        """Return the agreement of the scan of a pair with the photograph of another one, of the same size.

        Args:
            pose: `camera_from_scanner`.
            index: the pair of the scan.
            other: the pair of the photograph; its own, too, if `mirrored`.
            mirrored: whether left and right of the photograph, or of each of its faces, are exchanged.
        """
        level = _LEVEL_OF_SWAPPED
        found = []
        for aligner in self.aligners[index]:
            target = self._swapped_target(aligner, other, mirrored)
            if target is not None:
                points, own = aligner.points[level], aligner.pose(pose)
                found.append(agreement(points, target, aligner.occluder, own, level=level, radius=_RADIUS))
        return joined(found) if found else None

    def _swapped_target(self, aligner: Aligner, other: int, mirrored: bool) -> Target | None:
        """Return the photograph of another pair, or its mirror image, as a picture is compared with it."""
        level = _LEVEL_OF_SWAPPED
        working, harmonics = aligner.photo.cameras[0], aligner.photo.harmonics
        key = (other, _number(aligner), mirrored, working, harmonics)
        if key not in self._swapped:
            side = self._pairs[other].side(_number(aligner), working, harmonics)
            if side is None:
                return None
            side = mirrored_photo(side) if mirrored else side
            self._swapped[key] = Target(side.cameras[level], side.channels[level], side.usable[level])
        return self._swapped[key]

    def covariance(self, pose: Rigid, members: Sequence[int]) -> FloatArray | None:
        """Return the (6, 6) covariance of a finished pose by leaving out regions of pairs; None if they are few."""
        found = self._of(members).regions(pose)
        return None if found is None else found.pose_covariance

    def _of(self, members: Sequence[int]) -> JointAligner:
        aligners = [aligner for index in members for aligner in self.aligners[index]]
        return JointAligner(aligners, gate=GateOptions())


def _number(aligner: Aligner) -> int:
    """Return the number of an aligner's face; 0 for a photograph itself."""
    return 0 if aligner.face is None else aligner.face.number
