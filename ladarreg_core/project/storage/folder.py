"""The folder of a project; its files are consistent at every moment, even if the program is killed.

history.jsonl     every commit, undo and redo, each appended durably before it is reported
project.json      the current document, replaced atomically a moment later; where it is behind, the history prevails
arrays/NAME.npz   arrays, named by their content
inputs/           uploaded files
exports/          the latest export of each photograph
lock              locked while a program has the project open

Either of the first two is enough to open the project, and each is restored from the other. A damaged file is never
overwritten but renamed, for example to NAME.damaged-1.json.
"""

from __future__ import annotations

import contextlib
import datetime
import logging
import os
import secrets
import shutil
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec

from ladarreg_core.errors import ExportError, FormatError, LadarregError, NewerVersionError
from ladarreg_core.project.checksum import verify_checksum, with_checksum
from ladarreg_core.project.document import Document
from ladarreg_core.project.history import Entry, History
from ladarreg_core.project.source import Source
from ladarreg_core.project.storage.codec import arrays_of, decode_document, encode
from ladarreg_core.project.storage.delta import change_between
from ladarreg_core.project.storage.records import Records, read_records, record_line
from ladarreg_core.project.storage.replay import RECOVERED, Replayed, Snapshot, replay
from ladarreg_core.project.storage.unknown_fields import Unknown, encoded_with, unknown_fields
from ladarreg_core.project.stored_arrays import StoredArrays
from ladarreg_core.storage.atomic_write import (
    AppendedFile,
    cannot_write,
    make_folder,
    sync_file,
    sync_folder,
    sync_tree,
    write_bytes,
)
from ladarreg_core.storage.folder_lock import READ_ONLY, FolderLock

log = logging.getLogger(__name__)
_PROJECT, _HISTORY, _ARRAYS, _INPUTS, _EXPORTS, _LOCK = (
    "project.json", "history.jsonl", "arrays", "inputs", "exports", "lock",
)  # fmt: skip
_MAX_ENTRIES = 5000
_LONG_HISTORY_BYTES = 64 << 20


def is_project(path: str | Path) -> bool:
    """Return whether a folder contains a project, intact or damaged.

    Raises:
        FormatError: if the folder cannot be read: a project that may be there must not be begun anew.
    """
    try:
        return any((Path(path) / name).is_file() for name in (_PROJECT, _HISTORY))
    except OSError as error:
        raise FormatError(
            f"{path} cannot be read: {(error.strerror or type(error).__name__).lower()}; check the disk"
        ) from None


