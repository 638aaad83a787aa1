"""A batch: outcomes apart, the same results however it is done, and going on after anything that stops it."""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import pytest

import ladarreg_core as lr
from ladarreg_core.batches.jobs import run, work
from ladarreg_core.batches.jobs.job_list import JobListError
from ladarreg_core.batches.jobs.recorded_jobs import recorded_jobs
from ladarreg_core.batches.jobs.run_folder import read_batch
from ladarreg_core.batches.jobs.work import JobTask, UnfitWorkerError, do_job, input_state, job_software
from ladarreg_core.batches.photos.executor import WorkerProcesses
from ladarreg_core.errors import Cancelled, DiskFullError, ExportError, FormatError, OptionError
from ladarreg_core.export.outputs.integrity import check_integrity
from ladarreg_core.formats.documents.pose_file import read_pose
from testing.jobs import Here, contents
from testing.scenes.photo_set import small_photo_set, write_photo_set


def test_refused_and_failed_are_told_apart_and_the_folder_is_intact(jobs: list[lr.Job], tmp_path: Path) -> None:
    seen: list[lr.BatchProgress] = []
    result = lr.batch(jobs, tmp_path / "out", executor=Here(), report=seen.append)
    assert [one["outcome"] for one in result.jobs.values()] == ["refused"] * 3 + ["failed"]
    assert not result.accepted
    assert "damaged" in result.jobs["damaged"]["reasons"][0]
    assert result.jobs["damaged"]["folder"] is None
    assert not result.job_folder("damaged").exists()
    assert (seen[-1].done, seen[-1].outcomes) == (4, {"accepted": 0, "refused": 3, "failed": 1})
    assert read_batch(result.folder).jobs == result.jobs
    assert not check_integrity(result.folder).damaged
    times = json.loads((result.folder / "timing.json").read_text())["jobs"]
    assert times["p0"]["seconds"] > 0
    assert times["p0"]["steps"]
    everything = "".join(path.read_text() for path in result.folder.rglob("*.json") if path.name != "timing.json")
    assert '"seconds": 0' not in everything


def test_the_page_has_failures_first_and_is_readable_while_it_runs(jobs: list[lr.Job], tmp_path: Path) -> None:
    pages = []

    def look(progress: lr.BatchProgress) -> None:
        if progress.label == "starting" or progress.done == len(jobs):
            run_page()

    def run_page() -> None:
        path = tmp_path / "out" / "index.html"
        pages.append(path.read_text(encoding="utf-8") if path.exists() else "")

    lr.batch(jobs[::-1], tmp_path / "out", executor=Here(), report=look)
    last = (tmp_path / "out" / "index.html").read_text(encoding="utf-8")
    assert "to be done" in next(filter(None, pages))
    assert "location.reload" in next(filter(None, pages))
    assert "location.reload" not in last
    places = [last.index(f"<b>{name}</b>") for name in ("damaged", "p2", "p1", "p0")]
    assert places == sorted(places)
    assert last.count("data:image/jpeg;base64,") == 3
    assert "http" not in last.replace("http-equiv", "")
    assert 'href="jobs/p0/report.html"' in last


@pytest.mark.slow
def test_again_nothing_is_done_twice_but_what_failed_or_is_missing(jobs: list[lr.Job], tmp_path: Path) -> None:
    lr.batch(jobs, tmp_path / "out", executor=Here())
    before = contents(tmp_path / "out")
    again = Here()
    lr.batch(jobs, tmp_path / "out", executor=again)
    assert [task.job.id for task in again.tasks] == ["damaged"]
    shutil.rmtree(tmp_path / "out/jobs/p1")
    shutil.copy(tmp_path / "p0.png", tmp_path / "damaged.png")
    more = Here()
    result = lr.batch(jobs, tmp_path / "out", executor=more)
    assert sorted(task.job.id for task in more.tasks) == ["damaged", "p1"]
    assert result.count("failed") == 0
    now = contents(tmp_path / "out")
    assert {name: data for name, data in now.items() if name.startswith("jobs/") and "damaged" not in name} == {
        name: data for name, data in before.items() if name.startswith("jobs/")
    }


