"""Differences between documents, small enough to be written for every commit.

A change names the fields that differ. `photos`, `picks`, `measurements`, `ties` and `lines`, lists of objects with ids,
are stored as `{"in": {id: change}, "new": [objects], "gone": [ids], "order": [ids]}`, without the parts that are empty.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any, TypeVar

import msgspec
from msgspec.structs import replace

from ladarreg_core.errors import FormatError, LadarregError
from ladarreg_core.project.document import Document, MeasurementEntry, PhotoEntry, PickEntry
from ladarreg_core.project.drawn import LineEntry, TieEntry
from ladarreg_core.project.measurement_edits import checked_measurement, with_one_list
from ladarreg_core.project.storage.codec import FindArrays, arrays_of, encode, from_plain
from ladarreg_core.project.tie_edits import checked_line, checked_tie

Change = dict[str, Any]
T = TypeVar("T", bound=msgspec.Struct)
_LISTS: Mapping[str, type[PhotoEntry | PickEntry | MeasurementEntry | TieEntry | LineEntry]] = {
    "photos": PhotoEntry,
    "picks": PickEntry,
    "measurements": MeasurementEntry,
    "ties": TieEntry,
    "lines": LineEntry,
}


def change_between(before: Document, after: Document) -> Change:
    """Return the change that turns `before` into `after`; `codec.encode` serialises it."""
    return _field_changes(before, after)


def check_readable(before: Document, after: Document) -> None:
    """Check that the change between two documents survives being written and read again.

    Raises:
        FormatError: if it cannot be written, or reading it gives another document.
    """
    arrays = arrays_of(after)
    try:
        written = msgspec.json.decode(encode(change_between(before, after)))
        read = apply_change(before, written, arrays.__getitem__)
    except (FormatError, msgspec.MsgspecError, NotImplementedError, TypeError, ValueError, RecursionError) as error:
        raise FormatError(f"this cannot be saved in the project, so nothing was changed: {error}") from None
    if read != after:
        raise FormatError("this would change when it is read again, so nothing was changed")


def apply_change(document: Document, change: object, find: FindArrays) -> Document:
    """Apply a change to a document; the result shares the unchanged parts.

    Args:
        document: the document before the change.
        change: the change, decoded from JSON.
        find: returns arrays by name.

    Raises:
        FormatError: if the change does not fit this document.
    """
    try:
        return with_one_list(_apply(document, change, find))
    except (KeyError, AttributeError, TypeError, ValueError, LadarregError) as error:
        raise FormatError(f"the change does not fit this document ({type(error).__name__}: {error})") from None


def _field_changes(before: msgspec.Struct, after: msgspec.Struct) -> Change:
    found: Change = {}
    for name in after.__struct_fields__:
        was, now = getattr(before, name), getattr(after, name)
        if was is not now and was != now:
            found[name] = _list_change(was, now) if _is_list(before, name) else now
    return found


def _is_list(of: msgspec.Struct, name: str) -> bool:
    """Return whether a field is a list of objects with ids; the photographs of a line are ids."""
    return name in _LISTS and isinstance(of, Document | PhotoEntry)


def _list_change(before: Sequence[Any], after: Sequence[Any]) -> Change:
    old = {thing.id: thing for thing in before}
    there = {thing.id for thing in after}
    same = [(old[thing.id], thing) for thing in after if thing.id in old and old[thing.id] is not thing]
    inner = {now.id: _field_changes(was, now) for was, now in same}
    parts: Change = {
        "in": {name: change for name, change in inner.items() if change},
        "new": [thing for thing in after if thing.id not in old],
        "gone": [name for name in old if name not in there],
    }
    order = [thing.id for thing in after]
    if order != [name for name in old if name in there] + [thing.id for thing in parts["new"]]:
        parts["order"] = order
    return {name: part for name, part in parts.items() if part}


def _apply(before: T, change: Any, find: FindArrays) -> T:
    kinds = _kinds(type(before))
    found = {
        name: _apply_list_change(getattr(before, name), value, _LISTS[name], find)
        if _is_list(before, name)
        else from_plain(kinds[name], value, find)
        for name, value in change.items()
        if name in kinds  # fields of newer versions are kept with the whole document, see `unknown_fields`
    }
    after = replace(before, **found)
    _validate(after)
    return after


def _validate(thing: object) -> None:
    if isinstance(thing, PhotoEntry):
        for pick in thing.picks:
            pick.as_pick()
    elif isinstance(thing, PickEntry):
        thing.as_pick()
    elif isinstance(thing, MeasurementEntry):
        checked_measurement(thing)
    elif isinstance(thing, TieEntry):
        checked_tie(thing)
    elif isinstance(thing, LineEntry):
        checked_line(thing)


@cache
def _kinds(of: type[msgspec.Struct]) -> dict[str, Any]:
    return {field.name: field.type for field in msgspec.structs.fields(of)}


def _apply_list_change(before: Sequence[Any], change: Any, kind: type[Any], find: FindArrays) -> tuple[Any, ...]:
    things = {thing.id: thing for thing in before}
    for name in change.get("gone", ()):
        del things[name]
    for name, part in change.get("in", {}).items():
        things[name] = _apply(things[name], part, find)
    for fields in change.get("new", ()):
        new = from_plain(kind, fields, find)
        _validate(new)
        things[new.id] = new
    order = change.get("order")
    if order is None:
        return tuple(things.values())
    # what earlier versions kept with stations is in the list by now, and their orders do not name it
    moved = [name for name, thing in things.items() if kind is MeasurementEntry and thing.station and name not in order]
    order = [*order, *moved]
    if sorted(order) != sorted(things):
        raise ValueError("the order names other objects")
    return tuple(things[name] for name in order)
