"""The solving jobs: linear and robust estimators, and the verification of a pose against the images."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from ladarreg_core.errors import OptionError
from ladarreg_core.project.edits import with_pose, without_stage
from ladarreg_core.project.results import pose_entry, pose_of
from ladarreg_core.results.registration import STAGE_LABELS
from ladarreg_core.results.steps import StepLog

from ..messages import matches, verdict
from .inputs import Inputs, Workspace
from .runner import JobContext

if TYPE_CHECKING:
    from ladarreg_core.matching.image_check import Proposal
    from ladarreg_core.project.document import PhotoEntry
    from ladarreg_core.registration.register import MatchesRegistered
    from ladarreg_core.results.registration import PoseResult, StageId
    from ladarreg_core.results.steps import StepReport

FROM_IMAGES = ("refined", "auto", "survey", "carried")
"""Stages whose pose does not come from the matches."""


class SolveJobs:
    """The jobs of the step Solve except the simplex."""

    def __init__(self, workspace: Workspace) -> None:
        self._workspace = workspace

    def linear(self, inputs: Inputs, context: JobContext) -> str:
        """Solve the linear system of the thesis; after guided matching, the result is the constrained one."""
        from ladarreg_core.pose.estimate import solve_pose

        begun = time.perf_counter()
        options = replace(inputs.settings.pose_options, method="linear", intrinsics="fixed")
        result = solve_pose(inputs.matches(), inputs.photo.camera, options, assumed=inputs.photo.assumed)
        stage: StageId = "constrained_linear" if context.job.kind == "constrained" else "linear"
        return self.commit(inputs, stage, result, context, method="thesis", seconds=time.perf_counter() - begun)

    def robust(self, inputs: Inputs, context: JobContext) -> str:
        """Solve all matches by the default estimator, and show the pose as they were drawn."""
        return self._solve(inputs, context, "drawn")

    def solve(self, inputs: Inputs, context: JobContext) -> str:
        """Solve all matches by the default estimator, and refine the pose against the images: one verdict."""
        return self._solve(inputs, context, "refined")

    def _solve(self, inputs: Inputs, context: JobContext, proposal: Proposal) -> str:
        found = self.solved(inputs, context.step)
        context.check()
        note = self.note_on_start(inputs)
        shown = found.proposed(proposal)
        self._workspace.commit(
            inputs,
            "Solve from matches",
            self.with_solution(inputs, found, proposal=proposal, note=note),
            author=context.job.author,
            of_picks=True,
        )
        return " ".join(filter(None, [f"{matches(shown)}. {verdict(shown)}", note]))

    def note_on_start(self, inputs: Inputs) -> str:
        """Return what there is to say about the pose that solving starts from; empty: nothing."""
        return inputs.note_on_start if inputs.entry.pose is None else ""

    def verify(self, inputs: Inputs, context: JobContext) -> str:
        """Verify the shown pose against the images; whatever the outcome, it is stored with the pose."""
        from ladarreg_core.matching.image_check import check_against_images, refined_pose, with_image_check

        pose = inputs.entry.pose
        if pose is None:
            raise OptionError("there is no pose to verify; solve first")
        result = self._workspace.loader.registration(pose)
        steps = StepLog(context.step)
        settings = inputs.settings
        prior = settings.pose_options.camera_prior
        check = check_against_images(inputs.scan, inputs.photo, result, steps, seed=settings.seed, prior=prior)
        checked = replace(with_image_check(result, check), steps=(*result.steps, *steps.steps))
        refined = refined_pose(checked, check) if pose.stage not in FROM_IMAGES else None
        context.check()
        picks = self._workspace.loader.solved_on(pose)

        def kept(photo: PhotoEntry) -> PhotoEntry:
            photo = with_pose(
                photo, pose_entry(pose.stage, checked, picks=picks, clouds=pose.clouds, ranges=pose.ranges), shown=False
            )
            if refined is None:
                return photo
            entry = pose_entry(
                "refined", refined, picks=picks, method=pose.method, clouds=pose.clouds, ranges=pose.ranges
            )
            return with_pose(photo, entry, shown=False)

        label = f"Verify: {STAGE_LABELS[pose.stage].lower()}"
        self._workspace.commit(inputs, label, kept, author=context.job.author)
        return f"{verdict(checked)} {check.sentence}"

    def solved(self, inputs: Inputs, report: StepReport) -> MatchesRegistered:
        """Return the solution of the matches, and the pose that the images verify."""
        from ladarreg_core.registration.register import register_matches

        _ = inputs.matches()  # raises if matches are missing
        pose = inputs.entry.pose
        return register_matches(
            inputs.scan,
            inputs.photo,
            inputs.picks,
            initial=inputs.stated_pose if pose is None else pose_of(pose),
            options=inputs.settings.register_options,
            report=report,
        )

    def with_solution(
        self, inputs: Inputs, found: MatchesRegistered, *, proposal: Proposal, note: str
    ) -> Callable[[PhotoEntry], PhotoEntry]:
        """Return the edit that stores a solution, and shows the pose that is proposed of it."""
        how: dict[str, Any] = {
            "picks": inputs.entry.picks,
            "note": note,
            "clouds": inputs.clouds,
            "ranges": inputs.document.ranges,
        }
        drawn = pose_entry("robust", found.drawn, **how)
        refined = None if found.refined is None else pose_entry("refined", found.refined, **how)
        shows_refined = found.proposed(proposal) is found.refined

        def solved(photo: PhotoEntry) -> PhotoEntry:
            photo = with_pose(without_stage(photo, "refined"), drawn)
            return photo if refined is None else with_pose(photo, refined, shown=shows_refined)

        return solved

    def commit(
        self,
        inputs: Inputs,
        stage: StageId,
        result: PoseResult,
        context: JobContext,
        *,
        method: str = "manual",
        seconds: float = 0.0,
        note: str = "",
        of_picks: bool = True,
    ) -> str:
        """Commit a result, show its stage, and return a summary; `of_picks`: whether it was solved on the picks."""
        from ladarreg_core.picks.lengths import with_lengths_checked

        if of_picks:
            tolerance_m = inputs.settings.register_options.match_tolerance_m
            result = with_lengths_checked(result, inputs.scan, inputs.picks, tolerance_m=tolerance_m)
        result = replace(result, world_from_scanner=inputs.scan.world_from_scanner)
        picks = inputs.entry.picks if of_picks else None
        entry = pose_entry(
            stage,
            result,
            picks=picks,
            method=method,
            seconds=seconds,
            note=note,
            clouds=inputs.clouds,
            ranges=inputs.document.ranges,
        )
        self._workspace.commit(
            inputs,
            f"Solve: {STAGE_LABELS[stage].lower()}",
            lambda photo: with_pose(photo, entry),
            author=context.job.author,
            of_picks=of_picks,
        )
        return f"{STAGE_LABELS[stage]}: {matches(result)}. {verdict(result)}"
