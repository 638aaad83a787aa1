"""JSON documents of the exports: `registration.json`, and the parts that all of them share."""

from __future__ import annotations

import hashlib
import json
import math
import os
import platform
import re
from collections.abc import Mapping, Sequence
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ladarreg_core.errors import ExportError
from ladarreg_core.foundations.version import VERSION
from ladarreg_core.frames import ThesisParameters
from ladarreg_core.picks.lengths import lengths_by_end
from ladarreg_core.results.registration import PoseResult, Registration
from ladarreg_core.storage.atomic_write import write_bytes
from ladarreg_core.storage.checksums import sealed
from ladarreg_core.surface.texture.registered_texture import Label

if TYPE_CHECKING:
    from ladarreg_core.quality.assessment import Assessment
    from ladarreg_core.quality.smoothing import SmoothedScan

CAMERA_FROM_SCANNER_IS = (
    "maps scanner points (X forward, Y left, Z up, m) to the camera (x right, y down, z forward, m): "
    "p_camera = camera_from_scanner @ p_scanner"
)
"""Explanation of the direction of `camera_from_scanner`; written next to every such matrix."""
WORLD_FROM_SCANNER_IS = (
    "the scanner's pose as the scan's file states it: maps scanner points to the world's coordinates (m); null: the "
    "file states none, and camera_from_world is not known either"
)
"""Explanation of `world_from_scanner`."""
REJECTED_GUESS_IS = (
    "null, or of a refused registration the best candidate in the place of camera_from_scanner: it is no pose and must "
    "not be used as one"
)
"""Explanation of `rejected_guess`."""
_REGISTRATION_VERSION = 1
_READ_BYTES = 1 << 20
_LONGEST_HINT = 4096
_UPLOAD = re.compile(r"[0-9a-f]{32}")
InputFile = str | Path | tuple[Path, str]
"""An input file, or one with the name that its user knows it by."""


def write_document(path: str | Path, document: Mapping[str, Any]) -> None:
    """Write a document as strict JSON: no NaN, no infinity.

    Raises:
        ExportError: if the file cannot be written.
    """
    text = json.dumps(plain(document), indent=1, ensure_ascii=False, allow_nan=False)
    write_bytes(path, (_join_short_lists(text) + "\n").encode("utf-8"))


def write_result(path: str | Path, document: Mapping[str, Any]) -> None:
    """Write a document of results with its checksum; see `write_document`.

    Raises:
        ExportError: if the file cannot be written, or a number in it has no place in JSON.
    """
    try:
        checked = sealed(plain(document))
    except ValueError as error:
        raise ExportError(f"cannot write {path}: {error}; give options within the usual ranges") from None
    write_document(path, checked)


def registration_document(
    registration: Registration,
    *,
    assessment: Assessment | None = None,
    smoothed: SmoothedScan | None = None,
    inputs: Sequence[InputFile] = (),
    read_with: Sequence[Mapping[str, Any]] = (),
    folder: Path | None = None,
) -> dict[str, Any]:
    """Return a registration as a JSON-ready document; undefined numbers are None.

    Args:
        registration: the result.
        assessment: assessment of the result; None: that part of the document is empty.
        smoothed: the scan used for the models, if spikes were searched for.
        inputs: the input files; their names, sizes and SHA-256 are recorded, without their folders.
        read_with: how the first of them were read, see `input_documents`.
        folder: where the document will stand; the inputs' paths from there are then recorded, too.

    Raises:
        ExportError: if an input file cannot be read.
    """
    r = registration
    pose = r.camera_from_scanner if r.is_shown else None
    lengths = lengths_by_end(r.diagnostics)
    document = {
        "version": _REGISTRATION_VERSION,
        "camera_from_scanner": None if pose is None else pose.matrix,
        "camera_from_scanner_is": CAMERA_FROM_SCANNER_IS,
        "scanner_from_camera": None if pose is None else pose.inverse.matrix,
        "scanner_from_camera_is": "the inverse: maps camera points to the scanner; its last column is the camera's "
        "centre in the scanner frame",
        "rejected_guess": r.camera_from_scanner.matrix if pose is None and r.has_pose else None,
        "rejected_guess_is": REJECTED_GUESS_IS,
        **world_document(r),
        "camera": r.camera.as_fields(),
        "camera_sigmas": dict(r.camera_sigmas),
        **({} if r.camera_uncertainty is None else {"camera_uncertainty": r.camera_uncertainty.as_fields()}),
        "covariance": np.asarray(r.covariance) if np.isfinite(r.covariance).all() else None,
        "covariance_is": "of (w, c): R_true = exp([w]x) R (rad), c = true minus estimated camera centre in the "
        "scanner frame (m); null: not known, as of a pose that was given; of a refused result it is the guess's",
        "sigma": {
            "angle_rad": r.sigma_angle_rad,
            "position_m": r.sigma_position_m,
            "pixel_px": r.sigma_px,
            "range_m": r.sigma_range_m,
            "chi2_per_dof": r.chi2_per_dof,
        },
        "thesis_parameters": None if pose is None else thesis_document(r.thesis_parameters),
        "accepted": bool(r.accepted),
        "evidence": r.evidence,
        "mark": r.mark or None,
        "coarse": r.is_coarse,
        "reasons": list(r.reasons),
        "matches": [
            {
                "pick_id": pick_id,
                "inlier": r.inliers[k],
                "residual_px": r.residuals_px[k],
                "residual_m": r.residuals_m[k],
                "stereo_depth_error_m": r.stereo_depth_error_m[k],
                "uv": r.matches.uv[k],
                "ray": r.matches.rays[k],
                "range_m": r.matches.ranges[k],
                "influence": _influence(assessment, k),
                **_length_document(lengths.get((pick_id, round(float(r.matches.fractions[k]))))),
            }
            for k, pick_id in enumerate(r.matches.pick_ids)
        ],
        **({} if r.blocks is None else {"blocks": r.blocks.as_fields()}),
        "labels": {str(label.value): label.name.lower() for label in Label},
        "method": r.method,
        "steps": [
            {
                "name": step.name,
                "seconds": step.seconds,
                "matches": None if step.matches is None else len(step.matches),
                "detail": step.detail,
            }
            for step in r.steps
        ],
        "diagnostics": r.diagnostics,
        **_assessment_fields(assessment),
        "smoothing": None
        if smoothed is None
        else {"cells_replaced": smoothed.cells_replaced, "sentence": smoothed.sentence},
        "options": r.options,
        "seed": r.seed,
        "inputs": input_documents(inputs, read_with, folder=folder),
        "software": software_document(),
    }
    ready = plain(document)
    assert isinstance(ready, dict)
    return ready


