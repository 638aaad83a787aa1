"""Writes an adjustment: `adjustment.json`, `report.html`, the joint covariance, and results of each photograph."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ladarreg_core.batches.photos.cache import ContentCache
from ladarreg_core.batches.photos.executor import WorkerProcesses, usable_cores
from ladarreg_core.batches.photos.folder import SUMMARY_FILE, BatchFolder
from ladarreg_core.batches.photos.photo_task import ScanFiles, held_scan, thumbnail
from ladarreg_core.errors import LadarregError
from ladarreg_core.export.json import plain, write_result
from ladarreg_core.export.targets.folder import export_registration
from ladarreg_core.formats.isolated.messages import MessageError
from ladarreg_core.foundations.progress import Progress, Report, part_of
from ladarreg_core.quality.assessment import assess
from ladarreg_core.registration.register import RegisterOptions
from ladarreg_core.results.registration import Registration
from ladarreg_core.storage.atomic_write import write_bytes
from ladarreg_core.storage.replacement import REPORT_FILE
from ladarreg_core.survey.adjust import Solved, solve_survey
from ladarreg_core.survey.adjustment import Adjustment
from ladarreg_core.survey.registrations import main_scan, photo_registration
from ladarreg_core.survey.report import survey_page
from ladarreg_core.survey.survey import Survey
from ladarreg_core.survey.work import PhotoFiles, finished

COVARIANCE_FILE = "covariance.npz"
"""The joint covariance of all scans and photographs: `covariance` (6 n, 6 n), `kind` and `id` of each six rows."""
_CACHE_FOLDER = ".cache"
_SOLVED = 0.9  # share of the whole


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class _PhotoOutput:
    """One photograph whose folder of results is written."""

    photo: PhotoFiles
    scan: ScanFiles
    registration: Registration
    folder: Path


def write_adjustment(
    survey: Survey,
    folder: str | Path,
    *,
    options: RegisterOptions | None = None,
    processes: int | None = None,
    cache: ContentCache | None = None,
    force: bool = False,
    report: Report | None = None,
) -> Adjustment:
    """Solve a survey and write the results into a folder; run again after an interruption, it goes on.

    The folder has `adjustment.json`, `covariance.npz`, `report.html`, and for each accepted photograph a folder with
    what `export_registration` writes.

    Args:
        survey: the survey.
        folder: folder of the results: a new one, or that of an earlier run.
        options: as of `adjust`, like the next two.
        processes: number of worker processes.
        cache: keeps what costs time; None: a folder in the results, until they are complete.
        force: replace a folder of other results.
        report: receives the progress; may raise `Cancelled`: what was finished stays.

    Raises:
        LadarregError: as of `adjust`.
        ExportError: if the folder must not be used or cannot be written.
    """
    every = [*(one.source for one in survey.scans), *(one.source for one in survey.photos)]
    sources = [source for source in every if isinstance(source, Path)]
    with BatchFolder(folder, inputs=sources, force=force) as opened:
        own = ContentCache(opened.folder / _CACHE_FOLDER) if cache is None else cache
        o = options or RegisterOptions()
        opened.journal.add("begun", "survey", ContentCache.key(options=plain(asdict(o))), {})  # it can be resumed now
        solved = solve_survey(survey, options=o, processes=processes, cache=own, report=part_of(report, 0.0, _SOLVED))
        adjustment = replace(solved.adjustment, folder=opened.folder)
        pictures = _write_photos(survey, solved, opened, o, processes, part_of(report, _SOLVED, 1.0))
        document = adjustment.document()
        opened.write({
            SUMMARY_FILE: lambda path: write_result(path, document),
            COVARIANCE_FILE: lambda path: _write_covariance(path, adjustment),
            REPORT_FILE: lambda path: write_bytes(path, survey_page(adjustment, survey, pictures)),
        })  # fmt: skip
        for name in opened.photos.iterdir():
            if name.name not in adjustment.photos or not adjustment.photos[name.name].accepted:
                opened.remove(name.name)
        if cache is None:
            own.clear()
    return adjustment


def _write_photos(
    survey: Survey, solved: Solved, opened: BatchFolder, options: RegisterOptions, processes: int | None,
    report: Report | None,
) -> dict[str, str]:  # fmt: skip
    """Write the folders of the accepted photographs, and return the thumbnails of all."""
    adjustment, pictures = solved.adjustment, {}
    outputs = {
        one.id: _output(survey, solved, k, opened.photos / one.id, options)
        for k, one in enumerate(survey.photos) if adjustment.photos[one.id].accepted
    }  # fmt: skip
    with WorkerProcesses(processes or usable_cores()) as workers:
        waiting: dict[Any, str] = {workers.submit(_write_photo, one): name for name, one in outputs.items()}
        waiting |= {
            workers.submit(_thumbnail_of, state.files): state.given.id
            for state in solved.states if state.given.id not in outputs
        }  # fmt: skip
        latest = Progress(0, len(waiting), "writing")

        def tick() -> None:
            if report is not None:
                report(latest)

        for done, future in enumerate(finished(waiting, tick), 1):
            pictures[waiting[future]] = future.result()
            latest = Progress(done, len(waiting), f"writing {waiting[future]}")
            tick()
    return pictures


def _output(survey: Survey, solved: Solved, k: int, folder: Path, options: RegisterOptions) -> _PhotoOutput:
    state = solved.states[k]
    scan = main_scan(survey, solved, k)
    found = photo_registration(survey, solved, k, scan, options)
    return _PhotoOutput(photo=state.files, scan=solved.scans[scan], registration=found, folder=folder)


def _write_photo(task: _PhotoOutput) -> str:
    """Write a photograph's folder of results in a worker, and return its thumbnail."""
    result = task.registration
    scan = replace(held_scan(task.scan), world_from_scanner=result.world_from_scanner)
    photo = replace(task.photo.read(), camera=result.camera, calibrated=True, assumed=False, alternatives=())
    camera_file = task.photo.options.get("camera")
    inputs: list[str | Path] = [*task.scan.files[:1]]
    if isinstance(task.photo.source, Path):
        inputs.append(task.photo.source)
        inputs += [camera_file] if isinstance(camera_file, Path) else []
    complete = bool(task.scan.files) and isinstance(task.photo.source, Path)
    export_registration(
        task.folder, result, scan, photo, assessment=assess(scan, result), inputs=inputs if complete else (),
        read_with=[task.scan.options, _readable(task.photo.options)] if complete else (), force=True,
    )  # fmt: skip
    return thumbnail(photo.pixels)


def _readable(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return options of `read_photo` without a camera in memory, which the registration states itself."""
    return {name: value for name, value in options.items() if name != "camera" or isinstance(value, Path)}


def _thumbnail_of(files: PhotoFiles) -> str:
    try:
        return thumbnail(files.read().pixels)
    except (LadarregError, MessageError):
        return ""


def _write_covariance(path: Path, adjustment: Adjustment) -> None:
    import io

    stream = io.BytesIO()
    np.savez_compressed(
        stream, covariance=adjustment.joint, kind=np.array([kind for kind, _ in adjustment.joint_ids], dtype="U8"),
        id=np.array([name for _, name in adjustment.joint_ids], dtype="U255"),
    )  # fmt: skip
    write_bytes(path, stream.getvalue())
