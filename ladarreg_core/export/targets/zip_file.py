"""Export of results into one zip file, written atomically."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path

from ladarreg_core.export.targets.folder import FileJob
from ladarreg_core.foundations.progress import Progress, Report
from ladarreg_core.storage.atomic_write import cannot_write, move_file
from ladarreg_core.storage.manifest import MANIFEST_FILE, ListedFile, manifest_bytes
from ladarreg_core.storage.staging import clear_leftovers, staging_folder


def write_zip(path: str | Path, files: Callable[[], Sequence[FileJob]], *, report: Report | None = None) -> None:
    """Write files, and their manifest, into a zip file, replacing any of that name.

    It is written to a temporary folder first, so that an error, an interruption or a `report` that raises leaves the
    previous state.

    Args:
        path: the zip file; its folder exists, and only this program writes into it.
        files: returns the names and writers.
        report: receives the progress, before each file and at the end.

    Raises:
        ExportError: if it cannot be written.
    """
    target = Path(os.path.abspath(path))
    clear_leftovers(target.parent, more_names=[target.name])
    try:
        jobs = files()
        listed: list[ListedFile] = []
        with staging_folder(target, more_names=[target.name, *(name for name, _ in jobs)]) as folder:
            packed = folder / target.name
            with zipfile.ZipFile(packed, "w", compression=zipfile.ZIP_DEFLATED, compresslevel=1) as file:
                for done, (name, write) in enumerate(jobs):
                    if report is not None:
                        report(Progress(done, len(jobs), f"writing {name}"))
                    (folder / name).parent.mkdir(parents=True, exist_ok=True)
                    write(folder / name)
                    file.write(folder / name, name)
                    listed.append(ListedFile.of(folder / name, name))
                    (folder / name).unlink()
                file.writestr(MANIFEST_FILE, manifest_bytes(listed))
            if report is not None:
                report(Progress(len(jobs), len(jobs), "written"))
            move_file(packed, target)
    except OSError as error:
        raise cannot_write(target, error) from None
