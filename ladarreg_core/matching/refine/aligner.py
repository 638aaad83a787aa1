"""Alignment of a picture, a photograph or one of its faces, with a view of the scan.

Refinement, flow steps, finish and verification; all poses are those of the photograph.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ladarreg_core.camera import Camera
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.foundations.parallel import made_once, side_by_side
from ladarreg_core.frames import Rigid
from ladarreg_core.matches import Matches
from ladarreg_core.matching.images.blocks import BlockComparison, BlockMatches, Target, block_matches
from ladarreg_core.matching.images.faces import Face
from ladarreg_core.matching.images.photo_levels import LEVELS, PhotoLevels
from ladarreg_core.matching.images.sampling import ViewPoints, draw_points, edge_strength
from ladarreg_core.matching.images.scan_levels import BLOCK_PX, ScanLevels
from ladarreg_core.matching.images.support import common_variance
from ladarreg_core.matching.images.zbuffer import Occluder
from ladarreg_core.matching.refine.compared_blocks import compared_blocks
from ladarreg_core.matching.refine.covariance import RegionEvidence, region_evidence
from ladarreg_core.matching.refine.ecc import NO_CHANGE, CameraAnchor, CameraChange, Picture, RefineOptions, refine_pose
from ladarreg_core.matching.verify.agreement import Agreement, agreement
from ladarreg_core.matching.verify.verification import (
    GateOptions,
    Verification,
    region_markers,
    small_regions_gate,
    verify,
)
from ladarreg_core.pose.estimators.ransac import ransac_pose

REFINEMENT = {2: RefineOptions(tau_px=8, iterations=8), 1: RefineOptions(tau_px=6, iterations=6)}
_FINISH = RefineOptions(tau_px=3, iterations=6)
FINE = RefineOptions(tau_px=2, iterations=8)
FINE_POINTS = 20_000
"""Number of points of the finish, and of the verdict."""
_RADIUS = {0: 6, 1: 6, 2: 8}
_DAMPING = 3.0
_SUFFICIENT_FRACTION = 0.8
_FINISH_ROUNDS = 5
_FREE_CAMERA_STEPS = 6
_FREE_CAMERA_ROUNDS = 3
_STILL_PX = 0.05
_MIN_HEIGHT_SD = 2.2
_POINTS_PER_WINDOW = 3
_RANSAC_PX = 1.5
_RANSAC_ITERATIONS = 200
_MIN_MATCHES, _MIN_INLIERS = 24, 18


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A pose with its agreement at level 1."""

    camera_from_scanner: Rigid
    """The pose."""
    coarse: Agreement
    """Agreement at level 1."""
    coarse_verdict: Verification
    """Preliminary verdict, from level 1 alone."""

    @property
    def fraction(self) -> float:
        """Fraction of windows that agree at level 1."""
        return self.coarse_verdict.fraction


