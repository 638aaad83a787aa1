"""`adjust`: a survey solved as a whole, with a verdict and a covariance for each photograph.

1. The scanners are placed by their surfaces (`stations`).
2. Features are matched between photographs (`features`).
3. Each photograph is registered on the scans, most of them from what registered ones show (`placement`).
4. Cameras are pooled over their photographs, and everything is adjusted together with the ties (`build`, `solver`).
5. With the cameras that result, each photograph is registered again on the scans near it, and all is adjusted again.
6. What contradicts the rest is taken out; photographs without a scan's evidence are verified on the colours of the
   surface (`verdicts`).
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from ladarreg_core.batches.photos.cache import ContentCache
from ladarreg_core.batches.photos.executor import WorkerProcesses, usable_cores
from ladarreg_core.batches.photos.photo_task import ScanFiles
from ladarreg_core.camera import CameraModel
from ladarreg_core.errors import LadarregError, OptionError
from ladarreg_core.export.json import plain
from ladarreg_core.foundations.arrays import IntArray
from ladarreg_core.foundations.progress import Progress, Report, part_of
from ladarreg_core.foundations.validation import require_type
from ladarreg_core.frames import Rigid
from ladarreg_core.registration.register import RegisterOptions
from ladarreg_core.results.registration import Registration
from ladarreg_core.survey.adjustment import Adjustment
from ladarreg_core.survey.assembly import adjustment_of
from ladarreg_core.survey.build import (
    Bodies,
    build_problem,
    camera_unknowns,
    numbered_lines,
    pair_factor,
    photo_view,
    with_ties,
)
from ladarreg_core.survey.inputs import PhotoHeader, SurveyInputs
from ladarreg_core.survey.least_squares.problem import WORLD, CameraUnknowns, Problem, RelativePose, pose_difference
from ladarreg_core.survey.least_squares.solver import Adjusted, solve
from ladarreg_core.survey.local_world import adjustment_from, local_origin, scan_about, survey_about
from ladarreg_core.survey.placement import PhotoState, Placement
from ladarreg_core.survey.rigs import Rigs, rig_factors, rigs_of, start_from_rig
from ladarreg_core.survey.stations import place_stations
from ladarreg_core.survey.survey import Survey
from ladarreg_core.survey.ties.features import propose_pairs
from ladarreg_core.survey.ties.ties import DrawnEnds, with_drawn
from ladarreg_core.survey.verdicts import (
    Solution,
    TakenOut,
    count_ties,
    is_held_by_rig,
    largest_shift,
    solve_consistent,
    without_photo,
)
from ladarreg_core.survey.work import (
    PairTask,
    finished,
    pair_matches,
    photo_features,
    registered,
    verified_by_colors,
)

_DIFFERS = 27.9  # squared Mahalanobis distance with 6 degrees of freedom, exceeded once in 10,000
_ROUGH_RAD, _ROUGH_M = float(np.radians(0.02)), 0.001  # what the colours' own poses may be off
_STAGES = {
    "headers": 0.02, "scans": 0.06, "stations": 0.12, "features": 0.2, "matches": 0.3, "placement": 0.65,
    "adjust": 0.72, "refine": 0.9, "verify": 1.0,
}  # fmt: skip
"""Share of the whole that is done after each stage."""


@dataclass(frozen=True, slots=True, eq=False)
class Solved:
    """All that `adjust` leaves, for outputs."""

    adjustment: Adjustment
    states: tuple[PhotoState, ...]
    scans: tuple[ScanFiles, ...]


def adjust(
    survey: Survey,
    *,
    options: RegisterOptions | None = None,
    processes: int | None = None,
    cache: ContentCache | None = None,
    report: Report | None = None,
) -> Adjustment:
    """Solve a survey: all poses and cameras together, from the scans' images, ties between photographs and priors.

    The result is the same whatever the number of processes. On systems that spawn processes, as all do here, a program
    calls this below `if __name__ == "__main__":`. `write_adjustment` also writes it with all that a pair writes.

    Args:
        survey: the survey.
        options: seed, thresholds and priors of the registrations.
        processes: number of worker processes; None: one for each processor core.
        cache: keeps scans, features, matches and registrations, so that a survey can be resumed; None: only for this
            call.
        report: receives the progress; may raise `Cancelled`.

    Returns:
        The adjustment. Photographs that are not accepted are part of it, with their reasons.

    Raises:
        LadarregError: if a file cannot be read.
        OptionError: if an argument is of a wrong type.
    """
    return solve_survey(survey, options=options, processes=processes, cache=cache, report=report).adjustment


def solve_survey(
    survey: Survey, *, options: RegisterOptions | None = None, processes: int | None = None,
    cache: ContentCache | None = None, report: Report | None = None,
) -> Solved:  # fmt: skip
    """Solve a survey and return all that its outputs need; arguments as of `adjust`."""
    require_type(survey, Survey, "'survey'")
    o = RegisterOptions() if options is None else require_type(options, RegisterOptions, "'options'")
    if processes is not None and processes < 1:
        raise OptionError(f"the number of `processes` is {processes}; it must be at least 1")
    used = {photo.camera for photo in survey.photos}
    survey = replace(survey, cameras=tuple(one for one in survey.cameras if one.id in used))
    with ExitStack() as stack:
        kept = cache or ContentCache(stack.enter_context(tempfile.TemporaryDirectory(prefix="ladarreg-")))
        workers = stack.enter_context(WorkerProcesses(processes or usable_cores()))
        return _Run(survey, o, kept, workers, report).run()


@dataclass(slots=True, eq=False)
class _Run:
    survey: Survey
    options: RegisterOptions
    cache: ContentCache
    workers: Executor
    report: Report | None
    stage: tuple[float, float] = (0.0, 0.0)
    latest: Progress = field(default_factory=lambda: Progress(0, 1, "reading"))

    def run(self) -> Solved:
        inputs = SurveyInputs(self.survey, self.cache)
        self._begin("headers")
        headers = inputs.headers(self._reporter(len(self.survey.photos)))
        self._begin("scans")
        scans = inputs.scans(self._reporter(len(self.survey.scans)))
        origin = local_origin(self.survey.scans, [scan for _, scan in scans])
        self.survey = survey_about(self.survey, origin)
        stations = place_stations(
            self.survey.scans, [scan_about(scan, origin) for _, scan in scans], origin=origin, seed=self.options.seed,
            report=self._part("stations"),
        )  # fmt: skip
        files = [one for one, _ in scans]
        del scans
        states = self._states(headers)
        matches, drawn = self._with_drawn(states, self._matches(states))
        self._begin("placement")
        placement = Placement(
            states,
            files,
            stations,
            matches,
            self.options,
            self.workers,
            self._reporter(3 * len(states)),
            self._tick,
            drawn,
            numbered_lines(self.survey),
        )
        placement.run()
        cameras = camera_unknowns(self.survey, states)
        self._begin("adjust")
        first, bodies = self._adjusted(placement, cameras, self._factors(states, cameras))
        self._begin("refine")
        self._register_again(placement, first, bodies, [k for k, one in enumerate(states) if one.pose is not None])
        rigs = rigs_of(self.survey, states, first, bodies)
        self._register_again(placement, first, bodies, self._started_by_rigs(rigs, states, first))
        factors = self._factors(states, list(first.problem.cameras))
        second, bodies = self._refined(placement, first, bodies, factors, rigs)
        self._begin("verify")
        solution, refused = self._judged(placement, second, bodies)
        adjustment = adjustment_of(
            self.survey,
            placement,
            solution,
            refused,
            rigs=rigs,
            options=plain(asdict(self.options)),
            inputs=inputs.documents,
        )
        return Solved(adjustment_from(adjustment, origin), tuple(states), tuple(files))

    def _states(self, headers: Mapping[str, PhotoHeader]) -> list[PhotoState]:
        self._begin("features")
        report, states = self._reporter(len(headers)), []
        waiting = {
            self.workers.submit(photo_features, one.files, self.cache.folder, self.cache.most_bytes): name
            for name, one in headers.items()
        }
        for future in finished(waiting, self._tick):
            report(f"features of {waiting[future]}")
        for given, one, future in zip(self.survey.photos, headers.values(), waiting, strict=True):
            states.append(PhotoState(given, one.files, one.orientation, future.result(), one.camera, one.assumed))
        return states

    def _matches(self, states: list[PhotoState]) -> dict[tuple[int, int], Any]:
        self._begin("matches")
        pairs = propose_pairs([one.features for one in states])
        report = self._reporter(len(pairs))
        waiting = {
            self.workers.submit(
                pair_matches, states[i].files, states[j].files, self.cache.folder, self.cache.most_bytes
            ): (i, j)
            for i, j in pairs
        }
        for future in finished(waiting, self._tick):
            i, j = waiting[future]
            report(f"{states[i].given.id} and {states[j].given.id}")
        return {pair: future.result() for future, pair in waiting.items() if len(future.result())}

    def _with_drawn(
        self, states: list[PhotoState], matches: dict[tuple[int, int], IntArray]
    ) -> tuple[dict[tuple[int, int], IntArray], DrawnEnds]:
        """Give photographs the ends of the ties that were drawn as features, and return all matches, and which are."""
        index = {one.given.id: k for k, one in enumerate(states)}
        ties = [((index[one.photos[0]], index[one.photos[1]]), np.array(one.uv), one.sigma_px)
                for one in self.survey.ties]  # fmt: skip
        features, joined, drawn = with_drawn([one.features for one in states], matches, ties)
        for state, own in zip(states, features, strict=True):
            state.features = own
        return joined, drawn

    # -- the adjustment --------------------------------------------------------------------------------------------

    def _factors(self, states: list[PhotoState], cameras: list[CameraUnknowns]) -> dict[tuple[int, int], RelativePose]:
        index = {camera.id: k for k, camera in enumerate(self.survey.cameras)}
        return {
            (k, scan): pair_factor(result, state, cameras[index[state.given.camera]].size)
            for k, state in enumerate(states) for scan, result in state.pairs.items()
        }  # fmt: skip

    def _adjusted(
        self, placement: Placement, cameras: list[CameraUnknowns], factors: Mapping[tuple[int, int], RelativePose]
    ) -> tuple[Adjusted, Bodies]:
        """Adjust from the registrations and the poses that features gave."""
        states = placement.states
        poses = {k: one.pose for k, one in enumerate(states) if one.pose is not None}
        problem, bodies = build_problem(self.survey, placement, cameras, poses, factors)
        adjusted = solve(_determined(with_ties(problem, bodies, placement)), tick=self._tick)
        self._laser(placement, adjusted, bodies)
        adjusted = solve(with_ties(adjusted.problem, bodies, placement), tick=self._tick)
        for photo, body in bodies.photos.items():
            states[photo].pose = adjusted.problem.poses[body]
        self._start_others(placement, adjusted)
        return adjusted, bodies

    def _start_others(self, placement: Placement, adjusted: Adjusted) -> None:
        """Give photographs without a pose the one that the adjusted ones imply, with the adjusted cameras."""
        cameras = self._cameras_now(adjusted)
        for k, state in enumerate(placement.states):
            if state.pose is None:
                state.camera = self._camera_of(state, cameras)
                state.pose = placement.pose_from_features(k)

    def _started_by_rigs(self, rigs: Rigs, states: list[PhotoState], adjusted: Adjusted) -> list[int]:
        """Give photographs without a pose that which a verified one of the same frame implies, and return them."""
        cameras, found = self._cameras_now(adjusted), []
        for k, state in enumerate(states):
            if state.pose is None and (pose := start_from_rig(rigs, k, states)) is not None:
                state.camera, state.pose = self._camera_of(state, cameras), pose
                found.append(k)
        return found

    def _register_again(self, placement: Placement, adjusted: Adjusted, bodies: Bodies, photos: Sequence[int]) -> None:
        """Register photographs that have a pose with their adjusted cameras on all scans near them."""
        cameras, tasks = self._cameras_now(adjusted), {}
        for k in photos:
            state = placement.states[k]
            assert state.pose is not None
            camera = self._camera_of(state, cameras)
            for scan in placement.nearest_scans(state.pose):
                world = placement.stations.each[scan].world_from_scanner or Rigid.identity()
                if bodies.scans[scan] >= 0:
                    world = adjusted.problem.poses[bodies.scans[scan]].inverse
                tasks[k, scan] = PairTask(
                    photo=state.files, scan=placement.scans[scan], options=self.options, camera=camera,
                    initial=state.pose @ world, near=True,
                )  # fmt: skip
        report = self._reporter(len(tasks))
        waiting = {self.workers.submit(registered, task): key for key, task in tasks.items()}
        for k, state in enumerate(placement.states):
            if k in photos or state.pose is None:
                state.pairs = {}
        for future in finished(waiting, self._tick):
            k, scan = waiting[future]
            report(f"{placement.states[k].given.id} on scan {scan + 1}")
        for future, (k, scan) in waiting.items():
            try:
                result = future.result()
            except LadarregError as error:
                placement.states[k].reasons = (str(error),)
            else:
                if result.accepted:
                    placement.states[k].pairs[scan] = result
                elif not placement.states[k].reasons:
                    placement.states[k].reasons = result.reasons

    def _refined(
        self, placement: Placement, first: Adjusted, bodies: Bodies, factors: Mapping[tuple[int, int], RelativePose],
        rigs: Rigs,
    ) -> tuple[Adjusted, Bodies]:  # fmt: skip
        """Adjust again from the second registrations, with photographs that rest on ties alone."""
        poses = {k: one.pose for k, one in enumerate(placement.states) if one.pose is not None}
        stations = placement.stations
        moved = tuple(
            replace(one, world_from_scanner=first.problem.poses[body].inverse) if body >= 0 else one
            for one, body in zip(stations.each, bodies.scans, strict=True)
        )
        placement.stations = replace(stations, each=moved)
        cameras = list(first.problem.cameras)
        problem, bodies = build_problem(self.survey, placement, cameras, poses, factors)
        problem = replace(problem, relative=(*problem.relative, *rig_factors(rigs, placement.states, bodies)))
        self._laser(placement, None, bodies, problem)
        problem = _determined(with_ties(problem, bodies, placement))
        adjusted = solve(problem, tick=self._tick)
        self._laser(placement, adjusted, bodies)
        again = with_ties(adjusted.problem, bodies, placement)
        return replace(adjusted, problem=again), bodies

    def _laser(
        self, placement: Placement, adjusted: Adjusted | None, bodies: Bodies, problem: Problem | None = None
    ) -> None:
        """Find the places on the surfaces again, at the present poses, on the scans that stood nearest."""
        at = problem if adjusted is None else adjusted.problem
        assert at is not None
        poses = {photo: at.poses[body] for photo, body in bodies.photos.items()}
        cameras = {photo: at.camera_of(body) for photo, body in bodies.photos.items()}
        placement.laser.clear()
        which = [(photo, scan) for photo, pose in poses.items() for scan in placement.nearest_scans(pose)]
        placement.find_laser_points(which, poses, cameras)

    # -- verdicts --------------------------------------------------------------------------------------------------

    def _judged(
        self, placement: Placement, adjusted: Adjusted, bodies: Bodies
    ) -> tuple[Solution, dict[int, tuple[str, ...]]]:
        """Take out what contradicts the rest, and photographs on ties alone that nothing verifies."""
        names = {k: one.given.id for k, one in enumerate(placement.states)}
        solution = solve_consistent(adjusted.problem, bodies, names, tick=self._tick)
        refused: dict[int, tuple[str, ...]] = {}
        while True:
            verified = {k for k in solution.bodies.photos if placement.states[k].by_image}
            candidates = [k for k in solution.bodies.photos if k not in verified]
            against = {k: self._against(placement, solution, k, verified) for k in candidates if k not in refused}
            wrong = {k: why for k, why in against.items() if why}
            if not wrong:
                return solution, refused
            problem, left = solution.adjusted.problem, solution.bodies
            for k, why in wrong.items():
                refused[k] = (why, *placement.states[k].reasons[:1])
                problem, left = without_photo(problem, left, k)
            again = solve(problem, tick=self._tick)
            moved = {k: largest_shift(solution.adjusted, solution.bodies, again, left)[0] for k in wrong}
            taken = {**solution.taken_out, **{k: TakenOut(refused[k][0], moved[k]) for k in wrong}}
            solution = Solution(again, left, taken)

    def _against(self, placement: Placement, solution: Solution, photo: int, verified: set[int]) -> str:
        """Return why a photograph on ties alone is not accepted, as a sentence; empty: it is."""
        adjusted, bodies = solution.adjusted, solution.bodies
        ties, body = count_ties(adjusted, bodies, photo), bodies.photos[photo]
        by_rig = is_held_by_rig(adjusted, body)
        reason = "" if by_rig else ties.reason_against(verified)
        if reason:
            return reason
        pose, camera = adjusted.problem.poses[body], adjusted.problem.camera_of(body)
        sources = tuple(
            (placement.states[k].files, adjusted.problem.camera_of(at), adjusted.problem.poses[at])
            for k in ties.partners if k in verified for at in (bodies.photos[k],)
        )  # fmt: skip
        surfaces = tuple(
            (placement.scans[k], adjusted.problem.poses[bodies.scans[k]])
            for k in placement.nearest_scans(pose) if bodies.scans[k] >= 0
        )  # fmt: skip
        state = placement.states[photo]
        task = PairTask(
            photo=state.files, scan=placement.scans[0], options=self.options, camera=camera, initial=pose, near=True
        )
        self._reporter(1)(f"{state.given.id} against the colours of {len(sources)} photographs")
        future = self.workers.submit(verified_by_colors, task, sources, surfaces)
        result = next(finished([future], self._tick)).result()
        if by_rig and (result is None or not result.accepted):
            return ""  # nothing can be compared, and nothing contradicts
        if result is None:
            return "Too little of the surface that it shows is coloured by verified photographs to compare it with."
        if not result.accepted:
            return (
                f"The colours of the surface do not verify it: {result.reasons[0][:1].lower()}{result.reasons[0][1:]}"
            )
        return _contradicted_by(result, pose, adjusted.covariance_of(body))

    # -- cameras -------------------------------------------------------------------------------------------------

    def _cameras_now(self, adjusted: Adjusted) -> dict[str, CameraUnknowns]:
        return dict(zip((one.id for one in self.survey.cameras), adjusted.problem.cameras, strict=True))

    def _camera_of(self, state: PhotoState, cameras: Mapping[str, CameraUnknowns]) -> CameraModel:
        unknowns = cameras[state.given.camera]
        return photo_view(state, 0, unknowns).camera_at(unknowns.values)

    # -- progress --------------------------------------------------------------------------------------------------

    def _begin(self, stage: str) -> None:
        names = list(_STAGES)
        before = names.index(stage) - 1
        self.stage = (0.0 if before < 0 else _STAGES[names[before]], _STAGES[stage])

    def _part(self, stage: str) -> Report | None:
        self._begin(stage)
        return part_of(self._receive, *self.stage)

    def _receive(self, progress: Progress) -> None:
        self.latest = progress
        self._tick()

    def _tick(self) -> None:
        """Report the latest progress again, so that work which takes long can be stopped."""
        if self.report is not None:
            self.report(self.latest)

    def _reporter(self, total: int) -> Callable[[str], None]:
        """Return a function that reports one more of the units of this stage, by its label."""
        part, done = part_of(self._receive, *self.stage), 0

        def report(label: str) -> None:
            nonlocal done
            done += 1
            if part is not None:
                part(Progress(min(done, total), total, label))

        return report


def _determined(problem: Problem) -> Problem:
    """Return the problem with what is known so weakly of bodies without any relation that it can be solved.

    A photograph on ties alone may have lost all of them.
    """
    weak = np.eye(6)  # 1 rad, 1 m
    related = {one.body for one in problem.relative}
    more = [
        RelativePose(body, WORLD, pose, weak, name="its start")
        for body, (pose, view) in enumerate(zip(problem.poses, problem.views, strict=True))
        if view is not None and body not in related
    ]  # fmt: skip
    return replace(problem, relative=(*problem.relative, *more))


def _contradicted_by(result: Registration, pose: Rigid, covariance: Any) -> str:
    """Return a sentence if a registration on the coloured surface is elsewhere than a pose; else an empty text."""
    view = result.world_from_scanner
    assert view is not None
    found = result.camera_from_scanner @ view.inverse
    turn = np.eye(6)
    turn[3:, 3:] = view.rotation
    floor = np.diag([_ROUGH_RAD**2] * 3 + [_ROUGH_M**2] * 3)
    of_both = covariance + turn @ np.asarray(result.covariance) @ turn.T + floor
    off = pose_difference(found, pose)
    if float(off @ np.linalg.solve(of_both, off)) <= _DIFFERS:
        return ""
    return (
        f"The colours of the surface verify another pose, {1000 * np.linalg.norm(off[3:]):.0f} mm and "
        f"{np.degrees(np.linalg.norm(off[:3])):.2f} deg away."
    )
