"""Rules for replacing an existing folder by an export: it must contain only results of an earlier run.

The manifest of a folder lists what was written into it, with checksums: a file that it does not list, or that was
changed since, is never replaced. Folders of earlier versions have no manifest; there, results are recognised by their
document, never by the folder's name, so that no option can replace a folder of photographs. A project, the folder of an
input, and folders above or below them are never replaced.
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

from ladarreg_core.errors import ExportError, FormatError
from ladarreg_core.storage.atomic_write import raise_error
from ladarreg_core.storage.checksums import is_sealed_page
from ladarreg_core.storage.manifest import MANIFEST_FILE, ListedFile, read_manifest, remove_listed

REPORT_FILE = "report.html"
"""The report next to a registration, accepted or not."""
REGISTRATION_FILES = (
    "registration.json", REPORT_FILE,
    "registered.png", "labels.png", "visibility.png", "uncertainty.png", "model.glb", "cloud.ply",
)  # fmt: skip
"""Files of a registration; all but the first two are only written if it is accepted, or its pose was given."""
OVERLAY_FILE = "rejected_overlay.png"
"""Picture of a refused registration."""
REFUSED_FILES = ("registration.json", REPORT_FILE, OVERLAY_FILE)
"""Files of a registration that was refused; a folder with nothing else may be replaced."""
OFFSET_FILE = "offset.json"
"""File beside models that are written in the world."""
MATCHES_FILE = "matches.json"
"""File of the picks next to a registration."""
EXPORT_FILE = "export.json"
"""File that lists those of an export, which are in folders beside it; it is written first."""
_COMPARISON_FILES = ("comparison.json", "table.md", "contact_sheet.png")
PANORAMA_FILE = "panorama.json"
"""File that describes a panorama."""
PROVENANCE_FILE = "provenance.png"
"""Picture of which piece each cell of a panorama is from."""
PANORAMA_FILES = (PANORAMA_FILE, "scan.npz", PROVENANCE_FILE)
"""Files of a panorama."""
STATIONS_FILE = "stations.json"
"""File that describes stations, beside their scans."""
MODEL_FILE = "model.json"
"""File that describes a model of many photographs, beside its files."""
RIG_FILE = "rig.json"
"""File that describes a rig."""
RIG_FILES = (RIG_FILE, "camera.transform.yaml", "static_transforms.launch.py", "camchain-lidar.yaml",
             "overlay.webp")  # fmt: skip
"""Files of a rig of one camera; all but the first are only written if it is accepted."""
RIG_CAMERA_FILES = (".transform.yaml", ".pose.json", ".overlay.webp")
"""How the names of the files of each camera end, where a rig has several, behind the camera's name."""
_SIMULATION_FILES = ("scan.npz", "photo.png", "camera.json", "truth.json")
_STAGE_PICTURE = re.compile(r"(registered|not_accepted)_[a-z0-9_]+\.png")
_FILE_MANAGER_FILES = frozenset({".DS_Store", "Thumbs.db", "desktop.ini", ".directory"})
_PROJECT_FILES = ("project.json", "history.jsonl", "lock")
_PROJECT_FOLDERS = ("arrays", "inputs", "exports")
_LARGEST_DOCUMENT_BYTES = 32 << 20
_MAX_SHOWN = 3
_LONGEST_SHOWN = 160


@dataclass(frozen=True, slots=True)
class FolderContent:
    """Content of a folder, without its manifest and the files that file managers create."""

    names: tuple[str, ...]
    """All entries, sorted."""
    document: str | None
    """A file of the results, as a rule the document that describes them; None: there are no results."""
    others: tuple[str, ...]
    """Entries that are not part of the results."""
    refused: bool
    """Whether it contains a registration that was not accepted."""
    changed: tuple[str, ...] = ()
    """Files that are not as they were written, by the manifest; the manifest itself if it is damaged."""


