"""Results, as the command line writes them: as a zip to download, or into a folder."""

from __future__ import annotations

import re
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from app.jobs.bench import Bench, Inputs
from app.jobs.runner import JobContext
from ladarreg_core.errors import OptionError
from ladarreg_core.export.files import cannot_write
from ladarreg_core.export.leftovers import remove_leftovers

if TYPE_CHECKING:
    from ladarreg_core.project.document import PhotoEntry, PoseEntry

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
        target = self.zip_path(inputs.entry.id)
        folder = target.with_suffix("")
        self._write(inputs, folder, context, force=True)
        part = target.with_suffix(".zip.part")
        try:
            with zipfile.ZipFile(part, "w", compression=zipfile.ZIP_DEFLATED, compresslevel=1) as file:
                for path in sorted(folder.iterdir()):
                    context.check()
                    file.write(path, path.name)
            part.replace(target)
        except OSError as error:
            raise cannot_write(target, error) from None
        finally:
            part.unlink(missing_ok=True)
            shutil.rmtree(folder, ignore_errors=True)
        return f"The zip holds {_size(target.stat().st_size)}."

    def into_folder(self, folder: Path, *, force: bool) -> Work:
        """Return the job that writes into a folder."""

        def work(inputs: Inputs, context: JobContext) -> str:
            remove_leftovers(folder.parent, of=folder.name)
            self._write(inputs, folder, context, force=force)
            return f"Wrote {', '.join(sorted(path.name for path in folder.iterdir()))}."

        return work

    def _write(self, inputs: Inputs, folder: Path, context: JobContext, *, force: bool) -> None:
        from ladarreg_core.export.folder import export_registration
        from ladarreg_core.formats.matches_file import write_matches

        pose = self._pose(inputs.entry)
        room, folder_of = self._bench.room, self._bench.session.folder
        sources = [inputs.document.scan, inputs.entry.source, inputs.entry.camera.file]
        picks = [pick.as_pick() for pick in inputs.entry.picks]
        export_registration(
            folder,
            room.answer(pose),
            inputs.scan,
            inputs.photo,
            assessment=room.assessment(inputs.scan, pose),
            inputs=[folder_of.source_path(source.path) for source in sources if source is not None],
            more=[("matches.json", lambda path: write_matches(path, picks))] if picks else [],
            force=force,
            report=context.progress,
        )

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
