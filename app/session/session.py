"""The session: the document and its history, the only mutable state of a project, behind one lock."""

from __future__ import annotations

import datetime
import logging
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from ladarreg_core.errors import LadarregError, OptionError, UnsavedError
from ladarreg_core.project.delta import check_readable
from ladarreg_core.project.document import Document
from ladarreg_core.project.folder import ProjectFolder
from ladarreg_core.project.history import History
from ladarreg_core.project.rescue import write_rescue_copy

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
        self._last_commit: tuple[str, str, float] = ("", "", 0.0)
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
        self, label: str, edit: Edit, *, author: str, merge_key: str = "", automatic: bool = False
    ) -> int | None:
        """Edit the document.

        Args:
            label: description for the history.
            edit: returns the new document, or the same one if nothing changes.
            author: name of the client.
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
                    after, label=label, author=author, when=now(), automatic=automatic
                )
            history = self._history
            self._save(lambda: self.folder.save_commit(history, amended=amends))
            self._notify(before)
            return history.present.number

    def undo(self, number: int | None = None) -> None:
        """Undo the last step.

        Args:
            number: the step that is meant; None: whichever is the last.

        Raises:
            OptionError: if that step is not the last one any more.
        """
        with self._lock:
            if number is not None:
                self._require_last(number)
            self._move(lambda history: history.moved(-1))

    def _require_last(self, number: int) -> None:
        last = self._history.undone
        if last is not None and last.number == number:
            return
        done = self._history.entries[: self._history.at + 1]
        meant = next((entry for entry in done if entry.number == number), None)
        if meant is None or last is None:
            raise OptionError("that step is undone already")
        by = f" by {last.author}" if last.author and last.author != meant.author else ""
        raise OptionError(
            f"'{meant.label}' is not the last step any more: '{last.label}'{by} came after it; undo that first, or "
            "choose a step in the History"
        )

    def redo(self) -> None:
        """Redo the step that was undone last."""
        self._move(lambda history: history.moved(1))

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
        return f"{lacking}; the whole project including them is in {place}: open it with 'ladarreg serve {place}'"

    def _move(self, way: Callable[[History], History]) -> None:
        with self._lock:
            before, was = self.document, self._history.at
            self._history = history = way(self._history)
            self._last_commit = ("", "", 0.0)
            if history.at != was:
                self._save(lambda: self.folder.save_move(history))
                self._notify(before)

    def _merges(self, merge_key: str, author: str, clock: float) -> bool:
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


def now() -> str:
    """Return the present time, ISO 8601 with its offset."""
    return datetime.datetime.now().astimezone().isoformat(timespec="seconds")
