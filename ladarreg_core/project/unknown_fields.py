"""Fields that this version of the program does not know: they are kept, and written again where they stood."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import msgspec

from ladarreg_core.project.codec import name_arrays
from ladarreg_core.project.document import Document, PoseEntry, Source

Place = tuple[str, ...]
Unknown = dict[Place, dict[str, Any]]
"""What is unknown, by the place of the object that it stands in."""
_OF_THE_FILE = {"seq", "crc"}


def unknown_fields(fields: Any, document: Document) -> Unknown:
    """Return what a document was read from and does not hold.

    Args:
        fields: the document as JSON holds it.
        document: the same, decoded.
    """
    found: Unknown = {}
    for place, raw, thing in _things((), fields, document):
        more = {name: raw[name] for name in raw.keys() - set(thing.__struct_fields__)}
        if place == ():
            more = {name: value for name, value in more.items() if name not in _OF_THE_FILE}
        if more:
            found[place] = more
    return found


def encoded_with(document: Document, unknown: Unknown) -> bytes:
    """Return a document as JSON, with unknown fields where the objects still are that they stood in."""
    fields = msgspec.to_builtins(document, enc_hook=name_arrays)
    for place, raw, _ in list(_things((), fields, document)):
        raw.update(unknown.get(place, {}))
    return msgspec.json.encode(fields)


def _things(place: Place, raw: Any, thing: msgspec.Struct) -> Iterator[tuple[Place, dict[str, Any], msgspec.Struct]]:
    """Yield all objects of a document, each with its JSON and a place that stays as long as the object is the same."""
    yield place, raw, thing
    for name in thing.__struct_fields__:
        value = getattr(thing, name)
        if name not in raw:
            continue
        if isinstance(value, msgspec.Struct):
            yield from _things((*place, name, _name(value, 0)), raw[name], value)
        elif isinstance(value, tuple):
            for index, (part, inner) in enumerate(zip(raw[name], value, strict=True)):
                if isinstance(inner, msgspec.Struct):
                    yield from _things((*place, name, _name(inner, index)), part, inner)


def _name(thing: msgspec.Struct, index: int) -> str:
    if isinstance(thing, PoseEntry):
        return f"{thing.stage} {thing.arrays.name}"
    if isinstance(thing, Source):
        return thing.path
    return str(getattr(thing, "id", index))
