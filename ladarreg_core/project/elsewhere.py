"""Another place for a project whose own disk has no room."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from msgspec.structs import replace as changed

from ladarreg_core.errors import ExportError, LadarregError
from ladarreg_core.project.document import Document, Source
from ladarreg_core.project.folder import ProjectFolder
from ladarreg_core.project.history import History

_MOST_OF_ONE_NAME = 1000


def write_elsewhere(folder: ProjectFolder, history: History, places: Iterable[Path], *, name: str) -> Path:
    """Write a whole project, with its history and arrays, to the first place that takes it, and return where that is.

    Args:
        folder: where the project belongs; files that lie in it are referred to where they are.
        history: the project.
        places: folders to try, in order.
        name: what the folder of the project is called, with a number where that is taken.

    Raises:
        ExportError: if no place takes it; nothing is left in any of them.
    """
    entries = tuple(replace(entry, document=_from_outside(folder, entry.document)) for entry in history.entries)
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
    raise ExportError(f"there is no other place that takes the project ({'; '.join(reasons)})")


def _write(target: Path, history: History) -> None:
    copy = ProjectFolder(target)
    try:
        copy.begin(history)
    finally:
        copy.close()


def _new_folder(place: Path, name: str) -> Path:
    """Make a folder of a name that is not taken.

    Raises:
        OSError: if that fails.
    """
    place.mkdir(parents=True, exist_ok=True)
    for number in range(1, _MOST_OF_ONE_NAME):
        target = place / (name if number == 1 else f"{name}-{number}")
        with contextlib.suppress(FileExistsError):
            target.mkdir()
            return target
    raise FileExistsError(f"{name} and {_MOST_OF_ONE_NAME - 2:,} more are there")


def _from_outside(folder: ProjectFolder, document: Document) -> Document:
    """Return the document with the whole path of every file."""

    def whole(source: Source) -> Source:
        return changed(source, path=str(folder.source_path(source.path)))

    photos = tuple(
        changed(
            photo,
            source=whole(photo.source),
            camera=changed(photo.camera, file=whole(photo.camera.file)) if photo.camera.file else photo.camera,
        )
        for photo in document.photos
    )
    return changed(document, scan=whole(document.scan) if document.scan else None, photos=photos)
