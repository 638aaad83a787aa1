"""The result of a command as one JSON document on stdout (`--json`)."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ladarreg_core.photo import Photo
    from ladarreg_core.scan import Scan


def print_json(document: Mapping[str, Any]) -> None:
    """Print a document; undefined numbers are null."""
    from ladarreg_core.export.json import plain

    print(json.dumps(plain(document), ensure_ascii=False, allow_nan=False))


def print_written(folder: Path, document: str, scan: Scan, photo: Photo) -> None:
    """Print a document that was written into a folder, with the folder's files and the readers' notes."""
    from ladarreg_core.storage.manifest import visible_files

    fields = json.loads((folder / document).read_text(encoding="utf-8"))
    output = {"folder": os.path.abspath(folder), "files": visible_files(folder)}
    print_json({**fields, "notes": [*scan.notes, *photo.notes], "output": output})
