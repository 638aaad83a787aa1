"""Encoding of documents as JSON; arrays are referred to by name."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import msgspec

from ladarreg_core.errors import FormatError, NewerVersionError, OptionError
from ladarreg_core.project.document import VERSION, Document, PoseEntry
from ladarreg_core.project.measurement_edits import checked_measurement, with_one_list
from ladarreg_core.project.station_edits import checked_survey
from ladarreg_core.project.stored_arrays import StoredArrays
from ladarreg_core.project.tie_edits import checked_line, checked_tie


class _Versioned(msgspec.Struct):
    version: int = VERSION


FindArrays = Callable[[str], StoredArrays]
"""Returns arrays by name; raises FormatError if the name is invalid."""


def encode(value: object) -> bytes:
    """Return a document, or a part of one, as JSON with arrays replaced by their names."""
    return msgspec.json.encode(value, enc_hook=name_arrays)


def decode_document(data: bytes, find: FindArrays) -> Document:
    """Decode a document written by `encode`.

    Args:
        data: JSON.
        find: returns arrays by name.

    Raises:
        NewerVersionError: if a newer version of the program wrote it.
        FormatError: if it is not a valid document of this version.
    """
    try:
        version = msgspec.json.decode(data, type=_Versioned).version
        if version > VERSION:
            raise NewerVersionError(
                f"the project has version {version} and this program reads version {VERSION}; nothing was"
                " changed: open it with a newer version of ladarreg"
            )
        found = msgspec.json.decode(data, type=Document, dec_hook=_decoder_hook(find))
    except msgspec.DecodeError as error:
        raise FormatError(f"it is not a ladarreg project, or it is damaged: {error}") from None
    except UnicodeDecodeError as error:
        raise FormatError(f"it is not a ladarreg project, or it is damaged: {error.reason}") from None
    except OptionError as error:
        raise FormatError(f"the project is damaged: {error}") from None
    if found.version != VERSION:
        raise FormatError(f"there is no project version {found.version}; the file is damaged")
    for work in found.work:
        for pick in work.picks:
            pick.as_pick()  # validates
    stations = {"", *(station.id for station in found.stations)}
    for belongs, what in ((found.photos, "photograph"), (found.measurements, "measurement")):
        if lost := {each.station for each in belongs} - stations:
            raise FormatError(f"the project is damaged: it has no station {min(lost)!r}, which a {what} belongs to")
    found = with_one_list(found)
    for measurement in found.measurements:
        checked_measurement(measurement)
    for tie in found.ties:
        checked_tie(tie)
    for line in found.lines:
        checked_line(line)
    if found.survey is not None:
        checked_survey(found.survey)
    return found


def from_plain(kind: Any, value: object, find: FindArrays) -> Any:
    """Convert plain JSON values to a part of a document.

    Args:
        kind: type of the part.
        value: numbers, strings, lists and dictionaries.
        find: returns arrays by name.

    Raises:
        ValueError: if the value does not have that type.
    """
    return msgspec.convert(value, kind, dec_hook=_decoder_hook(find))


def arrays_of(document: Document) -> dict[str, StoredArrays]:
    """Return all arrays of a document by name."""
    poses: list[PoseEntry] = [pose for work in document.work for pose in work.poses]
    ties = None if document.adjusted is None else document.adjusted.ties
    return {pose.arrays.name: pose.arrays for pose in poses} | ({} if ties is None else {ties.name: ties})


def _decoder_hook(find: FindArrays) -> Callable[[type, Any], Any]:
    def hook(wanted: type, value: Any) -> Any:
        if wanted is StoredArrays and isinstance(value, str):
            return find(value)
        raise NotImplementedError(wanted)

    return hook


def name_arrays(value: Any) -> Any:
    """Return the name that replaces arrays in JSON; the `enc_hook` of msgspec."""
    if isinstance(value, StoredArrays):
        return value.name
    raise NotImplementedError(f"cannot write a {type(value).__name__}")
