"""The folder that a project is kept in; it is whole at every moment, whatever becomes of the program.

history.jsonl     every commit and every step back, each appended and on the disk before anybody is told of it
project.json      the document that counts, replaced in one step a moment later; where it is behind, the history leads
arrays/NAME.npz   arrays, named by their content
inputs/           files that were uploaded
exports/          what was exported last, per photograph
lock              held while a program has the project open
"""

from __future__ import annotations

import contextlib
import logging
import os
import secrets
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec

from ladarreg_core.errors import ExportError, FormatError, LadarregError
from ladarreg_core.export.files import append_bytes, cannot_write, sync_folder, write_bytes
from ladarreg_core.project.changes import change_between, changed
from ladarreg_core.project.codec import arrays_of, decode_document, encode
from ladarreg_core.project.document import Document
from ladarreg_core.project.history import Entry, History, entries_from
from ladarreg_core.project.stored_arrays import StoredArrays

log = logging.getLogger(__name__)
_PROJECT, _HISTORY, _ARRAYS, _INPUTS, _EXPORTS, _LOCK = (
    "project.json", "history.jsonl", "arrays", "inputs", "exports", "lock",
)  # fmt: skip
_MOST_ENTRIES = 5000
_LONG_HISTORY_BYTES = 64 << 20