def test_other_options_or_files_are_refused_unless_they_may_replace(jobs: list[lr.Job], tmp_path: Path) -> None:
    lr.batch(jobs[:2], tmp_path / "out", executor=Here())
    before = contents(tmp_path / "out")
    other = [replace(jobs[0], options={**jobs[0].options, "seed": 5}), jobs[1]]
    with pytest.raises(ExportError, match=r"other jobs, inputs or options than these \(p0\)"):
        lr.batch(other, tmp_path / "out", executor=Here())
    shutil.copy(jobs[2].photos[0], jobs[0].photos[0])
    with pytest.raises(ExportError, match=r"\(p0\)"):
        lr.batch(jobs[:2], tmp_path / "out", executor=Here())
    assert contents(tmp_path / "out") == before
    forced = Here()
    lr.batch(jobs[:2], tmp_path / "out", executor=forced, force=True)
    assert [task.job.id for task in forced.tasks] == ["p0"]
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign/mine.txt").write_text("mine")
    with pytest.raises(ExportError, match=r"mine\.txt"):
        lr.batch(jobs[:2], tmp_path / "foreign", executor=Here(), force=True)


def test_a_changed_result_is_kept_and_its_job_fails(jobs: list[lr.Job], tmp_path: Path) -> None:
    lr.batch(jobs[:1], tmp_path / "out", executor=Here())
    edited = tmp_path / "out/jobs/p0/rejected_overlay.png"
    edited.write_bytes(b"my own")
    result = lr.batch(jobs[:1], tmp_path / "out", executor=Here(), force=True)
    assert "changed since" in result.jobs["p0"]["reasons"][0]
    assert edited.read_bytes() == b"my own"


@pytest.mark.slow
def test_a_cancelled_batch_goes_on_where_it_was(jobs: list[lr.Job], tmp_path: Path) -> None:
    def stop(progress: lr.BatchProgress) -> None:
        if progress.done == 2:
            raise Cancelled

    with pytest.raises(Cancelled):
        lr.batch(jobs, tmp_path / "out", executor=Here(), report=stop)
    manifest = (tmp_path / "out/manifest.jsonl").read_bytes()
    (tmp_path / "out/manifest.jsonl").write_bytes(manifest + manifest.splitlines()[-1][:50])  # killed while it wrote
    again = Here()
    lr.batch(jobs, tmp_path / "out", executor=again)
    assert len(again.tasks) == 2
    assert (tmp_path / "out/manifest.jsonl").read_bytes().startswith(manifest)
    lr.batch(jobs, tmp_path / "whole", executor=Here())
    assert contents(tmp_path / "out") == contents(tmp_path / "whole")


def test_a_full_disk_is_waited_for(jobs: list[lr.Job], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run, "_RETRY_S", 0.0)
    monkeypatch.setattr(run, "_TICK_S", 0.01)
    failures = [3]

    def full(do: Callable[..., Any], task: JobTask) -> Any:
        if failures[0]:
            failures[0] -= 1
            raise DiskFullError("cannot write: no space left on device")
        return do(task)

    real, appended = run.BatchFolder.write, [2]

    def write(self: run.BatchFolder, files: Any) -> None:
        if appended[0] and run.JOBS_RUN.summary in files:
            appended[0] -= 1
            raise DiskFullError("cannot write: no space left on device")
        real(self, files)

    monkeypatch.setattr(run.BatchFolder, "write", write)
    remarks: list[str] = []
    result = lr.batch(jobs[:2], tmp_path / "out", executor=Here(full), report=lambda one: remarks.append(one.remark))
    assert result.count("refused") == 2
    assert any("is full" in one for one in remarks)
    assert (failures[0], appended[0]) == (0, 0)


def test_a_file_that_changes_or_goes_fails_its_job_alone(jobs: list[lr.Job], tmp_path: Path) -> None:
    def change(do: Callable[..., Any], task: JobTask) -> Any:
        if task.job.id == "p0":
            jobs[0].photos[0].write_bytes(jobs[2].photos[0].read_bytes() + b"more")
            jobs[1].photos[0].unlink()
        return do(task)

    result = lr.batch(jobs[:3], tmp_path / "out", executor=Here(change))
    assert "changed while it was done" in result.jobs["p0"]["reasons"][0]
    assert "p1.png" in result.jobs["p1"]["reasons"][0]
    assert result.jobs["p2"]["outcome"] == "refused"


