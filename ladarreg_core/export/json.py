"""What the JSON files of all exports share: strict numbers, a pose in both directions, where it came from."""

from __future__ import annotations

import hashlib
import json
import math
import platform
from collections.abc import Mapping, Sequence
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np

import ladarreg_core
from ladarreg_core.camera import Camera
from ladarreg_core.errors import ExportError
from ladarreg_core.export.atomic_write import write_bytes
from ladarreg_core.frames import ThesisParameters

CAMERA_FROM_SCANNER_IS = (
    "maps scanner points (X forward, Y left, Z up, m) to the camera (x right, y down, z forward, m): "
    "p_camera = camera_from_scanner @ p_scanner"
)
"""The direction of `camera_from_scanner` in words; it stands beside every matrix that is written."""
_READ_BYTES = 1 << 20


def write_document(path: str | Path, document: Mapping[str, Any]) -> None:
    """Write a document as strict JSON: no NaN, no infinity.

    Raises:
        ExportError: if the file cannot be written.
    """
    text = json.dumps(plain(document), indent=1, ensure_ascii=False, allow_nan=False)
    write_bytes(path, (_short_rows(text) + "\n").encode("utf-8"))


def thesis_document(thesis: ThesisParameters) -> dict[str, Any]:
    """Return the thesis's six parameters with their units and the position in words."""
    return {
        "Tx": thesis.Tx,
        "Ty": thesis.Ty,
        "Tz": thesis.Tz,
        "alpha": thesis.alpha,
        "beta": thesis.beta,
        "gamma": thesis.gamma,
        "units": "m, rad",
        "in_words": thesis.in_words(),
    }


def software_document() -> dict[str, str]:
    """Return which versions made a file."""
    return {
        "name": "ladarreg",
        "version": ladarreg_core.__version__,
        "python": platform.python_version(),
        "numpy": np.__version__,
    }


def input_document(path: Path) -> dict[str, Any]:
    """Return the name, size and SHA-256 of a file, not its folder.

    Raises:
        ExportError: if it cannot be read.
    """
    digest, size = hashlib.sha256(), 0
    try:
        with open(path, "rb") as file:
            while block := file.read(_READ_BYTES):
                digest.update(block)
                size += len(block)
    except OSError as error:
        reason = (error.strerror or type(error).__name__).lower()
        raise ExportError(f"cannot read the input {path} again: {reason}; keep it until the export is done") from None
    return {"name": path.name, "size": size, "sha256": digest.hexdigest()}


def plain(value: Any) -> Any:
    """Return a value as JSON knows it: dicts, lists, strings, finite numbers, None."""
    if value is None or isinstance(value, (str, bool)):
        return str(value.value) if isinstance(value, Enum) else value
    if isinstance(value, Enum):
        return plain(value.value)
    if isinstance(value, np.generic | np.ndarray):
        return plain(value.tolist())
    if isinstance(value, int):
        return int(value)
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, Sequence | set | frozenset):
        return [plain(item) for item in value]
    if isinstance(value, Camera):
        return value.as_fields()
    return str(value)


def _short_rows(text: str) -> str:
    """Put the numbers of a short list on one line, so that a matrix reads as a matrix."""
    lines, result, k = text.split("\n"), [], 0
    while k < len(lines):
        line = lines[k]
        if line.endswith("["):
            end = next(
                (n for n in range(k + 1, min(k + 10, len(lines))) if lines[n].lstrip()[:1] in ("]", "[", "{")), k
            )
            inner = [item.strip() for item in lines[k + 1 : end]]
            if end > k + 1 and lines[end].lstrip().startswith("]") and not any('"' in item for item in inner):
                result.append(line + " ".join(inner) + lines[end].strip())
                k = end + 1
                continue
        result.append(line)
        k += 1
    return "\n".join(result)
