"""The export jobs: a zip to download, a folder with the files that the command line writes, or the report alone."""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from ladarreg_core.errors import ExportError, OptionError
from ladarreg_core.project.station_edits import scans_of
from ladarreg_core.storage.atomic_write import write_bytes

from ..session.exported import ExportedPose, exported_pose
from .inputs import Inputs, Workspace
from .runner import JobContext

if TYPE_CHECKING:
    from ladarreg_core.export.output_frame import FrameName
    from ladarreg_core.export.targets.folder import FileJob
    from ladarreg_core.project.document import Document, PhotoEntry, Source

log = logging.getLogger(__name__)
Work = Callable[[Inputs, JobContext], str]


class ExportJobs:
    """Exports the files that the command line writes, and the matches."""

    def __init__(self, workspace: Workspace) -> None:
        self._workspace = workspace
        self._exported: dict[str, str] | None = None

    def zip_path(self, photo: str) -> Path:
        """Return the path of a photograph's zip."""
        return self._workspace.session.folder.exports / f"{photo}.zip"

    def record(self, entries: Iterable[PhotoEntry]) -> None:
        """Record that the shown poses of photographs were exported; it is known after a restart, too."""
        known = self._known_exports()
        known |= {entry.id: entry.pose.arrays.name for entry in entries if entry.pose is not None}
        self._exported = known
        try:
            write_bytes(self._record_path, json.dumps(known).encode())
        except (ExportError, OSError) as error:
            log.warning("exports are not recorded: %s", error)

    def is_exported(self, entry: PhotoEntry) -> bool:
        """Return whether the shown pose of a photograph was exported."""
        return entry.pose is not None and self._known_exports().get(entry.id) == entry.pose.arrays.name

    def _known_exports(self) -> dict[str, str]:
        """Return the name of the pose of each photograph that was exported last."""
        if self._exported is None:
            try:
                found = json.loads(self._record_path.read_bytes())
            except (OSError, ValueError):
                found = {}
            self._exported = found if isinstance(found, dict) else {}
        return dict(self._exported)

    @property
    def _record_path(self) -> Path:
        return self._workspace.session.folder.exports / "exported.json"

    def require_current(self, document: Document, entry: PhotoEntry, *, last_solved: bool) -> None:
        """Refuse to export a pose that is out of date, unless its state when it was solved is wanted.

        Raises:
            OptionError: stating what changed.
        """
        stale = "" if entry.pose is None else self._workspace.loader.stale(document, entry, entry.pose)
        if stale and not last_solved:
            raise OptionError(f"{stale}, or choose 'export the last solved state'")

    def check_frame(self, inputs: Inputs, frame: object) -> FrameName:
        """Return the frame of exported models.

        Raises:
            OptionError: if it is unknown, or `world` and the scan does not state where it stands.
        """
        from ladarreg_core.export.output_frame import OutputFrame

        return OutputFrame.of(inputs.scan, frame).name

    def export(self, inputs: Inputs, context: JobContext, *, frame: FrameName = "scanner") -> str:
        """Write a zip."""
        from ladarreg_core.export.targets.zip_file import write_zip

        target = self.zip_path(inputs.entry.id)
        write_zip(target, lambda: self._files(inputs, frame), report=context.progress)
        self.record([inputs.entry])
        return f"Wrote a zip of {size_of(target)}."

    def report_path(self, photo: str) -> Path:
        """Return the path of a photograph's report."""
        return self._workspace.session.folder.exports / f"{photo}.html"

    def report(self, inputs: Inputs, context: JobContext) -> str:
        """Write the report, which states by itself if the pose is refused or out of date."""
        pose = self._pose(inputs)
        context.check()
        target = self.report_path(inputs.entry.id)
        pose.write_report(target, inputs.scan, inputs.photo)
        return f"Wrote a report of {size_of(target)}."

    def check_folder(self, folder: Path, document: Document, *, force: bool) -> None:
        """Refuse a folder that must not be written or replaced.

        Raises:
            LadarregError: naming the reason.
        """
        from ladarreg_core.export.targets.folder import check_folder

        if not folder.is_absolute():
            raise OptionError(f"{folder} is not an absolute path; give one")
        check_folder(folder, force=force, inputs=self._sources(document), apart_from=self._projects)

    def into_folder(self, folder: Path, *, force: bool, frame: FrameName = "scanner") -> Work:
        """Return the work of a job that exports into a folder."""
        from ladarreg_core.export.targets.folder import write_folder
        from ladarreg_core.storage.manifest import visible_files

        def work(inputs: Inputs, context: JobContext) -> str:
            write_folder(
                folder,
                lambda: self._files(inputs, frame, folder),
                inputs=self._sources(inputs.document),
                apart_from=self._projects,
                force=force,
                report=context.progress,
            )
            self.record([inputs.entry])
            return f"Wrote {', '.join(visible_files(folder))}."

        return work

    def _files(self, inputs: Inputs, frame: FrameName, folder: Path | None = None) -> list[FileJob]:
        from ladarreg_core.export.targets.folder import registration_files
        from ladarreg_core.formats.documents.matches_file import write_matches
        from ladarreg_core.storage.replacement import MATCHES_FILE

        if inputs.entry.pose is None:
            drawn = [pick.as_pick() for pick in inputs.entry.picks]
            if not drawn:
                raise OptionError("there is nothing to export yet; draw matches and solve, or register automatically")
            return [(MATCHES_FILE, lambda path: write_matches(path, drawn))]
        pose = self._pose(inputs)
        files = registration_files(
            pose.registration,
            inputs.scan,
            inputs.photo,
            inputs=pose.inputs,
            read_with=pose.read_with,
            assessment=pose.assessment,
            rests_on=pose.rests_on,
            frame=frame,
            folder=folder,
        )
        return [*files, (MATCHES_FILE, lambda path: write_matches(path, pose.picks))] if pose.picks else files

    def _pose(self, inputs: Inputs) -> ExportedPose:
        workspace = self._workspace
        return exported_pose(workspace.loader, workspace.session.folder, inputs.document, inputs.entry, inputs.scan)

    @property
    def _projects(self) -> list[Path]:
        return [self._workspace.session.folder.path]

    def _sources(self, document: Document) -> list[Path]:
        """Return all files that the document refers to."""
        sources: list[Source | None] = [*scans_of(document)]
        for entry in document.photos:
            sources += [entry.source, entry.camera.file]
        folder = self._workspace.session.folder
        return [path for source in sources if source is not None for path in folder.source_files(source)]


def download_name(project: str, photo: str, *, ending: str = ".zip") -> str:
    """Return the name of a downloaded file, in ASCII letters, digits, dots, hyphens and underscores."""
    words = re.sub(r"[^A-Za-z0-9._-]+", "-", f"{project}-{photo}").strip("-.")
    return f"{words[:80] or 'registration'}{ending}"


def size_of(path: Path) -> str:
    """Return the size of a file, in words."""
    count = path.stat().st_size
    return f"{count / 1e6:.1f} MB" if count >= 1e5 else f"{count / 1e3:.0f} kB"
