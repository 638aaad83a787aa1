"""The jobs that the folder of a batch records, also while it runs: their files, what became of them, their poses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ladarreg_core.batches.jobs.job import Job
from ladarreg_core.batches.jobs.job_list import listed_jobs
from ladarreg_core.batches.jobs.run_folder import JOBS_RUN, LIST_FILE
from ladarreg_core.batches.photos.folder import SUMMARY_FILE, is_batch_folder
from ladarreg_core.batches.photos.journal import read_journal
from ladarreg_core.errors import FormatError, LadarregError
from ladarreg_core.formats.parsing.json_file import read_json_object

_RESULT_FILE = "registration.json"


@dataclass(frozen=True, slots=True)
class RecordedJob:
    """A job of a batch, and what is known of it."""

    job: Job
    folder: Path
    """Where its results are, if there are any."""
    found: Mapping[str, Any] | None
    """`outcome`, `verdict`, `reasons`, `sigma`, `thumbnail` (JPEG, Base64); None: it has not been done yet."""

    def poses(self) -> dict[str, Path]:
        """Return the result file of each photograph that was accepted, by the photograph's file name.

        Of photographs with the same name there is none: which result is whose is not known.
        """
        if self.found is None or self.found.get("outcome") == "failed":
            return {}
        if self.job.kind == "pair":
            accepted = self.found.get("outcome") == "accepted" and (self.folder / _RESULT_FILE).is_file()
            return {self.job.photos[0].name: self.folder / _RESULT_FILE} if accepted else {}
        try:
            photos = read_json_object(self.folder / SUMMARY_FILE, "an adjustment").get("photos")
        except (LadarregError, OSError):  # removed or damaged: nothing to begin with
            return {}
        named: dict[str, list[Path]] = {}
        for one in photos.values() if isinstance(photos, dict) else ():
            name, folder = _text(one, "input", "name"), _text(one, "folder")
            file = self.folder / folder / _RESULT_FILE
            if name and folder and ".." not in Path(folder).parts and file.is_file():
                named.setdefault(name, []).append(file)
        return {name: files[0] for name, files in named.items() if len(files) == 1}


def recorded_jobs(folder: str | Path) -> list[RecordedJob]:
    """Return the jobs of a batch in the order of its list; nothing in its folder is changed or locked.

    Args:
        folder: folder of a batch that runs, was stopped, or has ended.

    Raises:
        FormatError: if it is none, or was written before batches recorded their lists.
    """
    home = Path(folder)
    if not is_batch_folder(home, JOBS_RUN):
        raise FormatError(f"{home} is not the folder of a batch; give one that `ladarreg batch` has written")
    if not (home / LIST_FILE).is_file():
        raise FormatError(
            f"{home} does not record where the files of its jobs lie: it was written by an earlier version; run the "
            "same batch again, which does nothing that was done"
        )
    jobs = listed_jobs(home / LIST_FILE)
    records = read_journal(home / JOBS_RUN.journal)
    results = {name: record.get("result") for (_, name), record in records.items()}
    return [
        RecordedJob(job, home / JOBS_RUN.results / job.id, found if isinstance(found, Mapping) else None)
        for job in jobs
        for found in [results.get(job.id)]
    ]


def _text(fields: object, *names: str) -> str:
    """Return a text in nested objects; empty: it is not there."""
    for name in names:
        fields = fields.get(name) if isinstance(fields, Mapping) else None
    return fields if isinstance(fields, str) else ""
