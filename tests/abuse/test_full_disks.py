"""Disks that become full in the middle of a record, and programs that are killed or stopped then."""

from __future__ import annotations

import multiprocessing
import os
import random
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import msgspec
import pytest
from ladarreg.cli import _explain
from ladarreg.exit_codes import ExitCode
from ladarreg.session.session import Session

from ladarreg_core.errors import ExportError, UnsavedError
from ladarreg_core.project.history import NOBODY
from ladarreg_core.project.source import Source
from ladarreg_core.project.storage.folder import ProjectFolder
from ladarreg_core.project.storage.rescue import write_rescue_copy
from ladarreg_core.simulate.sample import sample_folder
from ladarreg_core.storage.atomic_write import AppendedFile
from testing.attacks.drawing import begin, draw, work_until_killed
from testing.attacks.full_disk import DiskNotMounted, fill, free, largest_file, small_disk
from testing.workbench.gateway_driver import soon
from testing.workbench.processes import restore_stop_signals
from testing.workbench.served import Page, Served

POSIX = pytest.mark.skipif(os.name == "nt", reason="no limit of file sizes and no kill -9 on Windows")
TOKEN = "a-token-for-full-disks"


def drawn(place: Path) -> list[int]:
    """Content of a project on disk, as the numbers given to `draw`."""
    folder = ProjectFolder(place)
    try:
        history = folder.read()
        assert [entry.label for entry in history.entries[1:]] == [
            f"Draw {round(pick.photo[0][0]) - 100}" for pick in history.document.photos[0].picks
        ], "every one is a step of the history"
        assert folder.remarks == ()
        return [round(pick.photo[0][0]) - 100 for pick in history.document.photos[0].picks]
    finally:
        folder.close()


@POSIX
def test_a_failed_append_leaves_no_partial_piece(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"sound\n")
    file = AppendedFile(path)
    file.append(b"more\n")
    for room in range(6):
        with largest_file(path.stat().st_size + room), pytest.raises(ExportError, match="cannot write"):
            file.append(b"too long\n")
        assert path.read_bytes() == b"sound\nmore\n"
    file.append(b"last\n")
    file.close()
    assert path.read_bytes() == b"sound\nmore\nlast\n"


@POSIX
def test_remains_of_a_failed_append_are_truncated_before_the_next(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"sound\n")
    file = AppendedFile(path)

    def refused(descriptor: int, length: int) -> None:
        raise OSError(5, "Input/output error")

    with monkeypatch.context() as patch:
        patch.setattr(os, "ftruncate", refused)
        for _ in range(2):
            with largest_file(9), pytest.raises(ExportError):
                file.append(b"too long\n")
        assert path.read_bytes() == b"sound\ntoo"
        with pytest.raises(ExportError, match="input/output"):
            file.append(b"fits\n")
    file.append(b"fits\n")
    file.close()
    assert path.read_bytes() == b"sound\nfits\n"


@POSIX
@pytest.mark.slow
@pytest.mark.parametrize("rounds", [4, pytest.param(20, marks=pytest.mark.long)])
def test_full_disks_and_kills_lose_no_edit_reported_as_saved(tmp_path: Path, rounds: int) -> None:
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["testing.attacks.drawing"])
    rng = random.Random(1)
    not_saved = 0
    for round_ in range(rounds):
        place = tmp_path / str(round_)
        mine, theirs = context.Pipe(duplex=False)
        process = context.Process(target=work_until_killed, args=(str(place), round_, theirs))
        process.start()
        theirs.close()
        answers = [mine.recv() for _ in range(rng.randrange(10, 40))]
        assert process.pid is not None
        os.kill(process.pid, signal.SIGKILL)
        process.join(60)
        while True:
            try:
                answers.append(mine.recv())
            except (EOFError, OSError):
                break
        found = drawn(place)
        last = max((k for k, saved in answers if saved), default=-1)
        assert found == list(range(len(found)))
        assert len(found) > last, "every edit before one that was saved is saved, too"
        not_saved += sum(not saved for _, saved in answers)
    assert not_saved > rounds, "the disks were full"


