"""Copies of a project, with its history and the files in its folder."""

from __future__ import annotations

import shutil
from pathlib import Path

import msgspec

from ladarreg_core.errors import ExportError
from ladarreg_core.project.history import History
from ladarreg_core.project.storage.folder import ProjectFolder
from ladarreg_core.storage.atomic_write import make_folder, sync_folder, sync_tree


def duplicate_project(folder: ProjectFolder, history: History, target: Path, *, name: str, when: str) -> None:
    """Write a copy of a project under another name; exports are not copied.

    Args:
        folder: the project, open in this process.
        history: its history.
        target: folder of the copy, which must not exist.
        name: name of the copy, which becomes the last step of its history.
        when: time of that step, ISO 8601.

    Raises:
        ExportError: if it cannot be written; nothing is left behind.
    """
    if folder.unreadable:
        raise ExportError("the project cannot be duplicated: stored matches cannot be read; check the disk")
    renamed = msgspec.structs.replace(history.document, name=name)
    copied = history.committed(renamed, label=f"Duplicate of {history.document.name}", author="", when=when)
    try:
        make_folder(target.parent)
        target.mkdir()
    except OSError as error:
        raise ExportError(f"{target} cannot be created: {error.strerror or error}") from None
    try:
        sync_folder(target.parent)
        copied_inputs = target / folder.inputs.name
        shutil.copytree(folder.inputs, copied_inputs, ignore=shutil.ignore_patterns("*.part"))
        sync_tree(copied_inputs)
        kept = ProjectFolder(target)
        try:
            kept.begin(copied)
        finally:
            kept.close()
    except (OSError, shutil.Error) as error:
        shutil.rmtree(target, ignore_errors=True)
        reason = getattr(error, "strerror", None) or "some files cannot be copied"
        raise ExportError(f"the project cannot be duplicated: {reason}; check the free space") from None
    except BaseException:
        shutil.rmtree(target, ignore_errors=True)
        raise
