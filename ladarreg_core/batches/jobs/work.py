"""What a worker process does: one job, exactly as the single command does it, and what the batch says of it."""

from __future__ import annotations

import os
import socket
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2

from ladarreg_core.batches.jobs.job import FILES, PHOTO_OPTIONS, Job, JobKind
from ladarreg_core.batches.photos.executor import as_worker
from ladarreg_core.batches.photos.memory_limit import memory_limit
from ladarreg_core.batches.photos.photo_run import register_photos
from ladarreg_core.batches.photos.photo_task import ScanFiles, held_scan, kept_channels, summary_fields, thumbnail
from ladarreg_core.camera import require_pinhole
from ladarreg_core.errors import LadarregError
from ladarreg_core.export.json import input_document, software_document
from ladarreg_core.export.output_frame import FrameName, OutputFrame
from ladarreg_core.export.outputs.saved_results import recorded_options, recorded_scans
from ladarreg_core.export.targets.folder import export_registration
from ladarreg_core.formats import read_photo
from ladarreg_core.formats.documents.matches_file import read_matches
from ladarreg_core.formats.documents.pose_file import read_initial
from ladarreg_core.formats.scans.scan_request import SCAN_OPTIONS, ScanOptions
from ladarreg_core.foundations.shell_command import serve_command
from ladarreg_core.quality.assessment import assess
from ladarreg_core.quality.smoothing import smooth_with_report
from ladarreg_core.registration.register import register
from ladarreg_core.storage.replacement import REPORT_FILE
from ladarreg_core.survey.outputs import write_adjustment
from ladarreg_core.survey.survey import Survey

_PAGE_FILE = "index.html"
_OF_CAMERA = ("camera", "focal_px", "focal_mm", "sensor_mm", "camera_model")
_IN_BATCH = ("verdict", "evidence", "precision", "reasons", "sigma", "thumbnail")
_one_at_a_time = threading.Lock()  # a process of a cluster may have several threads
_seen: dict[tuple[str, int, int], str] = {}


class UnfitWorkerError(LadarregError):
    """A worker that has another version of the software, or does not see the files; the batch cannot go on."""


@dataclass(frozen=True, slots=True)
class InputState:
    """A file as the batch found it."""

    path: Path
    size: int
    sha256: str


@dataclass(frozen=True, slots=True, kw_only=True)
class JobTask:
    """A job as a worker gets it: names of files, and no contents."""

    job: Job
    folder: Path
    """Where its results are written."""
    inputs: tuple[InputState, ...]
    """Its files."""
    software: Mapping[str, str]
    """The versions that its results depend on."""
    memory_bytes: int | None
    force: bool
    """Whether results of other inputs or options may be replaced."""


def job_software() -> dict[str, str]:
    """Return the versions that results depend on."""
    return {**software_document(), "opencv": str(cv2.__version__)}


def input_state(path: Path) -> InputState:
    """Return the state of a file, which is read again only if it was changed.

    Raises:
        ExportError: if it cannot be read.
    """
    try:
        status = os.stat(path)
        at = (str(path), status.st_size, status.st_mtime_ns)
    except OSError:
        at = None
    if at is None or at not in _seen:
        found = input_document(path)
        if at is None:
            return InputState(path, int(found["size"]), str(found["sha256"]))
        _seen[at] = str(found["sha256"])
    return InputState(path, at[1], _seen[at])


def do_job(task: JobTask) -> dict[str, Any]:
    """Do a job and write its folder of results.

    Returns:
        What the batch says of it, JSON-ready: `outcome`, `verdict`, `reasons`, `times`, ...

    Raises:
        UnfitWorkerError: if this process has other software or files than the batch.
        LadarregError: as of the command.
    """
    with _one_at_a_time:
        _require_fit(task)
        started, used = time.perf_counter(), _processor_seconds()
        with as_worker(), memory_limit(task.memory_bytes):
            fields, steps = _DO[task.job.kind](task)
        spent = {"seconds": time.perf_counter() - started, "processor_seconds": _processor_seconds() - used}
        return {**fields, "times": {**spent, **({"steps": steps} if steps else {})}}


def _require_fit(task: JobTask) -> None:
    here, mine = socket.gethostname(), job_software()
    other = [f"{name} {mine.get(name)} in place of {version}" for name, version in task.software.items()
             if mine.get(name) != version]  # fmt: skip
    if other:
        raise UnfitWorkerError(
            f"the worker on {here} runs other software ({', '.join(other)}); install the same versions on all machines"
        )
    for wanted in task.inputs:
        path = wanted.path
        try:
            found = input_state(path)
        except LadarregError:
            found = None
        if found is None:
            raise UnfitWorkerError(
                f"the worker on {here} does not see {path}; all machines need the files under the same names, as on a "
                "shared disk"
            )
        if found != wanted:
            raise UnfitWorkerError(
                f"the worker on {here} sees another {path} ({found.size:,} bytes, SHA-256 {found.sha256[:12]}; the "
                f"batch began with {wanted.size:,} bytes, {wanted.sha256[:12]}); keep the files as they are while it "
                "runs, under the same names on all machines"
            )


