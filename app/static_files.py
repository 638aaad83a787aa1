"""The page's files: in the source tree's `static/`, or inside an installed wheel."""

from __future__ import annotations

from functools import cache
from pathlib import Path

_ANCHOR = "tokens.css"


@cache
def static_folder() -> Path:
    """Return the folder of the page's files.

    Raises:
        FileNotFoundError: if the installation is broken.
    """
    here = Path(__file__).resolve().parent
    for folder in (here / "static", here.parent / "static"):
        if (folder / _ANCHOR).is_file():
            return folder
    raise FileNotFoundError(f"the page's files are missing beside {here}; reinstall ladarreg")


def static_text(name: str) -> str:
    """Return the text of one of the page's files."""
    return (static_folder() / name).read_text(encoding="utf-8")
