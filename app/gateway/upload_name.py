"""The name of a file that somebody sends: to be shown, never to be used as a path."""

from __future__ import annotations

import re
import unicodedata
from urllib.parse import unquote

from ladarreg_core.errors import OptionError

_LONGEST = 255
_SUFFIX = re.compile(r"\.[a-z0-9]{1,8}")


def upload_name(header: str | None) -> str:
    """Return the name that a file is shown by.

    Args:
        header: X-File-Name, percent-encoded UTF-8.

    Raises:
        OptionError: if it is missing, too long, or no name of a file.
    """
    name = unicodedata.normalize("NFC", unquote(header or "", errors="replace"))
    # Invisible signs that join or turn letters: some scripts' names need them, on a page they only mislead.
    name = "".join(letter for letter in name if unicodedata.category(letter) != "Cf").strip()
    if not name:
        raise OptionError("the file has no name; the header X-File-Name is needed")
    if len(name) > _LONGEST:
        raise OptionError(f"the file's name has {len(name)} characters; shorten it to {_LONGEST}")
    if set(name) & set("/\\") or name.strip(".") == "":
        raise OptionError("the file's name is a path; send the name alone")
    if any(unicodedata.category(letter) in ("Cc", "Cs") for letter in name):
        raise OptionError("the file's name holds control characters; rename it")
    return name


def safe_suffix(name: str) -> str:
    """Return a name's suffix, lower case, or nothing if it is no ordinary one."""
    suffix = "." + name.rpartition(".")[2].lower() if "." in name else ""
    return suffix if _SUFFIX.fullmatch(suffix) else ""