def test_a_worker_with_other_software_or_files_is_one_clear_error(jobs: list[lr.Job], tmp_path: Path) -> None:
    task = JobTask(
        job=jobs[0], folder=tmp_path / "out", inputs=(input_state(jobs[0].photos[0]),), software=job_software(),
        memory_bytes=None, force=False,
    )  # fmt: skip
    with pytest.raises(UnfitWorkerError, match=r"other software \(version .* in place of 0\.0\.1\)"):
        do_job(replace(task, software={**job_software(), "version": "0.0.1"}))
    with pytest.raises(UnfitWorkerError, match=r"does not see .*none\.png"):
        do_job(replace(task, inputs=(replace(task.inputs[0], path=tmp_path / "none.png"),)))
    with pytest.raises(UnfitWorkerError, match="sees another"):
        do_job(replace(task, inputs=(replace(task.inputs[0], sha256="0" * 64),)))

    def unfit(do: Callable[..., Any], task: JobTask) -> Any:
        return do(replace(task, software={"version": "0.0.1"}))

    with pytest.raises(UnfitWorkerError, match="same versions on all machines"):
        lr.batch(jobs, tmp_path / "out", executor=Here(unfit))
    assert not (tmp_path / "out").exists(), "nothing was finished"


def test_faulty_jobs_and_options_are_refused_before_anything_is_done(jobs: list[lr.Job], tmp_path: Path) -> None:
    with pytest.raises(JobListError, match="2 jobs have the name p0") as error:
        lr.batch([jobs[0], jobs[0], lr.Job(id="x")], tmp_path / "out", executor=Here())
    assert len(error.value.faults) == 3
    with pytest.raises(JobListError, match="no jobs"):
        lr.batch([], tmp_path / "out", executor=Here())
    for wrong in (0.0, float("nan"), -1.0):
        with pytest.raises(OptionError, match="memory_gb"):
            lr.batch(jobs, tmp_path / "out", memory_gb=wrong)
    with pytest.raises(FormatError, match="not finished"):
        read_batch(tmp_path)
    assert not (tmp_path / "out").exists()


def too_much(task: JobTask) -> Any:
    """Take more memory than the job may have, and say so as the job would."""
    real = work._DO["pair"]
    work._DO["pair"] = lambda _: bytearray(3_000_000_000) and real(task)  # type: ignore[index]
    try:
        return do_job(task)
    finally:
        work._DO["pair"] = real  # type: ignore[index]


@pytest.mark.skipif(sys.platform != "linux", reason="other systems watch the memory")
def test_a_job_that_needs_too_much_memory_fails_alone(jobs: list[lr.Job], tmp_path: Path) -> None:
    result = lr.batch(
        jobs[:2], tmp_path / "out", memory_gb=1.0,
        executor=Here(lambda do, task: too_much(task) if task.job.id == "p0" else do(task)),
    )  # fmt: skip
    assert "more memory than the 1.0 GB" in result.jobs["p0"]["reasons"][0]
    assert result.jobs["p1"]["outcome"] == "refused"


def crash(number: int, name: str, do: Callable[..., Any], task: JobTask) -> Any:
    if task.job.id == name:
        os.write(2, b"out of luck\n")
        os.kill(os.getpid(), number)
    return do(task)


