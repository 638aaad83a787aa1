"""The simplex, watched: every step can be seen, slowed down, paused and stopped, and the best is kept."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from ladarreg_core.errors import DegenerateGeometryError, OptionError
from ladarreg_core.project.results import pose_of

from .inputs import Bench, Inputs
from .runner import JobContext
from .solve import SolvingJobs

if TYPE_CHECKING:
    from ladarreg_core.frames import Rigid
    from ladarreg_core.matches import Matches
    from ladarreg_core.pose.thesis.stereo_simplex import DescentStep, SimplexFit
    from ladarreg_core.results import PoseResult

FIRST_SPEED = 60.0
"""Iterations a second at first: slow enough to be followed by eye."""
_SHOWN_EVERY_S = 1 / 20
_MOST_SLEEP_S = 0.2


@dataclass(frozen=True, slots=True)
class Frame:
    """One moment of the simplex, for those who watch."""

    photo: str
    matches: Matches
    inputs: Inputs
    step: DescentStep
    last: bool


Watch = Callable[[Frame], None]


class SimplexJobs:
    """The simplex with and without its rejections."""

    def __init__(self, bench: Bench, solving: SolvingJobs, watch: Watch) -> None:
        self._bench = bench
        self._solving = solving
        self._watch = watch

    def simplex(self, inputs: Inputs, context: JobContext) -> str:
        """Walk down the cost of all matches."""
        return self._walk(inputs, context, rejecting=False)

    def reject_outliers(self, inputs: Inputs, context: JobContext) -> str:
        """Leave out what lies off, and walk again, until the same matches stay."""
        return self._walk(inputs, context, rejecting=True)

    def _walk(self, inputs: Inputs, context: JobContext, *, rejecting: bool) -> str:
        from ladarreg_core.pose.estimate import STATED_SIGMA_PX
        from ladarreg_core.pose.simplex_result import simplex_answer
        from ladarreg_core.pose.thesis.stereo_simplex import descend

        begun = time.perf_counter()
        matches = inputs.matches()
        pose_options = replace(inputs.settings.pose_options, intrinsics="fixed")
        options = inputs.settings.simplex_options
        if not rejecting:
            options = replace(options, reject_rounds=0)
        steps = descend(
            matches,
            inputs.photo.camera,
            options,
            initial=self._start(inputs, matches, rejecting),
            sigma_px=pose_options.sigma_px or STATED_SIGMA_PX,
        )
        found = self._watched(steps, inputs, matches, context)
        result = simplex_answer(found, matches, inputs.photo.camera, pose_options)
        stopped = " Stopped; the best so far is kept." if context.stop_wanted else ""
        said = self._solving.keep(
            inputs,
            "simplex_outliers_removed" if rejecting else "simplex",
            result,
            context,
            method="thesis",
            seconds=time.perf_counter() - begun,
            note=found.in_words(),
        )
        return said + stopped

    def _start(self, inputs: Inputs, matches: Matches, rejecting: bool) -> Rigid | None:
        from ladarreg_core.inspection.figures import pose_at_scanner
        from ladarreg_core.pose.estimate import solve_pose

        if rejecting:
            before = inputs.entry.stage("simplex")
            return None if before is None else pose_of(before)
        wanted = inputs.settings.start_from
        if wanted == "linear":
            return None  # which is the linear pose, or one aimed at the matches where that is refused
        if wanted == "scanner":
            return pose_at_scanner(inputs.scan)
        if wanted == "shown":
            if inputs.entry.pose is None:
                raise OptionError("no pose is shown that the simplex could start from; choose another start")
            return pose_of(inputs.entry.pose)
        try:
            options = replace(inputs.settings.pose_options, intrinsics="fixed")
            robust: PoseResult = solve_pose(matches, inputs.photo.camera, options)
        except DegenerateGeometryError:
            return None
        return robust.camera_from_scanner

    def _watched(
        self, steps: Generator[DescentStep, None, SimplexFit], inputs: Inputs, matches: Matches, context: JobContext
    ) -> SimplexFit:
        """Walk to the end, or until it is stopped, and show what there is time for; the last step always."""
        from ladarreg_core.pose.thesis.stereo_simplex import stopped_at

        shown = due = time.monotonic()
        last: DescentStep | None = None
        while True:
            try:
                step = next(steps)
            except StopIteration as end:
                if last is not None:
                    self._show(inputs, matches, last, context, last=True)
                found: SimplexFit = end.value
                return found
            last = step
            clock = time.monotonic()
            if clock - shown >= _SHOWN_EVERY_S or step.simplex.move == "start" or context.job.state == "paused":
                shown = clock
                self._show(inputs, matches, step, context, last=False)
            context.wait_while_paused()
            if context.stop_wanted:
                self._show(inputs, matches, step, context, last=True)
                return stopped_at(step)
            if context.speed > 0:
                due = max(due + 1 / context.speed, clock - _MOST_SLEEP_S)
                if due > clock:
                    context.sleep(min(due - clock, 1.0))

    def _show(self, inputs: Inputs, matches: Matches, step: DescentStep, context: JobContext, *, last: bool) -> None:
        job = context.job
        job.done = step.simplex.iteration
        job.said = f"iteration {step.simplex.iteration}, {step.simplex.move.replace('_', ' ')}"
        if step.round:
            job.said += f", rejection {step.round}"
        context.tell()
        self._watch(Frame(inputs.entry.id, matches, inputs, step, last))


def frame_event(frame: Frame) -> dict[str, Any]:
    """Return a moment as the page is told it."""
    from ladarreg_core.frames import ThesisParameters

    step = frame.step
    pose = step.camera_from_scanner
    p = ThesisParameters.from_pose(pose)
    ends: dict[str, list[Any]] = {}
    uv = frame.inputs.photo.camera.project(pose @ frame.matches.points).tolist()
    for name, at in zip(frame.matches.pick_ids, uv, strict=True):
        ends.setdefault(name, []).append(at)
    return {
        "event": "simplex",
        "photo": frame.photo,
        "iteration": step.simplex.iteration,
        "move": step.simplex.move,
        "parameters": [p.Tx, p.Ty, p.Tz, p.alpha, p.beta, p.gamma],
        "cost": step.simplex.cost,
        "inliers": int(step.inliers.sum()),
        "matches": len(frame.matches),
        "residual": step.residual,
        "round": step.round,
        "predicted": ends,
        "last": frame.last,
    }
