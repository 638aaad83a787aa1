"""The inverse of one edit, applied to a later document: what the edit touched gets its former value, all else stays.

A document is compared by parts: its fields, the settings, the stations, measurements, ties and lines, and of each
photograph its fields, poses and picks, by path: `("name",)`, `("settings", "t1")`, `("measurements", "m1")`,
`("photos", "p1")` where the photograph exists on one side only, else `("photos", "p1", "camera")`,
`("photos", "p1", "poses", "auto")`, `("photos", "p1", "picks", "3", "on")`.
Counters of given numbers are no part: a number is never given twice.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any, TypeVar

import msgspec
from msgspec.structs import replace

from ladarreg_core.project.document import Document, PhotoEntry

Part = tuple[str, ...]
"""Path of a part of a document."""
Parts = dict[Part, tuple[Any, Any]]
"""Parts with their values before and after an edit."""
T = TypeVar("T", bound=msgspec.Struct)
_COUNTERS = ("numbered", "numbered_stations", "numbered_measurements", "numbered_ties", "numbered_lines")
_LISTS = ("picks", "poses")
_KEYS = {
    "photos": "id",
    "picks": "id",
    "poses": "stage",
    "stations": "id",
    "measurements": "id",
    "ties": "id",
    "lines": "id",
}
_WHOLE = ("stations", "measurements", "ties", "lines")
"""Lists of the document whose items are compared as wholes."""


class _Missing:
    def __repr__(self) -> str:
        return "missing"


MISSING = _Missing()
"""Value of a part that does not exist."""


class ChangedSinceError(Exception):
    """A part that an edit touched has another value by now.

    Args:
        part: the part.
    """

    def __init__(self, part: Part) -> None:
        super().__init__(" ".join(part))
        self.part = part


def changed_parts(before: Document, after: Document) -> Parts:
    """Return the parts in which two documents differ."""
    found: Parts = {}
    for name in before.__struct_fields__:
        if name in ("photos", "settings", *_WHOLE, *_COUNTERS):
            continue
        _note(found, (name,), getattr(before, name), getattr(after, name))
    for name in before.settings.__struct_fields__:
        _note(found, ("settings", name), getattr(before.settings, name), getattr(after.settings, name))
    for path, old, new in _differing(("photos",), before.photos, after.photos):
        if old is MISSING or new is MISSING:
            found[path] = old, new
        else:
            _compare_photos(found, path, old, new)
    for name in _WHOLE:
        for path, old, new in _differing((name,), getattr(before, name), getattr(after, name)):
            found[path] = old, new
    return found


def restored(present: Document, before: Document, after: Document, *, ignore: Collection[Part] = ()) -> Document:
    """Return the present document with what an edit from `before` to `after` touched as it was before.

    Args:
        present: the present document.
        before: the document before the edit.
        after: the document after the edit.
        ignore: parts that may have changed since.

    Raises:
        ChangedSinceError: if any of it has changed since.
    """
    changes = changed_parts(before, after)
    for part, (_, new) in changes.items():
        if part not in ignore and not _same(_value_at(present, part), new):
            raise ChangedSinceError(part)
    for name, photo_id, *_ in (part for part in changes if len(part) > 2):  # matches and poses belong to a scan, too
        then, now = after.photo(photo_id), present.photo(photo_id)
        if name == "photos" and then is not None and now is not None and then.station != now.station:
            raise ChangedSinceError(("photos", photo_id, "station"))
    if ("scan",) in changes:  # rays belong to a scan: none may have been drawn in it since
        for photo in present.photos:
            then = after.photo(photo.id)
            if then is None or then.picks != photo.picks or then.poses != photo.poses:
                raise ChangedSinceError(("photos", photo.id))
        if present.measurements != after.measurements:
            raise ChangedSinceError(("measurements",))
    return _with_former(present, before, {part: old for part, (old, _) in changes.items()})


def touches(change: Iterable[Part], part: Part) -> bool:
    """Return whether any of the changed parts contains a part, or is contained in it."""
    return any(other[: len(part)] == part[: len(other)] for other in change)


def _compare_photos(found: Parts, path: Part, old: PhotoEntry, new: PhotoEntry) -> None:
    for name in old.__struct_fields__:
        if name not in (*_LISTS, "id", *_COUNTERS):
            _note(found, (*path, name), getattr(old, name), getattr(new, name))
    for pose_path, was, now in _differing((*path, "poses"), old.poses, new.poses):
        found[pose_path] = was, now
    for pick_path, was, now in _differing((*path, "picks"), old.picks, new.picks):
        if was is MISSING or now is MISSING:
            found[pick_path] = was, now
            continue
        for name in was.__struct_fields__:
            _note(found, (*pick_path, name), getattr(was, name), getattr(now, name))


def _note(found: Parts, path: Part, old: Any, new: Any) -> None:
    if old is not new and old != new:
        found[path] = old, new


def _differing(path: Part, old: Sequence[Any], new: Sequence[Any]) -> Iterator[tuple[Part, Any, Any]]:
    """Yield the items of a list that differ, by their keys."""
    if old is new:
        return
    key = _KEYS[path[-1]]
    was, now = ({getattr(item, key): item for item in items} for items in (old, new))
    for name in {**was, **now}:
        first, second = was.get(name, MISSING), now.get(name, MISSING)
        if first is not second and not _same(first, second):
            yield (*path, name), first, second


def _same(one: Any, other: Any) -> bool:
    if isinstance(one, PhotoEntry) and isinstance(other, PhotoEntry):
        return replace(one, numbered=other.numbered) == other
    return one is other or bool(one == other)


def _value_at(thing: Any, part: Part) -> Any:
    """Return the value of a part; `MISSING` if it does not exist."""
    for name in part:
        if isinstance(thing, tuple):
            thing = next(
                (item for item in thing if name in (getattr(item, "id", None), getattr(item, "stage", None))), None
            )
            if thing is None:
                return MISSING
        else:
            thing = getattr(thing, name)
    return thing


def _with_former(present: Document, before: Document, former: Mapping[Part, Any]) -> Document:
    """Return the document with former values of parts, each of which exists unless its value says otherwise."""
    fields = {part[0]: value for part, value in former.items() if len(part) == 1}
    settings = {part[1]: value for part, value in former.items() if part[0] == "settings"}
    items = {
        name: {part[1]: value for part, value in former.items() if part[0] == name and len(part) == 2}
        for name in ("photos", *_WHOLE)
    }
    inner: dict[str, dict[Part, Any]] = {}
    for part, value in former.items():
        if part[0] == "photos" and len(part) > 2:
            inner.setdefault(part[1], {})[part[2:]] = value
    found = tuple(
        _photo_with_former(photo, before.photo(photo.id) or photo, inner[photo.id]) if photo.id in inner else photo
        for photo in present.photos
    )
    return replace(
        present,
        **fields,
        settings=replace(present.settings, **settings),
        photos=_merged(found, before.photos, items["photos"], "photos"),
        **{name: _merged(getattr(present, name), getattr(before, name), items[name], name) for name in _WHOLE},
    )


def _photo_with_former(photo: PhotoEntry, before: PhotoEntry, former: Mapping[Part, Any]) -> PhotoEntry:
    fields = {part[0]: value for part, value in former.items() if len(part) == 1}
    items: dict[str, dict[str, Any]] = {name: {} for name in _LISTS}
    picks: dict[str, dict[str, Any]] = {}
    for part, value in former.items():
        if len(part) == 2:
            items[part[0]][part[1]] = value
        elif len(part) == 3:
            picks.setdefault(part[1], {})[part[2]] = value
    kept = tuple(replace(pick, **picks[pick.id]) if pick.id in picks else pick for pick in photo.picks)
    return replace(
        photo,
        **fields,
        picks=_merged(kept, before.picks, items["picks"], "picks"),
        poses=_merged(photo.poses, before.poses, items["poses"], "poses"),
    )


def _merged(present: Sequence[T], before: Sequence[T], former: Mapping[str, Any], name: str) -> tuple[T, ...]:
    """Return the list with former items, those that return at their former place among the others."""
    if not former:
        return tuple(present)
    key = _KEYS[name]
    found = [former.get(getattr(item, key), item) for item in present]
    order = [getattr(item, key) for item in before]
    there = {getattr(item, key) for item in present}
    for name_of in (each for each in order if each in former and each not in there):
        behind = set(order[: order.index(name_of)])
        at = max(
            (k + 1 for k, item in enumerate(found) if item is not MISSING and getattr(item, key) in behind), default=0
        )
        found.insert(at, former[name_of])
    return tuple(item for item in found if item is not MISSING)
