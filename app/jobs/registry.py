"""All jobs by name: what they are called, what can be done with them while they run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ladarreg_core.errors import OptionError

from .export import ExportJobs, download_name
from .inputs import Bench, Inputs
from .matching import MatchingJobs
from .registration import WholeJobs
from .runner import FULL_SPEED, Control, JobContext, JobRunner
from .simplex import FIRST_SPEED, Frame, SimplexJobs, frame_event
from .solve import SolvingJobs

Work = Callable[[Inputs, JobContext], str]
_WATCHED: tuple[Control, ...] = ("pause", "stop", "speed", "step")


@dataclass(frozen=True, slots=True)
class Kind:
    """One kind of job."""

    label: str
    work: Work
    can: tuple[Control, ...] = ("stop",)
    speed: float = FULL_SPEED


class JobTable:
    """Begins jobs by name and keeps what they leave beside the document."""

    def __init__(
        self,
        bench: Bench,
        runner: JobRunner,
        watch: Callable[[Frame], None],
        tell_event: Callable[[dict[str, Any]], None],
    ) -> None:
        self._bench, self._runner, self._tell_event = bench, runner, tell_event
        self._watch = watch
        self._matching = MatchingJobs(bench)
        solving = SolvingJobs(bench)
        simplex = SimplexJobs(bench, solving, self._watched)
        self._whole = WholeJobs(bench, solving)
        self._exports = ExportJobs(bench)
        self._kinds = {
            "find_corners": Kind("Find corners", self._matching.find_corners),
            "match": Kind("Match corners", self._matching.match),
            "cull": Kind("Cull by disparity", self._matching.cull),
            "linear": Kind("Linear solution", solving.linear),
            "constrained": Kind("Second search", self._constrained(solving)),
            "densify": Kind("Lines between matches", self._matching.densify),
            "simplex": Kind("Simplex", simplex.simplex, _WATCHED, FIRST_SPEED),
            "reject_outliers": Kind("Reject outliers", simplex.reject_outliers, _WATCHED, 4 * FIRST_SPEED),
            "robust": Kind("Robust solution", solving.robust),
            "verify": Kind("Verify on the pictures", solving.verify),
            "auto": Kind("Register automatically", self._whole.auto),
            "thesis": Kind("Thesis, whole chain", self._whole.thesis),
            "compare": Kind("Compare all stages", self._whole.compare),
            "self_test": Kind("Self-test", self._whole.self_test),
            "export": Kind("Export", self._zipped),
        }

    def run(self, name: str, photo: object, author: str) -> str:
        """Begin a job and return its id.

        Raises:
            LadarregError: if there is no such job, something that it needs is missing, or another one runs.
        """
        kind = self._kinds.get(name)
        if kind is None:
            raise OptionError(f"there is no job {name[:40]!r}")
        return self._begin(name, kind, photo, author)

    def run_export(self, folder: Path, photo: object, author: str, *, force: bool) -> str:
        """Begin to export into a folder; as `run`."""
        self._exports.check_folder(folder, self._bench.session.document, force=force)
        kind = Kind(f"Export into {folder.name}", self._exports.into_folder(folder, force=force))
        return self._begin("export", kind, photo, author)

    def corners(self, photo: str) -> dict[str, Any] | None:
        """Return the corners found in a photograph and the scan."""
        return self._matching.corners(photo)

    def self_test(self, photo: str) -> dict[str, Any] | None:
        """Return how far a photograph's self-test has come."""
        return self._whole.self_tests.get(photo)

    def export_file(self, photo: str) -> tuple[Path, str] | None:
        """Return the last zip of a photograph and the name to save it by."""
        document = self._bench.session.document
        entry = document.photo(photo)
        if entry is None:
            return None
        path = self._exports.zip_path(entry.id)
        return (path, download_name(document.name, Path(entry.source.name).stem)) if path.is_file() else None

    def _begin(self, name: str, kind: Kind, photo: object, author: str) -> str:
        inputs = self._bench.inputs(photo)  # what is missing is said at once, and not by a job that fails

        def work(context: JobContext) -> str:
            return kind.work(inputs, context)

        return self._runner.start(
            name, work, label=kind.label, photo=inputs.entry.id, author=author, can=kind.can, speed=kind.speed
        )

    def _constrained(self, solving: SolvingJobs) -> Work:
        def work(inputs: Inputs, context: JobContext) -> str:
            said = self._matching.constrained(inputs, context)
            return f"{said} {solving.linear(self._bench.inputs(inputs.entry.id), context)}"

        return work

    def _zipped(self, inputs: Inputs, context: JobContext) -> str:
        said = self._exports.export(inputs, context)
        self._tell_event({"event": "export_ready", "photo": inputs.entry.id, "url": f"export/{inputs.entry.id}.zip"})
        return said

    def _watched(self, frame: Frame) -> None:
        self._tell_event(frame_event(frame))
        self._watch(frame)
