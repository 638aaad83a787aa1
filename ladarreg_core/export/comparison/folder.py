"""Export of a comparison of the thesis's stages with the default: numbers, table, contact sheet and images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ladarreg_core.export.comparison.contact_sheet import write_contact_sheet
from ladarreg_core.export.comparison.table import (
    Difference,
    cautions_of,
    comparison_table,
    differences,
    markdown_table,
    rms_depth_m,
    rms_px,
    title_of,
    verdict_of,
)
from ladarreg_core.export.json import (
    CAMERA_FROM_SCANNER_IS,
    input_documents,
    plain,
    software_document,
    thesis_document,
    world_document,
    write_document,
)
from ladarreg_core.export.pictures.images import write_registered_png
from ladarreg_core.export.targets.folder import FileJob, write_folder
from ladarreg_core.foundations.progress import Report
from ladarreg_core.photo import Photo
from ladarreg_core.registration.comparison import Column, Comparison
from ladarreg_core.results.registration import PoseResult
from ladarreg_core.scan import Scan
from ladarreg_core.storage.atomic_write import write_bytes

_VERSION = 1
_PICTURES_ARE = (
    "the photograph on the scan's grid: registered_<stage>.png where the stage is accepted; "
    "not_accepted_<stage>.png is only a candidate whose evidence is insufficient for acceptance"
)


def export_comparison(
    folder: str | Path,
    comparison: Comparison,
    scan: Scan,
    photo: Photo,
    *,
    inputs: Sequence[str | Path] = (),
    read_with: Sequence[Mapping[str, Any]] = (),
    force: bool = False,
    report: Report | None = None,
) -> None:
    """Write a comparison into a new folder atomically.

    It contains `comparison.json`, `table.md` and `contact_sheet.png`, and for each stage with a pose the photograph on
    the scan's grid: `registered_<stage>.png` if the stage is accepted, `not_accepted_<stage>.png` if not.

    Args:
        folder: output folder; missing parents are created.
        comparison: the columns.
        scan: the scan.
        photo: the photograph.
        inputs: the files that scan and photo were read from, recorded in `comparison.json`.
        read_with: the options that they were read with, see `json.input_documents`; recorded, too.
        force: replace the results of an earlier run.
        report: receives the progress, before each file and at the end.

    Raises:
        ExportError: if the folder exists and must not be replaced, see `check_folder`, or if something cannot be
            written.
        ShapeError: if there is no column, or an image is not on the scan's grid.
    """
    write_folder(
        folder,
        lambda: _files(comparison, scan, photo, inputs, read_with),
        inputs=inputs,
        force=force,
        report=report,
    )


def picture_name(column: Column) -> str | None:
    """Return the file name of a column's image, which shows whether it is accepted; None if there is no image."""
    if column.stage.result is None or column.texture is None:
        return None
    return f"{'registered' if column.stage.result.accepted else 'not_accepted'}_{column.stage.name}.png"


def comparison_document(
    comparison: Comparison,
    scan: Scan,
    *,
    inputs: Sequence[str | Path] = (),
    read_with: Sequence[Mapping[str, Any]] = (),
) -> dict[str, Any]:
    """Return a comparison as a JSON-ready document; undefined numbers are None.

    Args:
        comparison: the columns.
        scan: the scan that they share.
        inputs: the input files; their names, sizes and SHA-256 are recorded, without their folders.
        read_with: how the first of them were read, see `json.input_documents`.

    Raises:
        ExportError: if an input file cannot be read.
    """
    document = {
        "version": _VERSION,
        "camera_from_scanner_is": CAMERA_FROM_SCANNER_IS,
        "pictures_are": _PICTURES_ARE,
        "cautions": list(cautions_of(comparison)),
        "columns": [
            _column_document(column, apart)
            for column, apart in zip(comparison.columns, differences(comparison, scan), strict=True)
        ],
        "seed": comparison.seed,
        "inputs": input_documents(inputs, read_with),
        "software": software_document(),
    }
    ready = plain(document)
    assert isinstance(ready, dict)
    return ready


