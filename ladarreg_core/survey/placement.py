"""Where each photograph was taken, one by one: registered on the scans, from what registered photographs show of it.

Photographs that nothing is known of are searched for on the scans, which takes seconds each. Features shared with a
photograph that has a pose give the next one a pose on the laser's surface, from which it is refined once the cameras
are known. A group of photographs that share features therefore needs one search, not one for each.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.batches.photos.photo_task import ScanFiles
from ladarreg_core.camera import CameraModel
from ladarreg_core.errors import LadarregError
from ladarreg_core.foundations.arrays import IntArray
from ladarreg_core.frames import Rigid
from ladarreg_core.registration.register import RegisterOptions
from ladarreg_core.results.registration import Registration
from ladarreg_core.survey.parts import SurveyPhoto
from ladarreg_core.survey.stations import Stations
from ladarreg_core.survey.ties.features import Features
from ladarreg_core.survey.ties.lines import DrawnLine
from ladarreg_core.survey.ties.ties import DrawnEnds, LaserPoints
from ladarreg_core.survey.work import PairTask, PhotoFiles, finished, laser_under, registered

_MIN_START = 15  # inliers of a pose from features
_START_PX = 8.0  # of a photograph 1000 px wide: cameras and poses are rough yet
_SEEDS_AT_ONCE = 4
_NEAREST_SCANS = 2  # that a photograph is compared with: one is evidence, another holds it better
_ITERATIONS = 5000


@dataclass(slots=True, eq=False)
class PhotoState:
    """What has been found of a photograph so far."""

    given: SurveyPhoto
    files: PhotoFiles
    orientation: int
    """EXIF's."""
    features: Features
    camera: CameraModel
    """The camera before anything is adjusted."""
    assumed: bool
    """Whether only its focal length is known."""
    pairs: dict[int, Registration] = field(default_factory=dict)
    """Accepted registrations, by the index of the scan."""
    alone: Registration | None = None
    """The first of them, with its own estimate of the camera."""
    pose: Rigid | None = None
    """`camera_from_world`: of a registration, or from features."""
    searched: bool = False
    """Whether the scans were searched without a pose."""
    reasons: tuple[str, ...] = ()
    """Why it is not registered."""

    @property
    def by_image(self) -> bool:
        """Whether a scan's image verifies it."""
        return bool(self.pairs)


