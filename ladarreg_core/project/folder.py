"""The folder that a project is kept in; it is whole at every moment, whatever becomes of the program.

history.jsonl     every commit and every step back, each appended and on the disk before anybody is told of it
project.json      the document that counts, replaced in one step a moment later; where it is behind, the history leads
arrays/NAME.npz   arrays, named by their content
inputs/           files that were uploaded
exports/          what was exported last, per photograph
lock              held while a program has the project open

Either of the first two is a project, and each is written again from the other. A damaged file is never overwritten: it
is renamed to NAME.damaged-1.json, say.
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
from ladarreg_core.export.atomic_write import AppendedFile, cannot_write, sync_folder, write_bytes
from ladarreg_core.project.checksum import sealed, unsealed
from ladarreg_core.project.codec import arrays_of, decode_document, encode
from ladarreg_core.project.delta import change_between
from ladarreg_core.project.document import Document
from ladarreg_core.project.history import Entry, History
from ladarreg_core.project.lock import FolderLock
from ladarreg_core.project.records import Records, read_records, record_line
from ladarreg_core.project.replay import RECOVERED, Replayed, Snapshot, replayed
from ladarreg_core.project.stored_arrays import StoredArrays
from ladarreg_core.project.unknown_fields import Unknown, encoded_with, unknown_fields

log = logging.getLogger(__name__)
_PROJECT, _HISTORY, _ARRAYS, _INPUTS, _EXPORTS, _LOCK = (
    "project.json", "history.jsonl", "arrays", "inputs", "exports", "lock",
)  # fmt: skip
_MOST_ENTRIES = 5000
_LONG_HISTORY_BYTES = 64 << 20


def is_project(path: str | Path) -> bool:
    """Return whether there is a project in a folder, be it damaged."""
    return any(os.path.isfile(Path(path) / name) for name in (_PROJECT, _HISTORY))


class ProjectFolder:
    """Keeps one project on the disk.

    What cannot be written waits in memory: every later save, and every `settle`, begins with it.
    """

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
        self._lock = FolderLock(self.path, _LOCK)
        self._kept: dict[str, StoredArrays] = {}
        self._missing: dict[str, StoredArrays] = {}
        self._unknown: Unknown = {}
        self._damaged: set[Path] = set()
        self._said: list[str] = []
        self._written: bytes | None = None
        self._history: History | None = None  # as it is in memory
        self._seq = 0  # of the last record, be it waiting or written
        self._waiting: list[tuple[bytes, Document]] = []  # records that follow on those in the file
        self._anew = False  # the file has to be written whole
        self._journal: AppendedFile | None = None
        self._appending = threading.RLock()
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
        return is_project(self.path)

    @property
    def said(self) -> tuple[str, ...]:
        """What was amiss when the project was read, and what was done about it, in sentences."""
        return tuple(self._said)

    @property
    def behind(self) -> bool:
        """Whether the disk lacks a commit or a step back that was to be saved."""
        return self._anew or bool(self._waiting)

    def close(self) -> None:
        """Let another program have it."""
        if self._journal is not None:
            self._journal.close()
        self._lock.release()

    def source_path(self, path: str) -> Path:
        """Return where a source's file is."""
        return self.path / path  # an absolute one stays itself

    def relative(self, path: Path) -> str:
        """Return how a source names a file: relative where it lies in the folder, so that the folder can be moved."""
        absolute = Path(os.path.abspath(path))
        inside = absolute.is_relative_to(self.path)
        return absolute.relative_to(self.path).as_posix() if inside else str(absolute)

    def read(self) -> History:
        """Return the project with its history, as far as what is on the disk leads; `said` holds what was amiss.

        Raises:
            NewerVersionError: if a newer version of the program wrote the project; it is left as it is.
            FormatError: if there is no project, or nothing of it can be read.
        """
        if not self.begun:
            raise FormatError(f"there is no project in {self.path}: it has neither {_PROJECT} nor {_HISTORY}")
        snapshot = self._snapshot()
        appended = self._bytes(_HISTORY)
        records = read_records(appended or b"")
        try:
            found = replayed(records.found, snapshot, self._arrays)
        except NewerVersionError:
            raise
        except FormatError:
            raise FormatError(
                f"the project {self.path} cannot be read: {_PROJECT} and {_HISTORY} are both damaged or missing;"
                " put copies of them there"
            ) from None
        history = found.history
        if len(appended or b"") > _LONG_HISTORY_BYTES or len(history.entries) > _MOST_ENTRIES:
            history = history.shortened(_MOST_ENTRIES // 2)
        self._history, self._seq = history, found.seq
        self._unknown = found.unknown | self._unknown
        sound = records.sound if history is found.history and not (found.lost or found.recovered) else None
        if sound is None or appended is None:
            self._anew = True
        else:
            self._journal = AppendedFile(self.path / _HISTORY, sound=sound)
        self._say_of_history(appended, records, found)
        self._say_of_arrays(history)
        try:
            self.settle()
        except ExportError as error:  # it can be looked at, and is saved as soon as that is possible
            log.warning("the project cannot be saved: %s", error)
        return history

    def begin(self, history: History) -> None:
        """Write a new project, over whatever was there.

        Raises:
            ExportError: if that fails.
        """
        with self._appending:
            self._history, self._anew = history, True
        self.settle()

    def save_commit(self, history: History, *, amended: bool = False) -> None:
        """Write what a commit led to; when this returns the disk has it, and `settle` is due.

        Raises:
            ExportError: if that fails; it is `behind` then.
        """
        with self._appending:
            if self._history is None:
                self._anew = True
            else:
                change = change_between(self._history.document, history.document)
                kind = "amend" if amended else "commit"
                self._wait({kind: _entry_fields(history.present), "change": change}, history.document)
            self._history = history
            self._catch_up()

    def save_move(self, history: History) -> None:
        """Write that the history stands elsewhere; when this returns the disk has it, and `settle` is due.

        Raises:
            ExportError: if that fails; it is `behind` then.
        """
        with self._appending:
            self._wait({"at": history.present.number}, history.document)
            self._history = history
            self._catch_up()

    def settle(self) -> None:
        """Write what is waiting, and have project.json be the document that counts; any thread may call it.

        Raises:
            ExportError: if that fails.
        """
        try:
            with self._appending:
                self._catch_up()
        finally:  # of two files, the one that can be written is
            self._write_project()

    def _write_project(self) -> None:
        with self._replacing:
            with self._appending:
                if self._history is None:
                    return
                document, seq = self._history.document, self._seq
            data = self._project_bytes(document, seq)
            if data != self._written:
                self._save_arrays(document)
                self._replace(self.path / _PROJECT, data)
                self._written = data

    def _project_bytes(self, document: Document, seq: int) -> bytes:
        data = encoded_with(document, self._unknown) if self._unknown else encode(document)
        return sealed(data[:-1] + b',"seq":%d}' % seq)

    def _wait(self, fields: Mapping[str, Any], document: Document) -> None:
        self._seq += 1
        self._waiting.append((record_line(fields, self._seq), document))

    def _catch_up(self) -> None:
        """Write what is waiting, in its order."""
        if self._history is None or not self.behind:
            return
        if self._anew or self._journal is None or not self._journal.intact:
            self._write_history(self._history)
            return
        for _, document in self._waiting:
            self._save_arrays(document)
        self._journal.append(b"".join(line for line, _ in self._waiting))
        self._waiting = []

    def _write_history(self, history: History) -> None:
        """Write the file anew, as for a new project or where the present one cannot be appended to."""
        self._anew = True
        lines = []
        before: Document | None = None
        for entry in history.entries:
            self._save_arrays(entry.document)
            if before is None:
                whole = encoded_with(entry.document, self._unknown) if self._unknown else encode(entry.document)
                what: dict[str, Any] = {"document": msgspec.Raw(whole)}
            else:
                what = {"change": change_between(before, entry.document)}
            lines.append(record_line({"commit": _entry_fields(entry), **what}, self._seq))
            before = entry.document
        lines.append(record_line({"at": history.present.number}, self._seq))
        if self._journal is not None:
            if not self._journal.intact:  # somebody else has put something there
                self._damaged.add(self.path / _HISTORY)
            self._journal.close()
            self._journal = None
        data = b"".join(lines)
        self._replace(self.path / _HISTORY, data)
        self._journal = AppendedFile(self.path / _HISTORY, sound=len(data))
        self._anew, self._waiting = False, []

    def _save_arrays(self, document: Document) -> None:
        for name, arrays in arrays_of(document).items():
            if name not in self._kept and not arrays.lost:
                self._replace(self.path / _ARRAYS / f"{name}.npz", arrays.data)
                self._kept[name] = arrays

    def _replace(self, target: Path, data: bytes) -> None:
        """Write aside and rename, so that there is always the old or the new, and both whole."""
        aside = target.with_name(f".{target.name}.{secrets.token_hex(4)}.part")
        try:
            write_bytes(aside, data)
            if target in self._damaged and target.exists():
                self._said.append(f"The file as it was is kept as {_set_aside(target).name}.")
            self._damaged.discard(target)
            os.replace(aside, target)
            sync_folder(target.parent)
        except OSError as error:
            raise cannot_write(target, error) from None
        finally:
            with contextlib.suppress(OSError):
                aside.unlink(missing_ok=True)

    def _bytes(self, name: str) -> bytes | None:
        """Return a file; None where there is none.

        Raises:
            FormatError: if there is one that cannot be read, which is no reason to write another.
        """
        try:
            return (self.path / name).read_bytes()
        except FileNotFoundError:
            return None
        except OSError as error:
            raise FormatError(f"{self.path / name} cannot be read: {error.strerror or error}") from None

    def _snapshot(self) -> Snapshot | None:
        """Return what project.json holds; None where that cannot be read."""
        path = self.path / _PROJECT
        data = self._bytes(_PROJECT)
        if data is None:
            self._said.append(f"{_PROJECT} was missing and was written again from {_HISTORY}.")
            return None
        opened = unsealed(data)
        try:
            document = decode_document(opened.data, self._arrays)
            fields = msgspec.json.decode(opened.data)
            self._unknown = unknown_fields(fields, document)
        except NewerVersionError:
            raise
        except LadarregError as error:
            log.warning("%s is damaged: %s", path, error)
            self._damaged.add(path)
            self._said.append(f"{_PROJECT} was damaged and was written again from {_HISTORY}.")
            return None
        seq = fields.get("seq") if opened.state in ("sound", "mended") else None
        if opened.state == "sound":
            self._written = data
        if opened.state == "mended":
            self._damaged.add(path)
            self._said.append(f"{_PROJECT} had a damaged character, which its checksum told.")
        if opened.state == "broken":
            self._damaged.add(path)
            self._said.append(f"{_PROJECT} was changed by another program.")
        when = datetime.datetime.fromtimestamp(path.stat().st_mtime).astimezone().isoformat(timespec="seconds")
        return Snapshot(document, seq if isinstance(seq, int) else None, when)

    def _say_of_history(self, appended: bytes | None, records: Records, found: Replayed) -> None:
        if appended is None:
            self._said.append(f"{_HISTORY} was missing: the project is as {_PROJECT} keeps it, and its steps are lost.")
            return
        if records.sound is None or found.lost:
            self._damaged.add(self.path / _HISTORY)
        if found.lost:
            self._said.append(
                f"{_HISTORY} was damaged in {_times(found.lost)}: some steps cannot be gone back to any more, and what"
                f" they led to is {f'the step {RECOVERED!r}' if found.recovered else 'made of those that can be read'}."
            )
        elif found.recovered:
            self._said.append(f"{_PROJECT} holds what {_HISTORY} does not lead to: it is the step {RECOVERED!r}.")
        elif records.sound is None:
            self._said.append(f"{_HISTORY} had a damaged character, which its checksum told; no step is lost.")

    def _say_of_arrays(self, history: History) -> None:
        for arrays in self._missing.values():
            path = self._array_path(arrays.name)
            if path.exists():
                with contextlib.suppress(OSError):
                    _set_aside(path, keep=False)
        here = self._missing.keys() & arrays_of(history.document).keys()
        if here:
            self._said.append(f"The matches of {_answers(len(here))} are missing or damaged: solve again there.")
        elif self._missing:
            self._said.append("Matches of answers in earlier steps are missing or damaged.")

    def _array_path(self, name: str) -> Path:
        return self.path / _ARRAYS / f"{name}.npz"

    def _arrays(self, name: str) -> StoredArrays:
        known = self._kept.get(name) or self._missing.get(name)
        if known is not None:
            return known
        if not name.isalnum():
            raise FormatError(f"{name[:20]!r} is no name of stored matches; the project is damaged")
        with contextlib.suppress(OSError):
            found = StoredArrays(self._array_path(name).read_bytes())
            if found.name == name:
                self._kept[name] = found
                return found
        log.warning("the stored matches %s are missing or damaged", name)
        self._missing[name] = StoredArrays(b"", lost=name)
        return self._missing[name]


def _set_aside(path: Path, *, keep: bool = True) -> Path:
    """Have a damaged file under another name, and with `keep` under its own until another takes its place.

    Returns:
        The other name.

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
        with contextlib.suppress(OSError):  # a file system without links
            shutil.copy2(path, other)
            return other
        other.unlink(missing_ok=True)
    os.rename(path, other)
    return other


def _entry_fields(entry: Entry) -> dict[str, Any]:
    return {"number": entry.number, "label": entry.label, "author": entry.author, "when": entry.when}


def _times(count: int) -> str:
    return "one place" if count == 1 else f"{count} places"


def _answers(count: int) -> str:
    return "one answer" if count == 1 else f"{count} answers"
