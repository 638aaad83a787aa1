"""Change between two scans as files: a summary, a cloud with distances and their significance, and a picture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.export.json import software_document, write_result
from ladarreg_core.export.targets.folder import FileJob, write_folder
from ladarreg_core.foundations.arrays import ByteArray
from ladarreg_core.foundations.progress import Report
from ladarreg_core.frames import Rigid
from ladarreg_core.inspection.measuring.change import Change
from ladarreg_core.scan import Scan
from ladarreg_core.storage.atomic_write import write_bytes
from ladarreg_core.surface.texture.registered_texture import intensity_picture

CHANGE_FILE = "change.json"
"""The file that describes a comparison; it is written first."""
_ADDED, _REMOVED, _SAME, _UNKNOWN = (214, 60, 50), (46, 104, 220), (120, 170, 120), (110, 110, 110)
_FIELDS = (
    ("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("nx", "<f4"), ("ny", "<f4"), ("nz", "<f4"), ("distance", "<f4"),
    ("sigma", "<f4"), ("significant", "u1"), ("red", "u1"), ("green", "u1"), ("blue", "u1"),
)  # fmt: skip
_PLY_TYPES = {"<f4": "float", "u1": "uchar"}


def write_change(
    folder: str | Path,
    change: Change,
    before: Scan,
    *,
    before_from_after: Rigid,
    details: Mapping[str, Any] | None = None,
    inputs: Sequence[str | Path] = (),
    force: bool = False,
    report: Report | None = None,
) -> None:
    """Write a comparison into a new folder: `change.json`, `change.ply` and `change.png`.

    Args:
        folder: output folder.
        change: the comparison.
        before: the first scan.
        before_from_after: the pose of the second scanner that was used.
        details: what else is stated in `change.json`, such as how the pose was found.
        inputs: files and folders that must not be replaced.
        force: replace an earlier comparison.
        report: receives the progress.

    Raises:
        ExportError: if the folder exists and must not be replaced, or cannot be written.
    """
    document = {
        "version": 1,
        "kind": "change",
        "software": software_document(),
        **change.as_fields(),
        "before_from_after": before_from_after.matrix.tolist(),
        **(details or {}),
        "distance_is": "of the second scan's surface from the first's along its normal, m: positive where something "
        "was added; frame: the first scanner's",
    }
    jobs: list[FileJob] = [
        (CHANGE_FILE, lambda path: write_result(path, document)),
        ("change.ply", lambda path: write_bytes(path, _ply(change))),
        ("change.png", lambda path: _write_picture(path, change, before)),
    ]
    write_folder(
        folder, lambda: jobs, inputs=inputs, more_names=[name for name, _ in jobs], force=force, together=False,
        report=report,
    )  # fmt: skip


def _colors(change: Change) -> ByteArray:
    """Return a colour (N, 3) for each point."""
    colors = np.full((len(change.points), 3), _UNKNOWN, np.uint8)
    colors[change.known] = _SAME
    significant = change.significant
    with np.errstate(invalid="ignore"):
        colors[significant & (change.distance_m > 0)] = _ADDED
        colors[significant & (change.distance_m < 0)] = _REMOVED
    return colors


def _ply(change: Change) -> bytes:
    rows: NDArray[Any] = np.zeros(len(change.points), dtype=list(_FIELDS))
    for k, axis in enumerate("xyz"):
        rows[axis], rows[f"n{axis}"] = change.points[:, k], change.normals[:, k]
    rows["distance"], rows["sigma"], rows["significant"] = change.distance_m, change.sigma_m, change.significant
    for k, name in enumerate(("red", "green", "blue")):
        rows[name] = _colors(change)[:, k]
    header = [
        "ply", "format binary_little_endian 1.0", "comment ladarreg change; scanner frame of the first scan, metres",
        f"element vertex {len(rows)}", *(f"property {_PLY_TYPES[kind]} {name}" for name, kind in _FIELDS), "end_header",
    ]  # fmt: skip
    return ("\n".join(header) + "\n").encode("ascii") + rows.tobytes()


def _write_picture(path: Path, change: Change, before: Scan) -> None:
    picture = np.ascontiguousarray(intensity_picture(before)) // 2
    size = max(1, round(0.3 * np.sqrt(before.ranges.size / max(len(change.points), 1))))
    for (row, column), color in zip(change.cells.tolist(), _colors(change).tolist(), strict=True):
        cv2.circle(picture, (column, row), size, color, -1)
    write_bytes(path, cv2.imencode(".png", picture[..., ::-1])[1].tobytes())