class ProjectFolder:
    """Keeps one project on the disk."""

    def __init__(self, path: str | Path) -> None:
        """Open or make the folder, and hold it.

        Raises:
            ExportError: if it cannot be made or written, or another program has it open.
        """
        self.path = Path(os.path.abspath(path))
        try:
            for name in ("", _ARRAYS, _INPUTS, _EXPORTS):
                (self.path / name).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise cannot_write(self.path, error) from None
        self._lock = _held(self.path / _LOCK, self.path)
        self._kept: dict[str, StoredArrays] = {}
        self._written: bytes | None = None
        self._document: Document | None = None  # where the history stands
        self._replacing = threading.Lock()

    @property
    def inputs(self) -> Path:
        """Where uploads lie."""
        return self.path / _INPUTS

    @property
    def exports(self) -> Path:
        """Where exports lie."""
        return self.path / _EXPORTS

    @property
    def begun(self) -> bool:
        """Whether there is a project in it."""
        return (self.path / _PROJECT).is_file()

    def close(self) -> None:
        """Let another program have it."""
        _released(self._lock, self.path / _LOCK)

    def source_path(self, path: str) -> Path:
        """Return where a source's file is."""
        return self.path / path  # an absolute one stays itself

    def relative(self, path: Path) -> str:
        """Return how a source names a file: relative where it lies in the folder, so that the folder can be moved."""
        absolute = Path(os.path.abspath(path))
        inside = absolute.is_relative_to(self.path)
        return absolute.relative_to(self.path).as_posix() if inside else str(absolute)

    def read(self) -> History:
        """Return the project with its history, or with a new one where that is damaged or another document's.

        Raises:
            FormatError: if there is no project, or it is damaged.
        """
        try:
            data = (self.path / _PROJECT).read_bytes()
        except OSError as error:
            raise FormatError(f"there is no project in {self.path}: {error.strerror or error}") from None
        document = decode_document(data, self._arrays)
        self._written = data
        appended = self._appended()
        replayed = self._replayed(appended, document)
        if replayed is None:
            when = _last_change(self.path / _PROJECT)
            history = History.begun(document, label="Opened", author="", when=when)
        elif len(appended) > _LONG_HISTORY_BYTES or len(replayed.entries) > _MOST_ENTRIES:
            history = replayed.shortened(_MOST_ENTRIES // 2)
        else:
            history = replayed
        self._document = history.document
        self.settle()  # before the history is written anew, which may no longer lead there from the old project.json
        if history is not replayed or not appended.endswith(b"\n"):  # what is not ended was being written at a crash
            self._begin_history(history)
        return history

    def begin(self, history: History) -> None:
        """Write a new project, over whatever was there.

        Raises:
            ExportError: if that fails.
        """
        self._document = history.document
        self.settle()
        self._begin_history(history)

    def save_commit(self, history: History, *, amended: bool = False) -> None:
        """Write what a commit led to; when this returns the disk has it, and `settle` is due.

        Raises:
            ExportError: if that fails.
        """
        document = history.document
        self._save_arrays(document)
        line = {"amend" if amended else "commit": _entry_fields(history.present)}
        if self._document is None:
            self._append({**line, "document": document})
        else:
            self._append({**line, "change": change_between(self._document, document)})
        self._document = document

    def save_move(self, history: History) -> None:
        """Write that the history stands elsewhere; when this returns the disk has it, and `settle` is due.

        Raises:
            ExportError: if that fails.
        """
        self._append({"at": history.present.number})
        self._document = history.document

    def settle(self) -> None:
        """Have project.json be the document that counts; safe to be called by another thread than the others.

        Raises:
            ExportError: if that fails.
        """
        with self._replacing:
            document = self._document
            if document is None:
                return
            data = encode(document)
            if data != self._written:
                self._save_arrays(document)
                self._replace(self.path / _PROJECT, data)
                self._written = data

    def _save_arrays(self, document: Document) -> None:
        for name, arrays in arrays_of(document).items():
            if name not in self._kept:
                self._replace(self.path / _ARRAYS / f"{name}.npz", arrays.data)
                self._kept[name] = arrays

    def _replace(self, target: Path, data: bytes) -> None:
        """Write aside and rename, so that there is always the old or the new, and both whole."""
        aside = target.with_name(f".{target.name}.{secrets.token_hex(4)}.part")
        try:
            write_bytes(aside, data)
            os.replace(aside, target)
            sync_folder(target.parent)
        except OSError as error:
            raise cannot_write(target, error) from None
        finally:
            with contextlib.suppress(OSError):
                aside.unlink(missing_ok=True)

    def _append(self, fields: Mapping[str, Any]) -> None:
        append_bytes(self.path / _HISTORY, encode(fields) + b"\n")

    def _begin_history(self, history: History) -> None:
        lines = []
        before: Document | None = None
        for entry in history.entries:
            self._save_arrays(entry.document)
            what = (
                {"document": entry.document} if before is None else {"change": change_between(before, entry.document)}
            )
            lines.append(encode({"commit": _entry_fields(entry), **what}) + b"\n")
            before = entry.document
        lines.append(encode({"at": history.present.number}) + b"\n")
        self._replace(self.path / _HISTORY, b"".join(lines))

    def _appended(self) -> bytes:
        try:
            return (self.path / _HISTORY).read_bytes()
        except OSError:
            return b""

    def _replayed(self, appended: bytes, document: Document) -> History | None:
        """Replay what was appended; None where it is missing, damaged, or never came by project.json's document."""
        try:
            entries: list[Entry] = []
            passed: list[Document] = []
            at = 0
            for line in appended.split(b"\n")[:-1]:
                fields = msgspec.json.decode(line)
                if "at" in fields:
                    at = next(k for k, entry in enumerate(entries) if entry.number == fields["at"])
                    continue
                if "change" in fields:
                    after = changed(entries[at].document, fields["change"], self._arrays)
                else:
                    after = decode_document(encode(fields["document"]), self._arrays)
                if "amend" in fields:
                    entries[at:] = [_entry(fields["amend"], after)]
                else:
                    entries[at + 1 :] = [_entry(fields["commit"], after)]
                    at = len(entries) - 1
                passed.append(after)
            history = entries_from(entries, at)
            if document not in reversed(passed):
                raise FormatError("it is of another document")
        except (ValueError, KeyError, TypeError, IndexError, StopIteration, LadarregError) as error:
            log.info("the history is not used: %s", error)
            return None
        return history

    def _arrays(self, name: str) -> StoredArrays:
        if name in self._kept:
            return self._kept[name]
        if not name.isalnum():
            raise FormatError(f"{name[:20]!r} is no name of stored matches; the project is damaged")
        try:
            found = StoredArrays((self.path / _ARRAYS / f"{name}.npz").read_bytes())
        except OSError as error:
            raise FormatError(f"the stored matches {name[:8]} are missing: {error.strerror or error}") from None
        if found.name != name:
            raise FormatError(f"the stored matches {name[:8]} are not what they were; solve again")
        self._kept[name] = found
        return found


def _entry_fields(entry: Entry) -> dict[str, Any]:
    return {"number": entry.number, "label": entry.label, "author": entry.author, "when": entry.when}


def _entry(fields: Mapping[str, Any], document: Document) -> Entry:
    return Entry(int(fields["number"]), str(fields["label"]), str(fields["author"]), str(fields["when"]), document)


def _last_change(path: Path) -> str:
    import datetime

    return datetime.datetime.fromtimestamp(path.stat().st_mtime).astimezone().isoformat(timespec="seconds")


def _held(lock: Path, folder: Path) -> int:
    """Hold a file for as long as this process lives, so that a crash lets it go.

    Raises:
        ExportError: if another process holds it.
    """
    try:
        descriptor = os.open(lock, os.O_RDWR | os.O_CREAT, 0o600)
    except OSError as error:
        raise cannot_write(lock, error) from None
    try:
        if os.name == "nt":
            import msvcrt

            msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined,unused-ignore]
        else:
            import fcntl

            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        raise ExportError(
            f"the project {folder} is open in another program; close that, or open a copy of the folder"
        ) from None
    return descriptor


def _released(descriptor: int, lock: Path) -> None:
    with contextlib.suppress(OSError):
        os.close(descriptor)
