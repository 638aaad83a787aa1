"""Whole registrations, the comparison, and the self-test."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from ladarreg_core.project.edits import with_picks, with_pose, without_origin
from ladarreg_core.project.results import pose_entry, pose_of

from .inputs import Bench, Inputs
from .runner import JobContext
from .solve import SolvingJobs

if TYPE_CHECKING:
    from ladarreg_core.matches import Pick
    from ladarreg_core.project.document import PhotoEntry, StageId
    from ladarreg_core.results import PoseResult, Registration

FOUND = "auto"
"""Origin of what `auto` found."""


class WholeJobs:
    """Jobs that go from the pictures to an answer."""

    def __init__(self, bench: Bench, solving: SolvingJobs) -> None:
        self._bench = bench
        self._solving = solving
        self.self_tests: dict[str, dict[str, Any]] = {}

    def auto(self, inputs: Inputs, context: JobContext) -> str:
        """Register from the pictures alone; drawn matches stay what they are."""
        import ladarreg_core as lr

        pose = inputs.entry.pose
        known = pose_of(pose) if pose is not None and pose.accepted else None
        result = lr.register(
            inputs.scan,
            inputs.photo,
            initial=known,
            options=inputs.settings.register_options,
            report=context.step,
        )
        return self._with_its_matches(inputs, "auto", result, context)

    def thesis(self, inputs: Inputs, context: JobContext) -> str:
        """Register by the thesis's chain."""
        import ladarreg_core as lr

        result = lr.register(
            inputs.scan, inputs.photo, method="thesis", options=inputs.settings.register_options, report=context.step
        )
        return self._with_its_matches(inputs, "thesis", result, context)

    def compare(self, inputs: Inputs, context: JobContext) -> str:
        """Answer by every stage of the thesis and by the default, on the same inputs."""
        from ladarreg_core.comparison import compare

        picks = inputs.picks or None
        found = compare(
            inputs.scan, inputs.photo, picks=picks, options=inputs.settings.register_options, report=context.step
        )
        names: dict[str, StageId] = {"default": "robust" if picks else "auto"}
        entries = [
            pose_entry(
                names.get(column.stage.name, column.stage.name),  # type: ignore[arg-type]
                column.stage.result,
                method="thesis",
                seconds=column.seconds,
                note=column.stage.note,
            )
            for column in found.columns
            if column.stage.result is not None
        ]

        def kept(photo: PhotoEntry) -> PhotoEntry:
            for entry in entries:
                photo = with_pose(photo, entry)
            return photo

        self._bench.commit(inputs, "Compare all stages", kept, author=context.job.author, of_picks=bool(picks))
        missing = [f"{c.stage.name.replace('_', ' ')}: {c.stage.note}" for c in found.columns if c.stage.result is None]
        return " ".join([f"{len(entries)} of {len(found.columns)} stages have an answer.", *missing, *found.cautions])

    def self_test(self, inputs: Inputs, context: JobContext) -> str:
        """Try the scan and the camera on photographs made from the scan itself."""
        from ladarreg_core.self_test.report import SelfTest
        from ladarreg_core.self_test.trials import run_trials

        trials = []
        for trial in run_trials(inputs.scan, inputs.photo.camera, report=context.progress):
            trials.append(trial)
            self.self_tests[inputs.entry.id] = _self_test_shown(SelfTest(tuple(trials)))
            context.tell(now=True)
            if context.stop_wanted:
                break
        return SelfTest(tuple(trials)).summary()

    def _with_its_matches(self, inputs: Inputs, stage: StageId, result: Registration, context: JobContext) -> str:
        """Commit an answer with the matches that speak for it; of one that is not accepted, the answer alone."""
        if not result.accepted or not len(result.matches):
            return self._solving.keep(inputs, stage, result, context, of_picks=False)
        new = _picks_of(result)

        def kept(photo: PhotoEntry) -> PhotoEntry:
            photo, ids = with_picks(without_origin(photo, {FOUND, "corner", "between corners"}), new)
            named = replace(result, matches=replace(result.matches, pick_ids=ids))
            return with_pose(photo, pose_entry(stage, named))

        label = f"Register automatically: {len(new)} matches"
        self._bench.commit(inputs, label, kept, author=context.job.author)
        return f"{result.reasons[0] if result.reasons else 'Accepted.'}"


def _picks_of(result: PoseResult) -> list[Pick]:
    from ladarreg_core.matches import Pick

    matches = result.matches
    return [
        Pick(str(k), "point", ray[None], uv[None], on=bool(inlier), origin=FOUND)
        for k, (ray, uv, inlier) in enumerate(zip(matches.rays, matches.uv, result.inliers, strict=True))
    ]


def _self_test_shown(found: Any) -> dict[str, Any]:
    rows = [
        {
            "kind": trial.kind,
            "right": trial.right,
            "accepted": trial.accepted,
            "error_mm": trial.error_mm,
            "error_deg": trial.error_deg,
            "error_px": trial.error_px,
            "off_deg": trial.off_deg,
            "seconds": trial.seconds,
        }
        for trial in found.trials
    ]
    return {"sentence": found.summary(), "advice": found.advice(), "rows": rows}
