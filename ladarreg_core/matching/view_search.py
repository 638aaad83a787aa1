"""One view of the scan after the other beside the photo: what starts there are, and where climbs from them end."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np

from ladarreg_core.arrays import FloatArray
from ladarreg_core.frames import Rigid
from ladarreg_core.matches import Matches
from ladarreg_core.matching.aligner import Aligner, Candidate
from ladarreg_core.matching.alike import Places
from ladarreg_core.matching.ecc import ClimbOptions, ClimbResult, climb
from ladarreg_core.matching.grid_search import Place, likely_places
from ladarreg_core.matching.hypotheses import Hypothesis, described_corners, hypotheses, inliers_of, points_at
from ladarreg_core.matching.pictures import Pictures
from ladarreg_core.matching.pyramid import LEVELS, ChannelSet, ScanLevels
from ladarreg_core.matching.roll import Turn, turn_between
from ladarreg_core.matching.verification import GateOptions
from ladarreg_core.matching.views import towards_seen
from ladarreg_core.progress import StepLog

_COARSEST = LEVELS[-1]
_COARSE_CLIMB = ClimbOptions(tau_px=8, iterations=8)
_MOST_PLACES = 2
_KEPT_VIEWS = 2  # a scan of one view comes back to it after it was rolled


class ViewSearch:
    """Looks for the photo in views of a scan; every stage is a step."""

    def __init__(
        self,
        pictures: Pictures,
        steps: StepLog,
        *,
        gate: GateOptions,
        good_fraction: float,
        seed: int,
        channel_set: ChannelSet = "both",
    ) -> None:
        self._pictures = pictures
        self._scan = pictures.scan
        self._photo = pictures.photo
        self._steps = steps
        self._gate = gate
        self._good_fraction = good_fraction
        self._seed = seed
        self._channel_set = channel_set
        self._kept: deque[tuple[Rigid, Aligner]] = deque(maxlen=_KEPT_VIEWS)

    def view(self, direction: Rigid, *, name: int | str) -> Aligner | None:
        """Return the pair in one view, with its channels made; None where the view shows too little."""
        for kept, aligner in self._kept:
            if kept is direction:
                return aligner if aligner.usable else None
        with self._steps.step("channels") as note:
            levels = _with_channels(self._pictures, direction, self._channel_set)
            aligner = Aligner(levels, self._photo, gate=self._gate, seed=self._seed)
            note.update(view=name, points={level: len(p) for level, p in aligner.points.items()})
        self._kept.append((direction, aligner))
        return aligner if aligner.usable else None

    def convinces(self, candidate: Candidate) -> bool:
        """Return whether a climb ended where no other start needs to be tried."""
        return candidate.fraction >= self._good_fraction and candidate.first_look.accepted

    def from_start(self, aligner: Aligner, known: Places, start: Rigid) -> Candidate | None:
        """Climb from the given pose alone."""
        return self._best(aligner, [("the given pose", start)], known)

    def from_corners(self, aligner: Aligner, known: Places, *, given: Rigid | None = None) -> Candidate | None:
        """Climb from the given pose and from hypotheses until one convinces; return the best."""
        return self._best(aligner, self._starts(aligner, given), known)

    def from_places(self, aligner: Aligner, known: Places, *, around: Rigid | None = None) -> Candidate | None:
        """Climb from the likeliest of a grid of places until one convinces; return the best."""
        with self._steps.step("places") as note:
            found = likely_places(aligner.scan, aligner.photo, around=around)
            ends = sorted(_coarse_ends(aligner, found), key=lambda end: -end.correlation)
            note.update(near="the scanner" if around is None else "the given pose")
            note["scores"] = [round(place.score, 2) for place in found]
            note["correlations"] = [round(end.correlation, 3) for end in ends]
            if ends:
                self._steps.pose = ends[0].camera_from_scanner
        starts = ((f"place {k + 1}", end.camera_from_scanner) for k, end in enumerate(ends[:_MOST_PLACES]))
        return self._best(aligner, starts, known)

    def turn(self, aligner: Aligner) -> Turn | None:
        """Return the roll of the photo against the view, where its corners speak for one."""
        with self._steps.step("turn") as note:
            scan, photo = aligner.scan, aligner.photo
            scan_uv, photo_uv = described_corners(scan, photo)
            found = turn_between(
                scan.channels[0],
                scan_uv,
                photo.channels[0],
                photo_uv,
                inliers=partial(inliers_of, scan, photo, seed=self._seed),
            )
            if found is None:
                note["none"] = "no roll stands out"
                return None
            note.update(degrees=round(float(np.degrees(found.turn.angle_rad)), 1), agreeing=found.turn.matches)
            points = points_at(scan, found.scan_uv)
            known = np.isfinite(points).all(axis=-1)
            self._steps.matches = _as_matches(points[known], found.photo_uv[known], aligner)
        return found.turn

    def seen_whole(self, aligner: Aligner, candidate: Candidate) -> tuple[Aligner, Candidate]:
        """Return the pair in a view of all that the photo sees, where the present view shows only part of it."""
        pose = candidate.camera_from_scanner
        direction = towards_seen(self._scan, self._photo.cameras[0], pose, view=aligner.scan.view)
        whole = None if direction is None else self.view(direction, name="what the photo sees")
        if whole is None:
            return aligner, candidate
        again = self._climbed(whole, "the pose found in another view", pose)
        if again is None or again.first_look.agreeing <= candidate.first_look.agreeing:
            return aligner, candidate
        return whole, again

    def _best(self, aligner: Aligner, starts: Iterable[tuple[str, Rigid]], known: Places) -> Candidate | None:
        best: Candidate | None = None
        for source, start in starts:
            if known.leads_to_one(start):
                continue
            candidate = self._climbed(aligner, source, start)
            if candidate is None:
                continue
            if best is None or candidate.fraction > best.fraction:
                best = candidate
            if self.convinces(candidate):
                break
        return best

    def _climbed(self, aligner: Aligner, source: str, start: Rigid) -> Candidate | None:
        with self._steps.step("climb") as note:
            candidate = aligner.approach(start)
            note["start"] = source
            if candidate is not None:
                note.update(candidate.first_look.as_dict())
                self._steps.pose = candidate.camera_from_scanner
        return candidate

    def _starts(self, aligner: Aligner, given: Rigid | None) -> Iterator[tuple[str, Rigid]]:
        if given is not None:
            yield "the given pose", given
        found = hypotheses(aligner.scan, aligner.photo, seed=self._seed)
        while True:
            with self._steps.step("hypothesis") as note:
                item = next(found, None)
                if isinstance(item, Hypothesis):
                    note.update(source=item.source, matches=len(item.points), inliers=item.inliers)
                    self._steps.matches = _as_matches(item.points, item.uv, aligner)
                    self._steps.pose = item.camera_from_scanner
                else:
                    note["none"] = item or "no further hypotheses"
            if item is None:
                return
            if isinstance(item, Hypothesis):
                yield item.source, item.camera_from_scanner


def _coarse_ends(aligner: Aligner, places: Sequence[Place]) -> list[ClimbResult]:
    """Return where short climbs on the coarsest level end: there the right place stands out from all others."""
    points, target = aligner.points[_COARSEST], aligner.targets[_COARSEST]
    ends = (climb(points, target, aligner.occluder, p.camera_from_scanner, _COARSE_CLIMB) for p in places)
    return [end for end in ends if end is not None]


def _with_channels(pictures: Pictures, direction: Rigid, channel_set: ChannelSet) -> ScanLevels:
    """Return the scan's levels with the channels of both sides made, on two cores where there are two."""
    photo_side = pictures.photo
    with ThreadPoolExecutor(1) as other_core:
        of_photo = other_core.submit(lambda: (photo_side.channels, photo_side.fine_channels))
        levels = pictures.view(direction, channel_set)
        of_geometry = other_core.submit(lambda: levels.geometry_channels)
        _ = levels.intensity_channels, levels.fine_channels
        of_photo.result()
        of_geometry.result()
    return levels


def _as_matches(points: FloatArray, working_uv: FloatArray, aligner: Aligner) -> Matches:
    """Return matches in the photo's own pixels."""
    ranges = np.linalg.norm(points, axis=-1)
    photo = aligner.photo
    uv = photo.source.project(photo.cameras[0].unproject(working_uv))
    own = np.isfinite(uv).all(axis=-1)
    return Matches(points[own] / ranges[own, None], ranges[own], uv[own])
