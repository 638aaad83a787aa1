"""Differences between two values of a slice, so that only the difference is sent (docs/workbench.md).

The change of an object is `{"set": {name: value}, "gone": [names], "in": {name: change}}`, that of a list of items
`{"set": [items], "gone": [keys], "order": [keys]}`; empty parts are omitted. The key of an item is its `id`, or its
number `n`. static/js/net/delta.js implements `apply_change` in the page.
"""

from __future__ import annotations

from typing import Any

Change = dict[str, Any]
_MIN_SIZE = 16
"""Values with no more items than this are sent whole: a change would be no shorter."""
_MAX_DEPTH = 2


def change_between(before: Any, after: Any) -> Change | None:
    """Return the change that turns `before` into `after`, JSON values; None if it is no shorter than `after` itself.

    Parts that are the same object are not compared.
    """
    return _change(before, after, _MAX_DEPTH) if _is_long(after, _MAX_DEPTH) else None


def apply_change(before: Any, change: Change) -> Any:
    """Return a changed copy of a value.

    Raises:
        KeyError: if the change does not belong to this value.
    """
    gone = set(change.get("gone", ()))
    if isinstance(before, list):
        items = {_key(item): item for item in before if _key(item) not in gone}
        items.update((_key(item), item) for item in change.get("set", ()))
        return [items[key] for key in change.get("order", items)]
    rest = {name: value for name, value in before.items() if name not in gone}
    inner = {name: apply_change(before[name], part) for name, part in change.get("in", {}).items()}
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
    return _without_empty_parts({"set": whole, "gone": gone, "in": inner})


def _change_of_list(before: list[Any], after: list[Any]) -> Change | None:
    old, new = _by_key(before), _by_key(after)
    if old is None or new is None:
        return None
    whole = [item for key, item in new.items() if key not in old or not _same(old[key], item)]
    gone = [key for key in old if key not in new]
    if 2 * (len(whole) + len(gone)) > len(after):
        return None
    default_order = [key for key in old if key in new] + [key for key in new if key not in old]
    return _without_empty_parts({"set": whole, "gone": gone, "order": [] if default_order == list(new) else list(new)})


def _by_key(items: list[Any]) -> dict[Any, Any] | None:
    """Return items by their keys; None if one has no key, or two have the same."""
    if not all(isinstance(item, dict) and ("id" in item or "n" in item) for item in items):
        return None
    found = {_key(item): item for item in items}
    return found if len(found) == len(items) else None


def _key(item: dict[str, Any]) -> Any:
    return item["id"] if "id" in item else item["n"]


def _is_long(value: Any, depth: int) -> bool:
    if isinstance(value, dict):
        return len(value) > _MIN_SIZE or (depth > 1 and any(_is_long(part, depth - 1) for part in value.values()))
    return isinstance(value, list) and len(value) > _MIN_SIZE


def _same(a: Any, b: Any) -> bool:
    return a is b or bool(a == b)


def _without_empty_parts(change: Change) -> Change:
    return {name: part for name, part in change.items() if part}
