"""The solving jobs: linear and robust estimators, and the verification of a pose against the images."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import TYPE_CHECKING

from ladarreg_core.errors import OptionError
from ladarreg_core.project.edits import with_pose
from ladarreg_core.project.results import pose_entry, pose_of
from ladarreg_core.results import STAGE_LABELS

from ..messages import matches, verdict
from .inputs import Inputs, Workspace
from .runner import JobContext

if TYPE_CHECKING:
    from ladarreg_core.results import PoseResult, StageId


class SolveJobs:
    """The jobs of the step Solve except the simplex."""

    def __init__(self, workspace: Workspace) -> None:
        self._workspace = workspace

    def linear(self, inputs: Inputs, context: JobContext) -> str:
        """Solve the linear system of the thesis; after guided matching, the result is the constrained one."""
        from ladarreg_core.pose.estimate import solve_pose

        begun = time.perf_counter()
        options = replace(inputs.settings.pose_options, method="linear", intrinsics="fixed")
        result = solve_pose(inputs.matches(), inputs.photo.camera, options)
        stage: StageId = "constrained_linear" if context.job.kind == "constrained" else "linear"
        return self.commit(inputs, stage, result, context, method="thesis", seconds=time.perf_counter() - begun)

    def robust(self, inputs: Inputs, context: JobContext) -> str:
        """Solve all matches by the default estimator, and check the result from many starting poses."""
        import ladarreg_core as lr

        _ = inputs.matches()  # raises if matches are missing
        pose = inputs.entry.pose
        initial = None if pose is None else pose_of(pose)
        result = lr.register(
            inputs.scan,
            inputs.photo,
            method="manual",
            picks=inputs.picks,
            initial=initial,
            options=inputs.settings.register_options,
            report=context.step,
        )
        return self.commit(inputs, "robust", result, context)

    def verify(self, inputs: Inputs, context: JobContext) -> str:
        """Verify the shown pose against the images."""
        from ladarreg_core.matching.aligner import verify_pose

        pose = inputs.entry.pose
        if pose is None:
            raise OptionError("there is no pose to verify; solve first")
        result = self._workspace.loader.registration(pose)
        photo = replace(inputs.photo, camera=result.camera)
        found = verify_pose(inputs.scan, photo, result.camera_from_scanner, seed=inputs.settings.seed)
        context.check()
        if found is None:
            return "Undecidable: the scan shows too little texture here to compare with the photograph."
        reasons = " ".join(found.reasons)
        if not found.accepted:
            return f"The images do not confirm this pose: {reasons}"
        figures = {**found.as_dict(), "regions": [list(region) for region in found.regions]}
        verified = replace(
            result,
            accepted=True,
            evidence="image",
            reasons=(*found.reasons, *result.reasons),
            diagnostics={**result.diagnostics, "verification": figures},
        )
        entry = pose_entry(pose.stage, verified, picks=self._workspace.loader.solved_on(pose))
        self._workspace.commit(
            inputs,
            f"Verify: {STAGE_LABELS[pose.stage].lower()}",
            lambda photo: with_pose(photo, entry, shown=False),
            author=context.job.author,
        )
        return f"The images confirm this pose. {reasons}"

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
        picks = inputs.entry.picks if of_picks else None
        entry = pose_entry(stage, result, picks=picks, method=method, seconds=seconds, note=note)
        self._workspace.commit(
            inputs,
            f"Solve: {STAGE_LABELS[stage].lower()}",
            lambda photo: with_pose(photo, entry),
            author=context.job.author,
            of_picks=of_picks,
        )
        return f"{STAGE_LABELS[stage]}: {matches(result)}. {verdict(result)}"
