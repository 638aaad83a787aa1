"""The registry of jobs by name, with their labels and controls."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

from ladarreg_core.errors import OptionError
from ladarreg_core.frames import Rigid
from ladarreg_core.project.document import PhotoEntry
from ladarreg_core.project.history import Author

from .automatic import IDLE, AutomaticSolver
from .export import Export, ExportJobs
from .inputs import Inputs, Workspace
from .matching import MatchingJobs
from .registration import RegistrationJobs
from .runner import FULL_SPEED, WATCHED_SPEED, JobContext, JobRunner
from .simplex import Frame, SimplexJobs, frame_event
from .solve import SolveJobs
from .survey import SurveyJobs

if TYPE_CHECKING:
    from ..slices.choices import Control
    from ..slices.events import Event
    from ..slices.photographs import Audit, Corners, SelfTest, Solving

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
    """Starts jobs by name, and holds their results that are not part of the document; `exports` prepares exports.

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
        publish_event: Callable[[Event], None],
        on_change: Callable[[], None] | None,
    ) -> None:
        self._workspace, self._runner, self._publish_event = workspace, runner, publish_event
        self._watch = watch
        self._matching = MatchingJobs(workspace)
        solve = SolveJobs(workspace)
        self._automatic = AutomaticSolver(workspace, runner, solve, on_change) if on_change else None
        simplex = SimplexJobs(solve, self._show_frame)
        self._registration = RegistrationJobs(workspace, solve)
        self._survey = SurveyJobs(workspace, self._registration)
        self.exports = ExportJobs(workspace)
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
            "audit": JobKind("Audit", self._registration.audit),
        }

    def run(self, name: str, photo: object, author: Author) -> str:
        """Start a job and return its id.

        Raises:
            LadarregError: if there is no such job, an input is missing, or too many jobs are waiting.
        """
        kind = self._kinds.get(name)
        if kind is None:
            raise OptionError(f"there is no job {name[:40]!r}")
        return self._start(name, kind, photo, author)

    def run_refine(self, photo: object, author: Author, initial: Rigid) -> str:
        """Start a registration from a rough pose; raises as `run`."""
        kind = JobKind("Refine the rough pose", self._registration.refine(initial))
        return self._start("refine", kind, photo, author)

    def register_all(self, photos: Sequence[str] | None, author: Author) -> str:
        """Start registering photographs by their ids, None: all that are not accepted yet; raises as `run`."""
        self._survey.require_photos(photos)
        work = partial(self._survey.register_all, photos)
        return self._runner.start("register_all", work, label="Register all photographs", photo="", author=author)

    def adjust(self, photos: Sequence[str] | None, author: Author) -> str:
        """Start solving photographs and scans together; arguments and errors as of `register_all`."""
        self._survey.require_photos(photos)
        work = partial(self._survey.adjust, photos)
        return self._runner.start("adjust", work, label="Adjust everything together", photo="", author=author)

    def run_export(self, export: Export, author: Author) -> str:
        """Start an export and return the job's id; raises as `run`."""

        def work(context: JobContext) -> str:
            sentence = export.work(context)
            if export.event is not None:
                self._publish_event(export.event)
            return sentence

        return self._runner.start("export", work, label=export.label, photo=export.photo, author=author)

    def corners(self, photo: str) -> Corners | None:
        """Return the corners found in a photograph and the scan."""
        return self._matching.corners(photo)

    def self_test(self, photo: str) -> SelfTest | None:
        """Return the present results of a photograph's self-test."""
        return self._registration.self_tests.get(photo)

    def audited(self, entry: PhotoEntry) -> Audit | None:
        """Return the last audit of a photograph's pose, see `Audit.as_fields`; None without any."""
        return self._registration.audited(entry)

    def solving(self, photo: str) -> Solving:
        """Return the state of the automatic solving of a photograph."""
        return IDLE if self._automatic is None else self._automatic.state(photo)

    def close(self) -> None:
        """End automatic solving; the runner ends the jobs."""
        if self._automatic is not None:
            self._automatic.close()

    def _start(self, name: str, kind: JobKind, photo: object, author: Author) -> str:
        now = self._workspace.inputs(photo)  # raises at once if an input is missing
        entry = now.entry

        def work(context: JobContext) -> str:
            return kind.work(self._workspace.inputs(entry.id) if context.job.waited else now, context)

        return self._runner.start(
            name, work, label=kind.label, photo=entry.id, author=author, can=kind.can, speed=kind.speed
        )

    def _constrained(self, solve: SolveJobs) -> Work:
        def work(inputs: Inputs, context: JobContext) -> str:
            sentence = self._matching.constrained(inputs, context)
            return f"{sentence} {solve.linear(self._workspace.inputs(inputs.entry.id), context)}"

        return work

    def _show_frame(self, frame: Frame) -> None:
        self._publish_event(frame_event(frame))
        self._watch(frame)
