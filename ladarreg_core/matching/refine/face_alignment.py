"""Joint alignment of all faces of a photograph with a scan: one pose, one covariance, one verdict.

Every face is compared with a view of the scan of its own, as a photograph of a pinhole camera would be. The normal
equations of all faces are summed in the frame of the photograph's camera, and the compared regions counted together.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ladarreg_core.camera import Camera
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.frames import Rigid, rotation_from_rotvec
from ladarreg_core.matches import Matches
from ladarreg_core.matching.images.blocks import BlockComparison, BlockMatches, Target, block_matches, compare_blocks
from ladarreg_core.matching.images.faces import Face, FaceSet
from ladarreg_core.matching.images.laser_images import CleanedScan
from ladarreg_core.matching.images.pyramid import ChannelFloors, ChannelSet, ScanLevels, scan_levels
from ladarreg_core.matching.images.sampling import ViewPoints
from ladarreg_core.matching.images.views import direction_towards_overlap
from ladarreg_core.matching.refine.aligner import FINE, FINISH, FINISH_ROUNDS, REFINEMENT, STILL_PX, Aligner
from ladarreg_core.matching.refine.compared_blocks import compared_blocks
from ladarreg_core.matching.refine.covariance import RegionEvidence, WindowEvidence, jackknife, window_evidence
from ladarreg_core.matching.refine.ecc import (
    MAX_MOTION_PX,
    REFRESH_VISIBILITY,
    RefineOptions,
    block_systems,
    solve_step,
    step_system,
)
from ladarreg_core.matching.refine.ecc import STILL_PX as STILL_STEP_PX
from ladarreg_core.matching.verify.agreement import Agreement, joined
from ladarreg_core.matching.verify.verification import GateOptions, Verification, region_markers, verify
from ladarreg_core.results import ComparedBlocks
from ladarreg_core.scan import Scan
from ladarreg_core.surface.perspective import perspective_view

_FINE_POINTS = 8000  # of a face: only its own part of the picture counts, and there are many faces
_MAX_MARKERS = 250
# A regular floor or wall of another room agrees with nearly half of the regions; of the right rooms 62 % did at least.
_MIN_FRACTION = 0.57


@dataclass(frozen=True, slots=True, eq=False)
class FacePair:
    """One face with the view of the scan that it is compared with."""

    face: Face
    """The face."""
    aligner: Aligner
    """Its aligner; only pixels that belong to the face count."""

    @property
    def turn(self) -> FloatArray:
        """(6, 6): a step (w, t) of the camera frame in the frame of the face."""
        return np.kron(np.eye(2), self.face.face_from_camera.rotation)

    def pose(self, camera_from_scanner: Rigid) -> Rigid:
        """Return the pose of the face."""
        return self.face.face_from_camera @ camera_from_scanner


def face_view(
    scan: Scan, cleaned: CleanedScan, face: Face, working: Camera, pose: Rigid, *, channel_set: ChannelSet
) -> ScanLevels | None:
    """Return the levels of the view of what a face sees of the scan at a pose; None if it sees too little.

    Args:
        scan: the scan.
        cleaned: its images.
        face: the face.
        working: the ideal camera of the comparison.
        pose: `camera_from_scanner` of the photograph.
        channel_set: channels to compare.
    """
    direction = direction_towards_overlap(scan, working, face.face_from_camera @ pose)
    if direction is None:
        return None
    view = perspective_view(scan, working, view_from_scanner=direction)
    levels = scan_levels(scan, view, channel_set=channel_set, cleaned=cleaned)
    return levels if np.isfinite(levels.ranges).any() else None


def joint_aligner(
    scan: Scan,
    cleaned: CleanedScan,
    faces: FaceSet,
    working: Camera,
    pose: Rigid,
    *,
    channel_set: ChannelSet,
    gate: GateOptions,
    seed: int,
) -> JointAligner | None:
    """Return the aligner of all faces that see some of the scan at a pose; None if none does.

    Args:
        scan: the scan.
        cleaned: its images, stretched alike.
        faces: the faces of the photograph.
        working: the ideal camera of the comparison.
        pose: `camera_from_scanner` of the photograph, near the one sought.
        channel_set: channels to compare.
        gate: thresholds of verification.
        seed: random seed of the points drawn.
    """
    views = []
    for face in faces.faces:
        levels = face_view(scan, cleaned, face, working, pose, channel_set=channel_set)
        if levels is not None:
            views.append((face, levels))
    if not views:
        return None
    floors = ChannelFloors.common([levels for _, levels in views])
    pairs = []
    for face, own in views:
        levels = own.with_floors(floors)
        side = faces.levels(face, working, own=True)
        aligner = Aligner(levels, side, gate=gate, seed=seed, fine_points=_FINE_POINTS)
        if aligner.usable:
            pairs.append(FacePair(face, aligner))
    return JointAligner(faces, tuple(pairs), gate=gate) if pairs else None


class JointAligner:
    """Aligns all faces of a photograph with the scan.

    Args:
        faces: the faces of the photograph.
        pairs: those that see some of the scan, one or more.
        gate: thresholds of verification.
    """

    def __init__(self, faces: FaceSet, pairs: tuple[FacePair, ...], *, gate: GateOptions) -> None:
        self.faces = faces
        self.pairs = pairs
        self.gate = replace(gate, fraction=max(gate.fraction, _MIN_FRACTION))
        self.working = pairs[0].aligner.photo.cameras[0]

    def refine(self, start: Rigid) -> tuple[Rigid, float] | None:
        """Refine a pose at levels 2 and 1; return it with the mean correlation at level 1, or None."""
        pose, correlation = start, 0.0
        for level in (2, 1):
            found = self._refined(pose, partial(_of_level, level), REFINEMENT[level])
            if found is None:
                return None
            pose, correlation = found
        return pose, correlation

    def finish(self, start: Rigid) -> Rigid:
        """Refine a pose at level 0, then at fine points, until it stops moving."""
        found = self._refined(start, partial(_of_level, 0), FINISH)
        pose = start if found is None else found[0]
        for _ in range(FINISH_ROUNDS):
            found = self._refined(pose, _fine, FINE)
            if found is None:
                break
            before, pose = pose, found[0]
            if self._median_shift_px(before, pose) < STILL_PX:
                break
        return pose

    def agreement_at(self, pose: Rigid, level: int) -> Agreement:
        """Return the agreement of all faces at a pose."""
        return joined([pair.aligner.agreement_at(pair.pose(pose), level) for pair in self.pairs])

    def coarse_verdict(self, pose: Rigid) -> Verification:
        """Return the preliminary verdict on a pose, from level 1 alone."""
        return verify(self.agreement_at(pose, 1), None, self.gate)

    def verify(self, pose: Rigid) -> Verification:
        """Return the verdict on a finished pose, with the regions it rests on in the photograph's pixels."""
        fine = [pair.aligner.agreement_at(pair.pose(pose), 0) for pair in self.pairs]
        verdict = verify(self.agreement_at(pose, 1), joined(fine), self.gate)
        markers: list[tuple[float, float, bool]] = []
        for pair, maps in zip(self.pairs, fine, strict=True):
            camera = pair.face.camera
            found = region_markers(maps, self.working, camera, self.gate)
            if found:
                uv = self.faces.in_photo(pair.face, np.array([marker[:2] for marker in found]), camera)
                markers += [
                    (round(float(u), 1), round(float(v), 1), marker[2])
                    for (u, v), marker in zip(uv, found, strict=True)
                    if np.isfinite([u, v]).all()
                ]
        every = max(1, -(-len(markers) // _MAX_MARKERS))
        return replace(verdict, regions=tuple(markers[::every]))

    def evidence(self, pose: Rigid) -> WindowEvidence:
        """Return the uncertainty of a finished pose: by leaving out regions, or from its windows if they are few."""
        information, agreeing, scatters = np.zeros((6, 6)), 0, []
        for pair in self.pairs:
            maps = pair.aligner.agreement_at(pair.pose(pose), 0)
            if not maps.windows:
                continue
            points, camera = pair.aligner.verification_points, pair.face.camera
            found = window_evidence(maps, points, self.working, camera, pair.pose(pose))
            # (w, c): the rotation is that of the face, the centre that of the scanner frame
            turn = np.eye(6)
            turn[:3, :3] = pair.face.face_from_camera.rotation
            information += turn.T @ np.linalg.inv(found.covariance) @ turn
            agreeing += found.agreeing
            if np.isfinite(found.scatter_px):
                scatters.append(found.scatter_px)
        regions = self._regions(pose)
        covariance = regions.pose_covariance if regions is not None else np.linalg.pinv(information, hermitian=True)
        scatter = float(np.median(scatters)) if scatters else float("nan")
        return WindowEvidence(agreeing, (covariance + covariance.T) / 2, scatter)

    def block_matches(self, pose: Rigid) -> BlockMatches | None:
        """Return the sub-pixel matches of all faces at a finished pose, in the photograph's pixels; None without."""
        found: list[BlockMatches] = []
        compared: list[ComparedBlocks] = []
        before = 0
        for pair, seen, points in self._fine_blocks(pose):
            camera = pair.face.camera
            blocks = block_matches(seen, points, self.working, camera)
            first, before = before, before + len(seen.blocks)
            in_photo = partial(self.faces.in_photo, pair.face, camera=self.working)
            own = compared_blocks(seen, points, in_photo, blocks, FINE)
            compared.append(own.named(f"f{pair.face.number}."))
            uv = self.faces.in_photo(pair.face, blocks.matches.uv, camera)
            known = np.asarray(np.isfinite(uv).all(axis=-1))
            if not known.any():
                continue
            names = [f"f{pair.face.number}.{name}" for name in blocks.matches.pick_ids]
            matches = Matches(
                blocks.matches.rays[known],
                blocks.matches.ranges[known],
                uv[known],
                tuple(name for name, kept in zip(names, known.tolist(), strict=True) if kept),
            )
            of_block = blocks.of_block[known] + first
            found.append(BlockMatches(matches, blocks.inliers[known], blocks.scatter_px, of_block))
        if not found:
            return None
        weights = np.array([len(part.matches) for part in found], dtype=np.float64)
        scatter = float(np.sqrt(np.average([part.scatter_px**2 for part in found], weights=weights)))
        return BlockMatches(
            Matches.joined([part.matches for part in found]),
            np.concatenate([part.inliers for part in found]),
            scatter,
            np.concatenate([part.of_block for part in found]),
            ComparedBlocks.joined(compared),
        )

    def _regions(self, pose: Rigid) -> RegionEvidence | None:
        parts = []
        for pair, seen, points in self._fine_blocks(pose):
            H, g = block_systems(seen, self.working, FINE)
            grid = points.blocks.grid[points.blocks.of_point[seen.index[seen.blocks.starts]]]
            picture = np.full(len(grid), pair.face.number, np.intp)
            parts.append((pair.turn.T @ H @ pair.turn, g @ pair.turn, picture, grid))
        if not parts:
            return None
        H, g, picture, grid = (np.concatenate(values) for values in zip(*parts, strict=True))
        return jackknife(H, g, picture, grid, pose)

    def _fine_blocks(self, pose: Rigid) -> list[tuple[FacePair, BlockComparison, ViewPoints]]:
        found = []
        for pair in self.pairs:
            points, aligner, of_face = pair.aligner.fine_points, pair.aligner, pair.pose(pose)
            if points is None:
                continue
            buffer = aligner.occluder.depth_buffer(of_face)
            seen = compare_blocks(points, aligner.fine_target, aligner.occluder, buffer, of_face)
            if seen is not None:
                found.append((pair, seen, points))
        return found

    def _median_shift_px(self, first: Rigid, second: Rigid) -> float:
        """Return the median displacement of the level-0 points between two poses, working pixels."""
        lengths = []
        for pair in self.pairs:
            points = pair.aligner.points[0].points
            uv = self.working.project(pair.pose(first) @ points)
            length = np.hypot(*(uv - self.working.project(pair.pose(second) @ points)).T)
            lengths.append(length[np.isfinite(length)])
        every = np.concatenate(lengths)
        return float(np.median(every)) if len(every) else float("inf")

    def _refined(
        self, start: Rigid, of: Callable[[Aligner], tuple[ViewPoints | None, Target]], options: RefineOptions
    ) -> tuple[Rigid, float] | None:
        """Return the pose that maximises the correlation of the blocks of all faces, and their mean correlation."""
        pose, buffers = start, self._buffers(start)
        result = None
        for iteration in range(options.iterations):
            if iteration and iteration % REFRESH_VISIBILITY == 0:
                buffers = self._buffers(pose)
            H, g, rho = np.zeros((6, 6)), np.zeros(6), []
            motions: list[tuple[FloatArray, FloatArray, FloatArray]] = []
            for pair, buffer in zip(self.pairs, buffers, strict=True):
                points, target = of(pair.aligner)
                if points is None:
                    continue
                seen = compare_blocks(points, target, pair.aligner.occluder, buffer, pair.pose(pose))
                if seen is None:
                    continue
                system = step_system(seen, target.camera, options)
                H += pair.turn.T @ system.H @ pair.turn
                g += pair.turn.T @ system.g
                motions.append((system.Ju, system.Jv, pair.turn))
                rho.append(seen.rho)
            delta = solve_step(H, g) if rho else None
            if delta is None:
                return result
            moved = np.concatenate([np.hypot(Ju @ (turn @ delta), Jv @ (turn @ delta)) for Ju, Jv, turn in motions])
            motion = float(np.median(moved))
            if motion > MAX_MOTION_PX:
                delta = delta * (MAX_MOTION_PX / motion)
            turn = rotation_from_rotvec(delta[:3])
            pose = Rigid(turn @ pose.rotation, turn @ pose.translation + delta[3:])
            result = pose, float(np.concatenate(rho).mean())
            if motion < STILL_STEP_PX:
                break
        return result

    def _buffers(self, pose: Rigid) -> list[FloatArray]:
        return [pair.aligner.occluder.depth_buffer(pair.pose(pose)) for pair in self.pairs]


def _of_level(level: int, aligner: Aligner) -> tuple[ViewPoints, Target]:
    return aligner.points[level], aligner.targets[level]


def _fine(aligner: Aligner) -> tuple[ViewPoints | None, Target]:
    return aligner.fine_points, aligner.fine_target
