"""Changes of a run's folder that happen as a whole or not at all: a run is begun, or its panorama is added.

The run that a new one replaces is set aside in its folder, and removed once the new one is complete.

Only what the records of the run and the manifest of its folder list is touched, and only if it is unchanged: any other
file in the folder may be the user's work, and the run is then not replaced.
"""

from __future__ import annotations

import hashlib
import os
import secrets
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path

from ladarreg_core.acquisition.devices.exchange_log import EXCHANGES, EXCHANGES_BEFORE
from ladarreg_core.acquisition.run_records import RECORDS, Record, read_records
from ladarreg_core.errors import ExportError, FormatError, OptionError
from ladarreg_core.formats.parsing.untrusted import shown_name
from ladarreg_core.storage.atomic_write import make_folder, raise_error, sync_folder, write_bytes
from ladarreg_core.storage.folder_lock import FolderLock
from ladarreg_core.storage.manifest import MANIFEST_FILE, ListedFile, manifest_bytes, read_manifest, remove_listed
from ladarreg_core.storage.moved_together import MOVES_FILE, Move, finish_moves, is_unfinished, replace_together

PLAN, LOCK = "plan.json", ".lock"
PANORAMA_OF_RUN = ("scan.npz", "panorama.json", "provenance.png")
"""What is composed beside the pieces."""
_ASIDE = ".earlier-run-"
_OTHER_FOLDER = "so the run is not replaced; give another folder, or move it away first"


def begin_anew(folder: Path, write_plan: Callable[[Path], None]) -> None:
    """Begin a run in its folder; an earlier one moves as a whole into a hidden folder below it, in the same step.

    To be called with the folder locked.

    Args:
        folder: the folder.
        write_plan: writes the plan of the new run to a path.

    Raises:
        OptionError: if the folder has a file that the earlier run does not list, or that was changed since.
        ExportError: if a file cannot be written or moved; the earlier run is as it was then, or set aside as a whole.
    """
    aside = folder / f"{_ASIDE}{secrets.token_hex(4)}"
    names = _own_files(folder) if (folder / PLAN).is_file() else []
    kept = [name for name in names if name != MANIFEST_FILE]  # it does not list the records

    def set_aside() -> list[Move]:
        if kept:
            make_folder(aside)
            listed = [ListedFile.of(folder / name, name) for name in kept]
            write_bytes(aside / MANIFEST_FILE, manifest_bytes(listed))
            sync_folder(aside)
        return [(name, f"{aside.name}/{name}") for name in kept]

    try:
        replace_together(folder, {PLAN: write_plan}, aside=set_aside)
    except ExportError as error:
        raise ExportError(f"no run can be begun in {shown_name(folder)}: {error}") from None
    finally:
        with suppress(OSError, FormatError):
            if aside.is_dir() and os.listdir(aside) == [MANIFEST_FILE] and not (folder / MOVES_FILE).exists():
                remove_listed(aside)  # nothing was moved


def add_panorama(folder: Path, files: Mapping[str, Callable[[Path], None]]) -> None:
    """Write all or none of the files of a panorama beside the pieces of its run, which no program has open.

    Raises:
        ExportError: as `replace_together`, or if another program has the run open.
    """
    settle(folder)
    lock = FolderLock(folder, LOCK, what="run")
    try:
        replace_together(folder, files)
    finally:
        lock.discard()


def settle(folder: Path) -> None:
    """Finish what an interrupted program was moving in the folder of a run, before it is read.

    Raises:
        FormatError: if that cannot be done.
    """
    try:
        finish_moves(folder, lock=LOCK, what="run")
    except ExportError as error:
        raise FormatError(str(error)) from None


def remove_set_aside(folder: Path) -> None:
    """Remove the runs that were set aside in a folder, as far as they are unchanged."""
    for aside in folder.glob(f"{_ASIDE}*"):
        with suppress(OSError, FormatError):
            if aside.is_dir() and not aside.is_symlink():
                remove_listed(aside)


def _own_files(folder: Path) -> list[str]:
    """Return the names of the files of a run; those that make it a run come last.

    Raises:
        OptionError: as `begin_anew`.
        OSError: if a folder cannot be listed, or a file not be read.
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
    for parent, folders, files in os.walk(folder, onerror=raise_error):
        if Path(parent) == folder:
            folders[:] = [name for name in folders if not name.startswith(_ASIDE) and not is_unfinished(name)]
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
