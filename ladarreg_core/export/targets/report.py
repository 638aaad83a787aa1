"""The target `report`: a self-contained report of every photograph, and the document behind it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ladarreg_core.export.folder import FileJob
from ladarreg_core.export.json import registration_document, write_document
from ladarreg_core.export.report import write_report
from ladarreg_core.export.targets.registered_scan import RegisteredPhoto, RegisteredScan
from ladarreg_core.export.targets.target import ExportOptions
from ladarreg_core.progress import Report
from ladarreg_core.surface.texture import RegisteredTexture


def report_files(handed: RegisteredScan, options: ExportOptions, report: Report | None) -> Sequence[FileJob]:
    """Return `ID.html` and `ID.json` of every photograph."""
    del options, report
    return [
        job for one, texture in zip(handed.photos, handed.textures, strict=True) for job in _of(handed, one, texture)
    ]


def _of(handed: RegisteredScan, one: RegisteredPhoto, texture: RegisteredTexture) -> list[FileJob]:
    sources = (handed.scan_file, one.file, one.camera_file)
    inputs = [path for path in sources if path is not None]

    def write(path: Path) -> None:
        document = registration_document(one.registration, assessment=one.assessment(handed.scan), inputs=inputs)
        write_report(path, one.registration, handed.scan, one.photo, document, texture=texture)

    def write_json(path: Path) -> None:
        found = registration_document(one.registration, assessment=one.assessment(handed.scan), inputs=inputs)
        write_document(path, found)

    return [(f"{one.id}.html", write), (f"{one.id}.json", write_json)]
