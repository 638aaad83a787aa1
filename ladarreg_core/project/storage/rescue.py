"""Rescue copies: a project that cannot be saved in its own folder is written to another one."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from msgspec.structs import replace as changed

from ladarreg_core.errors import ExportError, LadarregError
from ladarreg_core.project.document import Document, PhotoEntry
from ladarreg_core.project.history import History
from ladarreg_core.project.source import Source
from ladarreg_core.project.storage.folder import ProjectFolder
from ladarreg_core.storage.atomic_write import make_folder, sync_folder

_MAX_OF_ONE_NAME = 1000


def write_rescue_copy(folder: ProjectFolder, history: History, places: Iterable[Path], *, name: str) -> Path:
    """Write a complete project, with its history and arrays, below the first folder that can be written.

    Args:
        folder: the project's own folder; the copy refers to the input files in it.
        history: history of the project.
        places: folders to try, in order.
        name: name of the new project folder; a number is appended if it exists.

    Returns:
        The new project folder.

    Raises:
        ExportError: if none can be written; nothing is left behind in any of them.
    """
    entries = tuple(replace(entry, document=_with_absolute_paths(folder, entry.document)) for entry in history.entries)
    whole = History(entries, history.at)
    reasons = []
    for place in places:
        try:
            target = _new_folder(place, name)
        except OSError as error:
            reasons.append(f"{place}: {(error.strerror or str(error)).lower()}")
            continue
        try:
            _write(target, whole)
        except (LadarregError, OSError) as error:
            reasons.append(str(error))
            shutil.rmtree(target, ignore_errors=True)
            continue
        return target
    raise ExportError(f"no other folder could be written either ({'; '.join(reasons)})")


def _write(target: Path, history: History) -> None:
    copy = ProjectFolder(target)
    try:
        copy.begin(history)
    finally:
        copy.close()


def _new_folder(place: Path, name: str) -> Path:
    """Create a folder with an unused name.

    Raises:
        OSError: if that fails.
    """
    make_folder(place)
    for number in range(1, _MAX_OF_ONE_NAME):
        target = place / (name if number == 1 else f"{name}-{number}")
        with contextlib.suppress(FileExistsError):
            target.mkdir()
            try:
                sync_folder(place)
            except OSError:
                target.rmdir()
                raise
            return target
    raise FileExistsError(f"{name} and {_MAX_OF_ONE_NAME - 2:,} numbered folders exist")


def _with_absolute_paths(folder: ProjectFolder, document: Document) -> Document:
    """Return the document with absolute paths of all files."""

    def absolute(source: Source) -> Source:
        path, *more = map(str, folder.source_files(source))
        return changed(source, path=path, more=tuple(more))

    def of_photos(photos: tuple[PhotoEntry, ...]) -> tuple[PhotoEntry, ...]:
        return tuple(
            changed(
                photo,
                source=absolute(photo.source),
                camera=changed(photo.camera, file=absolute(photo.camera.file)) if photo.camera.file else photo.camera,
            )
            for photo in photos
        )

    survey, adjusted = document.survey, document.adjusted
    return changed(
        document,
        scan=absolute(document.scan) if document.scan else None,
        photos=of_photos(document.photos),
        stations=tuple(
            changed(station, source=absolute(station.source), photos=of_photos(station.photos))
            for station in document.stations
        ),
        survey=None
        if survey is None
        else changed(
            survey,
            scans=tuple(map(absolute, survey.scans)),
            checks=tuple(changed(check, scan=absolute(check.scan)) for check in survey.checks),
        ),
        adjusted=None
        if adjusted is None
        else changed(adjusted, scans=tuple(changed(one, source=absolute(one.source)) for one in adjusted.scans)),
    )
