"""The estimators: linear, robust, and the judgement of a pose by the pictures."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import TYPE_CHECKING

from ladarreg_core.errors import OptionError
from ladarreg_core.project.edits import with_pose
from ladarreg_core.project.results import pose_entry, pose_of

from ..messages import matches as matches_in_words
from ..messages import verdict
from .inputs import Bench, Inputs
from .runner import JobContext

if TYPE_CHECKING:
    from ladarreg_core.project.document import StageId
    from ladarreg_core.results import PoseResult

STAGE_NAMES: dict[StageId, str] = {
    "linear": "Linear",
    "constrained_linear": "Constrained linear",
    "simplex": "Simplex",
    "simplex_outliers_removed": "Simplex, outliers removed",
    "robust": "Robust",
    "auto": "Automatic",
    "thesis": "Thesis, whole chain",
    "carried": "Carried over",
}


class SolvingJobs:
    """The jobs of the step Solve that need no watching."""

    def __init__(self, bench: Bench) -> None:
        self._bench = bench

    def linear(self, inputs: Inputs, context: JobContext) -> str:
        """Solve the linear system of the thesis; after a second search it is the constrained one."""
        from ladarreg_core.pose.estimate import solve_pose

        begun = time.perf_counter()
        options = replace(inputs.settings.pose_options, method="linear", intrinsics="fixed")
        result = solve_pose(inputs.matches(), inputs.photo.camera, options)
        stage: StageId = "constrained_linear" if context.job.kind == "constrained" else "linear"
        return self.keep(inputs, stage, result, context, method="thesis", seconds=time.perf_counter() - begun)

    def robust(self, inputs: Inputs, context: JobContext) -> str:
        """Solve all matches by the default estimator and judge the answer from many starts."""
        import ladarreg_core as lr

        _ = inputs.matches()  # which says what is missing before any work
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
        return self.keep(inputs, "robust", result, context)

    def verify(self, inputs: Inputs, context: JobContext) -> str:
        """Ask the pictures whether they agree under the shown pose."""
        from ladarreg_core.matching.aligner import verify_pose

        pose = inputs.entry.pose
        if pose is None:
            raise OptionError("there is no pose to verify; solve first")
        answer = self._bench.room.answer(pose)
        photo = replace(inputs.photo, camera=answer.camera)
        found = verify_pose(inputs.scan, photo, answer.camera_from_scanner, seed=inputs.settings.seed)
        context.check()
        if found is None:
            return "The scan shows too little here that could be compared with the photograph."
        said = " ".join(found.reasons)
        if not found.accepted:
            return f"The pictures do not confirm this pose: {said}"
        figures = {**found.as_dict(), "regions": [list(region) for region in found.regions]}
        judged = replace(
            answer,
            accepted=True,
            evidence="image",
            reasons=(*found.reasons, *answer.reasons),
            diagnostics={**answer.diagnostics, "verification": figures},
        )
        self.keep(inputs, pose.stage, judged, context, of_picks=False)
        return f"The pictures confirm this pose. {said}"

    def keep(
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
        """Commit an answer and return it in words."""
        entry = pose_entry(stage, result, method=method, seconds=seconds, note=note)
        self._bench.commit(
            inputs,
            f"Solve: {STAGE_NAMES[stage].lower()}",
            lambda photo: with_pose(photo, entry),
            author=context.job.author,
            of_picks=of_picks,
        )
        return f"{STAGE_NAMES[stage]}: {matches_in_words(result)}. {verdict(result)}"
