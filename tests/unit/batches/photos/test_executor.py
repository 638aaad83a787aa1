"""Worker processes: the task of a lost one is done again, Ctrl-C leaves nothing, and each works with one thread."""

from __future__ import annotations

import contextlib
import multiprocessing
import operator
import os
import signal
import sys
import time
from concurrent.futures import Future
from pathlib import Path

import pytest

from ladarreg_core.batches.photos.executor import WorkerLostError, WorkerProcesses
from ladarreg_core.errors import FormatError, OptionError


class _TwoArgumentsError(FormatError):
    """Can be pickled, but not read again."""

    def __init__(self, one: str, two: str) -> None:
        super().__init__(one + two)


def refuse() -> None:
    raise FormatError("no scan")


def refuse_oddly() -> None:
    raise _TwoArgumentsError("a", "b")


def settings() -> tuple[str | None, int, bool]:
    import cv2

    ignored = sys.platform == "win32" or signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, ())
    return os.environ.get("OMP_NUM_THREADS"), cv2.getNumThreads(), ignored


@pytest.mark.slow
def test_results_and_errors_come_back_and_a_task_that_ends_its_processes_fails_alone() -> None:
    with WorkerProcesses(1) as workers:
        before = workers.submit(operator.mul, 6, 7)
        lost = workers.submit(os._exit, 3)
        refused, odd = workers.submit(refuse), workers.submit(refuse_oddly)
        unsendable = workers.submit(operator.not_, lambda: None)
        after = workers.submit(settings)
    assert before.result() == 42
    with pytest.raises(WorkerLostError, match="3 times with code 3"):
        lost.result()
    with pytest.raises(FormatError, match="no scan"):
        refused.result()
    with pytest.raises(RuntimeError, match="_TwoArgumentsError: ab"):
        odd.result()
    assert isinstance(unsendable.exception(), Exception)
    assert after.result() == ("1", 1, True)


def sleeps_at_first(seen: str) -> int:
    """Return the process that did it: the third one to be given it; the first two sleep."""
    with open(seen, "ab") as stream:
        stream.write(b".")
    if os.path.getsize(seen) < 3:
        time.sleep(60)
    return os.getpid()


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_the_task_of_a_killed_process_is_done_by_another(tmp_path: Path) -> None:
    seen = tmp_path / "seen"
    with WorkerProcesses(1) as workers:
        killed: list[int] = []
        task = workers.submit(sleeps_at_first, str(seen))
        for count in (1, 2):
            while not seen.exists() or seen.stat().st_size < count:
                time.sleep(0.01)
            killed.append(only_worker())
            os.kill(killed[-1], signal.SIGKILL)
        assert task.result(60) not in killed


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_a_task_whose_processes_are_killed_says_so() -> None:
    with (
        WorkerProcesses(1) as workers,
        pytest.raises(WorkerLostError, match=r"was killed 3 times \(Killed\).*fewer processes"),
    ):
        workers.submit(end_by_kill).result(60)


def end_by_kill() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def only_worker() -> int:
    """Return the worker process that runs now."""
    (child,) = [process.pid for process in multiprocessing.active_children() if process.name == "ladarreg worker"]
    assert child is not None
    return child


def interrupted_while_working(workers: WorkerProcesses) -> tuple[int, Future[None], Future[None]]:
    pid = workers.submit(os.getpid).result()
    futures = workers.submit(time.sleep, 60), workers.submit(time.sleep, 60)
    with contextlib.suppress(KeyboardInterrupt), workers:
        raise KeyboardInterrupt
    return pid, *futures


def test_an_interruption_ends_the_processes_at_once_and_begins_nothing_more() -> None:
    started = time.monotonic()
    workers = WorkerProcesses(1)
    pid, working, waiting = interrupted_while_working(workers)
    assert time.monotonic() - started < 30
    assert working.cancelled() or isinstance(working.exception(), WorkerLostError)
    assert waiting.cancelled()
    if sys.platform != "win32":
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)
    with pytest.raises(RuntimeError, match="shut down"):
        workers.submit(os.getpid)


@pytest.mark.parametrize("count", [0, 1000, 1.5, True])
def test_an_impossible_number_is_refused(count: int) -> None:
    with pytest.raises(OptionError, match="processes"):
        WorkerProcesses(count)


def say_and_die(words: str) -> None:
    os.write(2, words.encode())
    os._exit(3)


@pytest.mark.slow
def test_the_last_words_of_a_lost_process_are_told_and_leave_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with WorkerProcesses(1) as workers:
        lost = workers.submit(say_and_die, "first\n\x1b[31mlast " + "x" * 5000)
        quiet = workers.submit(os._exit, 4)
        assert "code 3" in str(lost.exception())
        assert str(lost.exception()).endswith("x" * 100)
        assert "\x1b" not in str(lost.exception())
        assert "last words" not in str(quiet.exception()), "those of another task"
    assert not [*tmp_path.iterdir()]


def nested() -> tuple[int, int]:
    with WorkerProcesses(3) as workers:
        return os.getpid(), workers.submit(os.getpid).result()


def test_processes_of_a_worker_are_itself() -> None:
    with WorkerProcesses(1) as workers:
        first, second = workers.submit(nested).result()
    assert first == second != os.getpid()


class _EndsItsProcess:
    """Ends the process that reads it, as a kill does while a process is started, until a file is there."""

    def __init__(self, marks: Path, most: int) -> None:
        self.marks, self.most = marks, most

    def __reduce__(self) -> tuple[object, ...]:
        return end_process_until, (str(self.marks), self.most)


def end_process_until(marks: str, most: int) -> int:
    count = len(os.listdir(marks))
    if count < most:
        Path(marks, str(count)).touch()
        os._exit(9)
    return count


@pytest.mark.slow
@pytest.mark.parametrize(("most", "is_done"), [(5, True), (99, False)])
def test_processes_that_end_before_they_begin_a_task_are_not_its_fault_but_not_endless(
    tmp_path: Path, most: int, is_done: bool
) -> None:
    with WorkerProcesses(1) as workers:
        future = workers.submit(operator.pos, _EndsItsProcess(tmp_path, most))
        if is_done:
            assert future.result() == 5
        else:
            with pytest.raises(WorkerLostError, match="10 times with code 9"):
                future.result()
