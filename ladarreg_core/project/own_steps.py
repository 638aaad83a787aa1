"""Undo and redo of a person's own steps while others edit: the step's inverse becomes a step of its own.

Whose steps count is the caller's choice: a person who is alone may undo everybody's. An undo or redo is an entry of the
history that names the step it means (`Entry.undoes`, `Entry.redoes`), so that everybody's own steps can be found in the
one shared history.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

from ladarreg_core.errors import OptionError
from ladarreg_core.project.document import Document
from ladarreg_core.project.history import Author, Entry, History
from ladarreg_core.project.inverse import ChangedSinceError, Part, changed_parts, restored, touches

Mine = Callable[[Entry], bool]
"""Whether a step is one's own."""


def undoable(history: History, mine: Mine) -> Entry | None:
    """Return the newest own step whose effect is present; None if there is none."""
    return next(_active(history, mine), None)


def redoable(history: History, mine: Mine) -> Entry | None:
    """Return the undo that redo would take back: the newest own one, unless an own edit follows it."""
    return next(_undos(history, mine), None)


def undone(history: History, mine: Mine, author: Author, *, when: str, number: int | None = None) -> History:
    """Return the history with the inverse of an own step applied to the present document.

    Args:
        history: the history.
        mine: whose steps may be undone.
        author: who undoes.
        when: the time, ISO 8601.
        number: of the step to undo; None: the newest own one.

    Raises:
        OptionError: if there is no such step, or what it touched has changed since.
    """
    entry = undoable(history, mine) if number is None else active_step(history, mine, number)
    if entry is None:
        return history
    document = _inverse(history, entry, author, "undone")
    what = entry.number if entry.redoes is None else entry.redoes
    return history.committed(
        document, label=f"Undo {plain_label(entry)}", author=author.name, by=author.id, when=when, undoes=what
    )


def redone(history: History, mine: Mine, author: Author, *, when: str, number: int | None = None) -> History:
    """Return the history with an own step restored, by default the one that was undone last; arguments as of `undone`.

    Raises:
        OptionError: if there is no such step, or what it touched has changed since.
    """
    entry = redoable(history, mine)
    if number is not None and (entry is None or entry.undoes != number):
        raise OptionError("this step is not the one of yours that was undone last; see the history")
    if entry is None:
        return history
    document = _inverse(history, entry, author, "redone")
    return history.committed(
        document, label=f"Redo {plain_label(entry)}", author=author.name, by=author.id, when=when, redoes=entry.undoes
    )


def plain_label(entry: Entry) -> str:
    """Return the label of the step itself, where an entry undoes or redoes one."""
    if entry.undoes is not None:
        return entry.label.removeprefix("Undo ")
    return entry.label if entry.redoes is None else entry.label.removeprefix("Redo ")


def active_step(history: History, mine: Mine, number: int) -> Entry:
    """Return the entry by which an own step has its effect: the step, or where it was redone, the redo.

    Raises:
        OptionError: if it has none.
    """
    for entry in _active(history, mine):
        if number in (entry.number, entry.redoes):
            return entry
    raise OptionError("this step is not one of yours that can be undone, or it is undone already; see the history")


def _newest_first(history: History) -> Iterator[Entry]:
    """Yield the edits up to the present one, without the initial document and the program's own results."""
    return (entry for k in range(history.at, 0, -1) if not (entry := history.entries[k]).automatic)


def _active(history: History, mine: Mine) -> Iterator[Entry]:
    """Yield the own entries whose effect is present, newest first: edits, or where they were redone, the redo."""
    decided: set[int] = set()
    for entry in _newest_first(history):
        if entry.undoes is not None:
            decided.add(entry.undoes)
            continue
        number = entry.number if entry.redoes is None else entry.redoes
        if number not in decided and mine(entry):
            yield entry
        if entry.redoes is not None:
            decided.add(number)


def _undos(history: History, mine: Mine) -> Iterator[Entry]:
    """Yield the own undos whose effect is present, newest first, until an own edit."""
    decided: set[int] = set()
    for entry in _newest_first(history):
        if entry.undoes is not None:
            if entry.undoes not in decided and mine(entry):
                yield entry
            decided.add(entry.undoes)
        elif entry.redoes is not None:
            decided.add(entry.redoes)
        elif mine(entry):
            return


def _inverse(history: History, entry: Entry, author: Author, what: str) -> Document:
    index = history.entries.index(entry)
    before = history.entries[index - 1].document
    computed: set[Part] = set()
    while True:
        try:
            return restored(history.document, before, entry.document, ignore=computed)
        except ChangedSinceError as error:
            since = _last_change(history, index, error.part)
            if since.automatic and error.part not in computed:
                computed.add(error.part)  # the program's own result, which it computes again
                continue
            who = "You" if since.by and since.by == author.id else since.author or "Somebody"
            raise OptionError(
                f"{who} changed {_described(history, error.part)} since ('{since.label}', {since.when[11:19]}), so"
                f" '{plain_label(entry)}' cannot be {what} by itself; open History to go back before both"
            ) from None


def _last_change(history: History, index: int, part: Part) -> Entry:
    """Return the newest entry after an index that changed a part."""
    entries = history.entries
    for k in range(history.at, index, -1):
        if touches(changed_parts(entries[k - 1].document, entries[k].document), part):
            return entries[k]
    return history.present


def _described(history: History, part: Part) -> str:
    if part[0] == "measurements":
        return "the measurements" if len(part) == 1 else "the measurement"
    if part[0] == "stations":
        return "the stations" if len(part) == 1 else "the station"
    if part[0] == "lines":
        return "the lines" if len(part) == 1 else f"the line {part[1].removeprefix('l')}"
    if part[0] == "ties":
        return "the ties" if len(part) == 1 else f"the tie {part[1].removeprefix('t')}"
    if part[0] != "photos":
        return f"the setting {part[1].replace('_', ' ')}" if part[0] == "settings" else f"the project's {part[0]}"
    documents = [history.document, *(entry.document for entry in reversed(history.entries))]
    photo = next(found for document in documents if (found := document.photo(part[1])))
    if len(part) == 2:
        return photo.source.name
    if part[2] == "picks":
        return f"match {part[3]}"
    if part[2] in ("poses", "shown_stage"):
        return f"the pose of {photo.source.name}"
    return f"the {part[2].replace('_', ' ')} of {photo.source.name}"
