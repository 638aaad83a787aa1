"""What one document has that another had not, small enough to be written at every step of the work.

A change names the fields that differ. `photos` and `picks`, lists of things with ids, are told by what changed in
them: `{"in": {id: change}, "new": [things], "gone": [ids], "order": [ids]}`, each part left out where there is nothing
to say.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any, TypeVar

import msgspec
from msgspec.structs import replace

from ladarreg_core.errors import FormatError, LadarregError
from ladarreg_core.project.codec import FindArrays, arrays_of, encode, plain_as
from ladarreg_core.project.document import Document, PhotoEntry, PickEntry

Change = dict[str, Any]
T = TypeVar("T", bound=msgspec.Struct)
_LISTS: Mapping[str, type[PhotoEntry] | type[PickEntry]] = {"photos": PhotoEntry, "picks": PickEntry}


def change_between(before: Document, after: Document) -> Change:
    """Return what makes `after` of `before`; `codec.encode` writes it."""
    return _fields(before, after)


def check_readable(before: Document, after: Document) -> None:
    """Write the change between two documents and read it again, as whoever opens the project will.

    Raises:
        FormatError: if it cannot be written, or would not be read.
    """
    arrays = arrays_of(after)
    try:
        written = msgspec.json.decode(encode(change_between(before, after)))
        read = changed(before, written, arrays.__getitem__)
    except (FormatError, msgspec.MsgspecError, NotImplementedError, TypeError, ValueError, RecursionError) as error:
        raise FormatError(f"this cannot be kept in the project, so that nothing was changed: {error}") from None
    if read != after:
        raise FormatError("this would be read again as something else, so that nothing was changed")


def changed(document: Document, change: object, find: FindArrays) -> Document:
    """Return the document that a change makes of another; what did not change is shared by both.

    Args:
        document: the one that the change was told of.
        change: as it was written, read from JSON.
        find: returns the arrays that it names.

    Raises:
        FormatError: if it is no change of this document.
    """
    try:
        return _changed(document, change, find)
    except (KeyError, AttributeError, TypeError, ValueError, LadarregError) as error:
        raise FormatError(f"it is no change of this document ({type(error).__name__}: {error})") from None


def _fields(before: msgspec.Struct, after: msgspec.Struct) -> Change:
    found: Change = {}
    for name in after.__struct_fields__:
        was, now = getattr(before, name), getattr(after, name)
        if was is not now and was != now:
            found[name] = _things(was, now) if name in _LISTS else now
    return found


def _things(before: Sequence[Any], after: Sequence[Any]) -> Change:
    old = {thing.id: thing for thing in before}
    there = {thing.id for thing in after}
    same = [(old[thing.id], thing) for thing in after if thing.id in old and old[thing.id] is not thing]
    inner = {now.id: _fields(was, now) for was, now in same}
    parts: Change = {
        "in": {name: change for name, change in inner.items() if change},
        "new": [thing for thing in after if thing.id not in old],
        "gone": [name for name in old if name not in there],
    }
    order = [thing.id for thing in after]
    if order != [name for name in old if name in there] + [thing.id for thing in parts["new"]]:
        parts["order"] = order
    return {name: part for name, part in parts.items() if part}


def _changed(before: T, change: Any, find: FindArrays) -> T:
    kinds = _kinds(type(before))
    found = {
        name: _things_changed(getattr(before, name), value, _LISTS[name], find)
        if name in _LISTS
        else plain_as(kinds[name], value, find)
        for name, value in change.items()
        if name in kinds  # what a newer version added is kept with the whole document, see `unknown_fields`
    }
    after = replace(before, **found)
    if isinstance(after, PickEntry):
        after.as_pick()  # it checks itself
    return after


@cache
def _kinds(of: type[msgspec.Struct]) -> dict[str, Any]:
    return {field.name: field.type for field in msgspec.structs.fields(of)}


def _things_changed(before: Sequence[Any], change: Any, kind: type[Any], find: FindArrays) -> tuple[Any, ...]:
    things = {thing.id: thing for thing in before}
    for name in change.get("gone", ()):
        del things[name]
    for name, part in change.get("in", {}).items():
        things[name] = _changed(things[name], part, find)
    for fields in change.get("new", ()):
        new = plain_as(kind, fields, find)
        for pick in new.picks if isinstance(new, PhotoEntry) else (new,):
            pick.as_pick()
        things[new.id] = new
    order = change.get("order")
    if order is None:
        return tuple(things.values())
    if sorted(order) != sorted(things):
        raise ValueError("the order names other things")
    return tuple(things[name] for name in order)
