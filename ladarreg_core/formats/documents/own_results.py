"""Documents of results: they hold their own checksum, and are refused where they were changed since."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ladarreg_core.errors import FormatError, LadarregError
from ladarreg_core.formats.parsing.json_file import begins_with_brace, read_json_object
from ladarreg_core.formats.parsing.untrusted import PathLike, reading, shown_name
from ladarreg_core.storage.checksums import checksum_state
from ladarreg_core.storage.manifest import MANIFEST_FILE, manifest_fault

TRUST_OPTION = "take the file as it was written, or go on with it as given, not verified, by `trust_edited=True`"
"""What can be done about a document that was changed."""
EDITED_REASON = "The file was changed after it was written, so its verdict no longer holds: given, not verified."
"""Reason of a pose from such a file, where it is trusted."""


def read_own_result(file: Path, what: str, *, trust_edited: bool = False, option: str = TRUST_OPTION) -> dict[str, Any]:
    """Return the fields of a document of results.

    Args:
        file: an existing file.
        what: expected content, for error messages.
        trust_edited: read it even if it was changed, see `was_edited`.
        option: what can be done about a file that was changed.

    Raises:
        FormatError: if it is no JSON object, or was changed after it was written.
    """
    fields = read_json_object(file, what)
    fault = "" if trust_edited else edited_fault(file, fields)
    if fault:
        raise FormatError(f"{fault}; {option}")
    return fields


def edited_fault(file: Path, fields: Mapping[str, Any]) -> str:
    """Return why a document is not as it was written, as a clause; empty: it is, or has neither checksum nor manifest.

    Args:
        file: the document.
        fields: its fields.

    Raises:
        FormatError: if the manifest beside it is damaged.
    """
    if checksum_state(fields) == "edited":
        return "it does not match its own checksum: it was edited or damaged after it was written"
    if manifest_fault(file):
        return f"it is not the file that {MANIFEST_FILE} beside it lists: it was replaced or edited"
    return ""


def was_edited(file: Path, fields: Mapping[str, Any]) -> bool:
    """Return whether a document is not as it was written, or a damaged manifest leaves that open."""
    try:
        return bool(edited_fault(file, fields))
    except FormatError:
        return True


def checksum_words(file: Path, fields: Mapping[str, Any]) -> str:
    """Return in words whether a document is as it was written."""
    if was_edited(file, fields):
        return "wrong: the file was changed after it was written"
    return "no checksum" if checksum_state(fields) == "no checksum" else "right"


def edited_note(path: PathLike) -> str:
    """Return a note on a file with a pose to begin with that was changed after it was written; empty: it was not.

    Such a file is as good as a pose that was typed: the pose is only where the search begins.
    """
    try:
        with reading(path) as file:
            fault = edited_fault(file, read_json_object(file, "a pose file")) if begins_with_brace(file) else ""
    except LadarregError:  # whoever reads it says why
        return ""
    return f"{shown_name(path)}: {fault}; its pose was taken all the same, as one that was typed" if fault else ""
