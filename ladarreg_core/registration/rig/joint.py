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
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.frames import Rigid, rotation_from_rotvec
from ladarreg_core.matching.images.blocks import Target, compare_blocks
from ladarreg_core.matching.images.pyramid import ChannelSet, PairLevels, photo_levels
from ladarreg_core.matching.images.sampling import ViewPoints
from ladarreg_core.matching.images.support import carries_intensity
from ladarreg_core.matching.images.views import viewing_directions
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
from ladarreg_core.matching.verify.agreement import Agreement, agreement
from ladarreg_core.matching.verify.verification import GateOptions
from ladarreg_core.matching.wrong_poses import mirrored_photo
from ladarreg_core.registration.rig.results import RigPair

_SAME_VIEW_RAD = np.radians(4.0)
_KEPT_VIEWS = 3
_RADIUS = 6
_LEVEL_OF_SWAPPED = 1


@dataclass(eq=False)
class PairViews:
    """A pair with the views in which it was compared, the latest ones kept."""

    pair: RigPair
    seed: int
    levels: PairLevels = field(init=False)
    channel_set: ChannelSet = field(init=False)
    _kept: list[tuple[Rigid, Aligner]] = field(init=False, default_factory=list)

    def __post_init__(self) -> None:
        self.levels = PairLevels(self.pair.scan, self.pair.photo)
        self.channel_set = "both" if carries_intensity(self.pair.scan) else "geometry"

    def at(self, pose: Rigid) -> Aligner | None:
        """Return the aligner of the view of what the photograph sees at a pose; None if there is too little."""
        direction = viewing_directions(self.pair.scan, self.levels.working, initial=pose)[0]
        for kept, aligner in self._kept:
            if kept.angle_to(direction) < _SAME_VIEW_RAD:
                return aligner if aligner.usable else None
        if len(self._kept) == _KEPT_VIEWS:
            self._kept.pop(0)
        view = self.levels.view(direction, self.channel_set)
        aligner = Aligner(view, self.levels.photo, gate=GateOptions(), seed=self.seed)
        self._kept.append((direction, aligner))
        return aligner if aligner.usable else None


class JointPairs:
    """The pairs of a rig, each in its view at about one pose.

    Args:
        pairs: the pairs.
        pose: `camera_from_scanner`, near the one sought.
    """

    def __init__(self, pairs: Sequence[PairViews], pose: Rigid) -> None:
        self._pairs = pairs
        self._swapped: dict[tuple[int, bool, Camera, int], Target] = {}
        self.aligners = [pair.at(pose) for pair in pairs]

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
        aligner = self.aligners[index]
        return None if aligner is None else aligner.agreement_at(pose, level)

    def swapped_agreement(self, pose: Rigid, index: int, other: int, *, mirrored: bool = False) -> Agreement | None:
        """Return the agreement of the scan of a pair with the photograph of another one, of the same size.

        Args:
            pose: `camera_from_scanner`.
            index: the pair of the scan.
            other: the pair of the photograph; its own, too, if `mirrored`.
            mirrored: whether left and right of the photograph are exchanged.
        """
        aligner = self.aligners[index]
        if aligner is None:
            return None
        working, harmonics = aligner.photo.cameras[0], aligner.photo.harmonics
        key = (other, mirrored, working, harmonics)
        if key not in self._swapped:
            side = photo_levels(self._pairs[other].pair.photo, working, harmonics=harmonics)
            side = mirrored_photo(side) if mirrored else side
            level = _LEVEL_OF_SWAPPED
            self._swapped[key] = Target(side.cameras[level], side.channels[level], side.usable[level])
        points, level = aligner.points[_LEVEL_OF_SWAPPED], _LEVEL_OF_SWAPPED
        return agreement(points, self._swapped[key], aligner.occluder, pose, level=level, radius=_RADIUS)

    def covariance(self, pose: Rigid, members: Sequence[int]) -> FloatArray | None:
        """Return the (6, 6) covariance of a finished pose by leaving out regions of pairs; None if they are few."""
        parts = []
        for index in members:
            aligner = self.aligners[index]
            if aligner is None or aligner.fine_points is None:
                continue
            points = aligner.fine_points
            seen = compare_blocks(points, aligner.fine_target, aligner.occluder, aligner.occluder.depth_buffer(pose),
                                  pose)  # fmt: skip
            if seen is None:
                continue
            H, g = block_systems(seen, aligner.fine_target.camera, FINE)
            grid = points.blocks.grid[points.blocks.of_point[seen.index[seen.blocks.starts]]]
            parts.append((H, g, np.full(len(grid), index, np.intp), grid))
        if not parts:
            return None
        H, g, picture, grid = (np.concatenate(values) for values in zip(*parts, strict=True))
        found = jackknife(H, g, picture, grid, pose)
        return None if found is None else found.pose_covariance

    def _shift_px(self, first: Rigid, second: Rigid, members: Sequence[int]) -> float:
        """Return the largest median displacement of a pair's points between two poses, working pixels."""
        most = 0.0
        for index in members:
            aligner = self.aligners[index]
            if aligner is None:
                continue
            camera, points = aligner.photo.cameras[0], aligner.points[0].points
            length = np.hypot(*(camera.project(first @ points) - camera.project(second @ points)).T)
            if np.isfinite(length).any():
                most = max(most, float(np.nanmedian(length)))
        return most

    def _refined(
        self,
        start: Rigid,
        members: Sequence[int],
        of: Callable[[Aligner], tuple[ViewPoints | None, Target]],
        options: RefineOptions,
    ) -> Rigid | None:
        """Return the pose that maximises the correlation of the blocks of all members; None without any."""
        parts = [
            (points, target, aligner.occluder)
            for aligner in (self.aligners[index] for index in members)
            if aligner is not None
            for points, target in [of(aligner)]
            if points is not None
        ]
        pose, result = start, None
        buffers = [occluder.depth_buffer(pose) for _, _, occluder in parts]
        for iteration in range(options.iterations):
            if iteration and iteration % REFRESH_VISIBILITY == 0:
                buffers = [occluder.depth_buffer(pose) for _, _, occluder in parts]
            H, g = np.zeros((6, 6)), np.zeros(6)
            motions: list[tuple[FloatArray, FloatArray]] = []
            for (points, target, occluder), buffer in zip(parts, buffers, strict=True):
                seen = compare_blocks(points, target, occluder, buffer, pose)
                if seen is None:
                    continue
                system = step_system(seen, target.camera, options)
                H += system.H
                g += system.g
                motions.append((system.Ju, system.Jv))
            delta = solve_step(H, g) if motions else None
            if delta is None:
                return result
            motion = float(np.median(np.concatenate([np.hypot(Ju @ delta, Jv @ delta) for Ju, Jv in motions])))
            if motion > MAX_MOTION_PX:
                delta = delta * (MAX_MOTION_PX / motion)
            turn = rotation_from_rotvec(delta[:3])
            pose = Rigid(turn @ pose.rotation, turn @ pose.translation + delta[3:])
            result = pose
            if motion < STILL_STEP_PX:
                break
        return result


def _of_level(level: int, aligner: Aligner) -> tuple[ViewPoints, Target]:
    return aligner.points[level], aligner.targets[level]


def _fine(aligner: Aligner) -> tuple[ViewPoints | None, Target]:
    return aligner.fine_points, aligner.fine_target
