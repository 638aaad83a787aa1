"""How a slice became another: what a page that has the old one needs to have the new one (docs/workbench.md).

A change of an object is `{"set": {name: value}, "gone": [names], "in": {name: change}}`, one of a list of things
`{"set": [things], "gone": [keys], "order": [keys]}`; each part is left out where there is nothing to say. The key of
a thing is its `id`, or its number `n`. static/js/net/delta.js does what `changed` does.
"""

from __future__ import annotations

from typing import Any

Change = dict[str, Any]
_LONG = 16
"""What holds no more than this is told whole: a change of it would be no shorter."""
_DEEPEST = 2


def change_between(before: Any, after: Any) -> Change | None:
    """Return what makes `after` of `before`, JSON values; None where it is no shorter than telling `after` whole.

    Parts that are the same object are not looked into.
    """
    return _change(before, after, _DEEPEST) if _is_long(after, _DEEPEST) else None


def changed(before: Any, change: Change) -> Any:
    """Return what a change makes of a value, which stays as it is.

    Raises:
        KeyError: if the change is one of another value.
    """
    gone = set(change.get("gone", ()))
    if isinstance(before, list):
        things = {_key(thing): thing for thing in before if _key(thing) not in gone}
        things.update((_key(thing), thing) for thing in change.get("set", ()))
        return [things[key] for key in change.get("order", things)]
    rest = {name: value for name, value in before.items() if name not in gone}
    inner = {name: changed(before[name], part) for name, part in change.get("in", {}).items()}
    return rest | change.get("set", {}) | inner


def _change(before: Any, after: Any, depth: int) -> Change | None:
    if isinstance(before, dict) and isinstance(after, dict):
        return _change_of_object(before, after, depth)
    if isinstance(before, list) and isinstance(after, list):
        return _change_of_list(before, after)
    return None


def _change_of_object(before: dict[str, Any], after: dict[str, Any], depth: int) -> Change | None:
    other = {name: value for name, value in after.items() if name not in before or not _same(before[name], value)}
    inner: dict[str, Change] = {}
    if depth > 1:
        parts = {
            name: _change(before[name], value, depth - 1)
            for name, value in other.items()
            if name in before and _is_long(value, depth - 1)
        }
        inner = {name: part for name, part in parts.items() if part is not None}
    whole = {name: value for name, value in other.items() if name not in inner}
    gone = [name for name in before if name not in after]
    if not inner and 2 * (len(whole) + len(gone)) > len(after):
        return None
    return _without_nothing({"set": whole, "gone": gone, "in": inner})


def _change_of_list(before: list[Any], after: list[Any]) -> Change | None:
    old, new = _by_key(before), _by_key(after)
    if old is None or new is None:
        return None
    whole = [thing for key, thing in new.items() if key not in old or not _same(old[key], thing)]
    gone = [key for key in old if key not in new]
    if 2 * (len(whole) + len(gone)) > len(after):
        return None
    as_it_comes = [key for key in old if key in new] + [key for key in new if key not in old]
    return _without_nothing({"set": whole, "gone": gone, "order": [] if as_it_comes == list(new) else list(new)})


def _by_key(things: list[Any]) -> dict[Any, Any] | None:
    """Return things by their keys; None where they have none, or the same."""
    if not all(isinstance(thing, dict) and ("id" in thing or "n" in thing) for thing in things):
        return None
    found = {_key(thing): thing for thing in things}
    return found if len(found) == len(things) else None


def _key(thing: dict[str, Any]) -> Any:
    return thing["id"] if "id" in thing else thing["n"]


def _is_long(value: Any, depth: int) -> bool:
    if isinstance(value, dict):
        return len(value) > _LONG or (depth > 1 and any(_is_long(part, depth - 1) for part in value.values()))
    return isinstance(value, list) and len(value) > _LONG


def _same(a: Any, b: Any) -> bool:
    return a is b or bool(a == b)


def _without_nothing(change: Change) -> Change:
    return {name: part for name, part in change.items() if part}
