"""Joint alignment of several pairs that share one pose: one refinement, evidence for each pair, one covariance.

Each pair is compared with a view of its own scan. The normal equations of all are summed: blocks that correlate well
weigh more, so that each pair counts by its own evidence.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from ladarreg_core.camera import Camera
from ladarreg_core.foundations.arrays import BoolArray, FloatArray
from ladarreg_core.frames import Rigid, rotation_from_rotvec
from ladarreg_core.matching.face_registration import is_wide
from ladarreg_core.matching.images.blocks import Target, compare_blocks
from ladarreg_core.matching.images.faces import Face, FaceSet
from ladarreg_core.matching.images.pyramid import ChannelFloors, ChannelSet, PairLevels, PhotoLevels, photo_levels
from ladarreg_core.matching.images.sampling import ViewPoints
from ladarreg_core.matching.images.support import carries_intensity
from ladarreg_core.matching.images.views import direction_towards_overlap, viewing_directions
from ladarreg_core.matching.refine.aligner import FINE, FINISH, FINISH_ROUNDS, REFINEMENT, STILL_PX, Aligner
from ladarreg_core.matching.refine.covariance import jackknife
from ladarreg_core.matching.refine.ecc import (
    MAX_MOTION_PX,
    REFRESH_VISIBILITY,
    RefineOptions,
    block_systems,
    solve_step,
    step_system,
)
from ladarreg_core.matching.refine.ecc import STILL_PX as STILL_STEP_PX
from ladarreg_core.matching.verify.agreement import Agreement, agreement, joined
from ladarreg_core.matching.verify.verification import GateOptions
from ladarreg_core.matching.wrong_poses import mirrored_photo
from ladarreg_core.photo import Photo
from ladarreg_core.registration.rig.results import RigPair

_SAME_VIEW_RAD = np.radians(4.0)
_KEPT_VIEWS = 3
_RADIUS = 6
_LEVEL_OF_SWAPPED = 1
_MAX_FACES = 64
_MOVED_SHARE = 0.25


@dataclass(frozen=True, slots=True, eq=False)
class PairPart:
    """A picture of a pair with the view of the scan that it is compared with: the photograph, or one face of it."""

    aligner: Aligner
    face: Face | None = None
    """The face of a wide photograph; None: the photograph of a pinhole itself."""

    @property
    def number(self) -> int:
        """Of the face; 0 for a photograph itself."""
        return 0 if self.face is None else self.face.number

    @property
    def turn(self) -> FloatArray | None:
        """(6, 6): a step (w, t) of the camera frame in the frame of the face; None: they are the same."""
        return None if self.face is None else np.kron(np.eye(2), self.face.face_from_camera.rotation)

    def pose(self, camera_from_scanner: Rigid) -> Rigid:
        """Return the pose of the picture."""
        return camera_from_scanner if self.face is None else self.face.face_from_camera @ camera_from_scanner


@dataclass(eq=False)
class PairViews:
    """A pair with the views in which it was compared, the latest ones kept."""

    pair: RigPair
    seed: int
    channel_set: ChannelSet = field(init=False)
    _faces: FaceSet | None = field(init=False)
    _levels: list[PairLevels] = field(init=False)
    _kept: list[tuple[Rigid, list[PairPart]]] = field(init=False, default_factory=list)

    def __post_init__(self) -> None:
        scan, photo = self.pair.scan, self.pair.photo
        self.channel_set = "both" if carries_intensity(scan) else "geometry"
        self._faces = FaceSet(photo) if is_wide(photo) else None
        self._levels = (
            [PairLevels(scan, photo)]
            if self._faces is None
            else [
                PairLevels(scan, face.photo, levels_of=partial(_levels_of_face, self._faces, face))
                for face in self._faces.faces
            ]
        )

    def at(self, pose: Rigid) -> list[PairPart]:
        """Return the pictures with the views of what they see at a pose; none if there is too little."""
        direction = (
            viewing_directions(self.pair.scan, self._levels[0].working, initial=pose)[0]
            if self._faces is None
            else Rigid(pose.rotation, np.zeros(3))
        )
        for kept, parts in self._kept:
            if kept.angle_to(direction) < _SAME_VIEW_RAD:
                return parts
        if len(self._kept) == _KEPT_VIEWS:
            self._kept.pop(0)
        parts = self._of_photo(direction) if self._faces is None else self._of_faces(self._faces, pose)
        self._kept.append((direction, parts))
        return parts

    def side(self, number: int, working: Camera, harmonics: int) -> PhotoLevels | None:
        """Return the levels of the photograph, or of its face of a number; None if it has no such face."""
        if self._faces is None:
            return photo_levels(self.pair.photo, working, harmonics=harmonics)
        face = next((face for face in self._faces.faces if face.number == number), None)
        return None if face is None else self._faces.levels(face, working, own=True, harmonics=harmonics)

    def _of_photo(self, direction: Rigid) -> list[PairPart]:
        levels = self._levels[0]
        view = levels.view(direction, self.channel_set)
        aligner = Aligner(view, levels.photo, gate=GateOptions(), seed=self.seed)
        return [PairPart(aligner)] if aligner.usable else []

    def _of_faces(self, faces: FaceSet, pose: Rigid) -> list[PairPart]:
        views = []
        for face, levels in zip(faces.faces, self._levels, strict=True):
            direction = direction_towards_overlap(self.pair.scan, levels.working, face.face_from_camera @ pose)
            view = None if direction is None else levels.view(direction, self.channel_set)
            if view is not None and np.isfinite(view.ranges).any():
                views.append((face, levels, view))
        if not views:
            return []
        floors = ChannelFloors.common([view for _, _, view in views])
        parts = []
        for face, levels, view in views:
            aligner = Aligner(view.with_floors(floors), levels.photo, gate=GateOptions(), seed=self.seed)
            if aligner.usable:
                parts.append(PairPart(aligner, face))
        return parts


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
        self.parts = [pair.at(pose) for pair in pairs]

    def refine(self, start: Rigid, members: Sequence[int], levels: Sequence[int] = (2, 1)) -> Rigid | None:
        """Refine a pose on some pairs at some levels; None if too little of their scans is visible."""
        pose: Rigid | None = start
        for level in levels:
            assert pose is not None
            pose = self._refined(pose, members, partial(_of_level, level), REFINEMENT[level])
            if pose is None:
                return None
        return pose

    def finish(self, start: Rigid, members: Sequence[int]) -> Rigid:
        """Refine a pose on some pairs at level 0, then at fine points, until it stops moving."""
        pose = self._refined(start, members, partial(_of_level, 0), FINISH) or start
        for _ in range(FINISH_ROUNDS):
            after = self._refined(pose, members, _fine, FINE)
            if after is None:
                break
            before, pose = pose, after
            if self._shift_px(before, pose, members) < STILL_PX:
                break
        return pose

    def agreement_at(self, pose: Rigid, index: int, level: int) -> Agreement | None:
        """Return the agreement of a pair at a pose; None if it has too little to compare."""
        parts = [part.aligner.agreement_at(part.pose(pose), level) for part in self.parts[index]]
        return _joined(parts)

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
        for part in self.parts[index]:
            own = part.pose(pose)
            occluders = [
                other.aligner.occluder for k in others for other in self.parts[k] if other.number == part.number
            ]
            for level, masks in found.items():
                points = _compared_points(part.aligner, level)
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
        parts = []
        for part, mask in zip(self.parts[index], only, strict=True):
            swapped = photo != index or mirrored
            target = self._swapped_target(part, photo, mirrored) if swapped else part.aligner.targets[level]
            if target is not None:
                points = _compared_points(part.aligner, level)
                parts.append(agreement(points, target, part.aligner.occluder, part.pose(pose), level=level,
                                       radius=_RADIUS, only=mask))  # fmt: skip
        return _joined(parts)

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
        for part in self.parts[index]:
            aligner, target = part.aligner, self._swapped_target(part, other, mirrored)
            if target is not None:
                points = aligner.points[level]
                found.append(agreement(points, target, aligner.occluder, part.pose(pose), level=level, radius=_RADIUS))
        return _joined(found)

    def _swapped_target(self, part: PairPart, other: int, mirrored: bool) -> Target | None:
        """Return the photograph of another pair, or its mirror image, as a picture is compared with it."""
        level = _LEVEL_OF_SWAPPED
        working, harmonics = part.aligner.photo.cameras[0], part.aligner.photo.harmonics
        key = (other, part.number, mirrored, working, harmonics)
        if key not in self._swapped:
            side = self._pairs[other].side(part.number, working, harmonics)
            if side is None:
                return None
            side = mirrored_photo(side) if mirrored else side
            self._swapped[key] = Target(side.cameras[level], side.channels[level], side.usable[level])
        return self._swapped[key]

    def covariance(self, pose: Rigid, members: Sequence[int]) -> FloatArray | None:
        """Return the (6, 6) covariance of a finished pose by leaving out regions of pairs; None if they are few."""
        parts = []
        for index, part in self._of(members):
            points, aligner, own = part.aligner.fine_points, part.aligner, part.pose(pose)
            if points is None:
                continue
            seen = compare_blocks(
                points, aligner.fine_target, aligner.occluder, aligner.occluder.depth_buffer(own), own
            )
            if seen is None:
                continue
            H, g = block_systems(seen, aligner.fine_target.camera, FINE)
            if part.turn is not None:
                H, g = part.turn.T @ H @ part.turn, g @ part.turn
            grid = points.blocks.grid[points.blocks.of_point[seen.index[seen.blocks.starts]]]
            parts.append((H, g, np.full(len(grid), _MAX_FACES * index + part.number, np.intp), grid))
        if not parts:
            return None
        H, g, picture, grid = (np.concatenate(values) for values in zip(*parts, strict=True))
        found = jackknife(H, g, picture, grid, pose)
        return None if found is None else found.pose_covariance

    def _shift_px(self, first: Rigid, second: Rigid, members: Sequence[int]) -> float:
        """Return the largest median displacement of a pair's points between two poses, working pixels."""
        most = 0.0
        for _, part in self._of(members):
            camera, points = part.aligner.photo.cameras[0], part.aligner.points[0].points
            moved = camera.project(part.pose(first) @ points) - camera.project(part.pose(second) @ points)
            length = np.hypot(*moved.T)
            if np.isfinite(length).any():
                most = max(most, float(np.nanmedian(length)))
        return most

    def _of(self, members: Sequence[int]) -> list[tuple[int, PairPart]]:
        return [(index, part) for index in members for part in self.parts[index]]

    def _refined(
        self,
        start: Rigid,
        members: Sequence[int],
        of: Callable[[Aligner], tuple[ViewPoints | None, Target]],
        options: RefineOptions,
    ) -> Rigid | None:
        """Return the pose that maximises the correlation of the blocks of all members; None without any."""
        parts = [
            (part, points, target)
            for _, part in self._of(members)
            for points, target in [of(part.aligner)]
            if points is not None
        ]
        pose, result = start, None
        buffers = [part.aligner.occluder.depth_buffer(part.pose(pose)) for part, _, _ in parts]
        for iteration in range(options.iterations):
            if iteration and iteration % REFRESH_VISIBILITY == 0:
                buffers = [part.aligner.occluder.depth_buffer(part.pose(pose)) for part, _, _ in parts]
            H, g = np.zeros((6, 6)), np.zeros(6)
            motions: list[tuple[FloatArray, FloatArray]] = []
            for (part, points, target), buffer in zip(parts, buffers, strict=True):
                seen = compare_blocks(points, target, part.aligner.occluder, buffer, part.pose(pose))
                if seen is None:
                    continue
                system, turn = step_system(seen, target.camera, options), part.turn
                H += system.H if turn is None else turn.T @ system.H @ turn
                g += system.g if turn is None else turn.T @ system.g
                motions.append((system.Ju, system.Jv) if turn is None else (system.Ju @ turn, system.Jv @ turn))
            delta = solve_step(H, g) if motions else None
            if delta is None:
                return result
            motion = float(np.median(np.concatenate([np.hypot(Ju @ delta, Jv @ delta) for Ju, Jv in motions])))
            if motion > MAX_MOTION_PX:
                delta = delta * (MAX_MOTION_PX / motion)
            step = rotation_from_rotvec(delta[:3])
            pose = Rigid(step @ pose.rotation, step @ pose.translation + delta[3:])
            result = pose
            if motion < STILL_STEP_PX:
                break
        return result


def _compared_points(aligner: Aligner, level: int) -> ViewPoints:
    return aligner.verification_points if level == 0 else aligner.points[level]


def _joined(parts: Sequence[Agreement]) -> Agreement | None:
    if len(parts) < 2:
        return parts[0] if parts else None
    return joined(parts)


def _of_level(level: int, aligner: Aligner) -> tuple[ViewPoints, Target]:
    return aligner.points[level], aligner.targets[level]


def _fine(aligner: Aligner) -> tuple[ViewPoints | None, Target]:
    return aligner.fine_points, aligner.fine_target
