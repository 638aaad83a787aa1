"""The history of a document: every commit with its name; undo is a step back in a list."""

from __future__ import annotations

from dataclasses import dataclass, replace

from ladarreg_core.errors import OptionError
from ladarreg_core.project.document import Document

MOST_STEPS = 10_000
"""So many can be gone back: days of work, and a bound for what ten busy people leave in memory."""


@dataclass(frozen=True, slots=True, eq=False)
class Entry:
    """One commit."""

    number: int
    """Counts up and is never used twice."""
    label: str
    """What was done."""
    author: str
    """Who did it."""
    when: str
    """ISO 8601, local time with its offset."""
    document: Document
    """What it led to."""


@dataclass(frozen=True, slots=True, eq=False)
class History:
    """All commits that can be gone back or forward to."""

    entries: tuple[Entry, ...]
    """The first is where the work began."""
    at: int
    """Index of the present one."""

    @staticmethod
    def begun(document: Document, *, label: str, author: str, when: str) -> History:
        """Return a history of one entry."""
        return History((Entry(0, label, author, when, document),), 0)

    @property
    def present(self) -> Entry:
        """The entry that counts."""
        return self.entries[self.at]

    @property
    def document(self) -> Document:
        """The document that counts."""
        return self.present.document

    @property
    def undone(self) -> Entry | None:
        """What undo would take back; None at the beginning."""
        return self.present if self.at > 0 else None

    @property
    def redone(self) -> Entry | None:
        """What redo would bring again; None at the end."""
        return self.entries[self.at + 1] if self.at + 1 < len(self.entries) else None

    def committed(self, document: Document, *, label: str, author: str, when: str) -> History:
        """Return the history with one entry more; what had been undone is left behind."""
        entry = Entry(self.next_number, label, author, when, document)
        entries = (*self.entries[: self.at + 1], entry)[-MOST_STEPS:]
        return History(entries, len(entries) - 1)

    def amended(self, document: Document, *, when: str) -> History:
        """Return the history with another document for the present entry, as while one end is moved bit by bit."""
        entries = (*self.entries[: self.at], replace(self.present, document=document, when=when))
        return History(entries, self.at)

    @property
    def next_number(self) -> int:
        """The number of the next commit."""
        return self.entries[-1].number + 1  # they are in order

    def moved(self, steps: int) -> History:
        """Return the history gone back (negative) or forward, no further than it reaches."""
        return History(self.entries, min(max(self.at + steps, 0), len(self.entries) - 1))

    def gone_to(self, number: int) -> History:
        """Return the history at the commit of a number.

        Raises:
            OptionError: if there is none.
        """
        for index, entry in enumerate(self.entries):
            if entry.number == number:
                return History(self.entries, index)
        raise OptionError(f"there is no step {number} in the history; choose one that is listed")

    def shortened(self, most: int) -> History:
        """Return the last entries, the present one among them."""
        first = max(0, min(len(self.entries) - most, self.at))
        return History(self.entries[first:], self.at - first)