def folder_content(folder: Path, *, more_names: Collection[str] = ()) -> FolderContent:
    """Return the content of a folder, without its manifest.

    Args:
        folder: the folder.
        more_names: names of additional result files, beyond those that every run writes.

    Raises:
        OSError: if it cannot be listed.
    """
    with os.scandir(folder) as found:
        entries = {entry.name: entry.is_file(follow_symlinks=False) for entry in found}
    for name in (MANIFEST_FILE, *_FILE_MANAGER_FILES):
        entries.pop(name, None)
    names = tuple(sorted(entries))
    try:
        listed = read_manifest(folder)
    except FormatError:
        return FolderContent(names, None, (), False, (MANIFEST_FILE,))
    if listed is not None:
        own: Collection[str] = {*listed}
        document = next((name for name in (*_DOCUMENTS, *sorted(own)) if name in own and name in entries), None)
    else:
        document, own = _recognised(folder, [name for name in names if entries[name]], more_names)
    if document is None:
        return FolderContent(names, None, names, False)
    others = tuple(name for name in names if not (name in own if entries[name] else _only_contains(folder, name, own)))
    refused = bool(entries.get("registration.json")) and _is_refused(folder / "registration.json")
    return FolderContent(names, document, others, refused, () if others or listed is None else _changed(folder, listed))


def _recognised(
    folder: Path, files: Collection[str], more_names: Collection[str]
) -> tuple[str | None, Collection[str]]:
    """Return the document by which a folder of an earlier version, without a manifest, is known, and its files.

    Args:
        folder: the folder.
        files: the names of its files that are no links.
        more_names: as in `folder_content`.
    """
    for document, files_of in _DOCUMENTS.items():
        fields = _read(folder / document) if document in files else None
        own = None if fields is None else files_of(fields)
        if own is not None:
            return document, {*own, *more_names}
    return None, ()


def _is_refused(document: Path) -> bool:
    """Return whether a document is of a registration that was not accepted."""
    fields = _read(document) or {}
    return (
        _files_of_registration(fields) is not None and fields["accepted"] is False and fields.get("evidence") != "given"
    )


def _changed(folder: Path, listed: Mapping[str, ListedFile]) -> tuple[str, ...]:
    """Return the files that are not as a manifest lists them; those that are missing are nobody's loss."""
    there = [one for one in listed.values() if (folder / one.name).exists()]
    return tuple(sorted(one.name for one in there if one.fault(folder)))


def require_replaceable(
    folder: Path, *, force: bool, more_names: Collection[str] = (), shown: Path | None = None
) -> None:
    """Refuse to replace a folder because of its content.

    Args:
        folder: an existing folder.
        force: whether results may be replaced; otherwise only those of a refused registration.
        more_names: as in `folder_content`.
        shown: path shown in errors; None: `folder`.

    Raises:
        ExportError: if it contains anything but unchanged results, or results without `force`, or cannot be listed.
    """
    called = display_path(shown or folder)
    try:
        content = folder_content(folder, more_names=more_names)
    except OSError as error:
        reason = (error.strerror or type(error).__name__).lower()
        raise ExportError(f"the folder {called} exists and cannot be read: {reason}; give another folder") from None
    if content.others:
        beside = f" next to {content.document}" if content.document else ""
        raise ExportError(
            f"the folder {called} contains {_listed(content.others)}{beside}, which ladarreg did not write, so it is "
            "not replaced; give another folder, or move them away first"
        )
    if content.changed:
        raise ExportError(
            f"the folder {called} contains {_listed(content.changed)}, changed since ladarreg wrote it, so it is not "
            "replaced; give another folder, or move what was changed away first"
        )
    if force or (content.refused and {*content.names} <= {*REFUSED_FILES}):
        return
    state = f"contains earlier results ({_listed(content.names)})" if content.names else "exists and is empty"
    raise ExportError(f"the folder {called} {state}; give another folder, or allow it to be replaced by `force=True`")


def require_own_report(path: Path) -> None:
    """Refuse to replace a file that is not a report as it was written.

    Args:
        path: a file; one that does not exist is not refused.

    Raises:
        ExportError: if neither its own checksum nor the manifest beside it says that it is an unchanged report.
    """
    if not os.path.lexists(path):
        return
    called = display_path(path)
    try:
        if not path.is_symlink() and path.is_file():
            listed = (read_manifest(path.parent) or {}).get(path.name)
            if is_sealed_page(path) or (listed is not None and not listed.fault(path.parent)):
                return
    except FormatError as error:
        raise ExportError(f"{called} is not replaced: {error}") from None
    except OSError as error:
        reason = (error.strerror or type(error).__name__).lower()
        raise ExportError(f"{called} exists and cannot be read: {reason}; give another file") from None
    raise ExportError(
        f"{called} is not a report as ladarreg wrote it, so it is not replaced; give another file, or move it away"
    )


