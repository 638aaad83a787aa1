"""The folder of a batch: how it is laid out, and its result read back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from ladarreg_core.batches.photos.folder import RunKind
from ladarreg_core.errors import FormatError
from ladarreg_core.formats.documents.own_results import read_own_result
from ladarreg_core.formats.parsing.untrusted import reading

JOBS_RUN = RunKind("manifest.jsonl", "jobs", "batch.json", "jobs")
"""Layout of the folder of a batch."""
LIST_FILE = "jobs.json"
"""The list of its jobs, as `read_jobs` reads it; paths start at the folder."""
TIMES_FILE = "timing.json"
"""File with all times of a batch: nothing else of it differs from run to run."""
Outcome = Literal["accepted", "refused", "failed"]
OUTCOMES: tuple[Outcome, ...] = ("accepted", "refused", "failed")
"""`refused`: it was done, and is not accepted; `failed`: it could not be done."""
VERSION = 1


@dataclass(frozen=True, slots=True, eq=False)
class BatchResult:
    """The result of `batch`."""

    folder: Path
    """The folder of the results."""
    document: Mapping[str, Any]
    """The contents of `batch.json`, without its checksum."""

    @property
    def jobs(self) -> Mapping[str, Mapping[str, Any]]:
        """What the document says of each job, by its id: `outcome`, `verdict`, `reasons`, ..."""
        found: Mapping[str, Mapping[str, Any]] = self.document["jobs"]
        return found

    @property
    def accepted(self) -> bool:
        """Whether all jobs were accepted."""
        return all(one["outcome"] == "accepted" for one in self.jobs.values())

    def count(self, outcome: Outcome) -> int:
        """Return how many jobs had an outcome."""
        return sum(one["outcome"] == outcome for one in self.jobs.values())

    def job_folder(self, job: str) -> Path:
        """Return the folder with the results of a job, by its id; a failed one has none."""
        return self.folder / JOBS_RUN.results / job


def read_batch(folder: str | Path) -> BatchResult:
    """Return the result of a batch that was written into a folder.

    Raises:
        FormatError: if it was not finished, or its document is damaged, changed or of another version.
    """
    home = Path(folder)
    if not (home / JOBS_RUN.summary).is_file():
        raise FormatError(f"{home} is the folder of a batch that was not finished; run the same command again")
    with reading(home / JOBS_RUN.summary) as file:
        fields = read_own_result(file, "batch")
        if fields.get("version") != VERSION or not isinstance(fields.get("jobs"), dict):
            raise FormatError(f"it is of another version than {VERSION}, or damaged; run the batch again")
    return BatchResult(home, fields)


def describe_batch(folder: str | Path) -> dict[str, Any]:
    """Return what a batch found, JSON-ready: how many jobs had each outcome, and the verdict of each.

    Raises:
        FormatError: as of `read_batch`.
    """
    result = read_batch(folder)
    return {
        "kind": "results of a batch",
        **{outcome: f"{result.count(outcome)} of {len(result.jobs)}" for outcome in OUTCOMES},
        "jobs": [f"{name}: {one.get('outcome')}. {one.get('verdict')}" for name, one in result.jobs.items()],
    }
