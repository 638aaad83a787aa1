"""Rebuilds the history from the two files of a project, each of which may be damaged or missing.

The records of the history are replayed in order. `project.json` states after which record its document was saved. If
the replay arrives at another document there, because records are lost, the saved document becomes a step 'Recovered'
and the replay continues from it. A change whose predecessor is lost is applied to the document at hand if possible.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from ladarreg_core.errors import FormatError, LadarregError, NewerVersionError
from ladarreg_core.project.document import Document
from ladarreg_core.project.history import Entry, History
from ladarreg_core.project.storage.codec import FindArrays, decode_document, encode
from ladarreg_core.project.storage.delta import apply_change
from ladarreg_core.project.storage.records import Record
from ladarreg_core.project.storage.unknown_fields import Unknown, unknown_fields

RECOVERED = "Recovered"


@dataclass(frozen=True, slots=True)
class Snapshot:
    """Contents of `project.json`."""

    document: Document
    """The document."""
    seq: int | None
    """Number of the record that led to it; None if unknown, as in files of older versions."""
    when: str
    """Time of writing, ISO 8601."""


@dataclass(frozen=True, slots=True)
class Replayed:
    """Result of a replay."""

    history: History
    """The history, positioned at the newest document."""
    seq: int
    """Number of the last record."""
    lost: int
    """Number of gaps: records that were lost or could not be applied."""
    recovered: bool
    """Whether the snapshot became a step of its own."""
    unknown: Unknown
    """Fields of the documents that this version does not know."""


def replay(records: Sequence[Record | None], snapshot: Snapshot | None, find: FindArrays) -> Replayed:
    """Rebuild the history from its records and the snapshot.

    Args:
        records: records in order; None for lost ones.
        snapshot: contents of `project.json`; None if it is missing or damaged.
        find: returns arrays by name.

    Raises:
        NewerVersionError: if a newer version of the program wrote them.
        FormatError: if none of them contains a document.
    """
    state = _Replay(snapshot, find)
    for record in records:
        state.apply(record)
    return state.finish()


class _Replay:
    def __init__(self, snapshot: Snapshot | None, find: FindArrays) -> None:
        self._snapshot, self._find = snapshot, find
        self._waiting = snapshot if snapshot is not None and snapshot.seq is not None else None
        self._entries: list[Entry] = []
        self._at = 0
        self._seq: int | None = None
        self._numbers: dict[int, int] = {}
        self._passed: list[Document] = []
        self._lost = 0
        self._after_gap = False
        self._recovered = False
        self._unknown: Unknown = {}

    def apply(self, record: Record | None) -> None:
        """Apply the next record."""
        if record is None:
            self._lost += 1
            self._after_gap = True
            return
        try:
            self._follow_sequence(record)
            self._after_gap = False
            if "at" in record:
                self._at = self._index(self._numbers[record["at"]])
            elif "commit" in record or "amend" in record:
                self._commit(record)
        except NewerVersionError:
            raise
        except (ValueError, KeyError, TypeError, IndexError, AttributeError, LadarregError):
            self._lost += 1

    def finish(self) -> Replayed:
        """Return the result after all records."""
        if self._waiting is not None:
            self._insert_snapshot(self._waiting)
        elif self._snapshot is not None and self._snapshot.seq is None and self._is_new(self._snapshot.document):
            self._insert_snapshot(self._snapshot)
        if not self._entries:
            raise FormatError("it contains no readable document")
        seq = max(self._seq or 0, (self._snapshot.seq or 0) if self._snapshot is not None else 0)
        history = History(tuple(self._entries), self._at)
        return Replayed(history, seq, self._lost, self._recovered, self._unknown)

    def _follow_sequence(self, record: Record) -> None:
        """Detect gaps before the record, and whether the snapshot comes before it."""
        seq = record.get("seq")
        if not isinstance(seq, int):
            return
        if self._waiting is not None and self._waiting.seq is not None and seq > self._waiting.seq:
            if self._seq is not None or self._lost:  # otherwise the history was rewritten after it
                self._insert_snapshot(self._waiting)
            self._waiting = None
        if self._seq is not None and seq > self._seq + 1 and not self._after_gap:
            self._lost += 1
        self._seq = seq

    def _insert_snapshot(self, snapshot: Snapshot) -> None:
        """Continue from the snapshot where the replay arrived at another document."""
        if self._entries and self._entries[self._at].document == snapshot.document:
            return
        self._recovered = True
        number = self._entries[-1].number + 1 if self._entries else 0
        self._add(Entry(number, RECOVERED, "", snapshot.when, snapshot.document))

    def _commit(self, record: Record) -> None:
        amends = "amend" in record
        fields = record["amend" if amends else "commit"]
        number = int(fields["number"])
        after = self._document_after(record)
        if amends and self._entries and self._numbers.get(number) == self._entries[self._at].number:
            number = self._entries[self._at].number
            self._entries[self._at :] = [self._entry(number, fields, after)]
        else:
            after_present = self._entries[self._at].number + 1 if self._entries else number
            self._numbers[number] = new = max(number, after_present)
            self._add(self._entry(new, fields, after))
        self._passed.append(after)

    def _entry(self, number: int, fields: dict[str, Any], document: Document) -> Entry:
        undoes, redoes = (self._numbers.get(fields[name]) if name in fields else None for name in ("undoes", "redoes"))
        label, author, when = (str(fields[name]) for name in ("label", "author", "when"))
        automatic, by = fields.get("automatic") is True, str(fields.get("by", ""))
        return Entry(number, label, author, when, document, automatic, by, undoes, redoes)

    def _document_after(self, record: Record) -> Document:
        if "change" in record:
            return apply_change(self._entries[self._at].document, record["change"], self._find)
        document = decode_document(encode(record["document"]), self._find)
        self._unknown |= unknown_fields(record["document"], document)
        return document

    def _add(self, entry: Entry) -> None:
        self._entries[self._at + 1 :] = [entry]
        self._at = len(self._entries) - 1

    def _index(self, number: int) -> int:
        for index, entry in enumerate(self._entries):
            if entry.number == number:
                return index
        raise KeyError(number)

    def _is_new(self, document: Document) -> bool:
        return document not in reversed(self._passed)
