"""One photo against one view of the scan: climbs, flow steps, the finish and the verification."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ladarreg_core.frames import Rigid
from ladarreg_core.matching.agreement import Agreement, agreement
from ladarreg_core.matching.block_matches import BlockMatches, block_matches
from ladarreg_core.matching.climb import ClimbOptions, climb
from ladarreg_core.matching.compared import Target, compare_blocks
from ladarreg_core.matching.flow import flow_step
from ladarreg_core.matching.levels import LEVELS, PhotoLevels, ScanLevels
from ladarreg_core.matching.occlusion import Occluder
from ladarreg_core.matching.points import ViewPoints, select_points
from ladarreg_core.matching.verify import GateOptions, Verification, verify

_CLIMB = {2: ClimbOptions(tau_px=8, iterations=8), 1: ClimbOptions(tau_px=6, iterations=6)}
_FINISH = ClimbOptions(tau_px=3, iterations=6)
_FINE = ClimbOptions(tau_px=2, iterations=8)
_FINE_POINTS = _JUDGED_POINTS = 20_000
_RADIUS = {0: 6, 1: 6, 2: 8}
_SURE_FRACTION = 0.8
_FINISH_ROUNDS = 5
_STILL_PX = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A pose with its agreement at level 1."""

    camera_from_scanner: Rigid
    """The pose."""
    coarse: Agreement
    """Agreement at level 1."""
    first_look: Verification
    """The gate at level 1."""

    @property
    def fraction(self) -> float:
        """Share of windows that agree."""
        return self.first_look.fraction


class Aligner:
    """Holds what is computed once for a pair, and aligns from any start."""

    def __init__(self, scan: ScanLevels, photo: PhotoLevels, *, gate: GateOptions, seed: int) -> None:
        self.scan = scan
        self.photo = photo
        self._gate = gate
        self._seed = seed
        self.points: dict[int, ViewPoints] = {}
        for level in LEVELS:
            found = select_points(scan, scan.channels[level], level=level, seed=seed)
            if found is not None:
                self.points[level] = found

    @property
    def usable(self) -> bool:
        """Whether the scan has anything to compare."""
        return len(self.points) == len(LEVELS)

    @cached_property
    def occluder(self) -> Occluder:
        """The scan's surface for the photo's camera."""
        return Occluder(self.scan, self.photo.cameras[0])

    @cached_property
    def targets(self) -> dict[int, Target]:
        """The photo's channels for sampling, by level."""
        return {L: Target(self.photo.cameras[L], self.photo.channels[L], self.photo.usable[L]) for L in LEVELS}

    @cached_property
    def _fine_target(self) -> Target:
        return Target(self.photo.cameras[0], self.photo.fine_channels, self.photo.usable[0])

    @cached_property
    def _fine_points(self) -> ViewPoints | None:
        return select_points(
            self.scan,
            self.scan.fine_channels,
            level=0,
            seed=self._seed,
            count=_FINE_POINTS,
            away_from_edges=True,
        )

    @cached_property
    def judged_points(self) -> ViewPoints:
        """The level-0 points of the verdict: more of them than a climb needs, so that a window's peak is its own."""
        found = select_points(self.scan, self.scan.channels[0], level=0, seed=self._seed, count=_JUDGED_POINTS)
        assert found is not None, "an aligner without points must not be asked to judge"
        return found

    def look(self, pose: Rigid, level: int) -> Agreement:
        """Return the agreement at a pose."""
        points = self.judged_points if level == 0 else self.points[level]
        return agreement(points, self.targets[level], self.occluder, pose, level=level, radius=_RADIUS[level])

    def approach(self, start: Rigid) -> Candidate | None:
        """Climb at levels 2 and 1, with up to two flow steps where the result is not sure yet."""
        best = self._climb_from(start, (2, 1))
        for level in (2, 1):
            if best is None or best.fraction >= _SURE_FRACTION:
                break
            maps = best.coarse if level == 1 else self.look(best.camera_from_scanner, level)
            pulled = flow_step(self.points[level], self.targets[level], maps, seed=self._seed)
            if pulled is None:
                continue
            again = self._climb_from(pulled, (2, 1) if level == 2 else (1,))
            if again is not None and again.fraction > best.fraction:
                best = again
        return best

    def _climb_from(self, start: Rigid, levels: tuple[int, ...]) -> Candidate | None:
        pose = start
        for level in levels:
            result = climb(self.points[level], self.targets[level], self.occluder, pose, _CLIMB[level])
            if result is None:
                return None
            pose = result.camera_from_scanner
        coarse = self.look(pose, 1)
        return Candidate(pose, coarse, verify(coarse, None, self._gate))

    def finish(self, start: Rigid) -> Rigid:
        """Refine at level 0, then on intensity alone, until the pose stops moving."""
        result = climb(self.points[0], self.targets[0], self.occluder, start, _FINISH)
        pose = result.camera_from_scanner if result else start
        if self._fine_points is None:
            return pose
        for _ in range(_FINISH_ROUNDS):
            result = climb(self._fine_points, self._fine_target, self.occluder, pose, _FINE)
            if result is None:
                break
            before, pose = pose, result.camera_from_scanner
            if self._moved(before, pose) < _STILL_PX:
                break
        return pose

    def _moved(self, first: Rigid, second: Rigid) -> float:
        """Return the median displacement of the level-0 points between two poses, working pixels."""
        camera, points = self.photo.cameras[0], self.points[0].points
        shift = camera.project(first @ points) - camera.project(second @ points)
        return float(np.nanmedian(np.hypot(shift[:, 0], shift[:, 1])))

    def judge(self, pose: Rigid) -> tuple[Verification, Agreement, Agreement]:
        """Verify a finished pose; also return its agreement at levels 1 and 0."""
        coarse, fine = self.look(pose, 1), self.look(pose, 0)
        return verify(coarse, fine, self._gate), coarse, fine

    def block_matches(self, pose: Rigid) -> BlockMatches | None:
        """Return the sub-pixel point matches of a finished pose, or None where too little is seen."""
        if self._fine_points is None:
            return None
        buffer = self.occluder.depth_buffer(pose)
        seen = compare_blocks(self._fine_points, self._fine_target, self.occluder, buffer, pose)
        return (
            None if seen is None else block_matches(seen, self._fine_points, self.photo.cameras[0], self.photo.source)
        )
