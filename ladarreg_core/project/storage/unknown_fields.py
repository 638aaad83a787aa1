"""Preservation of fields from newer versions of the program: they are kept and written back to their objects."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import msgspec

from ladarreg_core.project.document import Document, PoseEntry
from ladarreg_core.project.source import Source
from ladarreg_core.project.storage.codec import name_arrays

ObjectPath = tuple[str, ...]
Unknown = dict[ObjectPath, dict[str, Any]]
"""Unknown fields by the path of their object."""
_FILE_FIELDS = {"seq", "crc"}


def unknown_fields(fields: Any, document: Document) -> Unknown:
    """Return the fields of a document's JSON that are not part of the decoded document.

    Args:
        fields: the document as plain JSON values.
        document: the decoded document.
    """
    found: Unknown = {}
    for path, raw, thing in _objects((), fields, document):
        more = {name: raw[name] for name in raw.keys() - set(thing.__struct_fields__)}
        if path == ():
            more = {name: value for name, value in more.items() if name not in _FILE_FIELDS}
        if more:
            found[path] = more
    return found


def encoded_with(document: Document, unknown: Unknown) -> bytes:
    """Return a document as JSON, with unknown fields added to those of their objects that still exist."""
    fields = msgspec.to_builtins(document, enc_hook=name_arrays)
    for path, raw, _ in list(_objects((), fields, document)):
        raw.update(unknown.get(path, {}))
    return msgspec.json.encode(fields)


def _objects(
    path: ObjectPath, raw: Any, thing: msgspec.Struct
) -> Iterator[tuple[ObjectPath, dict[str, Any], msgspec.Struct]]:
    """Yield all objects of a document, each with its JSON and a path that is stable as long as the object exists."""
    yield path, raw, thing
    for name in thing.__struct_fields__:
        value = getattr(thing, name)
        if name not in raw:
            continue
        if isinstance(value, msgspec.Struct):
            yield from _objects((*path, name, _name(value, 0)), raw[name], value)
        elif isinstance(value, tuple):
            for index, (part, inner) in enumerate(zip(raw[name], value, strict=True)):
                if isinstance(inner, msgspec.Struct):
                    yield from _objects((*path, name, _name(inner, index)), part, inner)


def _name(thing: msgspec.Struct, index: int) -> str:
    if isinstance(thing, PoseEntry):
        return f"{thing.stage} {thing.arrays.name}"
    if isinstance(thing, Source):
        return thing.path
    return str(getattr(thing, "id", index))
