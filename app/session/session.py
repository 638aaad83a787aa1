"""The session: the only state of the workbench that changes, behind one lock."""

from __future__ import annotations

import datetime
import logging
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from ladarreg_core.errors import LadarregError, UnsavedError
from ladarreg_core.project.delta import check_readable
from ladarreg_core.project.document import Document
from ladarreg_core.project.folder import ProjectFolder
from ladarreg_core.project.history import History
from ladarreg_core.project.rescue import write_rescue_copy

from .debounce import Quiet

log = logging.getLogger(__name__)
Edit = Callable[[Document], Document]
_ONE_MOVE_S = 1.5
"""Moves of the same end that follow each other as quickly are one step of the history."""
RETRY_S = 5.0
"""What could not be saved is tried again as often, and with every edit."""


@dataclass(frozen=True, slots=True)
class Change:
    """What listeners are told."""

    before: Document
    """The document as it was."""
    document: Document
    """As it is."""


Listener = Callable[[Change], None]


class Session:
    """Keeps the document and its history, and saves every commit before anybody is told of it.

    Args:
        folder: where it is saved.
        history: what was read from there, or what it was begun with.
        elsewhere: folders that take the project at the end if its own does not.
    """

    def __init__(self, folder: ProjectFolder, history: History, *, elsewhere: Sequence[Path] = ()) -> None:
        self.folder = folder
        self._elsewhere = tuple(elsewhere)
        self._history = history
        self._lock = threading.RLock()
        self._listeners: list[Listener] = []
        self._last_move: tuple[str, str, float] = ("", "", 0.0)
        self._saved_at = now()
        self._unsaved = ""
        self._unsettled = ""
        self._quiet = Quiet()
        if folder.behind:
            self._quiet.ask()
        self._thread = threading.Thread(target=self._settle, name="session", daemon=True)
        self._thread.start()

    @property
    def history(self) -> History:
        """The history as it stands."""
        return self._history

    @property
    def document(self) -> Document:
        """The document that counts."""
        return self._history.document

    @property
    def saved_at(self) -> str:
        """When it was saved last, ISO 8601."""
        return self._saved_at

    @property
    def unsaved(self) -> str:
        """Why something could not be saved, the document or its history; empty where both are on the disk."""
        return self._unsaved or self._unsettled

    def subscribe(self, listener: Listener) -> Callable[[], None]:
        """Have a listener called after each change, in their order; return what ends that.

        An exception in a listener is logged: the commit stands, and the other listeners are called all the same.
        """
        with self._lock:
            self._listeners.append(listener)
        return lambda: self._listeners.remove(listener)

    def commit(self, label: str, edit: Edit, *, author: str, one_move: str = "") -> Document:
        """Edit the document.

        Args:
            label: what is done, for the history.
            edit: returns another document, or the same for nothing.
            author: who does it.
            one_move: names a movement; edits of the same one that follow quickly become one step.

        Raises:
            LadarregError: whatever the edit refuses, or a document that could not be read again; nothing has changed
                then.
        """
        with self._lock:
            before = self.document
            after = edit(before)
            if after is before or after == before:
                return before
            check_readable(before, after)
            clock = time.monotonic()
            amends = bool(one_move) and self._goes_on(one_move, author, clock)
            if amends:
                self._history = self._history.amended(after, when=now())
            else:
                self._history = self._history.committed(after, label=label, author=author, when=now())
            self._last_move = (one_move, author, clock)
            history = self._history
            self._save(lambda: self.folder.save_commit(history, amended=amends))
            self._tell(before)
            return after

    def undo(self) -> None:
        """Take the last step back."""
        self._go(lambda history: history.moved(-1))

    def redo(self) -> None:
        """Take it again."""
        self._go(lambda history: history.moved(1))

    def go_to(self, number: int) -> None:
        """Go to a step of the history.

        Raises:
            OptionError: if there is none of that number.
        """
        self._go(lambda history: history.gone_to(number))

    def save_now(self) -> str:
        """Save everything, `project.json` included; return what became of edits that the disk has no room for."""
        with self._lock:
            self._save(self.folder.settle)
            return self._saved_elsewhere() if self.folder.behind else ""

    def close(self) -> None:
        """Save what could not be saved before, and let the folder go.

        Raises:
            UnsavedError: if the disk lacks edits still; it says which other place has the whole project, if any.
        """
        self._quiet.close()
        self._thread.join(30)
        with self._lock:
            try:
                self._save(self.folder.settle)
                if self.folder.behind:
                    raise UnsavedError(self._saved_elsewhere())
            finally:
                self.folder.close()

    def _saved_elsewhere(self) -> str:
        """Save the project where there is room, and return what there is to say of that."""
        lacking = f"the project {self.folder.path} lacks what was done since {self._saved_at} ({self.unsaved})"
        name = f"{self.folder.path.name}-unsaved-{datetime.datetime.now():%Y%m%d-%H%M%S}"
        try:
            place = write_rescue_copy(self.folder, self._history, self._elsewhere, name=name)
        except LadarregError as error:
            return f"{lacking}, and that is lost: {error}"
        return f"{lacking}; the whole project, that included, is in {place}: open it with 'ladarreg serve {place}'"

    def _go(self, way: Callable[[History], History]) -> None:
        with self._lock:
            before, was = self.document, self._history.at
            self._history = history = way(self._history)
            self._last_move = ("", "", 0.0)
            if history.at != was:
                self._save(lambda: self.folder.save_move(history))
                self._tell(before)

    def _goes_on(self, move: str, author: str, clock: float) -> bool:
        last, by, when = self._last_move
        return last == move and by == author and clock - when < _ONE_MOVE_S and self._history.redone is None

    def _save(self, save: Callable[[], None]) -> None:
        """Save; a full disk must not stop the work, which goes on in memory and is saved as soon as it can be."""
        try:
            save()
            self._unsaved, self._saved_at = "", now()
        except LadarregError as error:
            self._unsaved = str(error)
        self._quiet.ask()

    def _settle(self) -> None:
        """Let project.json follow, and save what could not be saved: again and again, as long as that fails."""
        while self._quiet.wait(RETRY_S if self.unsaved else None):
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
                    self._tell(self.document)

    def _tell(self, before: Document) -> None:
        change = Change(before, self.document)
        for listener in list(self._listeners):
            try:
                listener(change)
            except Exception:
                log.exception("a listener failed after a change")


def now() -> str:
    """Return the present time, ISO 8601 with its offset."""
    return datetime.datetime.now().astimezone().isoformat(timespec="seconds")
