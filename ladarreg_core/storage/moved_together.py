"""Several files of a folder that change as one, also if the program is killed or the disk fails in between.

What is to be moved is listed first, in `.ladarreg-moves.json`: from then on the folder counts as changed, and whoever
finds that file finishes the moves (`finish_moves`). No move replaces a file, so that all can be undone if one fails.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import secrets
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from ladarreg_core.errors import ExportError, FormatError
from ladarreg_core.storage.atomic_write import (
    cannot_write,
    make_folder,
    replaced_file,
    sync_folder,
    sync_tree,
    write_bytes,
)
from ladarreg_core.storage.checksums import checksum_state, sealed
from ladarreg_core.storage.folder_lock import FolderLock
from ladarreg_core.storage.manifest import MANIFEST_FILE, ListedFile, manifest_bytes, read_manifest

MOVES_FILE = ".ladarreg-moves.json"
"""Lists what is being moved in a folder; it exists for a moment, or until the next program finishes the moves."""
_NEW, _OLD = ".new-files-", ".old-files-"
_STAGING = re.compile(r"\.(?:new|old)-files-[0-9a-f]{8}")
_LARGEST_BYTES = 64 << 20
Move = tuple[str, str]
"""Old and new name of a file, relative to the folder, with `/` between folders."""


@dataclass(frozen=True, slots=True)
class Moves:
    """What is moved together: first some files away, then others to where these were, or elsewhere."""

    away: Sequence[Move]
    into: Sequence[Move]


def replace_together(
    folder: Path, files: Mapping[str, Callable[[Path], None]], *, aside: Callable[[], Sequence[Move]] | None = None
) -> None:
    """Write files into a folder that is locked, with their entries in its manifest, all or none.

    Args:
        folder: the folder.
        files: functions that write the files to a path, by their names.
        aside: returns what moves away at the same time, all that the manifest lists; None: nothing but the files that
            are replaced, which are removed then.

    Raises:
        ExportError: if one cannot be written, or would replace a file that is not as the manifest lists it; then the
            folder is as it was, or becomes what it should be by `finish_moves`.
        FormatError: if the manifest is damaged.
    """
    token = secrets.token_hex(4)
    new, old = folder / f"{_NEW}{token}", folder / f"{_OLD}{token}"
    try:
        remove_unfinished(folder)
        make_folder(new)
        names = list(files)
        for name, write in files.items():
            write(new / name)
        listed = {} if aside is not None else read_manifest(folder)
        if listed is not None:  # folders of earlier versions have none
            now = {name: ListedFile.of(new / name, name) for name in files}
            write_bytes(new / MANIFEST_FILE, manifest_bytes({**listed, **now}.values()))
            names.append(MANIFEST_FILE)
        sync_tree(new)
        away = {} if aside is None else dict(aside())
        for name in names:
            if name not in away and (folder / name).exists():
                if aside is None and listed is not None and name != MANIFEST_FILE:
                    _require_own(folder, name, listed)
                away[name] = f"{old.name}/{name}"
        _move_together(folder, Moves([*away.items()], [(f"{new.name}/{name}", name) for name in names]))
    except OSError as error:
        raise cannot_write(folder, error) from None
    finally:
        with contextlib.suppress(OSError):
            if not (folder / MOVES_FILE).exists():  # otherwise both are still needed
                remove_unfinished(folder)


def finish_moves(folder: Path, *, lock: str, what: str) -> None:
    """Finish the moves of an interrupted program in a folder; without its list nothing is done.

    Args:
        folder: the folder.
        lock: name of its lock file.
        what: what the folder is, for messages.

    Raises:
        ExportError: if another program has the folder locked, or a file cannot be moved.
        FormatError: if the list is damaged, or a foreign file is in the way.
    """
    if not (folder / MOVES_FILE).is_file():
        return
    held = FolderLock(folder, lock, what=what)
    try:
        if (folder / MOVES_FILE).is_file():  # no other program has finished it meanwhile
            _move(folder, _listed(folder))
            _remove_list(folder)
        remove_unfinished(folder)
    except OSError as error:
        reason = (error.strerror or type(error).__name__).lower()
        raise ExportError(
            f"an earlier change of the {what} {folder} was interrupted and cannot be finished: {reason}; make the "
            "folder writable and try again"
        ) from None
    finally:
        held.discard()


def remove_unfinished(folder: Path) -> None:
    """Remove what `replace_together` leaves in a folder that is locked when the program is killed."""
    for path in list(folder.iterdir()):
        if not _STAGING.fullmatch(path.name) or path.is_symlink() or not path.is_dir():
            continue
        with contextlib.suppress(OSError):
            for file in list(path.iterdir()):
                file.unlink()
            path.rmdir()


def is_unfinished(name: str) -> bool:
    """Return whether a name is one that this module gives to files in a folder."""
    return name == MOVES_FILE or _STAGING.fullmatch(name) is not None


def _move_together(folder: Path, moves: Moves) -> None:
    """Move files that are on disk, all or none; their new names are free, or those of files that move away.

    Raises:
        OSError: if one cannot be moved; all have their old names then, or get their new ones by `finish_moves`.
        FormatError: as `_move`.
    """
    with replaced_file(folder / MOVES_FILE) as path:
        fields = {"version": 1, "kind": "moves", "away": [*map(list, moves.away)], "into": [*map(list, moves.into)]}
        write_bytes(path, json.dumps(sealed(fields)).encode())
    try:
        _move(folder, moves)
    except (OSError, FormatError):
        _move_back(folder, moves)
        _remove_list(folder)
        raise
    _remove_list(folder)


def _move(folder: Path, moves: Moves) -> None:
    """Move the files that are not moved yet.

    Raises:
        OSError: if one cannot be moved.
        FormatError: if there is another file in its place.
    """
    comes_from = {new: folder / old for old, new in moves.into}
    for names in (moves.away, moves.into):
        for parent in dict.fromkeys((folder / new).parent for _, new in names):
            make_folder(parent)  # before the first move: it synchronises the folder above
        for old, new in names:
            source, target = folder / old, folder / new
            if any(path.is_symlink() for path in (source, target, source.parent, target.parent)):
                raise FormatError(f"{folder} has a symbolic link in place of {old} or {new}; remove it and try again")
            if not source.exists() or (names is moves.away and _has_come(source, target, comes_from.get(old))):
                continue
            if not target.exists():
                os.rename(source, target)
            elif _same(source, target):  # after a loss of power the disk had both names
                source.unlink()
            else:
                raise FormatError(f"{target} is in the way of a file that needs its name; move it away and try again")
        _sync_both(folder, names)


def _has_come(source: Path, target: Path, origin: Path | None) -> bool:
    """Return whether a file is already the new one, the former one having moved away."""
    return origin is not None and target.exists() and (not origin.exists() or _same(source, origin))


def _move_back(folder: Path, moves: Moves) -> None:
    """Undo those moves that were done.

    Raises:
        OSError: if that fails.
    """
    for names in (moves.into, moves.away):
        for old, new in reversed(names):
            if not (folder / old).exists() and (folder / new).exists():
                os.rename(folder / new, folder / old)
        _sync_both(folder, [(new, old) for old, new in names])


def _sync_both(folder: Path, names: Sequence[Move]) -> None:
    """Synchronise the folders of files that were moved.

    The new ones first: a crash between the two may leave the files in both places, never in neither.
    """
    now = [(folder / new).parent for _, new in names]
    for parent in dict.fromkeys([*now, *((folder / old).parent for old, _ in names)]):
        if parent.is_dir():
            sync_folder(parent)


def _same(one: Path, other: Path) -> bool:
    return ListedFile.of(one, "").sha256 == ListedFile.of(other, "").sha256


def _require_own(folder: Path, name: str, listed: Mapping[str, ListedFile]) -> None:
    """Refuse to replace a file that is not as the manifest of its folder lists it."""
    fault = listed[name].fault(folder) if name in listed else "is not one that ladarreg wrote there"
    if fault:
        raise ExportError(f"{folder / name} {fault}, so it is not replaced; move it away and try again")


def _remove_list(folder: Path) -> None:
    (folder / MOVES_FILE).unlink()
    sync_folder(folder)


def _listed(folder: Path) -> Moves:
    try:
        if (folder / MOVES_FILE).stat().st_size > _LARGEST_BYTES:
            raise ValueError("too large")
        fields = json.loads((folder / MOVES_FILE).read_bytes())
        if checksum_state(fields) != "intact" or fields["kind"] != "moves":
            raise ValueError("another checksum")
        away, into = ([(str(old), str(new)) for old, new in fields[part]] for part in ("away", "into"))
        if not all(_is_inside(name) for move in (*away, *into) for name in move):
            raise ValueError("a name leaves the folder")
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise FormatError(
            f"{MOVES_FILE}, which lists what was being moved in {folder}, is damaged; remove it"
        ) from None
    return Moves(away, into)


def _is_inside(name: str) -> bool:
    return all(part not in ("", ".", "..") for part in name.split("/")) and not {*"\\:\0"} & {*name}
