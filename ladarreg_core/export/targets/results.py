"""The target `results`: of every photograph, the files that a registration writes, and its matches."""

from __future__ import annotations

from collections.abc import Sequence

from ladarreg_core.export.registered_scan import RegisteredPhoto, RegisteredScan
from ladarreg_core.export.targets.folder import FileJob, registration_files
from ladarreg_core.export.targets.report import read_right
from ladarreg_core.export.targets.target import ExportOptions
from ladarreg_core.formats.documents.matches_file import write_matches
from ladarreg_core.foundations.progress import Report
from ladarreg_core.matches import Pick
from ladarreg_core.storage.replacement import MATCHES_FILE


def results_files(handed: RegisteredScan, options: ExportOptions, report: Report | None) -> Sequence[FileJob]:
    """Return the files of one photograph beside each other, or a folder of each of several."""
    del options, report
    found = {one.id: _of(handed, one) for one in (*handed.photos, *handed.refused)}
    found |= {name: [_matches(picks)] for name, picks in handed.drawn.items()}
    if len(found) == 1:
        return next(iter(found.values()))
    return [(f"{photo}/{name}", write) for photo, files in found.items() for name, write in files]


def _of(handed: RegisteredScan, one: RegisteredPhoto) -> list[FileJob]:
    sources = (handed.scan_file, one.file, one.camera_file, *handed.scan_options.get("more", ()))
    files = registration_files(
        one.registration,
        handed.scan,
        one.photo,
        [path for path in sources if path is not None],
        one.assessment(handed.scan),
        read_with=[handed.scan_options, one.options] if handed.scan_file and one.file else (),
        frame=handed.frame.name,
        saved_document=one.saved_document,
    )
    files = [(name, read_right(one, write)) for name, write in files]
    return [*files, _matches(one.matches)] if one.matches else files


def _matches(picks: Sequence[Pick]) -> FileJob:
    return MATCHES_FILE, lambda path: write_matches(path, picks)
