"""The history of a document: a list of commits with labels; undo is a step back in the list.

Automatic commits are results that the program computes after an edit. They belong to that edit: undo and redo step over
them, and consecutive ones replace each other.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import islice

from ladarreg_core.errors import OptionError
from ladarreg_core.project.document import Document

MAX_STEPS = 10_000
"""Limit of the undo steps: days of work, and a bound on the memory that ten busy clients use."""


@dataclass(frozen=True, slots=True)
class Author:
    """Who edits."""

    name: str = ""
    """Name of the operator."""
    id: str = ""
    """Stable id of the operator; empty if there is none, as for the command line."""


NOBODY = Author()
"""The author of edits that no operator made."""


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
    automatic: bool = False
    """Whether the program made it after the edit before it, without being asked."""
    by: str = ""
    """Id of the operator; empty if unknown, as in files of older versions."""
    undoes: int | None = None
    """Number of the earlier commit that this one takes back."""
    redoes: int | None = None
    """Number of the earlier commit that this one restores."""


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
        index = self._edit_before(self.at)
        return self.entries[index] if index > 0 else None

    @property
    def redone(self) -> Entry | None:
        """The commit that redo would restore; None at the end."""
        return next((entry for entry in self.entries[self.at + 1 :] if not entry.automatic), None)

    def latest_edits(self, most: int) -> tuple[Entry, ...]:
        """Return the newest commits that are not automatic, undone ones included, in order."""
        newest_first = (entry for entry in reversed(self.entries) if not entry.automatic)
        return tuple(islice(newest_first, most))[::-1]

    @property
    def edit(self) -> Entry:
        """The newest commit up to the current one that is not automatic."""
        return self.entries[self._edit_before(self.at)]

    def committed(
        self,
        document: Document,
        *,
        label: str,
        author: str,
        when: str,
        automatic: bool = False,
        by: str = "",
        undoes: int | None = None,
        redoes: int | None = None,
    ) -> History:
        """Return the history with an additional commit, without the commits that had been undone."""
        entry = Entry(self.next_number, label, author, when, document, automatic, by, undoes, redoes)
        entries = (*self.entries[: self.at + 1], entry)[-MAX_STEPS:]
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
        """Return the history moved back (negative) or forward by edits, at most to its ends."""
        at = self.at
        for _ in range(abs(steps)):
            at = self._edit_before(at) - 1 if steps < 0 else self._last_of(self._edit_after(at))
        return History(self.entries, min(max(at, 0), len(self.entries) - 1))

    def at_edit(self) -> History:
        """Return the history at its newest edit, before the automatic commits that follow it."""
        return History(self.entries, self._edit_before(self.at))

    def gone_to(self, number: int) -> History:
        """Return the history at the commit with a given number, with the automatic ones that belong to it.

        Raises:
            OptionError: if there is none.
        """
        for index, entry in enumerate(self.entries):
            if entry.number == number:
                return History(self.entries, self._last_of(index))
        raise OptionError(f"there is no step {number} in the history; choose one that is listed")

    def shortened(self, most: int) -> History:
        """Return the last `most` commits, and earlier ones back to the current commit if necessary."""
        first = max(0, min(len(self.entries) - most, self.at))
        return History(self.entries[first:], self.at - first)

    def _edit_before(self, index: int) -> int:
        """Return the index of the newest edit up to an index; 0 where all are automatic."""
        while index > 0 and self.entries[index].automatic:
            index -= 1
        return index

    def _edit_after(self, index: int) -> int:
        """Return the index of the next edit after an index; the index itself where there is none."""
        return next((k for k in range(index + 1, len(self.entries)) if not self.entries[k].automatic), index)

    def _last_of(self, index: int) -> int:
        """Return the index of the last automatic commit that follows an edit, or of the edit itself."""
        while index + 1 < len(self.entries) and self.entries[index + 1].automatic:
            index += 1
        return index
