"""The document as text, its arrays beside it under their names."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import msgspec

from ladarreg_core.errors import FormatError, NewerVersionError
from ladarreg_core.project.document import VERSION, Document, PoseEntry
from ladarreg_core.project.stored_arrays import StoredArrays


class _Versioned(msgspec.Struct):
    version: int = VERSION


FindArrays = Callable[[str], StoredArrays]
"""Returns the arrays of a name; raises FormatError where they are missing."""


def encode(value: object) -> bytes:
    """Return a document, or a part of one, as JSON; arrays are named only."""
    return msgspec.json.encode(value, enc_hook=name_arrays)


def decode_document(data: bytes, find: FindArrays) -> Document:
    """Return the document that `encode` wrote.

    Args:
        data: JSON.
        find: returns the arrays that it names.

    Raises:
        NewerVersionError: if a newer version of the program wrote it.
        FormatError: if it is no document of this version.
    """
    try:
        version = msgspec.json.decode(data, type=_Versioned).version
        if version > VERSION:
            raise NewerVersionError(
                f"the project has version {version} and this program reads version {VERSION}; nothing in it was"
                " changed: open it with a newer version of ladarreg"
            )
        found = msgspec.json.decode(data, type=Document, dec_hook=_finding(find))
    except msgspec.DecodeError as error:
        raise FormatError(f"it is no project of ladarreg, or damaged: {error}") from None
    except UnicodeDecodeError as error:
        raise FormatError(f"it is no project of ladarreg, or damaged: {error.reason}") from None
    if found.version != VERSION:
        raise FormatError(f"there is no version {found.version} of projects; the file is damaged")
    for photo in found.photos:
        for pick in photo.picks:
            pick.as_pick()  # it checks itself
    return found


def plain_as(kind: Any, value: object, find: FindArrays) -> Any:
    """Return a part of a document of its type, from what JSON holds of it.

    Args:
        kind: the type.
        value: numbers, words, lists and dictionaries.
        find: returns the arrays that it names.

    Raises:
        ValueError: if it is none of that type.
    """
    return msgspec.convert(value, kind, dec_hook=_finding(find))


def arrays_of(document: Document) -> dict[str, StoredArrays]:
    """Return all arrays of a document by name."""
    poses: list[PoseEntry] = [pose for photo in document.photos for pose in photo.poses]
    return {pose.arrays.name: pose.arrays for pose in poses}


def _finding(find: FindArrays) -> Callable[[type, Any], Any]:
    def hook(wanted: type, value: Any) -> Any:
        if wanted is StoredArrays and isinstance(value, str):
            return find(value)
        raise NotImplementedError(wanted)

    return hook


def name_arrays(value: Any) -> Any:
    """Return what stands for arrays in JSON; the `enc_hook` of msgspec."""
    if isinstance(value, StoredArrays):
        return value.name
    raise NotImplementedError(f"cannot write a {type(value).__name__}")
