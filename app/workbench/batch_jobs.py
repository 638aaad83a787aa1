"""The jobs of a batch's folder for the page: a list, and how each is opened as a project."""

from __future__ import annotations

import base64
import binascii
import hashlib
import os
import re
import threading
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ladarreg_core.batches.jobs.job import Job
from ladarreg_core.batches.jobs.recorded_jobs import RecordedJob, recorded_jobs
from ladarreg_core.batches.jobs.run_folder import JOBS_RUN, OUTCOMES
from ladarreg_core.batches.photos.summary_page import sigma_words
from ladarreg_core.errors import FormatError, OptionError
from ladarreg_core.formats.scans.scan_request import ScanOptions
from ladarreg_core.project.history import NOBODY
from ladarreg_core.project.storage.folder import is_project

from .given_files import Reading

if TYPE_CHECKING:
    from .workbench import Workbench

_WAITING = "waiting"
_ORDER = ("failed", "refused", _WAITING, "accepted")
_MAX_SHOWN = 300
_JPEG_BEGINS = b"\xff\xd8"


class BatchJobs:
    """The jobs of a batch that runs, was stopped, or has ended; nothing in its folder is changed.

    Args:
        folder: the folder of the batch.
        projects: folder in which the projects of jobs are begun.

    Raises:
        FormatError: if it is not the folder of a batch, or does not record its list.
    """

    def __init__(self, folder: Path, projects: Path) -> None:
        self.folder, self._projects = folder, projects
        self._lock = threading.Lock()
        self._read_at: tuple[int, int] | None = None
        self._jobs: dict[str, RecordedJob] = {}
        self._now()

    def listed(self, outcome: str | None, words: str) -> dict[str, Any]:
        """Return the list for pages, what has to be looked at first.

        Args:
            outcome: list only jobs with this one; None: with any.
            words: list only jobs in whose name, verdict or reasons they occur.
        """
        found = self._now()
        counts = Counter(map(_outcome, found.values()))
        wanted = words.casefold()
        rows = [row for row in map(self._row, found.values()) if wanted in _text(row)]
        rows = [row for row in rows if outcome in (None, row["outcome"])]
        rows.sort(key=lambda row: _ORDER.index(row["outcome"]))
        return {
            "name": self.folder.name,
            "counts": {each: counts[each] for each in _ORDER},
            "runs": bool(counts[_WAITING]),
            "matching": len(rows),
            "jobs": rows[:_MAX_SHOWN],
        }

    def picture(self, wanted: str) -> bytes | None:
        """Return the thumbnail of a job, JPEG; None if there is none."""
        job = self._now().get(wanted)
        coded = (job.found or {}).get("thumbnail") if job else None
        try:
            data = base64.b64decode(str(coded or ""), validate=True)
        except (binascii.Error, ValueError):
            return None
        return data if data.startswith(_JPEG_BEGINS) else None

    def opening(self, wanted: str) -> tuple[list[Path], Path, Reading]:
        """Return how a job is opened: its files, the folder of its project, and how the files are read.

        Raises:
            OptionError: if there is no such job any more, or one of its files is not there.
        """
        found = self._now().get(wanted)
        if found is None:
            raise OptionError("this job is not in the list any more; reload the page")
        job, project = found.job, self._project(found)
        files = [path for path in (job.survey, job.scan, *job.more, *job.photos) if path is not None]
        missing = [path for path in job.own_files if not path.exists()]
        if missing and is_project(project):
            return [], project, Reading()
        if missing:
            raise OptionError(
                f"{missing[0]} of the job {job.id} is not there; put it back, or run the batch again with the files "
                "where they are now"
            )
        return files, project, _reading(found)

    def _now(self) -> dict[str, RecordedJob]:
        """Return the jobs by their ids, read again if the batch has gone on."""
        with self._lock:
            try:
                status = os.stat(self.folder / JOBS_RUN.journal)
            except OSError:
                raise FormatError(f"the folder {self.folder.name} of the batch is not there any more") from None
            at = (status.st_size, status.st_mtime_ns)
            if at != self._read_at:
                self._jobs = {one.job.id: one for one in recorded_jobs(self.folder)}
                self._read_at = at
            return self._jobs

    def _project(self, listed: RecordedJob) -> Path:
        """Return the project folder of a job; always the same, so that earlier work is found."""
        where = f"{os.path.realpath(self.folder)}\0{listed.job.id}"
        digest = hashlib.sha256(os.fsencode(where)).hexdigest()[:8]
        words = re.sub(r"[^\w-]+", "-", listed.job.id).strip("-")[:40] or "job"
        return self._projects / f"{words}-{digest}"

    def _row(self, listed: RecordedJob) -> dict[str, Any]:
        job, found = listed.job, listed.found or {}
        reasons = found.get("reasons")
        return {
            "id": job.id,
            "kind": job.kind,
            "outcome": _outcome(listed),
            "verdict": found.get("verdict") if listed.found else "Not done yet.",
            "reason": str(reasons[0]) if isinstance(reasons, list) and reasons else "",
            "sigma": sigma_words(sigma) if isinstance(sigma := found.get("sigma"), Mapping) else "",
            "picture": bool(found.get("thumbnail")),
            "project": is_project(self._project(listed)),
        }


def register_unsolved(workbench: Workbench) -> None:
    """Show what the batch saw: register the photographs of one scan, from the poses that it found, if none has been.

    A survey is left to the operator: that takes long.
    """
    document = workbench.session.document
    photos = document.photos
    if document.scan is None or document.stations or not photos or any(one.poses or one.picks for one in photos):
        return
    if len(photos) == 1:
        workbench.jobs.run("auto", photos[0].id, NOBODY)
    else:
        workbench.jobs.register_all(None, NOBODY)


def _outcome(listed: RecordedJob) -> str:
    found = (listed.found or {}).get("outcome")
    return found if found in OUTCOMES else _WAITING


def _text(row: dict[str, Any]) -> str:
    return f"{row['id']} {row['verdict']} {row['reason']}".casefold()


def _reading(listed: RecordedJob) -> Reading:
    job: Job = listed.job
    names = {"camera_name": "name", "camera_model": "model"}
    stated = {} if job.kind == "survey" else job.photo_options
    camera = {
        names.get(name, name): value
        for name, value in stated.items()
        if value is not None and name not in ("camera", "temperature_unit")
    }
    options = {name: value for name, value in job.scan_options.items() if name != "more"}
    return Reading(
        scan_options=ScanOptions(**options).given(),
        camera=stated.get("camera"),
        camera_options=camera,
        temperature_unit=stated.get("temperature_unit"),
        matches=job.options.get("matches"),
        initial=job.options.get("initial"),
        # a photograph of a survey may have been placed by another scan than the first
        initials={} if job.kind == "survey" else listed.poses(),
    )
