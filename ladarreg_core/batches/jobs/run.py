"""`batch`: many jobs in one run that no lost process, full disk or bad file stops, and that goes on where it was."""

from __future__ import annotations

import queue
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ladarreg_core.batches.jobs.job import Job
from ladarreg_core.batches.jobs.job_list import JobListError, faults_of_jobs, list_bytes, read_jobs, survey_inputs
from ladarreg_core.batches.jobs.page import write_batch_page
from ladarreg_core.batches.jobs.run_folder import (
    JOBS_RUN,
    LIST_FILE,
    OUTCOMES,
    TIMES_FILE,
    VERSION,
    BatchResult,
    Outcome,
)
from ladarreg_core.batches.jobs.work import InputState, JobTask, UnfitWorkerError, do_job, input_state, job_software
from ladarreg_core.batches.photos.cache import ContentCache
from ladarreg_core.batches.photos.executor import MAX_ATTEMPTS, WorkerLostError, WorkerProcesses, usable_cores
from ladarreg_core.batches.photos.failures import lacks_memory, why_it_failed
from ladarreg_core.batches.photos.folder import PAGE_FILE, BatchFolder
from ladarreg_core.batches.photos.memory_limit import memory_of_machine
from ladarreg_core.errors import ExportError, LadarregError, OptionError
from ladarreg_core.export.json import plain, write_document, write_result
from ladarreg_core.foundations.progress import Progress
from ladarreg_core.foundations.validation import require_int
from ladarreg_core.storage.atomic_write import is_disk_full, write_bytes

_STAGE = "job"
_IN_HAND = 512  # jobs that an executor of unknown size is given at a time
_TICK_S = 1.0
_RETRY_S = 5.0
_PAGE_SHARE = 50  # the page is written again once so many times as long has passed as that takes
_PAGE_EVERY_S = 5.0
_NO_KEY = "none"
_KILLED_BY_DASK = "KilledWorker"  # dask.distributed is optional
_FAILED_VERDICT = "Failed: it could not be done."


@dataclass(frozen=True, slots=True)
class BatchProgress(Progress):
    """How far a batch is; `done` counts the jobs that were done by an earlier run, too."""

    outcomes: Mapping[Outcome, int] = field(default_factory=dict)
    """How many jobs have had each outcome."""
    resumed: int = 0
    """Jobs that were done by an earlier run."""
    remark: str = ""
    """What keeps the batch waiting, a sentence; empty: nothing."""


def batch(
    jobs: Sequence[Job] | str | Path,
    folder: str | Path,
    *,
    executor: Executor | None = None,
    workers: int | None = None,
    memory_gb: float | None = None,
    force: bool = False,
    report: Callable[[BatchProgress], None] | None = None,
) -> BatchResult:
    """Do many jobs, each as the single command does it, and write their results into one folder.

    The folder has `jobs/ID` with what the command writes, without times; `batch.json`, the page `index.html`,
    `jobs.json` with the list of the jobs, `timing.json`, and `manifest.jsonl`, by which a batch that was stopped goes
    on when it is called again. What failed is tried again then. The results are the same whatever executes the jobs. On
    systems that spawn processes, as all do here, a program calls this below `if __name__ == "__main__":`.

    Args:
        jobs: the jobs, or a file that lists them, see `read_jobs`.
        folder: folder of the results: a new one, or that of an earlier run.
        executor: does the jobs, as that of `dask.distributed`; its processes must see the files under the same names
            and run the same software. None: processes of this machine.
        workers: number of those processes; None: one for each processor core.
        memory_gb: memory that a job may use; None: that of this machine.
        force: replace results of other inputs or options in the folder, or a folder of other results.
        report: receives the progress; may raise `Cancelled`: what was finished stays.

    Raises:
        JobListError: if jobs have faults; all are listed, and nothing is done.
        UnfitWorkerError: if a worker has other software or files.
        ExportError: if the folder must not be used or cannot be written.
    """
    listed = read_jobs(jobs) if isinstance(jobs, str | Path) else list(jobs)
    if not isinstance(jobs, str | Path) and (faults := faults_of_jobs(listed) or ["it has no jobs"][len(listed) :]):
        raise JobListError("the list of jobs", faults)
    if memory_gb is not None and not 0 < memory_gb < float("inf"):
        raise OptionError(f"`memory_gb` is {memory_gb}; it must be a positive number")
    if workers is not None:
        require_int(workers, "workers", least=1)
    files = {job.id: _inputs_of(job) for job in listed}
    limit = memory_of_machine() if memory_gb is None else int(memory_gb * 1e9)
    with ExitStack() as stack:
        every = dict.fromkeys(path for job in listed for path in (*files[job.id], *job.own_files))
        opened = stack.enter_context(BatchFolder(folder, inputs=[*every], force=force, kind=JOBS_RUN))
        run = _Run(opened, listed, files, limit, force, report)
        waiting = run.resume()
        count = min(workers or usable_cores(), max(1, len(waiting)))
        # the last of a job's attempts is made when no other job runs
        pool = executor or stack.enter_context(WorkerProcesses(count, attempts=MAX_ATTEMPTS - 1))
        return run.finish(waiting, pool)


