"""The solving jobs: linear and robust estimators, and the verification of a pose against the images."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import TYPE_CHECKING

from ladarreg_core.errors import OptionError
from ladarreg_core.progress import StepLog
from ladarreg_core.project.edits import with_pose
from ladarreg_core.project.results import pose_entry, pose_of
from ladarreg_core.results import STAGE_LABELS

from ..messages import matches, verdict
from .inputs import Inputs, Workspace
from .runner import JobContext

if TYPE_CHECKING:
    from ladarreg_core.progress import StepReport
    from ladarreg_core.results import PoseResult, Registration, StageId


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
        """Solve all matches by the default estimator, and check the result from many starting poses."""
        note = self.note_on_start(inputs)
        said = self.commit(inputs, "robust", self._robust(inputs, context.step), context, note=note)
        return " ".join(filter(None, [said, note]))

    def solve(self, inputs: Inputs, context: JobContext) -> str:
        """Solve all matches by the default estimator and verify the pose against the images: one verdict."""
        result, sentence = self.solved(inputs, context.step)
        context.check()
        note = self.note_on_start(inputs)
        self.commit(inputs, "robust", result, context, note=note)
        return " ".join(filter(None, [verdict(result), sentence, note]))

    def note_on_start(self, inputs: Inputs) -> str:
        """Return what there is to say about the pose that solving starts from; empty: nothing."""
        return inputs.note_on_start if inputs.entry.pose is None else ""

    def verify(self, inputs: Inputs, context: JobContext) -> str:
        """Verify the shown pose against the images; whatever the outcome, it is stored with the pose."""
        pose = inputs.entry.pose
        if pose is None:
            raise OptionError("there is no pose to verify; solve first")
        result, sentence = self._checked(inputs, self._workspace.loader.registration(pose), context.step)
        context.check()
        entry = pose_entry(pose.stage, result, picks=self._workspace.loader.solved_on(pose), clouds=pose.clouds)
        self._workspace.commit(
            inputs,
            f"Verify: {STAGE_LABELS[pose.stage].lower()}",
            lambda photo: with_pose(photo, entry, shown=False),
            author=context.job.author,
        )
        return f"{verdict(result)} {sentence}"

    def _robust(self, inputs: Inputs, report: StepReport) -> Registration:
        import ladarreg_core as lr

        _ = inputs.matches()  # raises if matches are missing
        pose = inputs.entry.pose
        return lr.register(
            inputs.scan,
            inputs.photo,
            method="manual",
            picks=inputs.picks,
            initial=inputs.stated_pose if pose is None else pose_of(pose),
            options=inputs.settings.register_options,
            report=report,
        )

    def solved(self, inputs: Inputs, report: StepReport) -> tuple[Registration, str]:
        """Return the robust solution with its image verification, and the sentence on that."""
        return self._checked(inputs, self._robust(inputs, report), report)

    def _checked(self, inputs: Inputs, result: Registration, report: StepReport) -> tuple[Registration, str]:
        """Return the registration with its image verification, and the sentence on that."""
        from ladarreg_core.matching.image_check import check_against_images, with_image_check

        steps = StepLog(report)
        check = check_against_images(inputs.scan, inputs.photo, result, steps, seed=inputs.settings.seed)
        checked = with_image_check(result, check)
        return replace(checked, steps=(*checked.steps, *steps.steps)), check.sentence

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
        entry = pose_entry(stage, result, picks=picks, method=method, seconds=seconds, note=note, clouds=inputs.clouds)
        self._workspace.commit(
            inputs,
            f"Solve: {STAGE_LABELS[stage].lower()}",
            lambda photo: with_pose(photo, entry),
            author=context.job.author,
            of_picks=of_picks,
        )
        return f"{STAGE_LABELS[stage]}: {matches(result)}. {verdict(result)}"
