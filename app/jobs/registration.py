"""Jobs from the images to a pose: registration, the comparison of all stages, and the self-test."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

from ladarreg_core.errors import OptionError
from ladarreg_core.project.edits import with_picks, with_pose, without_origin
from ladarreg_core.project.results import pose_entry, pose_of
from ladarreg_core.results.registration import STAGE_LABELS

from .inputs import Inputs, Workspace
from .runner import JobContext
from .solve import SolveJobs

if TYPE_CHECKING:
    from ladarreg_core.frames import Rigid
    from ladarreg_core.matches import Pick
    from ladarreg_core.project.document import PhotoEntry
    from ladarreg_core.registration.self_test.report import SelfTest
    from ladarreg_core.results.registration import PoseResult, Registration, StageId

    from ..slices.photographs import Audit, SelfTestRow
    from ..slices.photographs import SelfTest as SelfTestSlice

FOUND = "auto"
"""Origin of the picks of a whole registration."""


class RegistrationJobs:
    """Jobs that need no matches."""

    def __init__(self, workspace: Workspace, solve: SolveJobs) -> None:
        self._workspace = workspace
        self._solve = solve
        self.self_tests: dict[str, SelfTestSlice] = {}
        self._audits: dict[str, tuple[object, Audit]] = {}

    def auto(self, inputs: Inputs, context: JobContext) -> str:
        """Register from the images alone; manual matches stay as they are."""
        import ladarreg_core as lr

        pose = inputs.entry.pose
        known = pose_of(pose) if pose is not None and pose.accepted else None
        note = inputs.note_on_start if known is None else ""
        result = lr.register(
            inputs.scan,
            inputs.photo,
            initial=inputs.stated_pose if known is None else known,
            options=inputs.settings.register_options,
            report=context.step,
        )
        return self._commit(inputs, "auto", result, context, note=note)

    def refine(self, initial: Rigid) -> Callable[[Inputs, JobContext], str]:
        """Return the work of a job that registers from the images, starting from a rough pose."""

        def work(inputs: Inputs, context: JobContext) -> str:
            import ladarreg_core as lr

            options = inputs.settings.register_options
            result = lr.register(inputs.scan, inputs.photo, initial=initial, options=options, report=context.step)
            return self._commit(inputs, "auto", result, context)

        return work

    def thesis(self, inputs: Inputs, context: JobContext) -> str:
        """Register by the chain of the thesis."""
        import ladarreg_core as lr

        result = lr.register(
            inputs.scan, inputs.photo, method="thesis", options=inputs.settings.register_options, report=context.step
        )
        return self._commit(inputs, "thesis", result, context)

    def compare(self, inputs: Inputs, context: JobContext) -> str:
        """Register by every stage of the thesis and by the default method, on the same inputs."""
        from ladarreg_core.registration.comparison import compare

        picks = inputs.picks or None
        found = compare(
            inputs.scan, inputs.photo, picks=picks, options=inputs.settings.register_options, report=context.step
        )
        names: dict[str, StageId] = {"default": "robust" if picks else "auto"}
        entries = [
            pose_entry(
                names.get(column.stage.name, column.stage.name),  # type: ignore[arg-type]
                column.stage.result,
                picks=inputs.entry.picks if picks else None,
                method="thesis",
                seconds=column.seconds,
                note=column.stage.note,
                clouds=inputs.clouds,
                ranges=inputs.document.ranges,
            )
            for column in found.columns
            if column.stage.result is not None
        ]

        def kept(photo: PhotoEntry) -> PhotoEntry:
            chosen = photo.pose
            for entry in entries:
                if chosen is None or entry.stage != chosen.stage:
                    photo = with_pose(photo, entry, shown=chosen is None)
            return photo

        self._workspace.commit(inputs, "Compare all stages", kept, author=context.job.author, of_picks=bool(picks))
        missing = [f"{STAGE_LABELS[c.stage.name]}: {c.stage.note}" for c in found.columns if c.stage.result is None]
        said = f"{len(entries)} of {len(found.columns)} stages found a pose."
        chosen = inputs.entry.pose
        kept_pose = "" if chosen is None else f"The chosen pose ({STAGE_LABELS[chosen.stage]}) is still in use."
        return " ".join(filter(None, [said, kept_pose, *missing, *found.cautions]))

    def self_test(self, inputs: Inputs, context: JobContext) -> str:
        """Estimate how well the scan and the camera will register, on photos rendered from the scan."""
        from ladarreg_core.registration.self_test.report import SelfTest
        from ladarreg_core.registration.self_test.trials import run_trials

        trials = []
        for trial in run_trials(inputs.scan, inputs.photo.pinhole, report=context.progress):
            trials.append(trial)
            self.self_tests[inputs.entry.id] = _self_test_shown(SelfTest(tuple(trials)))
            context.publish(now=True)
            if context.stop_wanted:
                break
        return SelfTest(tuple(trials)).summary()

    def audit(self, inputs: Inputs, context: JobContext) -> str:
        """Judge, by the images, the pose that a file states for the photograph, or else its current one."""
        from ladarreg_core.survey.audit import audit

        entry = inputs.entry
        judged = inputs.stated_pose
        name, camera = entry.stated_by or "the scan's file", None
        if judged is None:
            if entry.pose is None:
                raise OptionError("there is no pose to judge: open a pose file with the photograph, or solve first")
            current = self._workspace.loader.registration(entry.pose)
            judged, camera, name = current.camera_from_scanner, current.camera, STAGE_LABELS[entry.pose.stage]
        found = audit(
            inputs.scan, inputs.photo, judged, camera=camera, options=inputs.settings.register_options,
            report=context.step,
        )  # fmt: skip
        self._audits[entry.id] = audited_of(entry), {"judged": name, **found.as_fields()}
        return found.sentence

    def audited(self, entry: PhotoEntry) -> Audit | None:
        """Return the last audit of a photograph; None without any, or where it has another pose by now."""
        if entry.id not in self._audits:
            return None
        of, found = self._audits[entry.id]
        return found if of == audited_of(entry) else None

    def _commit(
        self, inputs: Inputs, stage: StageId, result: Registration, context: JobContext, *, note: str = ""
    ) -> str:
        """Commit a registration with its matches; one that is not accepted, without them."""
        if not result.accepted or not len(result.matches):
            said = self._solve.commit(inputs, stage, result, context, note=note, of_picks=False)
            return " ".join(filter(None, [said, note]))
        new = _picks_of(result)

        def kept(photo: PhotoEntry) -> PhotoEntry:
            photo, ids = with_picks(without_origin(photo, {FOUND, "corner", "between corners"}), new)
            with_ids = replace(result, matches=replace(result.matches, pick_ids=ids))
            made = [pick for pick in photo.picks if pick.id in set(ids)]
            return with_pose(
                photo,
                pose_entry(stage, with_ids, picks=made, note=note, clouds=inputs.clouds, ranges=inputs.document.ranges),
            )

        label = f"Register automatically: {len(new)} matches"
        self._workspace.commit(inputs, label, kept, author=context.job.author)
        return " ".join(filter(None, [result.reasons[0] if result.reasons else "Accepted.", note]))


def audited_of(entry: PhotoEntry) -> object:
    """Return what an audit of a photograph is about."""
    pose = entry.pose
    return entry.source, entry.camera, entry.stated_pose or (None if pose is None else pose.arrays.name)


def _picks_of(result: PoseResult) -> list[Pick]:
    from ladarreg_core.matches import Pick

    matches = result.matches
    return [
        Pick(str(k), "point", ray[None], uv[None], on=bool(inlier), origin=FOUND)
        for k, (ray, uv, inlier) in enumerate(zip(matches.rays, matches.uv, result.inliers, strict=True))
    ]


def _self_test_shown(found: SelfTest) -> SelfTestSlice:
    rows: list[SelfTestRow] = [
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
    return {"sentence": found.summary(), "advice": found.advice(), "counts": found.counts(), "rows": rows}