def _influence(assessment: Assessment | None, k: int) -> dict[str, float] | None:
    """Return the influence of match k on the pose; numbers are None if the other matches determine no pose."""
    found = None if assessment is None else assessment.influence
    if found is None:
        return None
    return {name: getattr(found, name)[k] for name in ("position_m", "angle_rad", "pixels", "cook")}


def _length_document(length: Mapping[str, Any] | None) -> dict[str, Any]:
    """Return how the length that came with a match compares with the scan's own range; empty without a length."""
    if length is None:
        return {}
    return {
        "name": length["name"],
        "range_is": "as stated with the match",
        "scan_range_m": length["scan_range_m"],
        "length_minus_scan_m": length["difference_m"],
        "length_tolerance_m": length["tolerance_m"],
        "length_state": length["state"],
    }


def _assessment_fields(assessment: Assessment | None) -> dict[str, Any]:
    a = assessment
    uncertainty = None if a is None else a.uncertainty
    return {
        "findings": [
            {
                "name": finding.name,
                "level": finding.level,
                "sentence": finding.sentence,
                "what_to_do": finding.what_to_do,
                "values": finding.values,
            }
            for finding in (a.findings or () if a is not None else ())
        ],
        "uncertainty": None
        if uncertainty is None
        else {
            "median_px": uncertainty.median_px,
            "p95_px": uncertainty.p95_px,
            "worst_px": uncertainty.worst_px,
            "worst_cell": uncertainty.worst_cell,
            "worst_uv": uncertainty.worst_uv,
        },
        "advice": [
            {"sentence": place.summary(), "cell": place.cell, "uv": place.uv, "gain": place.gain}
            for place in (a.advice or () if a is not None else ())
        ],
        "not_assessed": {} if a is None else a.absent,
    }


def world_document(result: PoseResult) -> dict[str, Any]:
    """Return where the scanner and the camera stand in the world, in double precision; None where it is not known."""
    in_world = result.camera_from_world if result.is_shown else None
    matrices = {"world_from_scanner": result.world_from_scanner, "camera_from_world": in_world}
    return {
        **{name: None if pose is None else pose.matrix for name, pose in matrices.items()},
        "world_from_scanner_is": WORLD_FROM_SCANNER_IS,
        "camera_centre_world": None if in_world is None else result.camera_centre_world,
    }


def thesis_document(thesis: ThesisParameters) -> dict[str, Any]:
    """Return the thesis's six parameters with their units and a description of the position."""
    return {
        "Tx": thesis.Tx,
        "Ty": thesis.Ty,
        "Tz": thesis.Tz,
        "alpha": thesis.alpha,
        "beta": thesis.beta,
        "gamma": thesis.gamma,
        "units": "m, rad",
        "in_words": thesis.describe_position(),
    }


def software_document() -> dict[str, str]:
    """Return the versions of the software that writes a file."""
    return {
        "name": "ladarreg",
        "version": VERSION,
        "python": platform.python_version(),
        "numpy": np.__version__,
    }


