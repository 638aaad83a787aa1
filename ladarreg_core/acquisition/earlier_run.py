"""The run that a new one replaces: set aside in its folder, and removed once the new one is complete.

Only what the records of the run and the manifest of its folder list is touched, and only as it was written: any other
file in the folder is somebody's, and the run is not replaced then.
"""

from __future__ import annotations

import hashlib
import os
import secrets
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from ladarreg_core.acquisition.exchange_log import EXCHANGES, EXCHANGES_BEFORE
from ladarreg_core.acquisition.run_records import RECORDS, Record, read_records
from ladarreg_core.errors import ExportError, FormatError, OptionError
from ladarreg_core.formats.untrusted import shown_name
from ladarreg_core.manifest import MANIFEST_FILE, read_manifest, remove_listed, write_manifest

PLAN, LOCK = "plan.json", ".lock"
PANORAMA_OF_RUN = ("scan.npz", "panorama.json", "provenance.png")
"""What is composed beside the pieces."""
_ASIDE = ".earlier-run-"
_OTHER_FOLDER = "so the run is not replaced; give another folder, or move it away first"


def set_aside(folder: Path) -> None:
    """Move an earlier run, all of it, into a hidden folder below its own; to be called with the folder locked.

    Raises:
        OptionError: if the folder has a file that the run does not list, or that was changed since.
        ExportError: if a file cannot be moved; all are where they were then.
    """
    names = _own_files(folder)
    aside = folder / f"{_ASIDE}{secrets.token_hex(4)}"
    moved: list[str] = []
    try:
        for name in names:
            (aside / name).parent.mkdir(parents=True, exist_ok=True)
            os.rename(folder / name, aside / name)
            moved.append(name)
        with suppress(FileNotFoundError):
            (aside / MANIFEST_FILE).unlink()  # it does not list the records
        write_manifest(aside)
    except OSError as error:
        for name in reversed(moved):
            with suppress(OSError):
                os.rename(aside / name, folder / name)
        raise ExportError(
            f"the run in {shown_name(folder)} cannot be set aside: {error.strerror}; give another folder"
        ) from None


def remove_set_aside(folder: Path) -> None:
    """Remove the runs that were set aside in a folder, as far as they are as they were."""
    for aside in folder.glob(f"{_ASIDE}*"):
        with suppress(OSError, FormatError):
            if aside.is_dir() and not aside.is_symlink():
                remove_listed(aside)


def _own_files(folder: Path) -> list[str]:
    """Return the names of the files of a run, those that say what it is last.

    Raises:
        OptionError: as `set_aside`.
    """
    try:
        listed = read_manifest(folder)
        checksums = _checksums(folder)
    except FormatError as error:
        raise OptionError(f"{error}; the run is not replaced") from None
    whole = {RECORDS, EXCHANGES, EXCHANGES_BEFORE}
    if listed is None:  # of earlier versions
        whole |= {PLAN, *(PANORAMA_OF_RUN if (folder / "panorama.json").is_file() else ())}
    found: list[str] = []
    for parent, folders, files in os.walk(folder):
        folders[:] = [name for name in folders if not (Path(parent) == folder and name.startswith(_ASIDE))]
        links = [name for name in folders if Path(parent, name).is_symlink()]
        for path in (Path(parent, name) for name in (*files, *links)):
            name = path.relative_to(folder).as_posix()
            if name == LOCK:
                continue
            if path.is_symlink() or not (
                name in whole or name == MANIFEST_FILE or name in {**checksums, **(listed or {})}
            ):
                raise OptionError(f"{shown_name(folder)} has {name}, which its run does not list, {_OTHER_FOLDER}")
            if name in checksums and checksums[name] != _sha256(path):
                raise OptionError(
                    f"{shown_name(folder)} has {name}, changed since its run recorded it, {_OTHER_FOLDER}"
                )
            if listed and name in listed and name not in checksums and listed[name].fault(folder):
                raise OptionError(f"{shown_name(folder)} has {name}, changed since its run wrote it, {_OTHER_FOLDER}")
            found.append(name)
    last = (RECORDS, MANIFEST_FILE, PLAN)
    return sorted(found, key=lambda name: (last.index(name) if name in last else -1, name))


def _checksums(folder: Path) -> Mapping[str, str]:
    """Return the checksums of pieces, photographs and stray files by their names."""
    found: dict[str, str] = {}
    for record in read_records(folder) if (folder / RECORDS).is_file() else ():
        if isinstance(record, Record):
            found |= {record.file: record.sha256, **record.strays}
            if record.photo is not None:
                found[record.photo] = record.photo_sha256
    return {name: value for name, value in found.items() if value}


def _sha256(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