def _inputs_of(job: Job) -> list[Path]:
    """Return the files that the result of a job depends on."""
    if job.survey is None:
        return job.own_files
    return survey_inputs(job.survey)


@dataclass(slots=True)
class _Run:
    """A batch under way."""

    folder: BatchFolder
    jobs: Sequence[Job]
    files: Mapping[str, Sequence[Path]]
    memory_bytes: int | None
    force: bool
    report: Callable[[BatchProgress], None] | None
    software: Mapping[str, str] = field(default_factory=job_software)
    found: dict[str, dict[str, Any]] = field(default_factory=dict)
    """What is known of each job that was done, by its id."""
    alone: list[Job] = field(default_factory=list)
    """Jobs whose workers were lost, which may be for want of memory: each is tried once more when no other runs."""
    retried: set[str] = field(default_factory=set)
    """Ids of those that have been."""
    resumed: int = 0
    outcomes: dict[Outcome, int] = field(default_factory=lambda: dict.fromkeys(OUTCOMES, 0))
    remark: str = ""
    is_full: bool = False
    """Whether the disk was full when something was written last."""
    retry_at: float = 0.0
    page_at: float = 0.0
    page_due: bool = True

    def resume(self) -> list[Job]:
        """Take what an earlier run has done, and return the jobs that are to be done, those of one scan together.

        Raises:
            ExportError: if results of other inputs or options are there, which may not be replaced.
        """
        done = self.folder.journal.names(_STAGE)
        changed = []
        for job in self.jobs:
            if job.id not in done:
                continue
            key = self._key(job, self._states(job))
            known = self.folder.journal.find(_STAGE, job.id, key)
            if known is None and (self.folder.results / job.id).exists():
                changed.append(job.id)
            elif known is not None and known["outcome"] != "failed" and self.folder.has_results(job.id):
                self._note(job, dict(known))
        self.folder.require_replaceable(changed, force=self.force)
        self.resumed = len(self.found)
        waiting = [job for job in self.jobs if job.id not in self.found]
        return sorted(waiting, key=lambda job: (str(job.scan), repr(sorted(job.scan_options.items()))) if job.scan
                      else ("", ""))  # fmt: skip

    def finish(self, waiting: Sequence[Job], pool: Executor) -> BatchResult:
        """Do the jobs, and write the summary."""
        to_do = deque(waiting)
        at_once = 2 * pool.count if isinstance(pool, WorkerProcesses) else _IN_HAND
        running: dict[Future[Any], tuple[Job, str]] = {}
        ended: queue.SimpleQueue[Future[Any]] = queue.SimpleQueue()
        self._tell("starting")
        self._write_list()
        self._write_page()
        try:
            while to_do or running or self.alone:
                if not to_do and not running:
                    to_do.append(self.alone.pop(0))
                while to_do and len(running) < at_once and time.monotonic() >= self.retry_at:
                    self._begin(to_do.popleft(), pool, running, ended)
                try:
                    future = ended.get(timeout=_TICK_S)
                except queue.Empty:
                    self._wait_on(pool)
                    continue
                job, key = running.pop(future)
                if _is_worker_lost(future) and job.id not in self.retried:
                    self.retried.add(job.id)
                    self.alone.append(job)
                elif self._take(job, key, future):
                    to_do.appendleft(job)
        finally:
            for future in running:
                future.cancel()
        self._tell("writing the summary")
        return self._write_summary()

    def _begin(
        self, job: Job, pool: Executor, running: dict[Future[Any], tuple[Job, str]], ended: queue.SimpleQueue[Any]
    ) -> None:
        try:
            states = self._states(job)
        except ExportError as error:  # a file has gone since the list was read
            self._record(job, _NO_KEY, _failed(str(error)))
            return
        task = JobTask(
            job=job, folder=self.folder.results / job.id, inputs=tuple(states), software=self.software,
            memory_bytes=self.memory_bytes, force=self.force,
        )  # fmt: skip
        try:
            future = pool.submit(do_job, task)
        except RuntimeError as error:  # it was shut down
            raise _lost(error) from error
        running[future] = job, self._key(job, states)
        future.add_done_callback(ended.put)

    def _take(self, job: Job, key: str, future: Future[Any]) -> bool:
        """Take in the result of a job, and return whether it has to be done again."""
        try:
            result = plain(future.result())
        except UnfitWorkerError:
            if not self._has_changed(job, key):
                raise
            result = _failed("its files were changed while it was done; run the batch again")
        except (BrokenExecutor, CancelledError) as error:
            raise _lost(error) from error
        except Exception as error:
            self.folder.clear_leftovers()
            if is_disk_full(error):
                self._wait_for_space()
                return True
            if isinstance(error, ModuleNotFoundError | AttributeError) and "ladarreg" in str(error):
                raise UnfitWorkerError(
                    f"a worker cannot load the program ({error}); install the same version on all machines"
                ) from error
            why = self._why(error)
            if _is_worker_lost(future):
                why = f"each time it was tried its worker was lost, the last time when no other job ran: {why}"
            result = _failed(why)
        self._record(job, key, result)
        return False

    def _record(self, job: Job, key: str, result: dict[str, Any]) -> None:
        self._patiently(lambda: self.folder.journal.add(_STAGE, job.id, key, result))
        self.is_full, self.remark = False, ""
        self._note(job, result)
        said = result["reasons"][0] if result["outcome"] == "failed" else result["verdict"]
        self._tell(f"{job.id}: {result['outcome']}. {said}")
        self.page_due = True
        self._write_page_if_due()

    def _has_changed(self, job: Job, key: str) -> bool:
        """Return whether the files of a job are not any more as they were when it was begun."""
        try:
            return self._key(job, self._states(job)) != key
        except ExportError:
            return True

    def _why(self, error: BaseException) -> str:
        if lacks_memory(error) and self.memory_bytes is not None:
            return (
                f"it needs more memory than the {self.memory_bytes / 1e9:.1f} GB that a job may use; allow more by "
                "`memory_gb`, or take a smaller scan or photo"
            )
        if type(error).__name__ == _KILLED_BY_DASK:
            return "each worker that was given it ended before it had finished it; their logs say why"
        return why_it_failed(error)

    def _states(self, job: Job) -> list[InputState]:
        return [input_state(path) for path in self.files[job.id]]

    def _key(self, job: Job, states: Sequence[InputState]) -> str:
        """Return the key of all that the results of a job depend on."""
        options = {name: value.name if isinstance(value, Path) else str(value) for name, value in job.options.items()}
        return ContentCache.key(
            kind=job.kind, options=options, files=[[one.path.name, one.sha256] for one in states]
        )  # fmt: skip

    def _note(self, job: Job, result: dict[str, Any]) -> None:
        self.found[job.id] = result
        self.outcomes[result["outcome"]] += 1

    def _tell(self, label: str) -> None:
        if self.report is not None:
            outcomes = dict(self.outcomes)
            self.report(BatchProgress(len(self.found), len(self.jobs), label, outcomes, self.resumed, self.remark))

    def _wait_on(self, pool: Executor) -> None:
        """Say what the batch waits for, if anything keeps it from going on."""
        if not self.is_full:
            self.remark = str(getattr(pool, "remark", ""))
        self._tell("waiting" if self.remark else "")
        self._write_page_if_due()

    def _wait_for_space(self) -> None:
        self.is_full, self.retry_at = True, time.monotonic() + _RETRY_S
        self.remark = f"the disk of {self.folder.folder} is full; free some space, and the batch goes on"
        self._tell("waiting")

    def _patiently(self, write: Callable[[], None]) -> None:
        """Write something, and wait where the disk is full."""
        while True:
            try:
                return write()
            except ExportError as error:
                if not is_disk_full(error):
                    raise
            self._wait_for_space()
            time.sleep(_RETRY_S)

    def _write_list(self) -> None:
        """Write down what the jobs are made of, so that the batch can be looked at and continued from its folder."""
        data, path = list_bytes(self.jobs, self.folder.folder), self.folder.folder / LIST_FILE
        if not path.is_file() or path.read_bytes() != data:
            self._patiently(lambda: self.folder.write({LIST_FILE: lambda aside: write_bytes(aside, data)}))

    def _write_page_if_due(self) -> None:
        if self.page_due and time.monotonic() >= self.page_at:
            self._write_page()

    def _write_page(self) -> None:
        """Write the page as things are, but not so often that it takes a notable share of the time."""
        started = time.monotonic()
        try:
            document = self._document()
            self.folder.write({PAGE_FILE: lambda path: write_batch_page(path, document, self.found, running=True)})
        except ExportError as error:
            if not is_disk_full(error):
                raise
        self.page_due = False
        now = time.monotonic()
        self.page_at = now + max(_PAGE_EVERY_S, _PAGE_SHARE * (now - started))

    def _write_summary(self) -> BatchResult:
        document = self._document()
        times = {
            "version": VERSION, "kind": "times of a batch",
            "jobs": {job.id: self.found[job.id].get("times") for job in self.jobs},
        }  # fmt: skip
        self._patiently(
            lambda: self.folder.write(
                {
                    JOBS_RUN.summary: lambda path: write_result(path, document),
                    TIMES_FILE: lambda path: write_document(path, times),
                    PAGE_FILE: lambda path: write_batch_page(path, document, self.found, running=False),
                }
            )
        )
        self._tell("done")
        return BatchResult(self.folder.folder, document)

    def _document(self) -> dict[str, Any]:
        """Return the contents of `batch.json`, which has neither times nor the folder of anything."""
        return {
            "version": VERSION,
            "kind": "batch",
            "software": dict(self.software),
            "outcomes": dict(self.outcomes),
            "jobs": {job.id: self._document_of(job) for job in self.jobs},
        }

    def _document_of(self, job: Job) -> dict[str, Any]:
        found = self.found.get(job.id)
        named = [job.survey, job.scan, *job.photos, *job.more]
        document: dict[str, Any] = {"kind": job.kind, "files": [path.name for path in named if path is not None]}
        if found is None:
            return {**document, "outcome": None, "folder": None}
        names = ("outcome", "verdict", "evidence", "precision", "reasons", "sigma", "report")
        return {
            **document,
            **{name: found.get(name) for name in names},
            "folder": None if found["outcome"] == "failed" else f"{JOBS_RUN.results}/{job.id}",
        }


def _is_worker_lost(future: Future[Any]) -> bool:
    """Return whether a job that has ended failed because its workers were lost."""
    if future.cancelled():
        return False
    error = future.exception()
    return isinstance(error, WorkerLostError) or type(error).__name__ == _KILLED_BY_DASK


def _failed(why: str) -> dict[str, Any]:
    return {
        "outcome": "failed", "verdict": _FAILED_VERDICT, "evidence": None, "precision": None, "reasons": [why],
        "sigma": None, "thumbnail": "", "report": None, "times": None,
    }  # fmt: skip


def _lost(error: BaseException) -> LadarregError:
    return ExportError(
        f"the workers of the batch were lost ({str(error)[:120] or type(error).__name__}); start them again and "
        "run the same command: it goes on where it was"
    )
