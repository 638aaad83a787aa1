"""The commands that hand results over to other programs: the table of targets, and the export itself."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

from ladarreg_core.errors import OptionError

from ..jobs.hand_over import Wanted
from ..jobs.registry import JobRegistry
from .clients import Client

Fields = Mapping[str, Any]
Reply = dict[str, Any]
_MOST = 10_000
_MAX_PATH, _MAX_PATH_PART = 4000, 255


class Exporting(Protocol):
    """The parts of the workbench that these commands use."""

    jobs: JobRegistry


def export_targets(context: Exporting, client: Client, fields: Fields) -> Reply:
    """Return the table of targets with what each is for, and why some cannot be written."""
    return context.jobs.export_targets(_wanted(fields))


def hand_over(context: Exporting, client: Client, fields: Fields) -> Reply:
    """Export registered photographs to targets, as a zip or into a folder of the server."""
    names = _names(fields.get("targets"), "targets") or ()
    folder = None if fields.get("folder") is None else folder_path(fields["folder"])
    force = fields.get("force") is True
    return {"job": context.jobs.run_hand_over(names, _wanted(fields), client.author, folder=folder, force=force)}


def export_folder(context: Exporting, client: Client, fields: Fields) -> Reply:
    """Export the results into a folder of the server."""
    folder = folder_path(fields.get("folder"))
    force, last_solved = fields.get("force") is True, fields.get("last_solved") is True
    photo, frame = fields.get("photo"), fields.get("frame", "scanner")
    job = context.jobs.run_export(folder, photo, client.author, force=force, last_solved=last_solved, frame=frame)
    return {"job": job}


EXPORT_COMMANDS = (export_targets, hand_over, export_folder)


def folder_path(value: object) -> Path:
    """Return the path of a folder if its name is valid.

    Raises:
        OptionError: if it is missing, too long, or contains control characters.
    """
    text = value.strip() if isinstance(value, str) else ""
    if not text:
        raise OptionError("give the folder to export to")
    if not text.isprintable():
        raise OptionError("the folder's path contains control characters; enter it again")
    if len(text.encode()) > _MAX_PATH or any(len(part.encode()) > _MAX_PATH_PART for part in Path(text).parts):
        raise OptionError(f"the folder's path is too long; the limit is {_MAX_PATH} bytes, {_MAX_PATH_PART} per name")
    return Path(text)


def _wanted(fields: Fields) -> Wanted:
    frame, crop = fields.get("frame", "scanner"), fields.get("crop", "none")
    if not isinstance(frame, str) or not isinstance(crop, str):
        raise OptionError("the frame is 'scanner' or 'world', and crop 'none' or 'photo'")
    return Wanted(
        photos=_names(fields.get("photos"), "photographs"),
        frame=frame,
        full=fields.get("full") is True,
        crop=crop,
        last_solved=fields.get("last_solved") is True,
    )


def _names(value: object, what: str) -> tuple[str, ...] | None:
    if value is None:
        return None
    if not isinstance(value, list) or len(value) > _MOST or not all(isinstance(name, str) for name in value):
        raise OptionError(f"the {what} are a list of names")
    return tuple(value)