@POSIX
def test_queued_edits_are_saved_once_the_disk_has_space(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ladarreg.session.session.RETRY_S", 0.1)
    session = begin(tmp_path / "p")
    tried: list[None] = []
    settle = session.folder.settle
    monkeypatch.setattr(session.folder, "settle", lambda: tried.append(None) or settle())
    reported = []
    session.subscribe(lambda change: reported.append(session.unsaved))
    assert draw(session, 0)
    with largest_file((tmp_path / "p" / "history.jsonl").stat().st_size + 30):
        assert [draw(session, k) for k in range(1, 5)] == [False] * 4
        session.undo()
        session.redo()
        before = len(tried)
        assert soon(lambda: len(tried) >= before + 3), "it tries again and again"
        assert "cannot write" in session.unsaved
    assert soon(lambda: not session.unsaved), "nobody did anything"
    assert soon(lambda: reported[-1] == ""), "listeners are notified once the disk has everything"
    shutil.copytree(tmp_path / "p", tmp_path / "copy")
    assert drawn(tmp_path / "copy") == list(range(5))
    session.close()


@POSIX
def test_a_project_opens_on_a_full_disk(tmp_path: Path) -> None:
    session = begin(tmp_path / "p")
    for k in range(3):
        draw(session, k)
    session.close()
    damaged = (tmp_path / "p" / "history.jsonl").read_bytes()[:-20] + b"\0" * 19 + b"\n"
    (tmp_path / "p" / "history.jsonl").write_bytes(damaged)
    with largest_file(100):
        folder = ProjectFolder(tmp_path / "p")
        history = folder.read()
        assert len(history.document.photos[0].picks) == 3
        assert folder.behind
        assert (tmp_path / "p" / "history.jsonl").read_bytes() == damaged
        session = Session(folder, history)
        assert not draw(session, 3)
    assert draw(session, 4)
    session.close()
    assert drawn_at_all(tmp_path / "p") == [0, 1, 2, 3, 4]


def drawn_at_all(place: Path) -> list[int]:
    folder = ProjectFolder(place)
    try:
        return [round(pick.photo[0][0]) - 100 for pick in folder.read().document.photos[0].picks]
    finally:
        folder.close()


@POSIX
def test_at_exit_a_rescue_copy_is_written_where_there_is_space(tmp_path: Path) -> None:
    session = begin(tmp_path / "p")
    (tmp_path / "p" / "inputs" / "scan.npz").write_bytes(b"scan")
    session.commit(
        "Open scan",
        lambda d: msgspec.structs.replace(d, scan=Source(path="inputs/scan.npz", name="scan.npz", size=4)),
        author=NOBODY,
    )
    session._elsewhere = (tmp_path / "file" / "nowhere", tmp_path / "elsewhere")
    (tmp_path / "file").write_bytes(b"no folder")
    (tmp_path / "p").rename(tmp_path / "moved")
    (tmp_path / "p").write_bytes(b"in its place")
    assert not draw(session, 1)
    with pytest.raises(UnsavedError, match="the whole project including them is in") as caught:
        session.close()
    (place,) = (tmp_path / "elsewhere").iterdir()
    assert str(place) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert _explain(caught.value) == (str(caught.value), ExitCode.FAILED)
    folder = ProjectFolder(place)
    read = folder.read()
    folder.close()
    assert [entry.label for entry in read.entries] == ["Begin", "Open scan", "Draw 1"]
    assert read.document.scan is not None
    assert read.document.scan.path == str(tmp_path / "p" / "inputs" / "scan.npz"), "what lay there is not elsewhere"


def test_without_space_anywhere_the_loss_is_reported(tmp_path: Path) -> None:
    session = begin(tmp_path / "p")
    (tmp_path / "file").write_bytes(b"no folder")
    with pytest.raises(ExportError, match="no other folder could be written"):
        write_rescue_copy(session.folder, session.history, [tmp_path / "file" / "x"], name="work")
    if os.name != "nt":
        with largest_file(64), pytest.raises(ExportError, match="no other folder could be written"):
            write_rescue_copy(session.folder, session.history, [tmp_path / "other"], name="work")
        assert list((tmp_path / "other").iterdir()) == []
    session.close()


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    try:
        with small_disk(tmp_path / "disk", 1 << 20) as disk:
            yield disk
    except DiskNotMounted as error:
        pytest.skip(str(error))


def test_a_full_disk(disk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ladarreg.session.session.RETRY_S", 0.1)
    rng = random.Random(3)
    session = begin(disk / "p")
    ballast = fill(disk)
    answers = []
    for k in range(60):
        answers.append(draw(session, k))
        if k % 7 == 3:
            free(ballast, rng.randrange(1, 9000))
        if k % 7 == 6:
            fill(disk)
    assert set(answers) == {True, False}
    killed = shutil.copytree(disk / "p", tmp_path / "as killed")
    found = drawn_at_all(killed)
    assert found == list(range(len(found)))
    assert len(found) > max(k for k, saved in enumerate(answers) if saved)
    fill(disk)
    while not session.folder.behind:
        draw(session, k := k + 1)
    session._elsewhere = (disk / "also full", tmp_path / "elsewhere")
    with pytest.raises(UnsavedError):
        session.close()
    (place,) = (tmp_path / "elsewhere").iterdir()
    assert drawn(place) == list(range(k + 1))


@pytest.mark.skipif(sys.platform == "win32", reason="a folder that is open cannot be moved there, nor Ctrl-C be sent")
@pytest.mark.slow
def test_a_server_that_cannot_save_says_so_and_ends_with_1(tmp_path: Path) -> None:
    sample = sample_folder()
    surroundings = {**os.environ, "LADARREG_HOME": str(tmp_path / "home"), "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(
        [sys.executable, "-m", "ladarreg", "serve", str(sample / "scan.npz"), str(next(sample.glob("photo.*"))),
         "--project", str(tmp_path / "p"), "--port", "0", "--no-browser", "--token", TOKEN],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=surroundings, preexec_fn=restore_stop_signals,
    )  # fmt: skip
    try:
        assert process.stdout is not None
        parts = urlsplit(next(word for word in process.stdout.readline().split() if "://" in word))
        served = Served(process, parts.hostname or "", parts.port or 0, TOKEN)
        served.enter()
        page = Page(served)
        pick = {"photo": "p1", "kind": "point", "scan": [[1, 0, 0]], "photo_uv": [[100, 50]]}
        assert "saved" not in page.ask("add_pick", **pick)
        (tmp_path / "p").rename(tmp_path / "moved")
        (tmp_path / "p").write_bytes(b"in its place")
        for _ in range(5):
            assert page.ask("add_pick", **pick)["saved"] is False
        assert page.slices["project"]["unsaved"] is True
        page.socket.close()
    finally:
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=60)
    assert process.returncode == ExitCode.FAILED, said
    (place,) = (tmp_path / "home" / "projects").iterdir()
    assert f"ladarreg serve {place}" in said.splitlines()[-1]
    assert len(drawn_picks(place)) == 6
    assert len(drawn_picks(tmp_path / "moved")) == 1


def drawn_picks(place: Path) -> tuple[object, ...]:
    folder = ProjectFolder(place)
    try:
        return folder.read().document.photos[0].picks
    finally:
        folder.close()
