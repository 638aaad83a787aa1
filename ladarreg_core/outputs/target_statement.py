"""The statement of a registration by survey targets, as files: `targets.json`, and a table of residuals."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ladarreg_core.export.json import software_document, write_result
from ladarreg_core.export.targets.folder import FileJob, write_folder
from ladarreg_core.registration.stations.survey_target import SurveyTarget
from ladarreg_core.registration.stations.target_pose import TargetRegistration
from ladarreg_core.storage.atomic_write import write_bytes

TARGETS_FILE, TABLE_FILE = "targets.json", "targets.csv"
"""The statement, and its residuals as a table."""


def write_target_statement(
    folder: str | Path,
    found: TargetRegistration,
    targets: Mapping[str, SurveyTarget],
    *,
    details: Mapping[str, Any] | None = None,
    inputs: Sequence[str | Path] = (),
    force: bool = False,
) -> dict[str, Any]:
    """Write where a scanner stood by its targets into a new folder, and return the document.

    Args:
        folder: output folder.
        found: the registration.
        targets: the targets in the scan, by name.
        details: what else is stated, such as the standard deviation of the coordinates.
        inputs: files that must not be replaced.
        force: replace an earlier statement.

    Raises:
        ExportError: if the folder exists and must not be replaced, or cannot be written.
    """
    fields = found.as_fields()
    for one in fields["targets"]:
        target = targets[one["name"]]
        one |= {"kind": "sphere" if target.side_m is None else "flat"}
        one |= {"center_m": target.center.tolist(), "center_sigma_m": np.sqrt(np.diag(target.covariance)).tolist()}
    document = {
        "version": 1,
        "kind": "targets",
        "software": software_document(),
        **fields,
        **(details or {}),
        "covariance_is": "of (w, c): R_true = exp([w]x) R (rad), c = true minus estimated scanner centre (m), in the "
        "frame of the coordinates",
        "residual_is": "surveyed minus measured, m, in the frame of the coordinates",
        "center_is": "in the scanner's frame, m",
    }
    jobs: list[FileJob] = [
        (TARGETS_FILE, lambda path: write_result(path, document)),
        (TABLE_FILE, lambda path: write_bytes(path, _table(fields["targets"]))),
    ]
    write_folder(folder, lambda: jobs, inputs=inputs, more_names=[name for name, _ in jobs], force=force)
    return document


def _table(targets: Sequence[Mapping[str, Any]]) -> bytes:
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(["name", "used", "dx_mm", "dy_mm", "dz_mm", "length_mm"])
    for one in targets:
        off = 1000 * np.asarray(one["residual_m"])
        rows.writerow([one["name"], int(one["used"]), *(f"{value:.3f}" for value in (*off, np.linalg.norm(off)))])
    return text.getvalue().encode()