class Aligner:
    """Aligns one picture with one view of the scan from any initial pose; data of the pair are computed once.

    Args:
        scan: the scan's levels in one view.
        photo: the levels of the photograph, or of one of its faces.
        gate: thresholds of verification.
        seed: random seed of the points drawn.
        fine_points: number of points of the finish and of the verdict, each.
        face: the face; None: the photograph itself.
    """

    def __init__(
        self,
        scan: ScanLevels,
        photo: PhotoLevels,
        *,
        gate: GateOptions,
        seed: int,
        fine_points: int = FINE_POINTS,
        face: Face | None = None,
    ) -> None:
        self.face = face
        self._fine_count = fine_points
        self.scan = scan
        self.photo = photo
        self.gate = gate if scan.coarse or scan.block_px == BLOCK_PX else small_regions_gate(gate)
        self.seed = seed
        self.points: dict[int, ViewPoints] = {}
        self._strength: dict[int, FloatArray] = {}
        self._last_blocks: tuple[Rigid, CameraChange, tuple[Picture, BlockComparison] | None] | None = None
        for level in LEVELS:
            strength = scan.once(("strength", level), partial(edge_strength, scan, scan.channels[level], level=level))
            if strength is not None:
                self._strength[level] = strength
                self.points[level] = self._drawn(level)

    def _drawn(self, level: int, count: int | None = None) -> ViewPoints:
        scan, seed = self.scan, self.seed
        channels, strength = scan.channels[level], self._strength[level]
        draw = partial(draw_points, scan, channels, strength, level=level, seed=seed, count=count)
        return scan.once(("points", level, seed, count), draw)

    @property
    def usable(self) -> bool:
        """Whether the view has points to compare on every level."""
        return len(self.points) == len(LEVELS)

    @property
    def common_variance(self) -> float:
        """Factor of a variance from the scatter of regions, for errors that the whole image of a coarse scan shares."""
        scan = self.scan
        return common_variance(
            scan.view.scan, scan.view.camera, coarse=scan.coarse, shape_alone=scan.channel_set == "geometry"
        )

    @made_once
    def occluder(self) -> Occluder:
        """Occlusion test by the scan's surface, for the photo's camera."""
        return Occluder(self.scan, self.photo.cameras[0])

    @made_once
    def targets(self) -> dict[int, Target]:
        """The photo's channels for sampling, by level."""
        return {L: Target(self.photo.cameras[L], self.photo.channels[L], self.photo.usable[L]) for L in LEVELS}

    @made_once
    def fine_target(self) -> Target:
        """The photo's channels of the finish."""
        return Target(self.photo.cameras[0], self.photo.fine_channels, self.photo.usable[0])

    @made_once
    def fine_points(self) -> ViewPoints | None:
        """Level-0 points of the finish, away from depth edges unless the scan is coarse; None if the view has none."""
        return self.scan.once(("fine points", self.seed, self._fine_count), self._draw_fine)

    def _draw_fine(self) -> ViewPoints | None:
        channels = self.scan.fine_channels
        strength = edge_strength(self.scan, channels, level=0, away_from_edges=not self.scan.coarse)
        if strength is None:
            return None
        return draw_points(self.scan, channels, strength, level=0, seed=self.seed, count=self._fine_count)

    @made_once
    def verification_points(self) -> ViewPoints:
        """Level-0 points of the verdict: more than refinement needs, so that each window's peak is well determined."""
        assert 0 in self._strength, "an aligner that is not usable cannot verify"
        return self._drawn(0, self._fine_count)

    def needed_to_finish(self) -> tuple[Callable[[], object], ...]:
        """Return pieces of work that finish and verdict need, for another thread to do before."""
        return (
            lambda: self.fine_points,
            lambda: (self.fine_target, self.targets[1].squares),
            lambda: self.verification_points,
            lambda: self.targets[0].squares,
        )

    def pose(self, camera_from_scanner: Rigid) -> Rigid:
        """Return the pose of the picture at a pose of the photograph."""
        return camera_from_scanner if self.face is None else self.face.face_from_camera @ camera_from_scanner

    def picture(self, level: int) -> Picture:
        """Return what is compared at a level."""
        return self._picture(self.points[level], self.targets[level])

    @property
    def fine_picture(self) -> Picture | None:
        """What is compared in the finish; None if the view has too little."""
        return None if self.fine_points is None else self._picture(self.fine_points, self.fine_target)

    def _picture(self, points: ViewPoints, target: Target) -> Picture:
        return Picture(points, target, self.occluder, None if self.face is None else self.face.face_from_camera)

    def in_photo(self, uv: FloatArray, camera: Camera) -> FloatArray:
        """Return the photograph's own pixels (..., 2) at pixels (..., 2) of a camera of the picture."""
        if self.face is not None:
            return self.face.in_photo(uv, camera)
        return uv if camera is self.photo.source else self.photo.source.project(camera.unproject(uv))

    def compared_points(self, level: int) -> ViewPoints:
        """Return the points of the agreement at a level."""
        return self.verification_points if level == 0 else self.points[level]

    def agreement_at(self, pose: Rigid, level: int) -> Agreement:
        """Return the agreement at a pose."""
        points, own = self.compared_points(level), self.pose(pose)
        return agreement(points, self.targets[level], self.occluder, own, level=level, radius=_RADIUS[level])

    def markers(self, fine: Agreement) -> tuple[tuple[float, float, bool], ...]:
        """Return (u, v, agrees) of some compared regions, in the photograph's own pixels.

        Args:
            fine: agreement at level 0.
        """
        found = region_markers(fine, self.photo.cameras[0], self.photo.source, self.gate)
        if self.face is None or not found:
            return found
        uv = self.in_photo(np.array([marker[:2] for marker in found]), self.photo.source)
        return tuple(
            (round(float(u), 1), round(float(v), 1), marker[2])
            for (u, v), marker in zip(uv, found, strict=True)
            if np.isfinite([u, v]).all()
        )

    def refine(self, start: Rigid) -> Candidate | None:
        """Refine a pose at levels 2 and 1, with up to two flow steps while the agreement is not sufficient."""
        best = self._refine_from(start, (2, 1))
        for level in (2, 1):
            if best is None or best.fraction >= _SUFFICIENT_FRACTION:
                break
            maps = best.coarse if level == 1 else self.agreement_at(best.camera_from_scanner, level)
            pulled = flow_step(self.points[level], self.targets[level], maps, seed=self.seed)
            if pulled is None:
                continue
            if self.face is not None:
                pulled = self.face.face_from_camera.inverse @ pulled
            again = self._refine_from(pulled, (2, 1) if level == 2 else (1,))
            if again is not None and again.fraction > best.fraction:
                best = again
        return best

    def _refine_from(self, start: Rigid, levels: tuple[int, ...]) -> Candidate | None:
        pose = start
        for level in levels:
            result = refine_pose([self.picture(level)], pose, REFINEMENT[level])
            if result is None:
                return None
            pose = result.camera_from_scanner
        coarse = self.agreement_at(pose, 1)
        return Candidate(pose, coarse, verify(coarse, None, self.gate))

    def finish(self, start: Rigid) -> Rigid:
        """Refine a pose at level 0, then on intensity alone, until it stops moving."""
        return self.finish_with_free_camera(start, free=0)[0]

    def refine_with_free_camera(self, start: Rigid, *, free: int) -> tuple[Rigid, CameraChange]:
        """Refine at level 1 with the first `free` of (log f, k1) free, damped, until the pose stops moving."""
        pose, change = start, NO_CHANGE
        options = replace(REFINEMENT[1], free=free, damping=_DAMPING)
        for _ in range(_FREE_CAMERA_ROUNDS):
            result = refine_pose([self.picture(1)], pose, options, change=change)
            if result is None:
                break
            pose, change = result.camera_from_scanner, result.change
            if result.motion_px < _STILL_PX:
                break
        return pose, change

    def finish_with_free_camera(
        self, start: Rigid, *, free: int, change: CameraChange = NO_CHANGE, anchor: CameraAnchor | None = None
    ) -> tuple[Rigid, CameraChange]:
        """Finish with the first `free` of (log f, k1, centre x, centre y) free.

        Args:
            start: the refined pose.
            free: 0 to 4.
            change: initial change of the camera relative to the stated one.
            anchor: what is known of these before.
        """
        return finish_pose([self], start, free=free, change=change, anchor=anchor)

    def preview_free_camera(
        self, pose: Rigid, *, free: int, anchor: CameraAnchor | None = None
    ) -> tuple[Rigid, CameraChange]:
        """Make a few further steps from a finished pose, as `finish_with_free_camera` would."""
        fine = self.fine_picture
        if fine is None:
            return pose, NO_CHANGE
        options = replace(FINE, free=free, iterations=_FREE_CAMERA_STEPS, anchor=anchor)
        result = refine_pose([fine], pose, options)
        return (pose, NO_CHANGE) if result is None else (result.camera_from_scanner, result.change)

    def median_shift_px(self, first: Rigid, before: CameraChange, second: Rigid, after: CameraChange) -> float:
        """Return the median displacement of the level-0 points between two poses and cameras, working pixels.

        If it is more, that between the cameras alone: the pose compensates most of it. Infinite: no point is seen.
        """
        camera, points = self.photo.cameras[0], self.points[0].points
        there = self.pose(second) @ points
        by_camera = after.applied_to(camera).project(there)
        most = 0.0
        for begin in (self.pose(first) @ points,) if before == after else (self.pose(first) @ points, there):
            length = np.hypot(*(before.applied_to(camera).project(begin) - by_camera).T)
            known = np.isfinite(length)
            most = max(most, float(np.median(length[known])) if known.any() else np.inf)
        return most

    def prepare_to_verify(self, pose: Rigid) -> None:
        """Make what the agreement at both levels needs, before two threads ask for it."""
        _ = self.verification_points, self.targets, self.occluder.depth_buffer(self.pose(pose))

    def verify(self, pose: Rigid) -> tuple[Verification, Agreement, Agreement]:
        """Return the verdict on a finished pose, and its agreement at levels 1 and 0."""
        self.prepare_to_verify(pose)
        fine, coarse = side_by_side(lambda level: self.agreement_at(pose, level), (0, 1))
        return verify(coarse, fine, self.gate), coarse, fine

    def regions(
        self, pose: Rigid, *, free: int, change: CameraChange = NO_CHANGE, anchor: CameraAnchor | None = None
    ) -> RegionEvidence | None:
        """Return the covariance of a finished pose and of the first `free` intrinsics, by leaving out regions.

        Args:
            pose: the finished pose.
            free: 0 to 4 of (log f, k1, centre x, centre y).
            change: of the camera, at which it was finished.
            anchor: what is known of the intrinsics before, relative to the changed camera.
        """
        compared = self.fine_blocks(pose, change)
        return region_evidence([compared] if compared else [], pose, replace(FINE, free=free, anchor=anchor))

    def block_matches(self, pose: Rigid) -> BlockMatches | None:
        """Return the sub-pixel point matches and blocks of a finished pose, or None if too few blocks are visible.

        The names of those of a face begin with its number.
        """
        compared = self.fine_blocks(pose)
        if compared is None:
            return None
        working, camera = self.photo.cameras[0], self.photo.source
        points, seen = compared[0].points, compared[1]
        found, of_block = block_matches(seen, points, working, camera)
        agreeing = of_block[found.inliers]
        own = compared_blocks(seen, points, partial(self.in_photo, camera=working), agreeing, FINE)
        if self.face is None:
            return replace(found, compared=own)
        prefix, matches = f"f{self.face.number}.", found.matches
        uv = self.in_photo(matches.uv, camera)
        known = np.asarray(np.isfinite(uv).all(axis=-1))
        names = tuple(prefix + name for name, kept in zip(matches.pick_ids, known.tolist(), strict=True) if kept)
        in_photo = Matches(matches.rays[known], matches.ranges[known], uv[known], names)
        return BlockMatches(in_photo, found.inliers[known], found.scatter_px, own.named(prefix))

    def fine_blocks(self, pose: Rigid, change: CameraChange = NO_CHANGE) -> tuple[Picture, BlockComparison] | None:
        """Return what is compared at a finished pose, and its blocks; None if too few are visible.

        Args:
            pose: the pose.
            change: of the camera.
        """
        last = self._last_blocks  # read once: another thread may be working on another pose
        if last is not None and last[0] is pose and last[1] == change:
            return last[2]  # the finished pose is asked for twice
        fine = self.fine_picture
        if fine is None:
            return None
        picture = fine.seen_by(change)
        seen = picture.compared(pose)
        found = None if seen is None else (picture, seen)
        self._last_blocks = pose, change, found
        return found


