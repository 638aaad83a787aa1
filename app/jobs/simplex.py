"""The simplex jobs: their iterations can be watched, slowed down, paused and stopped."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Generator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from ladarreg_core.errors import DegenerateGeometryError, OptionError
from ladarreg_core.project.results import pose_of

from .inputs import Inputs
from .runner import FULL_SPEED, JobContext
from .solve import SolveJobs

if TYPE_CHECKING:
    from ladarreg_core.frames import Rigid
    from ladarreg_core.matches import Matches
    from ladarreg_core.results.registration import PoseResult
    from ladarreg_core.thesis.estimators.stereo_simplex import DescentStep, SimplexFit

    from ..slices.events import SimplexEvent

_SHOW_EVERY_S = 1 / 20
_LONGEST_DEBT_S = 0.2
"""How far the pacing may lag behind its schedule before it gives up catching up."""


@dataclass(frozen=True, slots=True)
class Frame:
    """One iteration of the simplex, for display."""

    photo: str
    matches: Matches
    inputs: Inputs
    step: DescentStep
    last: bool


Watch = Callable[[Frame], None]


class SimplexJobs:
    """The simplex with and without outlier removal.

    Args:
        solve: commits the results.
        watch: called with the iterations to display.
    """

    def __init__(self, solve: SolveJobs, watch: Watch) -> None:
        self._solve = solve
        self._watch = watch

    def simplex(self, inputs: Inputs, context: JobContext) -> str:
        """Minimise the cost over all matches."""
        return self._minimise(inputs, context, rejecting=False)

    def reject_outliers(self, inputs: Inputs, context: JobContext) -> str:
        """Remove outliers and solve again, until the set of inliers is stable."""
        return self._minimise(inputs, context, rejecting=True)

    def _minimise(self, inputs: Inputs, context: JobContext, *, rejecting: bool) -> str:
        from ladarreg_core.pose.assumed_camera import with_assumed_camera
        from ladarreg_core.pose.estimate import STATED_SIGMA_PX
        from ladarreg_core.pose.simplex_result import build_simplex_result
        from ladarreg_core.thesis.estimators.stereo_simplex import descend

        begun = time.perf_counter()
        matches = inputs.matches()
        pose_options = replace(inputs.settings.pose_options, intrinsics="fixed")
        options = inputs.settings.simplex_options
        if not rejecting:
            options = replace(options, reject_rounds=0)
        steps = descend(
            matches,
            inputs.photo.pinhole,
            options,
            initial=self._start(inputs, matches, rejecting),
            sigma_px=pose_options.sigma_px or STATED_SIGMA_PX,
        )
        found = self._watched(steps, inputs, matches, context)
        result = build_simplex_result(found, matches, inputs.photo.pinhole, pose_options)
        if inputs.photo.assumed:
            result = with_assumed_camera(result, pose_options.camera_prior)
        stopped = " Stopped; the best pose so far is kept." if context.stop_wanted else ""
        sentence = self._solve.commit(
            inputs,
            "simplex_outliers_removed" if rejecting else "simplex",
            result,
            context,
            method="thesis",
            seconds=time.perf_counter() - begun,
            note=found.describe(),
        )
        return sentence + stopped

    def _start(self, inputs: Inputs, matches: Matches, rejecting: bool) -> Rigid | None:
        from ladarreg_core.inspection.figures import pose_at_scanner
        from ladarreg_core.pose.estimate import solve_pose

        if rejecting:
            before = inputs.entry.stage("simplex")
            return None if before is None else pose_of(before)
        wanted = inputs.settings.start_from
        if wanted == "linear":
            return None  # `descend` then starts from the linear pose, or from one aimed at the matches
        if wanted == "scanner":
            return pose_at_scanner(inputs.scan)
        if wanted == "shown":
            if inputs.entry.pose is None:
                raise OptionError("no pose is shown; choose another start for the simplex, or solve first")
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
        """Iterate to the end or until stopped; show iterations at a limited rate, and always the last one."""
        from ladarreg_core.thesis.estimators.stereo_simplex import stopped_at

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
            if clock - shown >= _SHOW_EVERY_S or step.simplex.move == "start" or context.job.state == "paused":
                shown = clock
                self._show(inputs, matches, step, context, last=False)
            context.wait_while_paused()
            if context.stop_wanted:
                self._show(inputs, matches, step, context, last=True)
                return stopped_at(step)
            if context.speed != FULL_SPEED:
                due = max(due + 1 / context.speed, clock - _LONGEST_DEBT_S)
                if due > clock:
                    context.sleep(min(due - clock, 1.0))

    def _show(self, inputs: Inputs, matches: Matches, step: DescentStep, context: JobContext, *, last: bool) -> None:
        job = context.job
        job.done = step.simplex.iteration
        job.message = f"iteration {step.simplex.iteration}, {step.simplex.move.replace('_', ' ')}"
        if step.round:
            job.message += f", outlier removal {step.round}"
        context.publish()
        self._watch(Frame(inputs.entry.id, matches, inputs, step, last))


def frame_event(frame: Frame) -> SimplexEvent:
    """Return the protocol event of an iteration."""
    from ladarreg_core.frames import ThesisParameters
    from ladarreg_core.matches import count_picks

    step = frame.step
    pose = step.camera_from_scanner
    p = ThesisParameters.from_pose(pose)
    ends: dict[str, list[list[float] | None]] = {}
    uv = frame.inputs.photo.camera.project(pose @ frame.matches.points).tolist()
    for name, at in zip(frame.matches.pick_ids, uv, strict=True):
        ends.setdefault(name, []).append(at if math.isfinite(at[0]) else None)  # behind the camera it is nowhere
    inliers, matches = count_picks(frame.matches, step.inliers)
    return {
        "event": "simplex",
        "photo": frame.photo,
        "iteration": step.simplex.iteration,
        "move": step.simplex.move,
        "parameters": [p.Tx, p.Ty, p.Tz, p.alpha, p.beta, p.gamma],
        "camera_from_scanner": pose.matrix[:3].tolist(),
        "cost": step.simplex.cost,
        "inliers": inliers,
        "matches": matches,
        "residual": step.residual,
        "round": step.round,
        "predicted": {name: [of_line[0], of_line[-1]][: len(of_line)] for name, of_line in ends.items()},
        "last": frame.last,
    }
