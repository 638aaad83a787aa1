"""The session: the document and its history, the only mutable state of a project, behind one lock."""

from __future__ import annotations

import datetime
import logging
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from ladarreg_core.errors import LadarregError, UnsavedError
from ladarreg_core.foundations.shell_command import shell_command
from ladarreg_core.project import own_steps
from ladarreg_core.project.document import Document
from ladarreg_core.project.history import NOBODY, Author, Entry, History
from ladarreg_core.project.storage.delta import check_readable
from ladarreg_core.project.storage.folder import ProjectFolder
from ladarreg_core.project.storage.rescue import write_rescue_copy

from .debounce import Debouncer

log = logging.getLogger(__name__)
Edit = Callable[[Document], Document]
_MERGE_WITHIN_S = 1.5
"""Edits with the same merge key within this time are one step of the history."""
RETRY_S = 5.0
"""Interval at which a failed save is retried; every edit retries it, too."""


@dataclass(frozen=True, slots=True)
class Change:
    """A change of the document, as listeners receive it."""

    before: Document
    """The previous document."""
    document: Document
    """The present document."""


Listener = Callable[[Change], None]


class Session:
    """The document and its history; every commit is saved before listeners are notified.

    Args:
        folder: the project's folder.
        history: the history read from there, or a new one.
        elsewhere: folders to save the project to on closing if its own cannot be written.
    """

    def __init__(self, folder: ProjectFolder, history: History, *, elsewhere: Sequence[Path] = ()) -> None:
        self.folder = folder
        self._elsewhere = tuple(elsewhere)
        self._history = history
        self._lock = threading.RLock()
        self._listeners: list[Listener] = []
        self._last_commit: tuple[str, Author, float] = ("", NOBODY, 0.0)
        self._editors = {entry.by for entry in history.entries}
        self._saved_at = now()
        self._unsaved = ""
        self._unsettled = ""
        self._debouncer = Debouncer()
        if folder.behind:
            self._debouncer.request()
        self._thread = threading.Thread(target=self._settle, name="session", daemon=True)
        self._thread.start()

    @property
    def history(self) -> History:
        """The present history."""
        return self._history

    @property
    def document(self) -> Document:
        """The present document."""
        return self._history.document

    @property
    def saved_at(self) -> str:
        """Time of the last save, ISO 8601."""
        return self._saved_at

    @property
    def unsaved(self) -> str:
        """The reason why the document or its history could not be saved; empty if both are on the disk."""
        return self._unsaved or self._unsettled

    def subscribe(self, listener: Listener) -> Callable[[], None]:
        """Call a listener after each change, in order; return a function that ends the subscription.

        An exception in a listener is logged; the commit stands, and the other listeners are still called.
        """
        with self._lock:
            self._listeners.append(listener)
        return lambda: self._listeners.remove(listener)

    def commit(
        self, label: str, edit: Edit, *, author: Author, merge_key: str = "", automatic: bool = False
    ) -> int | None:
        """Edit the document.

        Args:
            label: description for the history.
            edit: returns the new document, or the same one if nothing changes.
            author: the client, or nobody.
            merge_key: edits of one author with the same key in quick succession become one step; empty: never.
            automatic: the program's own result after the last edit, which undo steps over, see `project.history`.

        Returns:
            The number of the step in the history; None if nothing changed.

        Raises:
            LadarregError: if the edit is refused, or the new document could not be read again; nothing changes.
        """
        with self._lock:
            before = self.document
            after = edit(before)
            if after is before or after == before:
                return None
            check_readable(before, after)
            if automatic:
                amends = self._history.present.automatic
            else:
                clock = time.monotonic()
                amends = bool(merge_key) and self._merges(merge_key, author, clock)
                self._last_commit = (merge_key, author, clock)
            if amends and not automatic and self._history.present.automatic:
                self._history = at_edit = self._history.at_edit()
                self._save(lambda: self.folder.save_move(at_edit))
            if amends:
                self._history = self._history.amended(after, when=now())
            else:
                self._history = self._history.committed(
                    after, label=label, author=author.name, by=author.id, when=now(), automatic=automatic
                )
            self._editors.add(author.id)
            history = self._history
            self._save(lambda: self.folder.save_commit(history, amended=amends))
            self._notify(before)
            return history.present.number

    def undoable(self, author: Author, *, alone: bool) -> Entry | None:
        """Return the step that a client would undo; None if there is none."""
        if not self._may_have(author, alone=alone):
            return None
        return own_steps.undoable(self._history, _mine(author, alone=alone))

    def redoable(self, author: Author, *, alone: bool) -> Entry | None:
        """Return the step that a client would redo, or the undo that it would take back; None if there is none."""
        if not self._may_have(author, alone=alone):
            return None
        history, mine = self._history, _mine(author, alone=alone)
        ahead = history.redone
        return ahead if ahead is not None and mine(ahead) else own_steps.redoable(history, mine)

    def undo(self, author: Author = NOBODY, *, alone: bool = True, number: int | None = None) -> None:
        """Undo a client's own step: the newest one, or one by its number.

        A client who is alone goes back in the history. Among others, the inverse of the step is applied to the present
        document and becomes a step of its own, which does not affect what others did since.

        Raises:
            OptionError: if there is no such step, or what it touched has changed since.
        """
        with self._lock:
            history, mine = self._history, _mine(author, alone=alone)
            step = own_steps.undoable(history, mine)
            ahead = [entry for entry in history.entries[history.at + 1 :] if not entry.automatic]
            is_next = step is not None and step is history.edit and number in (None, step.number, step.redoes)
            if is_next and (alone or (ahead and all(map(mine, ahead)))):
                self._move(lambda history: history.moved(-1))
            else:
                self._append(own_steps.undone(history, mine, author, when=now(), number=number), author)

    def redo(self, author: Author = NOBODY, *, alone: bool = True, number: int | None = None) -> None:
        """Redo a client's own step that was undone last; `number`, if given, must be its number.

        Raises:
            OptionError: if it is not, or what the step touched has changed since.
        """
        with self._lock:
            history, mine = self._history, _mine(author, alone=alone)
            ahead = history.redone
            if ahead is not None and mine(ahead) and number in (None, ahead.number, ahead.redoes):
                self._move(lambda history: history.moved(1))
            else:
                self._append(own_steps.redone(history, mine, author, when=now(), number=number), author)

    def go_to(self, number: int) -> None:
        """Go to a step of the history.

        Raises:
            OptionError: if there is no step of that number.
        """
        self._move(lambda history: history.gone_to(number))

    def save_now(self) -> str:
        """Save everything, `project.json` included; return a sentence on unsaved edits, empty if there are none."""
        with self._lock:
            self._save(self.folder.settle)
            return self._saved_elsewhere() if self.folder.behind else ""

    def close(self) -> None:
        """Save what is not saved yet, and release the folder.

        Raises:
            UnsavedError: if the disk still lacks edits; it names the folder the project was saved to instead, if any.
        """
        self._debouncer.close()
        self._thread.join(30)
        with self._lock:
            try:
                self._save(self.folder.settle)
                if self.folder.behind:
                    raise UnsavedError(self._saved_elsewhere())
            finally:
                self.folder.close()

    def _saved_elsewhere(self) -> str:
        """Save the project to another folder, and return a sentence on the outcome."""
        lacking = f"the project {self.folder.path} lacks all edits since {self._saved_at} ({self.unsaved})"
        name = f"{self.folder.path.name}-unsaved-{datetime.datetime.now():%Y%m%d-%H%M%S}"
        try:
            place = write_rescue_copy(self.folder, self._history, self._elsewhere, name=name)
        except LadarregError as error:
            return f"{lacking}, and they are lost: {error}"
        opening = shell_command(["ladarreg", "serve", place])
        return f"{lacking}; the whole project including them is in {place}: open it with: {opening}"

    def _move(self, way: Callable[[History], History]) -> None:
        with self._lock:
            before, was = self.document, self._history.at
            self._history = history = way(self._history)
            self._last_commit = ("", NOBODY, 0.0)
            if history.at != was:
                self._save(lambda: self.folder.save_move(history))
                self._notify(before)

    def _append(self, history: History, author: Author) -> None:
        """Keep a history with an additional commit."""
        before = self.document
        if history is self._history:
            return
        check_readable(before, history.document)
        self._history = history
        self._last_commit = ("", NOBODY, 0.0)
        self._editors.add(author.id)
        self._save(lambda: self.folder.save_commit(history))
        self._notify(before)

    def _may_have(self, author: Author, *, alone: bool) -> bool:
        """Return whether any step can be a client's own: most that only watch have none among thousands."""
        return alone or author.id in self._editors

    def _merges(self, merge_key: str, author: Author, clock: float) -> bool:
        last, by, when = self._last_commit
        return last == merge_key and by == author and clock - when < _MERGE_WITHIN_S and self._history.redone is None

    def _save(self, save: Callable[[], None]) -> None:
        """Save; with a full disk, work continues in memory and is saved as soon as that is possible."""
        try:
            save()
            self._unsaved, self._saved_at = "", now()
        except LadarregError as error:
            self._unsaved = str(error)
        self._debouncer.request()

    def _settle(self) -> None:
        """Write project.json after edits, and retry failed saves."""
        while self._debouncer.wait(RETRY_S if self.unsaved else None):
            try:
                self.folder.settle()
                why = ""
            except LadarregError as error:
                why = str(error)
            with self._lock:
                was = self.unsaved
                self._unsettled = why
                if self._unsaved and not self.folder.behind:
                    self._unsaved, self._saved_at = "", now()
                if was != self.unsaved:
                    self._notify(self.document)

    def _notify(self, before: Document) -> None:
        change = Change(before, self.document)
        for listener in list(self._listeners):
            try:
                listener(change)
            except Exception:
                log.exception("a listener failed after a change")


def _mine(author: Author, *, alone: bool) -> Callable[[Entry], bool]:
    """Return which steps a client may undo: all if nobody else is there, else its own."""
    return lambda entry: alone or (entry.by == author.id and entry.by != "")


def now() -> str:
    """Return the present time, ISO 8601 with its offset."""
    return datetime.datetime.now().astimezone().isoformat(timespec="seconds")