def finish_pose(
    aligners: Sequence[Aligner],
    start: Rigid,
    *,
    free: int = 0,
    change: CameraChange = NO_CHANGE,
    anchor: CameraAnchor | None = None,
) -> tuple[Rigid, CameraChange]:
    """Refine a pose at level 0, then at fine points, on all pictures together, until it stops moving.

    Args:
        aligners: those of the pictures; the camera of a face is not free.
        start: the refined pose.
        free: 0 to 4 of (log f, k1, centre x, centre y) estimated with it.
        change: initial change of the camera relative to the stated one.
        anchor: what is known of these before.
    """
    pose = start
    rounds = [([aligner.picture(0) for aligner in aligners], _FINISH)]
    fine = [picture for aligner in aligners if (picture := aligner.fine_picture) is not None]
    if fine:
        rounds += [(fine, FINE)] * _FINISH_ROUNDS
    for number, (pictures, options) in enumerate(rounds):
        result = refine_pose(pictures, pose, replace(options, free=free, anchor=anchor), change=change)
        if result is None:
            if number:
                break
            continue
        before, changed = pose, change
        pose, change = result.camera_from_scanner, result.change
        if number:
            shifts = [aligner.median_shift_px(before, changed, pose, change) for aligner in aligners]
            if max(filter(np.isfinite, shifts), default=np.inf) < _STILL_PX:
                break
    return pose, change


