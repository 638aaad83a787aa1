"""The target `report`: a self-contained report of every photograph, and the document behind it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from ladarreg_core.errors import FormatError
from ladarreg_core.export.json import registration_document, write_result
from ladarreg_core.export.registered_scan import RegisteredPhoto, RegisteredScan
from ladarreg_core.export.report.page import write_report
from ladarreg_core.export.targets.folder import FileJob
from ladarreg_core.export.targets.target import ExportOptions
from ladarreg_core.foundations.progress import Report
from ladarreg_core.surface.texture.registered_texture import RegisteredTexture


def report_files(handed: RegisteredScan, options: ExportOptions, report: Report | None) -> Sequence[FileJob]:
    """Return `ID.html` and `ID.json` of every photograph; those whose pose was refused have them, too."""
    del options, report
    accepted = [job for k, one in enumerate(handed.photos) for job in _of(handed, one, k)]
    return [*accepted, *(job for one in handed.refused for job in _of(handed, one, None))]


def _of(handed: RegisteredScan, one: RegisteredPhoto, k: int | None) -> list[FileJob]:
    @cache  # hashing the inputs takes longest
    def document() -> Mapping[str, Any]:
        if one.saved_document is not None:
            return one.saved_document()
        sources = (handed.scan_file, one.file, one.camera_file, *handed.scan_options.get("more", ()))
        return registration_document(
            one.registration,
            assessment=one.assessment(handed.scan),
            inputs=[path for path in sources if path is not None],
            read_with=[handed.scan_options, one.options] if handed.scan_file and one.file else (),
        )

    def write(path: Path) -> None:
        texture: RegisteredTexture | None = None if k is None else handed.textures[k]
        write_report(path, one.registration, handed.scan, one.photo, document(), texture=texture)

    return [(f"{one.id}.html", read_right(one, write)), (f"{one.id}.json", lambda path: write_result(path, document()))]


def read_right(one: RegisteredPhoto, write: Callable[[Path], None]) -> Callable[[Path], None]:
    """Return a writer that raises `FormatError` where a document that was read does not hold what is written there."""
    if one.saved_document is None:
        return write

    def written(path: Path) -> None:
        try:
            write(path)
        except (KeyError, TypeError, ValueError, AttributeError):
            raise FormatError(f"the registration.json of {one.photo.name} is damaged; give an unmodified one") from None

    return written
