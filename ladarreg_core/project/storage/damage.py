"""What is damaged in the folder of a project, found without opening it: nothing is locked, repaired or written."""

from __future__ import annotations

import contextlib
from pathlib import Path

import msgspec

from ladarreg_core.errors import LadarregError
from ladarreg_core.project.checksum import verify_checksum
from ladarreg_core.project.document import Document
from ladarreg_core.project.source import Source as OpenedFile
from ladarreg_core.project.storage.codec import decode_document
from ladarreg_core.project.storage.records import read_records
from ladarreg_core.project.storage.replay import Snapshot, replay
from ladarreg_core.project.stored_arrays import StoredArrays

_PROJECT, _HISTORY, _ARRAYS = "project.json", "history.jsonl", "arrays"


def project_damage(folder: Path) -> tuple[list[str], list[str]]:
    """Return what is damaged in a project, a sentence each, and notes on what could not be compared.

    Raises:
        OSError: if a file cannot be read.
    """
    damaged: list[str] = []
    notes: list[str] = []
    arrays = _Arrays(folder / _ARRAYS)
    document: Document | None = None
    snapshot: Snapshot | None = None
    if (folder / _PROJECT).is_file():
        checked = verify_checksum((folder / _PROJECT).read_bytes(), correct=False)
        if checked.state == "no checksum":
            notes.append(f"{_PROJECT} has no checksum")
        elif checked.state != "intact":
            damaged.append(f"{_PROJECT} does not match its checksum")
        try:
            document = decode_document(checked.data, arrays.find)
            seq = msgspec.json.decode(checked.data).get("seq") if checked.state == "intact" else None
            snapshot = Snapshot(document, seq if isinstance(seq, int) else None, "")
        except LadarregError as error:
            damaged.append(f"{_PROJECT} cannot be read: {error}")
    else:
        damaged.append(f"{_PROJECT} is missing; the history restores it when the project is opened")
    if (folder / _HISTORY).is_file():
        records = read_records((folder / _HISTORY).read_bytes())
        if records.intact_bytes is None:
            damaged.append(f"{_HISTORY} has lines that do not match their checksums")
        with contextlib.suppress(LadarregError):
            found = replay(records.found, snapshot, arrays.find)
            if found.lost:
                damaged.append(f"{_HISTORY} has lost steps in {found.lost} places")
            document = document or found.history.document
    else:
        damaged.append(f"{_HISTORY} is missing: the undo steps are lost")
    damaged += arrays.damaged
    for source in [] if document is None else _opened(document):
        damaged += _of_source(folder, source)
    return list(dict.fromkeys(damaged)), notes


class _Arrays:
    """Stored arrays by their names, with a sentence on each that is missing or damaged."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._known: dict[str, StoredArrays] = {}
        self.damaged: list[str] = []

    def find(self, name: str) -> StoredArrays:
        if name not in self._known:
            self._known[name] = self._read(name)
        return self._known[name]

    def _read(self, name: str) -> StoredArrays:
        shown = f"{_ARRAYS}/{name[:60]}.npz"
        if name.isalnum():
            with contextlib.suppress(OSError):
                found = StoredArrays((self._folder / f"{name}.npz").read_bytes())
                if found.name == name:
                    return found
                self.damaged.append(f"{shown} is not what was written (another SHA-256)")
                return StoredArrays(b"", lost=name)
        self.damaged.append(f"{shown} is missing")
        return StoredArrays(b"", lost=name)


def _opened(document: Document) -> list[OpenedFile]:
    files = [document.scan, *(one for photo in document.photos for one in (photo.source, photo.camera.file))]
    return [one for one in files if one is not None]


def _of_source(folder: Path, source: OpenedFile) -> list[str]:
    """Return what has become of a file that was opened; those of a moved project are missed where it needs them."""
    path = folder / source.path
    if not path.is_file():
        return [f"{source.name}: the file is missing ({source.path})"]
    size = path.stat().st_size
    return [] if size == source.size else [f"{source.name} has {size:,} bytes in place of {source.size:,}"]