def require_apart(target: Path, *, inputs: Sequence[str | Path] = (), projects: Sequence[str | Path] = ()) -> None:
    """Refuse to replace a folder that is, contains or lies in a project or an input.

    Folders are compared by identity, so that links, mounts and different spellings make no difference.

    Args:
        target: an existing folder, its parents without symbolic links.
        inputs: input files and folders of the results.
        projects: project folders in addition to those recognised by their files.

    Raises:
        ExportError: if it overlaps one of them.
    """
    called = display_path(target)
    for path in map(Path, inputs):
        if _lies_in(path, target):
            raise ExportError(
                f"the folder {called} contains the input {display_path(path.name)}, so it is not replaced; give "
                "another folder"
            )
        if path.is_dir() and _lies_in(target, path):
            raise ExportError(
                f"the folder {called} lies in the input {display_path(path.name)}, so it is not replaced; give another "
                "folder"
            )
    for project in (*map(Path, projects), *filter(is_project, (target, *target.parents))):
        where = "contains" if _lies_in(project, target) else "lies in" if _lies_in(target, project) else ""
        if where:
            what = "is a project" if _same(project, target) else f"{where} the project {display_path(project.name)}"
            raise ExportError(f"the folder {called} {what}, so it is not replaced; give a folder outside of projects")


def is_project(folder: Path) -> bool:
    """Return whether a folder has the files of a project, of which one may be missing."""
    found = [os.path.isfile(folder / name) for name in _PROJECT_FILES]
    return sum(found) + sum(os.path.isdir(folder / name) for name in _PROJECT_FOLDERS) >= 2 and any(found)


def remove_results(folder: Path, *, more_names: Collection[str] = ()) -> None:
    """Remove the files that exports write into a folder, and the folder if it is empty then.

    Of a folder with a manifest, only the files are removed that it lists and that are as they were written.
    """
    with contextlib.suppress(OSError, FormatError):
        if read_manifest(folder) is not None:
            remove_listed(folder, besides=_FILE_MANAGER_FILES)
            return
    registration = {*REGISTRATION_FILES, *REFUSED_FILES, OFFSET_FILE, MATCHES_FILE, EXPORT_FILE, MANIFEST_FILE}
    own = {*registration, *_COMPARISON_FILES, *_SIMULATION_FILES, *PANORAMA_FILES, *_FILE_MANAGER_FILES, *more_names}
    with contextlib.suppress(OSError):
        with os.scandir(folder) as listed:
            entries = [entry for entry in listed if entry.is_file(follow_symlinks=False)]
        below = _files_of_export(_read(folder / EXPORT_FILE) or {}) or ()
        for entry in entries:
            if entry.name in own or _STAGE_PICTURE.fullmatch(entry.name):
                os.unlink(entry.path)
        _remove_below(folder, [name for name in {*below, *more_names} if "/" in name])
        os.rmdir(folder)


def _only_contains(folder: Path, name: str, files: Collection[str]) -> bool:
    """Return whether all files below a folder's subfolder, which is no link, are among those listed.

    Raises:
        OSError: if a folder cannot be listed.
    """
    if os.path.islink(folder / name) or not (folder / name).is_dir():
        return False
    found = False
    for parent, folders, names in os.walk(folder / name, onerror=raise_error):
        if any(os.path.islink(os.path.join(parent, inner)) for inner in folders):
            return False
        for file in names:
            path = Path(parent, file)
            listed = path.relative_to(folder).as_posix() in files
            if path.is_symlink() or not (listed or file in _FILE_MANAGER_FILES):
                return False
            found |= listed
    return found


def _remove_below(folder: Path, names: Collection[str]) -> None:
    """Remove files in subfolders, given their names with `/`, and the subfolders that are empty then."""
    parents = set()
    for name in names:
        path = folder / name
        above = [parent for parent in path.parents if parent != folder and folder in parent.parents]
        if any(parent.is_symlink() for parent in above):
            continue
        parents.update(above)
        with contextlib.suppress(OSError):
            os.unlink(path)
    for parent in sorted(parents, key=lambda path: -len(path.parts)):
        with contextlib.suppress(OSError):
            for junk in _FILE_MANAGER_FILES & set(os.listdir(parent)):
                os.unlink(parent / junk)
            os.rmdir(parent)


