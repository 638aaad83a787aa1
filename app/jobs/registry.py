"""The registry of jobs by name, with their labels and controls."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ladarreg_core.errors import OptionError
from ladarreg_core.frames import Rigid
from ladarreg_core.project.edits import require_photo
from ladarreg_core.project.history import Author

from .automatic import IDLE, AutomaticSolver
from .export import ExportJobs, download_name
from .hand_over import HAND_OVER, HandOverJobs, Wanted
from .inputs import Inputs, Workspace
from .matching import MatchingJobs
from .registration import RegistrationJobs
from .runner import FULL_SPEED, WATCHED_SPEED, Control, JobContext, JobRunner
from .simplex import Frame, SimplexJobs, frame_event
from .solve import SolveJobs

if TYPE_CHECKING:
    from ladarreg_core.export.output_frame import FrameName
    from ladarreg_core.project.document import PhotoEntry

Work = Callable[[Inputs, JobContext], str]
_WATCHED: tuple[Control, ...] = ("pause", "stop", "speed", "step")


@dataclass(frozen=True, slots=True)
class JobKind:
    """A kind of job."""

    label: str
    work: Work
    can: tuple[Control, ...] = ("stop",)
    speed: float = FULL_SPEED


class JobRegistry:
    """Starts jobs by name, and holds their results that are not part of the document.

    Args:
        workspace: provides inputs and commits results.
        runner: runs the jobs.
        watch: called with the iterations of the simplex.
        publish_event: sends an event to all clients.
        on_change: called when automatic solving starts and ends; None: there is none.
    """

    def __init__(
        self,
        workspace: Workspace,
        runner: JobRunner,
        watch: Callable[[Frame], None],
        publish_event: Callable[[dict[str, Any]], None],
        on_change: Callable[[], None] | None,
    ) -> None:
        self._workspace, self._runner, self._publish_event = workspace, runner, publish_event
        self._watch = watch
        self._matching = MatchingJobs(workspace)
        solve = SolveJobs(workspace)
        self._automatic = AutomaticSolver(workspace, runner, solve, on_change) if on_change else None
        simplex = SimplexJobs(solve, self._show_frame)
        self._registration = RegistrationJobs(workspace, solve)
        self._exports = ExportJobs(workspace)
        self._hand_over = HandOverJobs(workspace, self._exports)
        self._kinds = {
            "find_corners": JobKind("Find corners", self._matching.find_corners),
            "match": JobKind("Match corners", self._matching.match),
            "cull": JobKind("Filter by disparity", self._matching.cull),
            "linear": JobKind("Linear solution", solve.linear),
            "constrained": JobKind("Guided matching", self._constrained(solve)),
            "densify": JobKind("Lines between matches", self._matching.densify),
            "simplex": JobKind("Simplex", simplex.simplex, _WATCHED, WATCHED_SPEED),
            "reject_outliers": JobKind("Remove outliers", simplex.reject_outliers, _WATCHED, 4 * WATCHED_SPEED),
            "solve": JobKind("Solve from matches", solve.solve),
            "robust": JobKind("Robust solution", solve.robust),
            "verify": JobKind("Verify against the images", solve.verify),
            "auto": JobKind("Register automatically", self._registration.auto),
            "thesis": JobKind("Thesis chain", self._registration.thesis),
            "compare": JobKind("Compare all stages", self._registration.compare),
            "self_test": JobKind("Self-test", self._registration.self_test),
            "export": JobKind("Export", self._export_zip_in("scanner")),
            "report": JobKind("Report", self._write_report),
        }

    def run(
        self, name: str, photo: object, author: Author, *, last_solved: bool = False, frame: object = "scanner"
    ) -> str:
        """Start a job and return its id; `last_solved` lets an export write a pose that is out of date.

        `frame` is that of the models that an export writes.

        Raises:
            LadarregError: if there is no such job, an input is missing, or another job is running.
        """
        kind = self._kinds.get(name)
        if kind is None:
            raise OptionError(f"there is no job {name[:40]!r}")
        if name == "export":
            self._require_current(photo, last_solved=last_solved)
            kind = replace(kind, work=self._export_zip_in(self._frame(photo, frame)))
        return self._start(name, kind, photo, author)

    def run_refine(self, photo: object, author: Author, initial: Rigid) -> str:
        """Start a registration from a rough pose; raises as `run`."""
        kind = JobKind("Refine the rough pose", self._registration.refine(initial))
        return self._start("refine", kind, photo, author)

    def run_export(
        self, folder: Path, photo: object, author: Author, *, force: bool, last_solved: bool, frame: object = "scanner"
    ) -> str:
        """Start an export into a folder; raises as `run`."""
        self._require_current(photo, last_solved=last_solved)
        self._exports.check_folder(folder, self._workspace.session.document, force=force)
        kind = JobKind(
            f"Export into {folder.name}",
            self._exports.into_folder(folder, force=force, frame=self._frame(photo, frame)),
        )
        return self._start("export", kind, photo, author)

    def export_targets(self, wanted: Wanted) -> dict[str, Any]:
        """Return the table of targets; raises as `HandOverJobs.table`."""
        return self._hand_over.table(wanted)

    def run_hand_over(
        self, names: Sequence[str], wanted: Wanted, author: Author, *, folder: Path | None, force: bool
    ) -> str:
        """Start an export to targets, as a zip or into a folder; raises as `run` and `HandOverJobs.work`."""
        work, photo = self._hand_over.work(names, wanted, folder, force=force)

        def and_report(context: JobContext) -> str:
            sentence = work(context)
            if folder is None:
                self._publish_event({"event": "hand_over_ready", "url": f"export/{HAND_OVER}.zip"})
            return sentence

        label = "Export to other programs" if folder is None else f"Export into {folder.name}"
        return self._runner.start("hand_over", and_report, label=label, photo=photo, author=author)

    def corners(self, photo: str) -> dict[str, Any] | None:
        """Return the corners found in a photograph and the scan."""
        return self._matching.corners(photo)

    def self_test(self, photo: str) -> dict[str, Any] | None:
        """Return the present results of a photograph's self-test."""
        return self._registration.self_tests.get(photo)

    def solving(self, photo: str) -> dict[str, Any]:
        """Return the state of the automatic solving of a photograph."""
        return IDLE if self._automatic is None else self._automatic.state(photo)

    def close(self) -> None:
        """End automatic solving; the runner ends the jobs."""
        if self._automatic is not None:
            self._automatic.close()

    def export_file(self, photo: str) -> tuple[Path, str] | None:
        """Return the last zip of a photograph, or of a hand-over, and its download name; None before there is one."""
        document = self._workspace.session.document
        if photo == HAND_OVER:
            path = self._hand_over.zip_path
            return (path, download_name(document.name, HAND_OVER)) if path.is_file() else None
        entry = document.photo(photo)
        if entry is None:
            return None
        path = self._exports.zip_path(entry.id)
        return (path, download_name(document.name, Path(entry.source.name).stem)) if path.is_file() else None

    def is_exported(self, entry: PhotoEntry) -> bool:
        """Return whether the shown pose of a photograph was exported."""
        return self._exports.is_exported(entry)

    def report_file(self, photo: str) -> tuple[Path, str] | None:
        """Return the last report of a photograph and its download name; None before there is one."""
        document = self._workspace.session.document
        entry = document.photo(photo)
        if entry is None:
            return None
        path = self._exports.report_path(entry.id)
        name = download_name(document.name, Path(entry.source.name).stem, ending="-report.html")
        return (path, name) if path.is_file() else None

    def _require_current(self, photo: object, *, last_solved: bool) -> None:
        document = self._workspace.session.document
        self._exports.require_current(document, require_photo(document, photo), last_solved=last_solved)

    def _start(self, name: str, kind: JobKind, photo: object, author: Author) -> str:
        inputs = self._workspace.inputs(photo)  # raises at once if an input is missing

        def work(context: JobContext) -> str:
            return kind.work(inputs, context)

        return self._runner.start(
            name, work, label=kind.label, photo=inputs.entry.id, author=author, can=kind.can, speed=kind.speed
        )

    def _constrained(self, solve: SolveJobs) -> Work:
        def work(inputs: Inputs, context: JobContext) -> str:
            sentence = self._matching.constrained(inputs, context)
            return f"{sentence} {solve.linear(self._workspace.inputs(inputs.entry.id), context)}"

        return work

    def _frame(self, photo: object, frame: object) -> FrameName:
        return self._exports.check_frame(self._workspace.inputs(photo), frame)

    def _export_zip_in(self, frame: FrameName) -> Work:
        def work(inputs: Inputs, context: JobContext) -> str:
            sentence = self._exports.export(inputs, context, frame=frame)
            url = f"export/{inputs.entry.id}.zip"
            self._publish_event({"event": "export_ready", "photo": inputs.entry.id, "url": url})
            return sentence

        return work

    def _write_report(self, inputs: Inputs, context: JobContext) -> str:
        sentence = self._exports.report(inputs, context)
        url = f"export/{inputs.entry.id}.html"
        self._publish_event({"event": "report_ready", "photo": inputs.entry.id, "url": url})
        return sentence

    def _show_frame(self, frame: Frame) -> None:
        self._publish_event(frame_event(frame))
        self._watch(frame)