class ProjectFolder:
    """Storage of one project on disk.

    Changes that cannot be written stay queued in memory; every later save and every `settle` writes them first.
    """

    def __init__(self, path: str | Path) -> None:
        """Open or create the folder, and lock it; one that cannot be written can be viewed, and a remark says so.

        Raises:
            ExportError: if it cannot be created or written, or another program has it open.
        """
        self.path = Path(os.path.abspath(path))
        try:
            for name in ("", _ARRAYS, _INPUTS, _EXPORTS):
                make_folder(self.path / name)
        except OSError as error:
            if error.errno not in READ_ONLY or not is_project(self.path):
                raise cannot_write(self.path, error) from None
        self._lock = FolderLock(self.path, _LOCK, what="project")
        self._kept: dict[str, StoredArrays] = {}
        self._synced: set[str] = set()  # files of sources that are known to be on disk
        self._missing: dict[str, StoredArrays] = {}
        self._unreadable: set[str] = set()  # those of them that may be intact, but cannot be read now
        self._unknown: Unknown = {}
        self._damaged: set[Path] = set()
        self._remarks: list[str] = [self._lock.remark] if self._lock.remark else []
        self._written: bytes | None = None
        self._history: History | None = None  # as in memory
        self._seq = 0  # number of the last record, queued or written
        self._queue: list[tuple[bytes, Document]] = []  # records that follow those in the file
        self._rewrite = False  # the history file must be rewritten
        self._journal: AppendedFile | None = None
        self._appending = threading.RLock()
        self._replacing = threading.Lock()

    @property
    def inputs(self) -> Path:
        """Folder of uploaded files."""
        return self.path / _INPUTS

    @property
    def exports(self) -> Path:
        """Folder of exports."""
        return self.path / _EXPORTS

    @property
    def begun(self) -> bool:
        """Whether the folder contains a project."""
        return is_project(self.path)

    @property
    def remarks(self) -> tuple[str, ...]:
        """Problems found when the project was read, and how they were handled, in sentences."""
        return tuple(self._remarks)

    @property
    def unreadable(self) -> bool:
        """Whether some stored matches cannot be read at the moment, though they may be intact."""
        return bool(self._unreadable)

    @property
    def behind(self) -> bool:
        """Whether commits, undos or redos are not yet on disk."""
        return self._rewrite or bool(self._queue)

    def close(self) -> None:
        """Close the files and release the lock."""
        if self._journal is not None:
            self._journal.close()
        self._lock.release()

    def source_path(self, path: str) -> Path:
        """Return the path of a source's file."""
        return self.path / path  # an absolute one stays itself

    def scan_options(self, source: Source) -> dict[str, Any]:
        """Return the arguments of `read_scan` for a scan, `more` among them where clouds are accumulated."""
        more = tuple(map(self.source_path, source.more))
        return {**source.scan_options, "more": more} if more else source.scan_options

    def source_files(self, source: Source) -> list[Path]:
        """Return all files of a source, that of its path first."""
        return [self.source_path(path) for path in (source.path, *source.more)]

    def relative(self, path: Path) -> str:
        """Return a file's path for a `Source`: relative inside the folder, so that the folder can be moved."""
        absolute = Path(os.path.abspath(path))
        inside = absolute.is_relative_to(self.path)
        return absolute.relative_to(self.path).as_posix() if inside else str(absolute)

    def read(self) -> History:
        """Read the project with its history, as far as it is readable; `remarks` lists the problems.

        Raises:
            NewerVersionError: if a newer version of the program wrote the project, which is left unchanged.
            FormatError: if there is no project, or nothing of it can be read.
        """
        if not self.begun:
            raise FormatError(f"there is no project in {self.path}: it has neither {_PROJECT} nor {_HISTORY}")
        snapshot = self._snapshot()
        appended = self._bytes(_HISTORY)
        records = read_records(appended or b"")
        try:
            found = replay(records.found, snapshot, self._arrays)
        except NewerVersionError:
            raise
        except FormatError:
            raise FormatError(
                f"the project {self.path} cannot be read: {_PROJECT} and {_HISTORY} are both damaged or missing;"
                " restore them from a backup"
            ) from None
        history = found.history
        if len(appended or b"") > _LONG_HISTORY_BYTES or len(history.entries) > _MAX_ENTRIES:
            history = history.shortened(_MAX_ENTRIES // 2)
        self._history, self._seq = history, found.seq
        self._synced.update(path for source in history.document.sources for path in source.paths)
        self._unknown = found.unknown | self._unknown
        is_complete = history is found.history and not (found.lost or found.recovered)
        intact = records.intact_bytes if is_complete else None
        if intact is None or appended is None:
            self._rewrite = True
        else:
            self._journal = AppendedFile(self.path / _HISTORY, intact_bytes=intact)
        self._report_history(appended, records, found)
        self._report_arrays(history)
        try:
            self.settle()
        except ExportError as error:  # it can be viewed, and is saved as soon as possible
            log.warning("the project cannot be saved: %s", error)
        return history

    def begin(self, history: History) -> None:
        """Write a new project, replacing any in the folder.

        Raises:
            ExportError: if that fails.
        """
        with self._appending:
            self._history, self._rewrite = history, True
        self.settle()

    def save_commit(self, history: History, *, amended: bool = False) -> None:
        """Append a commit durably; `settle` should follow.

        Raises:
            ExportError: if that fails; the folder is then `behind`.
        """
        with self._appending:
            if self._history is None:
                self._rewrite = True
            else:
                change = change_between(self._history.document, history.document)
                kind = "amend" if amended else "commit"
                self._enqueue({kind: _entry_fields(history.present), "change": change}, history.document)
            self._history = history
            self._write_queue()

    def save_move(self, history: History) -> None:
        """Append a new position in the history (undo, redo) durably; `settle` should follow.

        Raises:
            ExportError: if that fails; the folder is then `behind`.
        """
        with self._appending:
            self._enqueue({"at": history.present.number}, history.document)
            self._history = history
            self._write_queue()

    def settle(self) -> None:
        """Write the queued records and bring project.json up to date; may be called from any thread.

        Raises:
            ExportError: if that fails.
        """
        try:
            with self._appending:
                self._write_queue()
        finally:  # if only one of the two files can be written, it is
            self._write_project()

    def _write_project(self) -> None:
        with self._replacing:
            with self._appending:
                if self._history is None:
                    return
                document, seq = self._history.document, self._seq
            data = self._project_bytes(document, seq)
            if data != self._written:
                self._save_named(document)
                self._replace(self.path / _PROJECT, data)
                self._written = data

    def _project_bytes(self, document: Document, seq: int) -> bytes:
        data = encoded_with(document, self._unknown) if self._unknown else encode(document)
        return with_checksum(data[:-1] + b',"seq":%d}' % seq)

    def _enqueue(self, fields: Mapping[str, Any], document: Document) -> None:
        self._seq += 1
        self._queue.append((record_line(fields, self._seq), document))

    def _write_queue(self) -> None:
        """Write the queued records in order."""
        if self._history is None or not self.behind:
            return
        if self._rewrite or self._journal is None or not self._journal.intact:
            self._write_history(self._history)
            return
        for _, document in self._queue:
            self._save_named(document)
        self._journal.append(b"".join(line for line, _ in self._queue))
        self._queue = []

    def _write_history(self, history: History) -> None:
        """Rewrite the history file, for a new project or where the present file cannot be appended to."""
        self._rewrite = True
        lines = []
        before: Document | None = None
        for entry in history.entries:
            self._save_named(entry.document)
            if before is None:
                whole = encoded_with(entry.document, self._unknown) if self._unknown else encode(entry.document)
                what: dict[str, Any] = {"document": msgspec.Raw(whole)}
            else:
                what = {"change": change_between(before, entry.document)}
            lines.append(record_line({"commit": _entry_fields(entry), **what}, self._seq))
            before = entry.document
        lines.append(record_line({"at": history.present.number}, self._seq))
        if self._journal is not None:
            if not self._journal.intact:  # another program has modified it
                self._damaged.add(self.path / _HISTORY)
            self._journal.close()
            self._journal = None
        data = b"".join(lines)
        self._replace(self.path / _HISTORY, data)
        self._journal = AppendedFile(self.path / _HISTORY, intact_bytes=len(data))
        self._rewrite, self._queue = False, []

    def _save_named(self, document: Document) -> None:
        """Bring all files that a document names to disk, before the document itself.

        Raises:
            ExportError: if that fails.
        """
        for path in (path for source in document.sources for path in source.paths):
            if path not in self._synced and not os.path.isabs(path):
                self._sync_source(self.path / path)
            self._synced.add(path)
        for name, arrays in arrays_of(document).items():
            if name not in self._kept and not arrays.lost:
                self._replace(self.path / _ARRAYS / f"{name}.npz", arrays.data)
                self._kept[name] = arrays

    def _sync_source(self, file: Path) -> None:
        """Synchronise a file in the folder, with the names that lead to it; a missing one is passed over."""
        try:
            if not file.is_file():
                return
            if file.parent == self.inputs or not file.is_relative_to(self.inputs):
                sync_file(file)
            else:  # a descriptor has a folder of its own, with the files that it names
                sync_tree(file.parent)
            for parent in file.parents[: len(file.relative_to(self.path).parts)]:
                sync_folder(parent)
        except OSError as error:
            raise cannot_write(file, error) from None

    def _replace(self, target: Path, data: bytes) -> None:
        """Replace a file atomically: write a temporary file and rename it."""
        aside = target.with_name(f".{target.name}.{secrets.token_hex(4)}.part")
        try:
            write_bytes(aside, data)
            if target in self._damaged and target.exists():
                self._remarks.append(f"The damaged file is kept as {_set_aside(target).name}.")
            self._damaged.discard(target)
            os.replace(aside, target)
            sync_folder(target.parent)
        except OSError as error:
            raise cannot_write(target, error) from None
        finally:
            with contextlib.suppress(OSError):
                aside.unlink(missing_ok=True)

    def _bytes(self, name: str) -> bytes | None:
        """Return a file's content; None if it does not exist.

        Raises:
            FormatError: if it exists but cannot be read; it must not be overwritten then.
        """
        try:
            return (self.path / name).read_bytes()
        except FileNotFoundError:
            return None
        except OSError as error:
            raise FormatError(f"{self.path / name} cannot be read: {error.strerror or error}") from None

    def _snapshot(self) -> Snapshot | None:
        """Return the contents of project.json; None if it is missing or cannot be read."""
        path = self.path / _PROJECT
        data = self._bytes(_PROJECT)
        if data is None:
            self._remarks.append(f"{_PROJECT} was missing and was restored from {_HISTORY}.")
            return None
        checked = verify_checksum(data)
        try:
            document = decode_document(checked.data, self._arrays)
            fields = msgspec.json.decode(checked.data)
            self._unknown = unknown_fields(fields, document)
        except NewerVersionError:
            raise
        except LadarregError as error:
            log.warning("%s is damaged: %s", path, error)
            self._damaged.add(path)
            self._remarks.append(f"{_PROJECT} was damaged and was restored from {_HISTORY}.")
            return None
        seq = fields.get("seq") if checked.state in ("intact", "corrected") else None
        if checked.state == "intact":
            self._written = data
        if checked.state == "corrected":
            self._damaged.add(path)
            self._remarks.append(f"{_PROJECT} had a damaged character, which was corrected.")
        if checked.state == "damaged":
            self._damaged.add(path)
            self._remarks.append(f"{_PROJECT} was changed by another program.")
        when = datetime.datetime.fromtimestamp(path.stat().st_mtime).astimezone().isoformat(timespec="seconds")
        return Snapshot(document, seq if isinstance(seq, int) else None, when)

    def _report_history(self, appended: bytes | None, records: Records, found: Replayed) -> None:
        if appended is None:
            self._remarks.append(
                f"{_HISTORY} was missing: the project is as saved in {_PROJECT}, and its undo steps are lost."
            )
            return
        if records.intact_bytes is None or found.lost:
            self._damaged.add(self.path / _HISTORY)
        if found.lost:
            self._remarks.append(
                f"{_HISTORY} was damaged in {_places(found.lost)}: some steps can no longer be reached by undo, and"
                f" their result is {f'the step {RECOVERED!r}' if found.recovered else 'rebuilt from readable steps'}."
            )
        elif found.recovered:
            self._remarks.append(
                f"{_PROJECT} contains a document that {_HISTORY} lacks: it became the step {RECOVERED!r}."
            )
        elif records.intact_bytes is None:
            self._remarks.append(
                f"{_HISTORY} had a damaged character, which was corrected by its checksum; no step is lost."
            )

    def _report_arrays(self, history: History) -> None:
        for arrays in self._missing.values():
            path = self._array_path(arrays.name)
            with contextlib.suppress(OSError):
                if arrays.name not in self._unreadable and path.exists():
                    _set_aside(path, keep=False)
        here = self._missing.keys() & arrays_of(history.document).keys()
        if here:
            self._remarks.append(f"The matches of {_results(len(here))} are missing or damaged: solve again.")
        elif self._missing:
            self._remarks.append("Matches of results in earlier steps are missing or damaged.")

    def _array_path(self, name: str) -> Path:
        return self.path / _ARRAYS / f"{name}.npz"

    def _arrays(self, name: str) -> StoredArrays:
        known = self._kept.get(name) or self._missing.get(name)
        if known is not None:
            return known
        if not name.isalnum():
            raise FormatError(f"{name[:20]!r} is not a valid name of stored matches; the project is damaged")
        try:
            found = StoredArrays(self._array_path(name).read_bytes())
        except FileNotFoundError:
            found = StoredArrays(b"")
        except OSError as error:
            log.warning("%s cannot be read: %s", self._array_path(name), error)
            self._unreadable.add(name)
            found = StoredArrays(b"")
        if found.name == name:
            self._kept[name] = found
            return found
        log.warning("the stored matches %s are missing or damaged", name)
        self._missing[name] = StoredArrays(b"", lost=name)
        return self._missing[name]


def _set_aside(path: Path, *, keep: bool = True) -> Path:
    """Give a damaged file another name; with `keep`, also keep it under its own name until it is replaced.

    Returns:
        The new path.

    Raises:
        OSError: if that fails.
    """
    number = 1
    while (other := path.with_name(f"{path.stem}.damaged-{number}{path.suffix}")).exists():
        number += 1
    if keep:
        with contextlib.suppress(OSError):
            os.link(path, other)
            return other
        with contextlib.suppress(OSError):  # file systems without hard links
            shutil.copy2(path, other)
            return other
        other.unlink(missing_ok=True)
    os.rename(path, other)
    return other


def _entry_fields(entry: Entry) -> dict[str, Any]:
    fields = {"number": entry.number, "label": entry.label, "author": entry.author, "when": entry.when}
    more = {"automatic": entry.automatic, "by": entry.by, "undoes": entry.undoes, "redoes": entry.redoes}
    return fields | {name: value for name, value in more.items() if value}


def _places(count: int) -> str:
    return "one place" if count == 1 else f"{count} places"


def _results(count: int) -> str:
    return "one result" if count == 1 else f"{count} results"
