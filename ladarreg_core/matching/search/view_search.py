"""Search of a view of the scan for the photo: initial poses from corners or from a grid, and their refinement."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial

import numpy as np

from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.foundations.parallel import Begun, OtherCore, side_by_side
from ladarreg_core.frames import Rigid
from ladarreg_core.matches import Matches
from ladarreg_core.matching.images.kept_channels import Channels, keep_view, recall_view
from ladarreg_core.matching.images.pair import PairLevels
from ladarreg_core.matching.images.photo_levels import LEVELS
from ladarreg_core.matching.images.scan_levels import ChannelSet, ScanLevels
from ladarreg_core.matching.images.views import direction_towards_overlap, settled_view
from ladarreg_core.matching.refine.aligner import Aligner, Candidate
from ladarreg_core.matching.refine.ecc import RefineOptions, RefineResult, refine_pose
from ladarreg_core.matching.search.ambiguity import KnownPoses
from ladarreg_core.matching.search.grid_search import ScoredPose, likely_poses
from ladarreg_core.matching.search.hypotheses import (
    Hypothesis,
    count_inliers,
    descriptor_corners,
    hypotheses,
    points_at,
)
from ladarreg_core.matching.search.roll import Roll, roll_between
from ladarreg_core.matching.verify.verification import GateOptions
from ladarreg_core.results.steps import StepLog

_Attempt = Hypothesis | str
_COARSEST = LEVELS[-1]
_COARSE_REFINEMENT = RefineOptions(tau_px=8, iterations=8)
_MAX_GRID_POSES = 2
_AS_WELL = 0.9  # of the regions that agreed in the view of the search; fewer: what the photo sees is cut off


class ViewSearch:
    """Searches views of a scan for the photo; reports every step.

    Args:
        pair: the levels of the pair.
        steps: receives every step.
        other_core: begins what the search will need.
        gate: thresholds of verification.
        good_fraction: fraction of agreeing regions that ends the search.
        seed: random seed.
        channel_set: scan channels to compare.
        channels: those that are kept for further registrations; None: only those of the last view are.
    """

    def __init__(
        self,
        pair: PairLevels,
        steps: StepLog,
        other_core: OtherCore,
        *,
        gate: GateOptions,
        good_fraction: float,
        seed: int,
        channel_set: ChannelSet = "both",
        channels: Channels | None = None,
    ) -> None:
        self._pair = pair
        self._channels = channels
        self._scan = pair.scan
        self._photo = pair.photo
        self._steps = steps
        self._other_core = other_core
        self._gate = gate
        self._good_fraction = good_fraction
        self._seed = seed
        self._channel_set = channel_set
        self._kept: deque[tuple[Rigid, Aligner]] = deque()
        self._begun: tuple[Aligner, Iterator[_Attempt], Begun[_Attempt | None]] | None = None
        self._prepared: Aligner | None = None
        self._of_photo: Begun[object] | None = other_core.begin(lambda: self._photo.channels)

    def view(self, direction: Rigid, *, name: int | str, for_corners: bool = False) -> Aligner | None:
        """Return the aligner of one view, or None if the view has too little to compare.

        Args:
            direction: the rotation (view from scanner).
            name: of the view, for the log.
            for_corners: whether `from_corners` follows: its first hypothesis is then begun.
        """
        self._begun = self._prepared = None
        for kept, aligner in self._kept:
            if kept is direction:
                return aligner if aligner.usable else None
        if len(self._kept) == self._pair.kept_views:
            self._kept.popleft()  # before the next one takes as much memory
        with self._steps.step("channels") as note:
            levels = _view_levels(self._pair, direction, self._channel_set, self._channels)
            of_intensity = None
            if not levels.has_channels:
                of_intensity = self._other_core.begin(lambda: levels.intensity_channels)
            attempts = hypotheses(levels, self._photo, seed=self._seed)
            first = self._other_core.begin(partial(next, attempts, None)) if for_corners else None
            if self._pair.kept_views > 1:  # of a large scan, memory matters more
                self._other_core.begin(lambda: self._photo.fine_channels)
            if of_intensity is not None:
                _ = levels.geometry_channels
                of_intensity.result()
                _ = levels.channels
            keep_view(self._channels, self._pair.scan, self._pair.working, direction, levels)
            aligner = Aligner(levels, self._photo, gate=self._gate, seed=self._seed)
            if self._of_photo is not None:
                self._of_photo.result()
                self._of_photo = None
            self._begun = None if first is None else (aligner, attempts, first)
            note.update(view=name, points={level: len(p) for level, p in aligner.points.items()})
        self._kept.append((direction, aligner))
        return aligner if aligner.usable else None

    def is_sufficient(self, candidate: Candidate) -> bool:
        """Return whether a candidate is good enough to end the search."""
        return candidate.fraction >= self._good_fraction and candidate.coarse_verdict.accepted

    def from_start(self, aligner: Aligner, known: KnownPoses, start: Rigid) -> Candidate | None:
        """Refine the given pose only."""
        self._prepare_to_finish(aligner)
        return self._best(aligner, [("the given pose", start)], known)

    def from_corners(self, aligner: Aligner, known: KnownPoses, *, given: Rigid | None = None) -> Candidate | None:
        """Refine the given pose and hypotheses until one is sufficient; return the best candidate."""
        return self._best(aligner, self._starts(aligner, given), known)

    def from_grid(self, aligner: Aligner, known: KnownPoses, *, around: Rigid | None = None) -> Candidate | None:
        """Refine the best poses of a grid of positions until one is sufficient; return the best candidate."""
        with self._steps.step("places") as note:
            found = likely_poses(aligner.scan, aligner.photo, around=around)
            ends = sorted(_coarse_refinements(aligner, found), key=lambda end: -end.correlation)
            note.update(near="the scanner" if around is None else "the given pose")
            note["scores"] = [round(item.score, 2) for item in found]
            note["correlations"] = [round(end.correlation, 3) for end in ends]
            if ends:
                self._steps.pose = ends[0].camera_from_scanner
        starts = [(f"place {k + 1}", end.camera_from_scanner) for k, end in enumerate(ends[:_MAX_GRID_POSES])]
        begun = {source: self._other_core.begin(partial(aligner.refine, start)) for source, start in starts[1:]}
        return self._best(aligner, starts, known, begun)

    def detect_roll(self, aligner: Aligner) -> Roll | None:
        """Return the roll of the camera relative to the view, if corners indicate one."""
        with self._steps.step("turn") as note:
            scan, photo = aligner.scan, aligner.photo
            scan_uv, photo_uv = descriptor_corners(scan, photo)
            found = roll_between(
                scan.channels[0],
                scan_uv,
                photo.channels[0],
                photo_uv,
                inliers=partial(count_inliers, scan, photo, seed=self._seed),
            )
            if found is None:
                note["none"] = "no roll is distinct"
                return None
            note.update(degrees=round(float(np.degrees(found.roll.angle_rad)), 1), agreeing=found.roll.matches)
            points = points_at(scan, found.scan_uv)
            known = np.isfinite(points).all(axis=-1)
            self._steps.matches = _as_matches(points[known], found.photo_uv[known], aligner)
        return found.roll

    def with_full_overlap(self, aligner: Aligner, candidate: Candidate) -> tuple[Aligner, Candidate]:
        """Return aligner and candidate in a view of the whole overlap, if the current view shows only part of it."""
        pose = candidate.camera_from_scanner
        direction = direction_towards_overlap(self._scan, self._photo.cameras[0], pose, view=aligner.scan.view)
        whole = None if direction is None else self.view(direction, name="what the photo sees")
        if whole is None:
            return aligner, candidate
        self._prepare_to_finish(whole)
        again = self._refined(whole, "the pose found in another view", pose)
        if again is None or again.coarse_verdict.agreeing <= candidate.coarse_verdict.agreeing:
            return aligner, candidate
        return whole, again

    def settled(self, aligner: Aligner, candidate: Candidate) -> tuple[Aligner, Candidate]:
        """Return aligner and candidate of a coarse scan in the view that all starts near this pose lead to."""
        if not aligner.scan.coarse:
            return aligner, candidate
        with self._steps.step("finish"):
            pose = aligner.finish(candidate.camera_from_scanner)
            self._steps.pose = pose
        towards = direction_towards_overlap(self._scan, self._photo.cameras[0], pose)
        view = None if towards is None else self.view(settled_view(towards), name="about the pose")
        if view is None:
            return aligner, candidate
        self._prepare_to_finish(view)
        again = self._refined(view, "the pose found in another view", pose)
        if again is None:
            return aligner, candidate
        as_well = again.coarse_verdict.agreeing >= _AS_WELL * candidate.coarse_verdict.agreeing
        return (view, again) if as_well and again.fraction >= _AS_WELL * candidate.fraction else (aligner, candidate)

    def _best(
        self,
        aligner: Aligner,
        starts: Iterable[tuple[str, Rigid]],
        known: KnownPoses,
        begun: Mapping[str, Begun[Candidate | None]] | None = None,
    ) -> Candidate | None:
        """Return the best candidate of starts, of which some may have been begun, by name."""
        best: Candidate | None = None
        for source, start in starts:
            if known.covers_start(start):
                continue
            candidate = self._refined(aligner, source, start, (begun or {}).get(source))
            if candidate is None:
                continue
            if best is None or candidate.fraction > best.fraction:
                best = candidate
            if self.is_sufficient(candidate):
                break
        return best

    def _refined(
        self, aligner: Aligner, source: str, start: Rigid, begun: Begun[Candidate | None] | None = None
    ) -> Candidate | None:
        with self._steps.step("climb") as note:
            candidate = aligner.refine(start) if begun is None else begun.result()
            note["start"] = source
            if candidate is not None:
                note.update(candidate.coarse_verdict.as_dict())
                self._steps.pose = candidate.camera_from_scanner
        return candidate

    def _prepare_to_finish(self, aligner: Aligner) -> None:
        """Begin what the finish needs, once for each aligner; of a large scan, memory matters more."""
        if self._prepared is not aligner and self._pair.kept_views > 1:
            self._prepared = aligner
            for piece in aligner.needed_to_finish():
                self._other_core.begin(piece)

    def _starts(self, aligner: Aligner, given: Rigid | None) -> Iterator[tuple[str, Rigid]]:
        if given is not None:
            self._prepare_to_finish(aligner)
            yield "the given pose", given
        begun, self._begun = self._begun, None
        ahead = begun is not None and begun[0] is aligner
        found = begun[1] if begun is not None and ahead else hypotheses(aligner.scan, aligner.photo, seed=self._seed)
        while True:
            with self._steps.step("hypothesis") as note:
                item = begun[2].result() if begun is not None and ahead else next(found, None)
                ahead = False
                if isinstance(item, Hypothesis):
                    note.update(source=item.source, matches=len(item.points), inliers=item.inliers)
                    self._steps.matches = _as_matches(item.points, item.uv, aligner)
                    self._steps.pose = item.camera_from_scanner
                else:
                    note["none"] = item or "no further hypotheses"
            if item is None:
                return
            if isinstance(item, Hypothesis):
                self._prepare_to_finish(aligner)
                yield item.source, item.camera_from_scanner


def _coarse_refinements(aligner: Aligner, poses: Sequence[ScoredPose]) -> list[RefineResult]:
    """Return the results of short refinements on the coarsest level, where the correct pose is most distinct."""
    coarsest = [aligner.picture(_COARSEST)]

    def refined(pose: ScoredPose) -> RefineResult | None:
        return refine_pose(coarsest, pose.camera_from_scanner, _COARSE_REFINEMENT)

    return [end for end in side_by_side(refined, poses) if end is not None]


def _view_levels(pair: PairLevels, direction: Rigid, channel_set: ChannelSet, channels: Channels | None) -> ScanLevels:
    """Return the scan's levels, those kept of another photo if there are any."""
    if not pair.has_view(direction):
        asked = pair.scan, pair.working, direction, channel_set
        kept = recall_view(channels, *asked, coarse=pair.coarse, harmonics=pair.harmonics)
        if kept is not None:
            pair.add_view(direction, kept)
    levels = pair.view(direction, channel_set)
    _ = levels.made  # before two threads ask for it
    return levels


def _as_matches(points: FloatArray, working_uv: FloatArray, aligner: Aligner) -> Matches:
    """Return matches in the photo's own pixels."""
    ranges = np.linalg.norm(points, axis=-1)
    photo = aligner.photo
    uv = photo.source.project(photo.cameras[0].unproject(working_uv))
    own = np.isfinite(uv).all(axis=-1)
    return Matches(points[own] / ranges[own, None], ranges[own], uv[own])
