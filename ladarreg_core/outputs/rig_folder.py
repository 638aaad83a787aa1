"""Rigs in files: the pairs of a table are read, and the result is written as JSON, for ROS and for Kalibr."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ladarreg_core.progress import Progress, Report

if TYPE_CHECKING:
    from ladarreg_core.formats.documents.rig_file import RigRow
    from ladarreg_core.registration.rig.results import RigPair, RigResult

_VERSION = 1
_POSE_IS = (
    "maps scanner points to the camera frame: p_camera = R p_scanner + t; scanner: X forward, Y left, Z up; camera: x "
    "right, y down, z forward; metres"
)
_COVARIANCE_IS = (
    "of (w, c): R_true = exp([w]x) R_estimated, c = C_true - C_estimated, the camera's centre in the scanner frame, "
    "in rad and m"
)


def read_rig(
    rows: Sequence[RigRow],
    *,
    scan_options: Mapping[str, Any] | None = None,
    photo_options: Mapping[str, Any] | None = None,
    report: Report | None = None,
) -> list[RigPair]:
    """Read the pairs of a table.

    Args:
        rows: of `read_rig_table`.
        scan_options: arguments of `read_scan` for all scans.
        photo_options: arguments of `read_photo` for all photographs; a row's own camera file precedes them.
        report: receives the progress.

    Raises:
        LadarregError: if a file cannot be read.
    """
    from ladarreg_core.formats import read_photo, read_scan
    from ladarreg_core.registration.rig.results import RigPair

    found = []
    for done, row in enumerate(rows):
        if report is not None:
            report(Progress(done, len(rows), f"reading {row.name}"))
        scan = read_scan(row.scan, **{**(scan_options or {}), "more": row.more})
        own: dict[str, Any] = dict(photo_options or {})
        if row.camera is not None:
            own = {"camera": row.camera, "camera_name": own.get("camera_name")}
        found.append(RigPair(row.name, scan, read_photo(row.photo, **own)))
    return found


def write_rig(
    folder: str | Path,
    result: RigResult,
    *,
    inputs: Sequence[str | Path] = (),
    force: bool = False,
    report: Report | None = None,
) -> dict[str, Any]:
    """Write `rig.json` and, of an accepted rig, the files for ROS and Kalibr into a new folder, all at once.

    Args:
        folder: output folder.
        result: the result.
        inputs: the table and the files that it names.
        force: replace an earlier folder of a rig and nothing else.
        report: receives the progress.

    Returns:
        the document that was written.

    Raises:
        ExportError: if the folder exists and must not be replaced, or cannot be written.
    """
    from ladarreg_core.export.json import write_result
    from ladarreg_core.export.photo_files import text_writer
    from ladarreg_core.export.targets.folder import FileJob, write_folder
    from ladarreg_core.export.targets.kalibr import lidar_chain
    from ladarreg_core.export.targets.ros import rig_files
    from ladarreg_core.storage.replacement import RIG_FILE

    fields = rig_document(result, inputs=inputs)
    jobs: list[FileJob] = [(RIG_FILE, lambda path: write_result(path, fields))]
    pose = result.camera_from_scanner
    if result.accepted and pose is not None:
        words = [
            result.reasons[0],
            f"Standard deviations: {_list(fields['sigma_deg'])} deg about the axes of the camera, "
            f"{_list(fields['sigma_mm'])} mm of its centre in the scanner's frame.",
        ]
        jobs += [(name, text_writer(text)) for name, text in rig_files(pose, words).items()]
        chain = lidar_chain(pose, result.cameras[0], words)
        if chain is not None:
            jobs.append(("camchain-lidar.yaml", text_writer(chain)))
    write_folder(folder, lambda: jobs, inputs=inputs, force=force, report=report)
    return fields


def rig_document(result: RigResult, *, inputs: Sequence[str | Path] = ()) -> dict[str, Any]:
    """Return the contents of `rig.json`, JSON-ready."""
    from ladarreg_core.export.json import input_documents, plain, software_document
    from ladarreg_core.frames import ThesisParameters
    from ladarreg_core.storage.replacement import RIG_FILES

    pose, known = result.camera_from_scanner, bool(np.isfinite(result.covariance).all())
    sigma = np.sqrt(np.diag(result.covariance)) if known else np.full(6, np.nan)
    matrix = None if pose is None else pose.matrix.tolist()
    fields: dict[str, Any] = {
        "version": _VERSION,
        "kind": "rig",
        "software": software_document(),
        "camera_from_scanner": matrix if result.accepted else None,
        "camera_from_scanner_is": _POSE_IS,
    }
    if not result.accepted:
        fields["rejected_guess"] = matrix
    if pose is not None and result.accepted:
        six = ThesisParameters.from_pose(pose)
        fields |= {
            "scanner_from_camera": pose.inverse.matrix.tolist(),
            "in_words": f"{six.describe_position()}; {six.describe_orientation()}",
        }
    fields |= {
        "accepted": result.accepted,
        "reasons": list(result.reasons),
        "false_alarm": result.false_alarm,
        "covariance": result.covariance.tolist() if known else None,
        "covariance_is": _COVARIANCE_IS,
        "sigma_deg": np.degrees(sigma[:3]).tolist(),
        "sigma_mm": (1e3 * sigma[3:]).tolist(),
        "pairs": [one.as_dict() for one in result.pairs],
        "used": list(result.used),
        "refused": list(result.refused),
        "cameras": [camera.as_fields() for camera in result.cameras],
        "steps": [{"name": step.name, "seconds": round(step.seconds, 4), **step.detail} for step in result.steps],
        "options": dict(result.options),
        "seed": result.seed,
        "files": list(RIG_FILES) if result.accepted else [],
        "inputs": input_documents(list(inputs)),
    }
    return dict(plain(fields))


def _list(numbers: Sequence[float | None]) -> str:
    return ", ".join("?" if number is None else f"{number:.3g}" for number in numbers)
