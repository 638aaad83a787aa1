"""A comparison of the thesis's stages with the default, in one folder: numbers, table, contact sheet, pictures."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ladarreg_core.comparison import Column, Comparison
from ladarreg_core.export.atomic_write import write_bytes
from ladarreg_core.export.comparison_table import (
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
from ladarreg_core.export.contact_sheet import write_contact_sheet
from ladarreg_core.export.folder import FileJob, write_folder
from ladarreg_core.export.images import write_registered_png
from ladarreg_core.export.json import (
    CAMERA_FROM_SCANNER_IS,
    input_document,
    plain,
    software_document,
    thesis_document,
    write_document,
)
from ladarreg_core.photo import Photo
from ladarreg_core.progress import Report
from ladarreg_core.results import PoseResult
from ladarreg_core.scan import Scan

_VERSION = 1
_PICTURES_ARE = (
    "the photograph on the scan's grid: registered_<stage>.png where the stage is accepted; "
    "not_accepted_<stage>.png is only a candidate whose evidence is not enough to call it registered"
)


def export_comparison(
    folder: str | Path,
    comparison: Comparison,
    scan: Scan,
    photo: Photo,
    *,
    inputs: Sequence[str | Path] = (),
    force: bool = False,
    report: Report | None = None,
) -> None:
    """Write a comparison into a new folder that is there wholly or not at all.

    `comparison.json`, `table.md` and `contact_sheet.png`, and per stage with a pose its picture on the scan's grid:
    `registered_<stage>.png` if the stage is accepted, `not_accepted_<stage>.png` if not.

    Args:
        folder: where to; its parents are made if need be.
        comparison: the columns.
        scan: the scan.
        photo: the photograph.
        inputs: the files that scan and photo came from, named in `comparison.json`.
        force: replace the results of an earlier run.
        report: told before each file and at the end.

    Raises:
        ExportError: if the folder exists and must not be replaced, as `check_folder` says, or if something cannot be
            written.
        ShapeError: if there is no column, or a picture is not on the scan's grid.
    """
    write_folder(folder, lambda: _files(comparison, scan, photo, inputs), inputs=inputs, force=force, report=report)


def picture_name(column: Column) -> str | None:
    """Return the file name of a column's picture, which says whether it is registered; None where there is none."""
    if column.stage.result is None or column.texture is None:
        return None
    return f"{'registered' if column.stage.result.accepted else 'not_accepted'}_{column.stage.name}.png"


def comparison_document(comparison: Comparison, scan: Scan, *, inputs: Sequence[str | Path] = ()) -> dict[str, Any]:
    """Return a comparison as a JSON-ready document; a number that does not exist is None.

    Args:
        comparison: the columns.
        scan: the scan that they share.
        inputs: the files it came from; their names, sizes and SHA-256 are kept, not their folders.

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
        "inputs": [input_document(Path(path)) for path in inputs],
        "software": software_document(),
    }
    ready = plain(document)
    assert isinstance(ready, dict)
    return ready


def table_text(comparison: Comparison, scan: Scan) -> str:
    """Return the Markdown file: the table, what was foreseen, and why each stage is judged as it is."""
    parts = ["# Registration, stage by stage", markdown_table(comparison_table(comparison, scan)).rstrip()]
    cautions = cautions_of(comparison)
    if cautions:
        parts.append("\n".join(f"- Caution: {_line(caution)}" for caution in cautions))
    parts.append("\n".join(f"- {title_of(c)}: {_line(_verdict_in_words(c))}" for c in comparison.columns))
    parts.append(
        "`points`: matches that hold, of those used; the rms values are over those that hold. `from default`: the "
        "median displacement in the photograph of what the default colours, the distance of the camera centres, and "
        "the angle between the orientations."
    )
    return "\n\n".join(parts) + "\n"


def _files(comparison: Comparison, scan: Scan, photo: Photo, inputs: Sequence[str | Path]) -> list[FileJob]:
    jobs: list[FileJob] = [
        (
            "comparison.json",
            lambda path: write_document(path, comparison_document(comparison, scan, inputs=inputs)),
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
                ("camera_from_scanner", "thesis_parameters", "matches", "inliers", "rms_px", "rms_depth_error_m")
            ),
            "accepted": False,
            "evidence": "none",
            "reasons": [],
        }
    thesis = result.thesis_parameters
    return {
        "camera_from_scanner": result.camera_from_scanner.matrix,
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


def _verdict_in_words(column: Column) -> str:
    result = column.stage.result
    reasons = () if result is None else result.reasons
    return " ".join([f"{verdict_of(column)}.", *filter(None, (column.stage.note, *reasons))])


def _line(text: str) -> str:
    """Return the text on one line of Markdown, with nothing that it would set apart."""
    return " ".join(text.split()).replace("|", "\\|").replace("<", "&lt;")