def flow_step(points: ViewPoints, target: Target, maps: Agreement, *, seed: int) -> Rigid | None:
    """Return the pose that most windows' correlation peaks agree on, by RANSAC; None if there is no consensus.

    Args:
        points: the level's scan points.
        target: the photo at that level.
        maps: agreement of that level at the current pose.
        seed: random seed of RANSAC.
    """
    if not maps.windows:
        return None
    shift, height, border = maps.peaks()
    index, uv = [], []
    for k in np.flatnonzero((height >= _MIN_HEIGHT_SD) & ~border):
        members = maps.members[k]
        chosen = members[np.linspace(0, len(members) - 1, _POINTS_PER_WINDOW).astype(np.intp)]
        index.append(chosen)
        uv.append(maps.uv[chosen] + shift[k])
    if _POINTS_PER_WINDOW * len(index) < _MIN_MATCHES:
        return None
    result = ransac_pose(
        points.points[np.concatenate(index)].astype(np.float64),
        np.concatenate(uv).astype(np.float64),
        target.camera,
        threshold_px=_RANSAC_PX,
        iterations=_RANSAC_ITERATIONS,
        seed=seed,
    )
    if result is None or np.count_nonzero(result.inliers) < _MIN_INLIERS:
        return None
    return result.camera_from_scanner
