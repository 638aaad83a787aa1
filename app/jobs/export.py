"""Results, as the command line writes them: as a zip to download, or into a folder."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from ladarreg_core.errors import OptionError

from .inputs import Bench, Inputs
from .runner import JobContext

if TYPE_CHECKING:
    from ladarreg_core.export.folder import FileJob
    from ladarreg_core.project.document import Document, PhotoEntry, PoseEntry

Work = Callable[[Inputs, JobContext], str]


class ExportJobs:
    """Writes what the command line writes, and the matches besides."""

    def __init__(self, bench: Bench) -> None:
        self._bench = bench

    def zip_path(self, photo: str) -> Path:
        """Return where the last zip of a photograph is."""
        return self._bench.session.folder.exports / f"{photo}.zip"

    def export(self, inputs: Inputs, context: JobContext) -> str:
        """Write a zip."""
        from ladarreg_core.export.zip_file import write_zip

        target = self.zip_path(inputs.entry.id)
        write_zip(target, lambda: self._files(inputs), report=context.progress)
        return f"The zip holds {_size(target.stat().st_size)}."

    def check_folder(self, folder: Path, document: Document, *, force: bool) -> None:
        """Refuse a folder that results must not go to.

        Raises:
            LadarregError: if it is one.
        """
        from ladarreg_core.export.folder import check_folder

        if not folder.is_absolute():
            raise OptionError(f"{folder} is no whole path; say where the folder is, from the root on")
        check_folder(folder, force=force, inputs=self._sources(document), apart_from=self._projects)

    def into_folder(self, folder: Path, *, force: bool) -> Work:
        """Return the job that writes into a folder."""
        from ladarreg_core.export.folder import write_folder

        def work(inputs: Inputs, context: JobContext) -> str:
            write_folder(
                folder,
                lambda: self._files(inputs),
                inputs=self._sources(inputs.document),
                apart_from=self._projects,
                force=force,
                report=context.progress,
            )
            return f"Wrote {', '.join(sorted(path.name for path in folder.iterdir()))}."

        return work

    def _files(self, inputs: Inputs) -> list[FileJob]:
        from ladarreg_core.export.folder import registration_files
        from ladarreg_core.export.replacement import MATCHES_FILE
        from ladarreg_core.formats.matches_file import write_matches

        pose = self._pose(inputs.entry)
        room, folder = self._bench.room, self._bench.session.folder
        sources = [inputs.document.scan, inputs.entry.source, inputs.entry.camera.file]
        picks = [pick.as_pick() for pick in inputs.entry.picks]
        files = registration_files(
            room.answer(pose),
            inputs.scan,
            inputs.photo,
            inputs=[folder.source_path(source.path) for source in sources if source is not None],
            assessment=room.assessment(inputs.scan, pose),
        )
        return [*files, (MATCHES_FILE, lambda path: write_matches(path, picks))] if picks else files

    @property
    def _projects(self) -> list[Path]:
        return [self._bench.session.folder.path]

    def _sources(self, document: Document) -> list[Path]:
        """Return every file that the document refers to."""
        sources = [document.scan]
        for entry in document.photos:
            sources += [entry.source, entry.camera.file]
        return [self._bench.session.folder.source_path(source.path) for source in sources if source is not None]

    def _pose(self, entry: PhotoEntry) -> PoseEntry:
        if entry.pose is None:
            raise OptionError("there is no pose to export; solve first")
        return entry.pose


def download_name(project: str, photo: str) -> str:
    """Return the name of a zip: letters, digits and a few signs, whatever the files are called."""
    words = re.sub(r"[^A-Za-z0-9._-]+", "-", f"{project}-{photo}").strip("-.")
    return f"{words[:80] or 'registration'}.zip"


def _size(count: int) -> str:
    return f"{count / 1e6:.1f} MB" if count >= 1e5 else f"{count / 1e3:.0f} kB"
