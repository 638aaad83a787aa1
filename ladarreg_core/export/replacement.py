"""Which existing folder an export may replace: one that holds results of an earlier run and nothing else.

Whether a folder holds results is read from its files, never taken from its name, so that no option replaces a folder of
photographs. A project, the folder of an input, and whatever lies above or below them is never replaced.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ladarreg_core.errors import ExportError

REGISTRATION_FILES = ("registration.json", "registered.png", "labels.png", "uncertainty.png", "model.glb", "cloud.ply")
"""What a registration is written as; all but the first only where it is accepted."""
MATCHES_FILE = "matches.json"
"""The picks beside a registration."""
_COMPARISON_FILES = ("comparison.json", "table.md", "contact_sheet.png")
_SIMULATION_FILES = ("scan.npz", "photo.png", "camera.json", "truth.json")
_STAGE_PICTURE = re.compile(r"(registered|not_accepted)_[a-z0-9_]+\.png")
_OF_FILE_MANAGERS = frozenset({".DS_Store", "Thumbs.db", "desktop.ini", ".directory"})
_PROJECT_MARKS = ("project.json", "history.jsonl", "lock")
_PROJECT_FOLDERS = ("arrays", "inputs", "exports")
_LARGEST_DOCUMENT_BYTES = 32 << 20
_MOST_SHOWN = 3
_LONGEST_SHOWN = 160


@dataclass(frozen=True, slots=True)
class FolderContent:
    """What a folder holds, but for the files that file managers leave in every folder."""

    names: tuple[str, ...]
    """All entries, sorted."""
    document: str | None
    """The document that shows whose results these are; None: there are no results."""
    others: tuple[str, ...]
    """Entries that are no part of the results."""
    refused: bool
    """Whether it is a registration that was not accepted."""


def content_of(folder: Path, *, more_names: Collection[str] = ()) -> FolderContent:
    """Return what a folder holds.

    Args:
        folder: the folder.
        more_names: files that are part of the results, beside those of every run.

    Raises:
        OSError: if it cannot be listed.
    """
    with os.scandir(folder) as listed:
        entries = {entry.name: entry.is_file(follow_symlinks=False) for entry in listed}
    for name in _OF_FILE_MANAGERS:
        entries.pop(name, None)
    names = tuple(sorted(entries))
    for document, files_of in _DOCUMENTS.items():
        fields = _read(folder / document) if entries.get(document) else None
        own = None if fields is None else files_of(fields)
        if fields is not None and own is not None:
            others = tuple(name for name in names if not entries[name] or name not in {*own, *more_names})
            refused = document == "registration.json" and fields["accepted"] is False
            return FolderContent(names, document, others, refused)
    return FolderContent(names, None, names, False)


def require_replaceable(
    folder: Path, *, force: bool, more_names: Collection[str] = (), shown: Path | None = None
) -> None:
    """Refuse a folder that is not to be replaced for what it holds.

    Args:
        folder: a folder that exists.
        force: whether results may be replaced; without it only those of a registration that was refused.
        more_names: as in `content_of`.
        shown: what the error calls the folder; None: `folder`.

    Raises:
        ExportError: if it holds anything but results, cannot be listed, or holds results and `force` is off.
    """
    called = in_words(shown or folder)
    try:
        content = content_of(folder, more_names=more_names)
    except OSError as error:
        reason = (error.strerror or type(error).__name__).lower()
        raise ExportError(f"the folder {called} exists and cannot be read: {reason}; give another folder") from None
    if content.others:
        beside = f" beside {content.document}" if content.document else ""
        raise ExportError(
            f"the folder {called} holds {_listed(content.others)}{beside}, which ladarreg did not write, so it is not "
            "replaced; give another folder, or move them away first"
        )
    if force or (content.refused and len(content.names) == 1):
        return
    holds = f"holds earlier results ({_listed(content.names)})" if content.names else "exists and is empty"
    raise ExportError(
        f"the folder {called} {holds}; give another folder, or allow it to be replaced (--force; in the page, "
        "'replace earlier results')"
    )


def require_apart(target: Path, *, inputs: Sequence[str | Path] = (), projects: Sequence[str | Path] = ()) -> None:
    """Refuse to replace a folder that is, holds or lies in a project or an input.

    Folders are compared as the system sees them, so that links, mounts and other spellings make no difference.

    Args:
        target: a folder that exists, its parents without symbolic links.
        inputs: files and folders that the results come from.
        projects: folders of projects beside those that are recognised by their files.

    Raises:
        ExportError: if it is.
    """
    called = in_words(target)
    for path in map(Path, inputs):
        if _lies_in(path, target):
            raise ExportError(
                f"the folder {called} holds the input {in_words(path.name)}, so it is not replaced; give another folder"
            )
        if path.is_dir() and _lies_in(target, path):
            raise ExportError(
                f"the folder {called} lies in the input {in_words(path.name)}, so it is not replaced; give another "
                "folder"
            )
    for project in (*map(Path, projects), *filter(is_project, (target, *target.parents))):
        where = "holds" if _lies_in(project, target) else "lies in" if _lies_in(target, project) else ""
        if where:
            what = "is a project" if _same(project, target) else f"{where} the project {in_words(project.name)}"
            raise ExportError(f"the folder {called} {what}, so it is not replaced; give a folder outside of projects")


def is_project(folder: Path) -> bool:
    """Return whether a folder has the files of a project; one of them may be missing."""
    found = [os.path.isfile(folder / name) for name in _PROJECT_MARKS]
    return sum(found) + sum(os.path.isdir(folder / name) for name in _PROJECT_FOLDERS) >= 2 and any(found)


def remove_results(folder: Path, *, more_names: Collection[str] = ()) -> None:
    """Remove the files that any run of ours may have written into a folder, and the folder if nothing else is left."""
    own = {*REGISTRATION_FILES, MATCHES_FILE, *_COMPARISON_FILES, *_SIMULATION_FILES, *_OF_FILE_MANAGERS, *more_names}
    with contextlib.suppress(OSError):
        with os.scandir(folder) as listed:
            entries = [entry for entry in listed if entry.is_file(follow_symlinks=False)]
        for entry in entries:
            if entry.name in own or _STAGE_PICTURE.fullmatch(entry.name):
                os.unlink(entry.path)
        os.rmdir(folder)


def in_words(path: str | Path) -> str:
    """Return a path as a sentence may show it: on one line, and not too long."""
    text = "".join(c if c.isprintable() else "?" for c in str(path))
    return text if len(text) <= _LONGEST_SHOWN else f"{text[: _LONGEST_SHOWN // 2]}...{text[-_LONGEST_SHOWN // 2 :]}"


def _listed(names: Sequence[str]) -> str:
    shown = ", ".join(in_words(name) for name in names[:_MOST_SHOWN])
    return shown if len(names) <= _MOST_SHOWN else f"{shown} and {len(names) - _MOST_SHOWN} more"


def _read(path: Path) -> dict[str, Any] | None:
    """Return the object in a JSON file; None where it is none."""
    try:
        if path.stat().st_size > _LARGEST_DOCUMENT_BYTES:
            return None
        fields = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError):
        return None
    return fields if isinstance(fields, dict) else None


def _files_of_registration(fields: Mapping[str, Any]) -> Collection[str] | None:
    ours = _is_of_export(fields) and isinstance(fields.get("accepted"), bool) and "camera_from_scanner" in fields
    return (*REGISTRATION_FILES, MATCHES_FILE) if ours else None


def _files_of_comparison(fields: Mapping[str, Any]) -> Collection[str] | None:
    columns = fields.get("columns")
    if not _is_of_export(fields) or not isinstance(columns, list):
        return None
    pictures = [column.get("picture") for column in columns if isinstance(column, dict)]
    return (*_COMPARISON_FILES, *(p for p in pictures if isinstance(p, str) and _STAGE_PICTURE.fullmatch(p)))


def _files_of_simulation(fields: Mapping[str, Any]) -> Collection[str] | None:
    return _SIMULATION_FILES if fields.get("made_by") == "simulate" and "camera_from_scanner" in fields else None


def _is_of_export(fields: Mapping[str, Any]) -> bool:
    """Return whether a document has what every document of an export has, whichever version wrote it."""
    software = fields.get("software")
    return (
        isinstance(fields.get("version"), int)
        and str(fields.get("camera_from_scanner_is")).startswith("maps scanner points")
        and isinstance(fields.get("inputs"), list)
        and isinstance(software, dict)
        and {"name", "version"} <= set(software)
    )


_DOCUMENTS: Mapping[str, Callable[[Mapping[str, Any]], Collection[str] | None]] = {
    "registration.json": _files_of_registration,
    "comparison.json": _files_of_comparison,
    "truth.json": _files_of_simulation,
}
"""The document that every folder of its kind holds, and what returns the files beside it, or None: it is not ours."""


def _lies_in(path: Path, folder: Path) -> bool:
    """Return whether a path is a folder or lies below it."""
    real = Path(os.path.realpath(path))
    return any(_same(parent, folder) for parent in (real, *real.parents))


def _same(first: Path, second: Path) -> bool:
    try:
        return os.path.samefile(first, second)
    except OSError:
        return False
