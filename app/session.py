"""The session: the only state of the workbench that changes, behind one lock."""

from __future__ import annotations

import datetime
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from app.quiet import Quiet
from ladarreg_core.errors import LadarregError
from ladarreg_core.project.document import Document
from ladarreg_core.project.folder import ProjectFolder
from ladarreg_core.project.history import History

Edit = Callable[[Document], Document]
_ONE_MOVE_S = 1.5
"""Moves of the same end that follow each other as quickly are one step of the history."""


@dataclass(frozen=True, slots=True)
class Change:
    """What listeners are told."""

    before: Document
    """The document as it was."""
    document: Document
    """As it is."""


Listener = Callable[[Change], None]


class Session:
    """Keeps the document and its history, and saves every commit before anybody is told of it."""

    def __init__(self, folder: ProjectFolder, history: History) -> None:
        self.folder = folder
        self._history = history
        self._lock = threading.RLock()
        self._listeners: list[Listener] = []
        self._last_move: tuple[str, str, float] = ("", "", 0.0)
        self._saved_at = now()
        self._unsaved = ""
        self._quiet = Quiet()
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
        """Why the last commit could not be saved; empty where it was."""
        return self._unsaved

    def subscribe(self, listener: Listener) -> Callable[[], None]:
        """Have a listener called after each change, in their order; return what ends that."""
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
            LadarregError: whatever the edit refuses; nothing has changed then.
        """
        with self._lock:
            before = self.document
            after = edit(before)
            if after is before or after == before:
                return before
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

    def save_now(self) -> None:
        """Have everything on the disk, `project.json` included; what cannot be saved is said by `unsaved`."""
        with self._lock:
            self._save(self.folder.settle)

    def close(self) -> None:
        """Save what could not be saved before, and let the folder go."""
        self._quiet.close()
        self._thread.join(30)
        with self._lock:
            self._save(self.folder.settle)
            self.folder.close()

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
            if self._unsaved:
                self.folder.begin(self._history)
            else:
                save()
            self._unsaved, self._saved_at = "", now()
        except LadarregError as error:
            self._unsaved = str(error)
        self._quiet.ask()

    def _settle(self) -> None:
        """Let project.json follow: what was committed is in the history's file, and that is on the disk."""
        while self._quiet.wait():
            try:
                self.folder.settle()
            except LadarregError as error:
                with self._lock:
                    self._unsaved = str(error)
                    self._tell(self.document)

    def _tell(self, before: Document) -> None:
        change = Change(before, self.document)
        for listener in list(self._listeners):
            listener(change)


def now() -> str:
    """Return the present time, ISO 8601 with its offset."""
    return datetime.datetime.now().astimezone().isoformat(timespec="seconds")
