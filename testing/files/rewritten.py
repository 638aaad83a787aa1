"""Documents of results as another program would write them: changed, with a checksum that is right."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ladarreg_core.storage.checksums import sealed
from ladarreg_core.storage.manifest import MANIFEST_FILE


def rewrite(path: Path, fields: Mapping[str, Any]) -> None:
    """Write a document of results with its checksum; no manifest lists another one."""
    path.write_text(json.dumps(sealed(fields)), encoding="utf-8")
    (path.parent / MANIFEST_FILE).unlink(missing_ok=True)


def without_hints(path: Path) -> None:
    """Remove the paths of the inputs from a `registration.json`."""
    fields = json.loads(path.read_bytes())
    for record in fields["inputs"]:
        record.pop("path_hint", None)
    rewrite(path, fields)