class Crashing(WorkerProcesses):
    """Processes that are killed by the job `p1`."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        return super().submit(partial(crash, signal.SIGKILL, "p1"), fn, *args)


@pytest.mark.long
@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_a_job_that_kills_its_workers_fails_with_its_last_words(jobs: list[lr.Job], tmp_path: Path) -> None:
    with Crashing(2) as workers:
        result = lr.batch(jobs[:3], tmp_path / "out", executor=workers)
    assert "the last time when no other job ran: its process was killed" in result.jobs["p1"]["reasons"][0]
    assert "last words: out of luck" in result.jobs["p1"]["reasons"][0]
    assert [result.jobs[name]["outcome"] for name in ("p0", "p2")] == ["refused", "refused"]


@pytest.mark.long
@pytest.mark.timeout(1200)
def test_the_executor_makes_no_difference(tmp_path: Path) -> None:
    pytest.importorskip("embreex")
    (tmp_path / "site").mkdir()
    photos = write_photo_set(tmp_path / "site", small_photo_set("office", seed=3, photos=2))
    write_photo_set(tmp_path, small_photo_set("boxes", seed=5, photos=1))
    scan = tmp_path / "site/scan.npz"
    jobs = [lr.Job(id=path.stem, scan=scan, photos=(path,)) for path in [*photos, tmp_path / "IMG_0001.jpg"][1:]]
    jobs += [lr.Job(id="several", kind="photos", scan=scan, photos=tuple(photos))]
    found = {}
    for name, workers in (("one", 1), ("three", 3)):
        result = lr.batch(jobs, tmp_path / name, workers=workers)
        found[name] = contents(tmp_path / name)
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:  # a fork of threads may hang
        lr.batch(jobs, tmp_path / "pool", executor=pool)
    assert [one["outcome"] for one in result.jobs.values()] == ["accepted", "refused", "accepted"]
    assert len(found["one"]) > 30
    for name in ("three", "pool"):
        assert contents(tmp_path / name).keys() == found["one"].keys()
        assert not [one for one, data in contents(tmp_path / name).items() if data != found["one"][one]], name


def test_the_folder_alone_says_what_the_jobs_are_and_where_their_poses_lie(jobs: list[lr.Job], tmp_path: Path) -> None:
    lr.batch(jobs, tmp_path / "out", executor=Here())
    site = tmp_path.parent / f"{tmp_path.name}-moved"
    shutil.move(tmp_path, site)
    found = recorded_jobs(site / "out")
    assert [one.job.photos for one in found] == [(site.resolve() / job.photos[0].name,) for job in jobs]
    assert [one.found and one.found["outcome"] for one in found] == ["refused"] * 3 + ["failed"]
    assert all(one.job.options["camera"] == site.resolve() / "camera.json" for one in found)
    assert all(one.poses() == {} for one in found)  # none was accepted
    assert not found[0].job.faults()


def test_the_jobs_of_a_batch_that_was_stopped_are_listed(jobs: list[lr.Job], tmp_path: Path) -> None:
    def stop(progress: lr.BatchProgress) -> None:
        if progress.done == 2:
            raise Cancelled

    with pytest.raises(Cancelled):
        lr.batch(jobs, tmp_path / "out", executor=Here(), report=stop)
    assert [one.found is not None for one in recorded_jobs(tmp_path / "out")] == [True, True, False, False]


@pytest.mark.slow
def test_accepted_photographs_of_a_job_have_their_poses(tmp_path: Path) -> None:
    photos = write_photo_set(tmp_path, small_photo_set("office", seed=3, photos=2))
    jobs = [
        lr.Job(id="one", scan=tmp_path / "scan.npz", photos=(photos[0],)),
        lr.Job(id="both", kind="photos", scan=tmp_path / "scan.npz", photos=tuple(photos)),
    ]
    result = lr.batch(jobs, tmp_path / "out", executor=Here())
    assert result.accepted
    one, both = recorded_jobs(tmp_path / "out")
    for job, names in ((one, {photos[0].name}), (both, {path.name for path in photos})):
        poses = job.poses()
        assert {*poses} == names
        assert all(read_pose(path).distance_to(lr.Rigid.identity()) > 0 for path in poses.values())


def test_a_folder_that_is_no_batch_or_of_an_earlier_version_is_refused(jobs: list[lr.Job], tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="not the folder of a batch"):
        recorded_jobs(tmp_path)
    lr.batch(jobs[:1], tmp_path / "out", executor=Here())
    (tmp_path / "out/jobs.json").unlink()
    with pytest.raises(FormatError, match="earlier version"):
        recorded_jobs(tmp_path / "out")
