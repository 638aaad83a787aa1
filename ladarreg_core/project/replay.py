"""Makes a history of what the two files of a project hold, each of which may be damaged or missing.

The history's records are replayed in order. `project.json` says of which record it holds the document: where that
document is not what the replay came to, because records before it are lost, it becomes a step 'Recovered', and the
replay goes on from there. A change whose predecessor is lost is made to what there is, as far as that is possible.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from ladarreg_core.errors import FormatError, LadarregError, NewerVersionError
from ladarreg_core.project.codec import FindArrays, decode_document, encode
from ladarreg_core.project.delta import changed
from ladarreg_core.project.document import Document
from ladarreg_core.project.history import Entry, History
from ladarreg_core.project.records import Record
from ladarreg_core.project.unknown_fields import Unknown, unknown_fields

RECOVERED = "Recovered"


@dataclass(frozen=True, slots=True)
class Snapshot:
    """What `project.json` holds."""

    document: Document
    """The document."""
    seq: int | None
    """Which record led to it; None where that is not known, as with files of older versions."""
    when: str
    """When it was written, ISO 8601."""


@dataclass(frozen=True, slots=True)
class Replayed:
    """What came of it."""

    history: History
    """The history, which stands at the newest document."""
    seq: int
    """The last record's number."""
    lost: int
    """How many stretches of records were lost, or could not be made."""
    recovered: bool
    """Whether the snapshot became a step of its own."""
    unknown: Unknown
    """Fields of whole documents that this version does not know."""


def replayed(records: Sequence[Record | None], snapshot: Snapshot | None, find: FindArrays) -> Replayed:
    """Return the history of the records and the snapshot.

    Args:
        records: in order, None for what is lost.
        snapshot: what `project.json` holds; None where it is missing or damaged.
        find: returns the arrays of a name.

    Raises:
        NewerVersionError: if a newer version of the program wrote them.
        FormatError: if there is no document in any of them.
    """
    replay = _Replay(snapshot, find)
    for record in records:
        replay.take(record)
    return replay.ended()


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

    def take(self, record: Record | None) -> None:
        """Make the next record."""
        if record is None:
            self._lost += 1
            self._after_gap = True
            return
        try:
            self._count(record)
            self._after_gap = False
            if "at" in record:
                self._at = self._index(self._numbers[record["at"]])
            elif "commit" in record or "amend" in record:
                self._commit(record)
        except NewerVersionError:
            raise
        except (ValueError, KeyError, TypeError, IndexError, AttributeError, LadarregError):
            self._lost += 1

    def ended(self) -> Replayed:
        """Return what came of all records."""
        if self._waiting is not None:
            self._meet(self._waiting)
        elif self._snapshot is not None and self._snapshot.seq is None and self._not_passed(self._snapshot.document):
            self._meet(self._snapshot)
        if not self._entries:
            raise FormatError("no document in it can be read any more")
        seq = max(self._seq or 0, (self._snapshot.seq or 0) if self._snapshot is not None else 0)
        history = History(tuple(self._entries), self._at)
        return Replayed(history, seq, self._lost, self._recovered, self._unknown)

    def _count(self, record: Record) -> None:
        """Look where the record stands: after which others, and before or after the snapshot."""
        seq = record.get("seq")
        if not isinstance(seq, int):
            return
        if self._waiting is not None and self._waiting.seq is not None and seq > self._waiting.seq:
            if self._seq is not None or self._lost:  # otherwise the history was written anew after it
                self._meet(self._waiting)
            self._waiting = None
        if self._seq is not None and seq > self._seq + 1 and not self._after_gap:
            self._lost += 1
        self._seq = seq

    def _meet(self, snapshot: Snapshot) -> None:
        """Go on from the snapshot where the replay did not come to the same."""
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
            self._entries[self._at :] = [_entry(number, fields, after)]
        else:
            after_present = self._entries[self._at].number + 1 if self._entries else number
            self._numbers[number] = new = max(number, after_present)
            self._add(_entry(new, fields, after))
        self._passed.append(after)

    def _document_after(self, record: Record) -> Document:
        if "change" in record:
            return changed(self._entries[self._at].document, record["change"], self._find)
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

    def _not_passed(self, document: Document) -> bool:
        return document not in reversed(self._passed)


def _entry(number: int, fields: dict[str, Any], document: Document) -> Entry:
    return Entry(number, str(fields["label"]), str(fields["author"]), str(fields["when"]), document)
