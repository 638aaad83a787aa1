"""The history of a document: a list of commits with labels; undo is a step back in the list."""

from __future__ import annotations

from dataclasses import dataclass, replace

from ladarreg_core.errors import OptionError
from ladarreg_core.project.document import Document

MOST_STEPS = 10_000
"""Limit of the undo steps: days of work, and a bound on the memory that ten busy clients use."""


@dataclass(frozen=True, slots=True, eq=False)
class Entry:
    """One commit."""

    number: int
    """Increasing number, never reused."""
    label: str
    """Description of the edit."""
    author: str
    """Name of the operator."""
    when: str
    """ISO 8601, local time with its offset."""
    document: Document
    """Document after the edit."""


@dataclass(frozen=True, slots=True, eq=False)
class History:
    """All commits that undo and redo can reach."""

    entries: tuple[Entry, ...]
    """Commits in order; the first is the initial document."""
    at: int
    """Index of the current commit."""

    @staticmethod
    def begun(document: Document, *, label: str, author: str, when: str) -> History:
        """Return a history of one entry."""
        return History((Entry(0, label, author, when, document),), 0)

    @property
    def present(self) -> Entry:
        """The current commit."""
        return self.entries[self.at]

    @property
    def document(self) -> Document:
        """The current document."""
        return self.present.document

    @property
    def undone(self) -> Entry | None:
        """The commit that undo would revert; None at the beginning."""
        return self.present if self.at > 0 else None

    @property
    def redone(self) -> Entry | None:
        """The commit that redo would restore; None at the end."""
        return self.entries[self.at + 1] if self.at + 1 < len(self.entries) else None

    def committed(self, document: Document, *, label: str, author: str, when: str) -> History:
        """Return the history with an additional commit, without the commits that had been undone."""
        entry = Entry(self.next_number, label, author, when, document)
        entries = (*self.entries[: self.at + 1], entry)[-MOST_STEPS:]
        return History(entries, len(entries) - 1)

    def amended(self, document: Document, *, when: str) -> History:
        """Return the history with another document for the current commit, as while a point is being dragged."""
        entries = (*self.entries[: self.at], replace(self.present, document=document, when=when))
        return History(entries, self.at)

    @property
    def next_number(self) -> int:
        """The number of the next commit."""
        return self.entries[-1].number + 1  # they are in order

    def moved(self, steps: int) -> History:
        """Return the history moved back (negative) or forward, at most to its ends."""
        return History(self.entries, min(max(self.at + steps, 0), len(self.entries) - 1))

    def gone_to(self, number: int) -> History:
        """Return the history at the commit with a given number.

        Raises:
            OptionError: if there is none.
        """
        for index, entry in enumerate(self.entries):
            if entry.number == number:
                return History(self.entries, index)
        raise OptionError(f"there is no step {number} in the history; choose one that is listed")

    def shortened(self, most: int) -> History:
        """Return the last `most` commits, and earlier ones back to the current commit if necessary."""
        first = max(0, min(len(self.entries) - most, self.at))
        return History(self.entries[first:], self.at - first)