def _register_pair(task: JobTask) -> tuple[dict[str, Any], list[list[Any]]]:
    job = _with_recorded(task.job)
    assert job.scan is not None
    scan_options, photo_options, options = job.scan_options, job.photo_options, job.options
    scan = held_scan(ScanFiles(job.scan, scan_options, _scan_key(task, job)))
    photo = read_photo(job.photos[0], **photo_options)
    if options.get("smooth"):
        require_pinhole(photo.camera, "`smooth`")
    frame: FrameName = options.get("frame") or "scanner"
    OutputFrame.of(scan, frame)  # refuse before the work
    picks = read_matches(options["matches"], scan) if options.get("matches") else None
    initial = None
    if options.get("initial"):
        initial = read_initial(options["initial"], scan.world_from_scanner, picture=job.photos[0].name)
    result = register(
        scan, photo, method=options.get("method") or "auto", picks=picks, initial=initial,
        options=job.register_options, channels=kept_channels(), threads=1,
    )  # fmt: skip
    assessment = assess(scan, result)
    smoothed = (
        smooth_with_report(scan, result, picks=picks or ()) if options.get("smooth") and result.accepted else None
    )
    export_registration(
        task.folder, result.untimed, scan, photo, assessment=assessment, smoothed=smoothed, inputs=job.own_files,
        read_with=[scan_options, photo_options], frame=frame, force=True,
        open_command=None if result.accepted else _open_command(job),
    )  # fmt: skip
    fields = summary_fields(result, photo)
    return (
        {
            "outcome": "accepted" if result.accepted else "refused",
            **{name: fields[name] for name in _IN_BATCH},
            "report": REPORT_FILE,
        },
        [[step.name, step.seconds] for step in result.steps],
    )


def _scan_key(task: JobTask, job: Job) -> str:
    """Return what a scan is known by in this process."""
    contents = {one.path: one.sha256 for one in task.inputs}
    files = [f"{path} {contents.get(path)}" for path in (job.scan, *job.more) if path is not None]
    return "|".join([*files, repr(sorted(job.scan_options.items()))])


def _with_recorded(job: Job) -> Job:
    """Return a job with the options that its initial pose, if it is an earlier result of it, records."""
    initial = job.options.get("initial")
    if initial is None or job.scan is None:
        return job
    found = recorded_options(initial, job.scan, job.photos[0])
    if any(job.options.get(name) is not None for name in _OF_CAMERA):
        found = {name: value for name, value in found.items() if name not in _OF_CAMERA}
    more = job.more or tuple(recorded_scans(initial, job.scan)[0])
    return replace(job, options={**found, **job.options}, more=more)


def _open_command(job: Job) -> str:
    assert job.scan is not None
    defaults = ScanOptions()
    names = [name for name in (*SCAN_OPTIONS, *PHOTO_OPTIONS, *FILES[1:])
             if job.options.get(name) not in (None, getattr(defaults, name, None))]  # fmt: skip
    words = {
        name: ",".join(map(str, value)) if isinstance(value := job.options[name], tuple) else value for name in names
    }
    return serve_command([job.scan, *job.more, *job.photos], words)


def _register_photos(task: JobTask) -> tuple[dict[str, Any], list[list[Any]]]:
    job = task.job
    assert job.scan is not None
    result = register_photos(
        job.scan, job.photos, task.folder, scan_options=job.scan_options, photo_options=job.photo_options,
        options=job.register_options, frame=job.options.get("frame") or "scanner", processes=1, force=task.force,
    )  # fmt: skip
    return _of_several(result.photos, result.accepted, job.photos[0], _PAGE_FILE), []


def _adjust(task: JobTask) -> tuple[dict[str, Any], list[list[Any]]]:
    assert task.job.survey is not None
    survey = Survey.from_file(task.job.survey)
    found = write_adjustment(
        survey, task.folder, options=task.job.register_options, processes=1, force=task.force
    )  # fmt: skip
    first = next(one.source for one in survey.photos if isinstance(one.source, Path))
    photos = {
        name: {"accepted": one.accepted, "reasons": one.reasons, "verdict": one.verdict}
        for name, one in found.photos.items()
    }
    fields = _of_several(photos, found.accepted, first, REPORT_FILE)
    unplaced = [f"{name}: {' '.join(one.reasons)}" for name, one in found.scans.items() if not one.accepted]
    return {**fields, "reasons": [*unplaced, *fields["reasons"]]}, []


def _of_several(photos: Mapping[str, Mapping[str, Any]], accepted: bool, first: Path, report: str) -> dict[str, Any]:
    count = sum(bool(one["accepted"]) for one in photos.values())
    refused = [f"{name}: {one['verdict']}" for name, one in photos.items() if not one["accepted"]]
    try:
        picture = thumbnail(read_photo(first).pixels)
    except LadarregError:  # the first one may be the damaged one
        picture = ""
    return {
        "outcome": "accepted" if accepted else "refused",
        "verdict": f"{count} of {len(photos)} photographs were accepted.",
        "evidence": None, "precision": None, "reasons": refused, "sigma": None, "thumbnail": picture,
        "report": report,
    }  # fmt: skip


_DO: Mapping[JobKind, Callable[[JobTask], tuple[dict[str, Any], list[list[Any]]]]] = {
    "pair": _register_pair, "photos": _register_photos, "survey": _adjust,
}  # fmt: skip


def _processor_seconds() -> float:
    """Return the processor time of this process and of those that it has waited for."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system