def input_documents(
    inputs: Sequence[InputFile], read_with: Sequence[Mapping[str, Any]] = (), *, folder: Path | None = None
) -> list[dict[str, Any]]:
    """Return the documents of input files.

    Args:
        inputs: the files, the scan first, then the photograph; with a name, it is recorded in place of the file's.
        read_with: the options that the first of them were read with, in the same order: the arguments of `read_scan`
            and `read_photo`, recorded as `read_with` so that nobody need repeat them. Files among them are recorded by
            their names; options that were not given are left out.
        folder: where the document will stand: the path of each file from there becomes its `path_hint`.

    Raises:
        ExportError: if a file cannot be read.
    """
    found = []
    for each in inputs:
        path, name = each if isinstance(each, tuple) else (Path(each), Path(each).name)
        hint = None if folder is None else _path_hint(path, folder)
        found.append({**input_document(path), "name": name, **({} if hint is None else {"path_hint": hint})})
    for document, options in zip(found, read_with, strict=False):
        given = {name: value for name, value in options.items() if value is not None and value != ()}
        document["read_with"] = {name: plain(_name_of(value)) for name, value in given.items()}
    return found


def _name_of(value: Any) -> Any:
    """Return a file as its name, and files as theirs; any other value unchanged."""
    if isinstance(value, Path):
        return value.name
    return [_name_of(item) for item in value] if isinstance(value, tuple) else value


def input_document(path: Path) -> dict[str, Any]:
    """Return the name, size and SHA-256 of an input file, without its folder.

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


def _path_hint(path: Path, folder: Path) -> str | None:
    """Return a file's path relative to a folder; None: they are on different drives."""
    real = os.path.join(os.path.realpath(path.parent), path.name)
    try:
        return Path(os.path.relpath(real, os.path.realpath(folder))).as_posix()
    except ValueError:
        return None


def hinted_file(record: Mapping[str, Any], folder: Path, within: Sequence[Path] | None = None) -> Path | None:
    """Return the file at the `path_hint` of an input document, if it is that input by its size and SHA-256.

    Args:
        record: the input document.
        folder: where the document that states it stands.
        within: folders that it must lie in, links followed; None: it may lie anywhere. What lies outside is not
            looked at, and gives the same answer as a file that does not exist.
    """
    hint = record.get("path_hint")
    if not isinstance(hint, str) or not 0 < len(hint) <= _LONGEST_HINT or not isinstance(record.get("size"), int):
        return None
    if "\0" in hint or Path(hint).is_absolute() or Path(hint).drive:
        return None
    try:
        there = Path(os.path.realpath(folder), hint)
        real = Path(os.path.realpath(there))
        if within is not None and not any(real.is_relative_to(os.path.realpath(one)) for one in within):
            return None
        named = Path(os.path.realpath(there.parent), there.name)  # a link keeps its name
        return named if real.is_file() and is_recorded(real, record) else None
    except (OSError, ExportError, ValueError):
        return None


def find_inputs(
    recorded: Sequence[Mapping[str, Any]],
    folders: Sequence[Path],
    *,
    beside: Path | None = None,
    within: Sequence[Path] | None = None,
    option: str = "`inputs`",
) -> list[Path]:
    """Return the files of input documents, found in folders by their names and recognised by their SHA-256.

    Args:
        recorded: the input documents.
        folders: the folders; an entry that is a file stands for itself, but files of the
            recorded name precede it.
        beside: folder of the document that states them, for their `path_hint`, which is followed last; None: it is not.
        within: as in `hinted_file`.
        option: how to give a folder, for messages.

    Raises:
        ExportError: if one is not found, or only files of its name with another content.
    """
    found = []
    for record in recorded:
        name = Path(str(record.get("name"))).name
        there = [folder if folder.is_file() else folder / name for folder in dict.fromkeys(folders)]
        there = sorted((path for path in there if path.is_file()), key=lambda path: path.name != name)
        path = next((path for path in there if is_recorded(path, record)), None)
        if path is None:  # a file that was uploaded to a project lies there under a random name
            uploads = (path for folder in dict.fromkeys(folders) for path in _uploads(folder))
            path = next((path for path in uploads if is_recorded(path, record)), None)
        if path is None and beside is not None:
            path = hinted_file(record, beside, within)
        if path is None:
            why = f"{there[0]} differs from it (another SHA-256)" if there else "there is no such file"
            raise ExportError(f"the input {name} is needed, but {why}; give its folder with {option}")
        found.append(path)
    return found


def _uploads(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if _UPLOAD.fullmatch(path.stem)) if folder.is_dir() else []


def is_recorded(path: Path, record: Mapping[str, Any]) -> bool:
    """Return whether a file is that of an input document; a file of another size is not hashed.

    Raises:
        ExportError: if it cannot be read.
    """
    size = record.get("size")
    if isinstance(size, int) and path.stat().st_size != size:
        return False
    return bool(input_document(path)["sha256"] == record.get("sha256"))


def plain(value: Any) -> Any:
    """Convert a value to plain JSON values: dicts, lists, strings, finite numbers, None."""
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
    if hasattr(value, "as_fields"):  # a camera
        return value.as_fields()
    return str(value)


def _join_short_lists(text: str) -> str:
    """Put the numbers of a short list on one line, so that matrices are readable."""
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