def table_text(comparison: Comparison, scan: Scan) -> str:
    """Return the Markdown file: the table, the cautions, and the reasons of each verdict."""
    parts = ["# Registration, stage by stage", markdown_table(comparison_table(comparison, scan)).rstrip()]
    cautions = cautions_of(comparison)
    if cautions:
        parts.append("\n".join(f"- Caution: {_line(caution)}" for caution in cautions))
    parts.append("\n".join(f"- {title_of(c)}: {_line(_verdict_sentences(c))}" for c in comparison.columns))
    parts.append(
        "`points`: inliers, of the matches used; the rms values are over the inliers. `from default`: the median "
        "displacement in the photograph of the points coloured by the default, the distance of the camera positions, "
        "and the angle between the camera orientations."
    )
    return "\n\n".join(parts) + "\n"


def _files(
    comparison: Comparison,
    scan: Scan,
    photo: Photo,
    inputs: Sequence[str | Path],
    read_with: Sequence[Mapping[str, Any]],
) -> list[FileJob]:
    jobs: list[FileJob] = [
        (
            "comparison.json",
            lambda path: write_document(
                path, comparison_document(comparison, scan, inputs=inputs, read_with=read_with)
            ),
        ),
        ("table.md", lambda path: write_bytes(path, table_text(comparison, scan).encode("utf-8"))),
        ("contact_sheet.png", lambda path: write_contact_sheet(path, comparison, scan, photo)),
    ]
    for column in comparison.columns:
        name = picture_name(column)
        if name is not None and column.texture is not None:
            jobs.append((name, partial(write_registered_png, texture=column.texture)))
    return jobs


def _column_document(column: Column, apart: Difference | None) -> dict[str, Any]:
    result = column.stage.result
    return {
        "name": column.stage.name,
        "title": title_of(column),
        "verdict": verdict_of(column),
        "note": column.stage.note,
        "seconds": column.seconds,
        "picture": picture_name(column),
        **_result_document(result),
        "from_default": None
        if apart is None
        else {
            "median_px": apart.median_px,
            "position_m": apart.position_m,
            "angle_rad": apart.angle_rad,
            "angle_deg": np.degrees(apart.angle_rad),
        },
    }


def _result_document(result: PoseResult | None) -> dict[str, Any]:
    if result is None:
        return {
            **dict.fromkeys(
                (
                    "camera_from_scanner",
                    "world_from_scanner",
                    "camera_from_world",
                    "camera_centre_world",
                    "thesis_parameters",
                    "matches",
                    "inliers",
                    "rms_px",
                    "rms_depth_error_m",
                )
            ),
            "accepted": False,
            "evidence": "none",
            "reasons": [],
        }
    thesis = result.thesis_parameters
    return {
        "camera_from_scanner": result.camera_from_scanner.matrix,
        **world_document(result),
        "thesis_parameters": {
            **thesis_document(thesis),
            **{f"{name}_deg": np.degrees(getattr(thesis, name)) for name in ("alpha", "beta", "gamma")},
        },
        "matches": len(result.matches),
        "inliers": int(result.inliers.sum()),
        "rms_px": rms_px(result),
        "rms_depth_error_m": rms_depth_m(result),
        "accepted": bool(result.accepted),
        "evidence": result.evidence,
        "reasons": list(result.reasons),
    }


def _verdict_sentences(column: Column) -> str:
    result = column.stage.result
    reasons = () if result is None else result.reasons
    return " ".join([f"{verdict_of(column)}.", *filter(None, (column.stage.note, *reasons))])


def _line(text: str) -> str:
    """Return the text on one line, with special characters of Markdown escaped."""
    return " ".join(text.split()).replace("|", "\\|").replace("<", "&lt;")