def display_path(path: str | Path) -> str:
    """Return a path for messages: on one line and not too long."""
    text = "".join(c if c.isprintable() else "?" for c in str(path))
    return text if len(text) <= _LONGEST_SHOWN else f"{text[: _LONGEST_SHOWN // 2]}...{text[-_LONGEST_SHOWN // 2 :]}"


def _listed(names: Sequence[str]) -> str:
    shown = ", ".join(display_path(name) for name in names[:_MAX_SHOWN])
    return shown if len(names) <= _MAX_SHOWN else f"{shown} and {len(names) - _MAX_SHOWN} more"


def _read(path: Path) -> dict[str, Any] | None:
    """Return the object in a JSON file; None if it cannot be read."""
    try:
        if path.stat().st_size > _LARGEST_DOCUMENT_BYTES:
            return None
        fields = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError):
        return None
    return fields if isinstance(fields, dict) else None


def _files_of_registration(fields: Mapping[str, Any]) -> Collection[str] | None:
    ours = _is_export_document(fields) and isinstance(fields.get("accepted"), bool) and "camera_from_scanner" in fields
    return (*REGISTRATION_FILES, OVERLAY_FILE, OFFSET_FILE, MATCHES_FILE) if ours else None


def _files_of_comparison(fields: Mapping[str, Any]) -> Collection[str] | None:
    columns = fields.get("columns")
    if not _is_export_document(fields) or not isinstance(columns, list):
        return None
    pictures = [column.get("picture") for column in columns if isinstance(column, dict)]
    return (*_COMPARISON_FILES, *(p for p in pictures if isinstance(p, str) and _STAGE_PICTURE.fullmatch(p)))


def _files_of_simulation(fields: Mapping[str, Any]) -> Collection[str] | None:
    return _SIMULATION_FILES if fields.get("made_by") == "simulate" and "camera_from_scanner" in fields else None


def _files_of_export(fields: Mapping[str, Any]) -> Collection[str] | None:
    files = fields.get("files")
    if fields.get("kind") != "export" or not isinstance(fields.get("software"), dict) or not isinstance(files, list):
        return None
    # Without a manifest beside it, it could name anything: each target has a folder of its own.
    named = [name for name in files if isinstance(name, str) and is_file_name(name) and "/" in name]
    return (EXPORT_FILE, *named) if len(named) == len(files) else None


def _files_of_panorama(fields: Mapping[str, Any]) -> Collection[str] | None:
    return PANORAMA_FILES if fields.get("kind") == "panorama" and isinstance(fields.get("software"), dict) else None


def _files_of_stations(fields: Mapping[str, Any]) -> Collection[str] | None:
    stations = fields.get("stations")
    if fields.get("kind") != "stations" or not isinstance(fields.get("software"), dict):
        return None
    named = [one.get("scan") for one in stations if isinstance(one, dict)] if isinstance(stations, list) else []
    return (STATIONS_FILE, *(name for name in named if isinstance(name, str) and is_file_name(name)))


def _files_of_rig(fields: Mapping[str, Any]) -> Collection[str] | None:
    if fields.get("kind") != "rig" or not isinstance(fields.get("software"), dict):
        return None
    cameras = fields.get("by_camera")
    named = [f"{name}{end}" for name in (cameras if isinstance(cameras, dict) else ()) for end in RIG_CAMERA_FILES]
    return (*RIG_FILES, *(name for name in named if is_file_name(name)))


def is_file_name(name: str) -> bool:
    """Return whether a name, with `/` between folders, is of a file below the folder that it is relative to."""
    parts = name.split("/")
    return all(part not in ("", ".", "..") and not {*"\\:\0"} & {*part} for part in parts)


def _is_export_document(fields: Mapping[str, Any]) -> bool:
    """Return whether a document has the fields that all versions write into every exported document."""
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
    EXPORT_FILE: _files_of_export,
    PANORAMA_FILE: _files_of_panorama,
    STATIONS_FILE: _files_of_stations,
    RIG_FILE: _files_of_rig,
}
"""Document of each kind of results, and a function by which folders without a manifest are recognised: it returns the
names of all their files; None if the document was not written by ladarreg."""


def _lies_in(path: Path, folder: Path) -> bool:
    """Return whether a path is a folder or lies below it."""
    real = Path(os.path.realpath(path))
    return any(_same(parent, folder) for parent in (real, *real.parents))


def _same(first: Path, second: Path) -> bool:
    try:
        return os.path.samefile(first, second)
    except OSError:
        return False