@dataclass(slots=True, eq=False)
class Placement:
    """Registers the photographs of a survey; the result is the same whatever the number of workers."""

    states: Sequence[PhotoState]
    scans: Sequence[ScanFiles]
    stations: Stations
    matches: Mapping[tuple[int, int], IntArray]
    options: RegisterOptions
    workers: Executor
    report: Callable[[str], None]
    tick: Callable[[], None]
    """Called several times a second; may raise to stop."""
    drawn: DrawnEnds = field(default_factory=dict)
    """Which features are ends of ties that were drawn by hand."""
    lines: Sequence[DrawnLine] = ()
    """Lines that were drawn by hand."""
    laser: dict[tuple[int, int], LaserPoints] = field(default_factory=dict)
    """Places on the surface of scan s under all features of photograph p, by (p, s)."""

    def run(self) -> None:
        """Register what can be registered."""
        rough = [k for k, one in enumerate(self.states) if one.given.initial is not None]
        self._near({k: self.states[k].given.initial for k in rough})  # type: ignore[misc]
        drawn = [k for k, one in enumerate(self.states) if one.given.matches is not None and not one.by_image]
        self._solve_matches(drawn)
        tried: dict[int, int] = {}
        while waiting := [k for k, one in enumerate(self.states) if one.pose is None and not one.searched]:
            starts = {}
            for k in self._without_pose():
                known = self._known_partners(k)
                if known and tried.get(k) != len(known):
                    tried[k] = len(known)
                    if (pose := self.pose_from_features(k)) is not None:
                        starts[k] = pose
            if starts:
                self._start(starts)
                continue
            self._search(self._seeds(waiting))
        for k in self._without_pose():  # what the last searches made known
            if (pose := self.pose_from_features(k)) is not None:
                self._start({k: pose})

    def pose_from_features(self, photo: int) -> Rigid | None:
        """Return `camera_from_world` from features that registered photographs show on the surface; None: too few."""
        state = self.states[photo]
        uv, points = self._on_surface(photo)
        if len(uv) < _MIN_START:
            return None
        rays = state.camera.unproject(uv)
        ahead = np.isfinite(rays).all(axis=1) & (rays[:, 2] > 0.05)
        tangents, points = rays[ahead, :2] / rays[ahead, 2:], points[ahead]
        if len(tangents) < _MIN_START:
            return None
        pinhole = state.camera.as_pinhole
        focal = pinhole.focal_px if pinhole is not None else state.camera.width / np.pi
        found, turn, shift, inliers = cv2.solvePnPRansac(
            points, tangents, np.eye(3), None, iterationsCount=_ITERATIONS, confidence=0.9999,
            reprojectionError=_START_PX * state.camera.width / 1000 / focal, flags=cv2.SOLVEPNP_SQPNP,
        )  # fmt: skip
        if not found or inliers is None or len(inliers) < _MIN_START:
            return None
        kept = inliers.ravel()
        turn, shift = cv2.solvePnPRefineLM(points[kept], tangents[kept], np.eye(3), None, turn, shift)
        return Rigid.from_rotvec(turn.ravel(), shift.ravel())

    def find_laser_points(
        self, which: Iterable[tuple[int, int]], poses: Mapping[int, Rigid], cameras: Mapping[int, CameraModel]
    ) -> None:
        """Find the places of scans' surfaces under all features of photographs, for pairs (photograph, scan).

        Args:
            which: the pairs.
            poses: `camera_from_world` of the photographs.
            cameras: their cameras.
        """
        waiting = {}
        for photo, scan in which:
            world = self.stations.each[scan].world_from_scanner or Rigid.identity()
            relative, uv = poses[photo] @ world, self.states[photo].features.uv
            future = self.workers.submit(laser_under, self.scans[scan], cameras[photo], relative, uv)
            waiting[future] = (photo, scan)
        for future in finished(waiting, self.tick):
            self.laser[waiting[future]] = future.result()

    def _without_pose(self) -> list[int]:
        return [k for k, one in enumerate(self.states) if one.pose is None]

    def _known_partners(self, photo: int) -> list[int]:
        return [
            other for pair, found in self.matches.items() if photo in pair and len(found)
            for other in pair if other != photo and self.states[other].pose is not None
        ]  # fmt: skip

    def _on_surface(self, photo: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the features (N, 2) of a photograph that registered ones show on a surface, and the points (N, 3)."""
        uv, points = [np.zeros((0, 2))], [np.zeros((0, 3))]
        for other in self._known_partners(photo):
            pair = (min(photo, other), max(photo, other))
            own, theirs = self.matches[pair].T if photo < other else self.matches[pair].T[::-1]
            for scan, station in enumerate(self.stations.each):
                laser, world = self.laser.get((other, scan)), station.world_from_scanner
                if laser is None or world is None:
                    continue
                xyz = laser.xyz[theirs].astype(np.float64)
                known = np.isfinite(xyz).all(axis=1)
                uv.append(self.states[photo].features.uv[own[known]].astype(np.float64))
                points.append(world @ xyz[known])
        return np.concatenate(uv), np.concatenate(points)

    def _seeds(self, waiting: Sequence[int]) -> list[int]:
        """Return photographs to search for: those that share most with others, no two that share anything."""
        shared = np.zeros((len(self.states), len(self.states)), np.int64)
        for (i, j), found in self.matches.items():
            shared[i, j] = shared[j, i] = len(found)
        seeds: list[int] = []
        for k in sorted(waiting, key=lambda one: (-int(shared[one, list(waiting)].sum()), one)):
            if len(seeds) < _SEEDS_AT_ONCE and not any(shared[k, seed] for seed in seeds):
                seeds.append(k)
        return seeds

    def _search(self, photos: Sequence[int]) -> None:
        """Search the scans for photographs, one scan after the other."""
        left = list(photos)
        for scan in range(len(self.scans)):
            tasks = {k: PairTask(photo=self.states[k].files, scan=self.scans[scan], options=self.options) for k in left}
            self._take({(k, scan): task for k, task in tasks.items()})
            left = [k for k in left if not self.states[k].by_image]
        for k in photos:
            self.states[k].searched = True

    def _start(self, poses: Mapping[int, Rigid]) -> None:
        """Take poses (`camera_from_world`) from features as they are, until the cameras are known better."""
        for k, pose in poses.items():
            self.states[k].pose = pose
        nearest = [(k, scan) for k, pose in poses.items() for scan in self.nearest_scans(pose)[:1]]
        self.find_laser_points(nearest, poses, {k: self.states[k].camera for k in poses})
        self.report(f"{len(poses)} photographs from what others show")

    def _near(self, poses: Mapping[int, Rigid]) -> None:
        """Refine photographs on the scans near their poses (`camera_from_world`)."""
        tasks = {}
        for k, pose in poses.items():
            self.states[k].pose = pose
            for scan in self.nearest_scans(pose):
                world = self.stations.each[scan].world_from_scanner or Rigid.identity()
                tasks[k, scan] = PairTask(
                    photo=self.states[k].files, scan=self.scans[scan], options=self.options, initial=pose @ world,
                    near=True,
                )  # fmt: skip
        self._take(tasks)
        for k in poses:
            if not self.states[k].by_image:
                self.states[k].pose = None

    def nearest_scans(self, camera_from_world: Rigid) -> list[int]:
        """Return the scans whose scanners stood nearest to a camera."""
        placed = [k for k, one in enumerate(self.stations.each) if one.world_from_scanner is not None]

        def away(scan: int) -> float:
            pose = self.stations.each[scan].world_from_scanner
            assert pose is not None
            return float(np.linalg.norm(pose.translation - camera_from_world.centre))

        return sorted(placed, key=away)[:_NEAREST_SCANS]

    def _solve_matches(self, photos: Sequence[int]) -> None:
        """Solve the matches that were given for photographs, with the first scan."""
        self._take({
            (k, 0): PairTask(
                photo=self.states[k].files, scan=self.scans[0], options=self.options,
                matches=self.states[k].given.matches,
            )
            for k in photos
        })  # fmt: skip

    def _take(self, tasks: Mapping[tuple[int, int], PairTask]) -> None:
        """Register pairs (photograph, scan), and keep what is accepted."""
        waiting: dict[Future[Registration], tuple[int, int]] = {
            self.workers.submit(registered, task): key for key, task in tasks.items()
        }
        done: dict[tuple[int, int], Registration] = {}
        for future in finished(waiting, self.tick):
            photo, scan = waiting[future]
            try:
                done[photo, scan] = future.result()
            except LadarregError as error:
                self.states[photo].reasons = (str(error),)
            self.report(f"{self.states[photo].given.id} on scan {scan + 1}")
        new: list[tuple[int, int]] = []
        for photo, scan in sorted(done):
            state, result = self.states[photo], done[photo, scan]
            if not result.accepted:
                state.reasons = state.reasons or result.reasons
                continue
            state.pairs[scan] = result
            new.append((photo, scan))
            if state.alone is None:
                state.alone, state.reasons = result, ()
                world = self.stations.each[scan].world_from_scanner
                if world is not None:
                    state.pose = result.camera_from_scanner @ world.inverse
        placed = [key for key in new if self.states[key[0]].pose is not None]
        self.find_laser_points(
            placed,
            {
                photo: self.states[photo].pairs[scan].camera_from_scanner @ self._scanner_from_world(scan)
                for photo, scan in placed
            },
            {photo: self.states[photo].pairs[scan].camera for photo, scan in placed},
        )

    def _scanner_from_world(self, scan: int) -> Rigid:
        return (self.stations.each[scan].world_from_scanner or Rigid.identity()).inverse
