"""Exports onto folders that are not theirs, killed exports, and concurrent exports."""

from __future__ import annotations

import json
import multiprocessing
import os
import random
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from functools import partial
from multiprocessing.connection import Connection
from multiprocessing.synchronize import Barrier
from pathlib import Path

import pytest

from ladarreg_core.errors import ExportError
from ladarreg_core.export.json import registration_document, write_document
from ladarreg_core.export.targets.folder import FileJob, check_folder, write_folder
from ladarreg_core.export.targets.zip_file import write_zip
from ladarreg_core.project.document import Document
from ladarreg_core.project.history import History
from ladarreg_core.project.storage.folder import ProjectFolder
from ladarreg_core.storage import replacement, staging
from testing.scenes.small_registration import sample_registration

DOCUMENT = registration_document(sample_registration())
TEXT = json.dumps(DOCUMENT)
PARTS = ("registered.png", "labels.png", "model.glb")


def results(generation: object) -> list[FileJob]:
    """The files of a run, each of which contains its number."""

    def document(path: Path) -> None:
        write_document(path, {**DOCUMENT, "seed": generation})

    def part(path: Path) -> None:
        path.write_text(str(generation))

    return [("registration.json", document), *((name, part) for name in PARTS)]


def generation_of(folder: Path) -> object:
    """The run that wrote all files of a folder."""
    (found,) = {json.loads((folder / "registration.json").read_text())["seed"]} | {
        int((folder / name).read_text()) for name in PARTS
    }
    assert len(list(folder.iterdir())) == 2 + len(PARTS), "registration.json and the manifest, too"
    return found


def tree(folder: Path) -> dict[str, bytes | str]:
    """Everything below a folder."""
    return {
        str(path.relative_to(folder)): os.readlink(path) if path.is_symlink() else path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if not path.is_dir() or path.is_symlink()
    }


def refused(folder: Path | str, **options: object) -> str:
    """The error for a folder, the same with and without force, before and after the computation."""
    said = set()
    for force in (True, False):
        for write in (check_folder, partial(write_folder, files=lambda: results(0))):
            with pytest.raises(ExportError) as caught:
                write(folder, force=force, **options)
            said.add(str(caught.value))
    (sentence,) = said
    assert "\n" not in sentence
    assert "; give " in sentence
    return sentence


def photographs(folder: Path) -> Path:
    folder.mkdir(parents=True)
    for k in range(5):
        (folder / f"IMG_{k:04d}.jpg").write_bytes(b"\xff\xd8" + bytes([k]) * 100)
    return folder


SPELLINGS: dict[str, Callable[[Path], Path | str]] = {
    "plain": lambda folder: folder,
    "with dots": lambda folder: f"{folder}/../{folder.name}/.",
    "with a slash": lambda folder: f"{folder}///",
    "relative": lambda folder: os.path.relpath(folder),
    "through a link": lambda folder: folder.parent / "above" / folder.name,
    "above a link": lambda folder: folder.parent / "link" / ".." / ".." / folder.name,  # not where the text leads
}


@pytest.fixture(params=SPELLINGS)
def spelled(request: pytest.FixtureRequest, tmp_path: Path) -> Callable[[Path], Path | str]:
    (tmp_path / "deep" / "deeper").mkdir(parents=True)
    (tmp_path / "above").symlink_to(tmp_path)
    (tmp_path / "link").symlink_to(tmp_path / "deep" / "deeper")
    return SPELLINGS[request.param]


def test_photographs_are_never_replaced(tmp_path: Path, spelled: Callable[[Path], Path | str]) -> None:
    folder = photographs(tmp_path / "holiday")
    (folder / "raw").mkdir()
    before = tree(tmp_path)
    assert "contains IMG_0000.jpg, IMG_0001.jpg, IMG_0002.jpg and 3 more, which" in refused(spelled(folder))
    assert tree(tmp_path) == before


def test_a_link_is_not_followed(tmp_path: Path) -> None:
    folder = photographs(tmp_path / "holiday")
    write_folder(tmp_path / "out", lambda: results(1))
    for target in (folder, tmp_path / "out", tmp_path / "nowhere"):
        (tmp_path / "link").unlink(missing_ok=True)
        (tmp_path / "link").symlink_to(target)
        assert "symbolic link" in refused(tmp_path / "link")
    assert generation_of(tmp_path / "out") == 1


@pytest.mark.parametrize(
    "document",
    [
        b"{}",
        b"not JSON",
        b"\xff\xfe",
        b"[" * 200_000,
        b'{"version": ' + b"9" * 10_000 + b"}",
        b'{"version": 1, "accepted": true, "camera_from_scanner": null}',
        json.dumps({**DOCUMENT, "software": {}}).encode(),
        json.dumps({**DOCUMENT, "accepted": "yes"}).encode(),
        json.dumps({**DOCUMENT, "inputs": 3}).encode(),
        json.dumps([DOCUMENT]).encode(),
        TEXT[:-2].encode(),
    ],
    ids=range(11),
)
def test_a_document_that_is_not_ours_opens_nothing(tmp_path: Path, document: bytes) -> None:
    for name in ("registration.json", "comparison.json", "truth.json"):
        folder = tmp_path / name
        folder.mkdir()
        (folder / name).write_bytes(document)
        (folder / "photo.png").write_bytes(b"mine")
        before = tree(folder)
        assert "which ladarreg did not write" in refused(folder)
        assert tree(folder) == before


def test_a_document_of_ours_among_other_files_opens_nothing(tmp_path: Path) -> None:
    folder = photographs(tmp_path / "holiday")
    (folder / "registration.json").write_text(TEXT)
    assert "contains IMG_0000.jpg, IMG_0001.jpg, IMG_0002.jpg and 2 more next to registration.json" in refused(folder)
    comparison = tmp_path / "comparison"
    comparison.mkdir()
    pictures = ["IMG_0001.jpg", "../holiday/IMG_0001.jpg", "registered_a.png", 3, None]
    columns = [{"picture": name} for name in pictures]
    (comparison / "comparison.json").write_text(json.dumps({**DOCUMENT, "columns": [*columns, 5]}))
    (comparison / "IMG_0001.jpg").write_bytes(b"mine")
    assert "contains IMG_0001.jpg next to comparison.json" in refused(comparison)
    case = tmp_path / "case"
    case.mkdir()
    (case / "registration.json").write_text(TEXT)
    (case / "scan.npz").write_bytes(b"measured")  # ours by name, but not the name of a result
    assert "contains scan.npz next to registration.json" in refused(case)


@pytest.mark.parametrize("odd", ["link", "folder", "pipe"])
def test_names_of_ours_that_are_no_files_are_not_ours(tmp_path: Path, odd: str) -> None:
    folder, real = tmp_path / "out", tmp_path / "real.json"
    real.write_text(TEXT)
    for document in (True, False):
        (tmp_path / f"out {document}").mkdir()
        folder = tmp_path / f"out {document}"
        name = "registration.json" if document else "model.glb"
        if not document:
            (folder / "registration.json").write_text(TEXT)
        if odd == "link":
            (folder / name).symlink_to(real)
        elif odd == "folder":
            photographs(folder / name)
        elif not hasattr(os, "mkfifo"):
            pytest.skip("this system has no named pipes")
        else:
            os.mkfifo(folder / name)
        assert f"contains {name}" in refused(folder)
    assert real.read_text() == TEXT


@pytest.fixture
def project(tmp_path: Path) -> Iterator[ProjectFolder]:
    kept = ProjectFolder(tmp_path / "project")
    kept.begin(History.begun(Document(name="office"), label="Begin", author="", when="2026-01-01T00:00:00+00:00"))
    yield kept
    kept.close()


def test_the_open_project_is_never_replaced(
    tmp_path: Path, project: ProjectFolder, spelled: Callable[[Path], Path | str]
) -> None:
    write_folder(project.path / "mine", lambda: results(1))
    before = tree(tmp_path)
    for known in ([], [project.path]):
        assert "is a project" in refused(spelled(project.path), apart_from=known)
        for inside in ("inputs", "exports", "mine"):
            said = refused(Path(spelled(project.path)) / inside, apart_from=known)
            assert "lies in the project project" in said
    for above in (tmp_path, project.path / "..", tmp_path / "above" / "project" / "inputs" / ".." / ".."):
        assert "contains the project project" in refused(above, apart_from=[project.path])
        assert "which ladarreg did not write" in refused(above)
    assert tree(tmp_path) == before


@pytest.mark.parametrize("lost", ["project.json", "history.jsonl", "lock", "arrays", "inputs"])
def test_a_damaged_project_is_a_project(tmp_path: Path, project: ProjectFolder, lost: str) -> None:
    path = project.path / lost
    path.rmdir() if path.is_dir() else path.unlink()
    write_folder(project.path / "exports" / "mine", lambda: results(1))
    assert "is a project" in refused(project.path)
    assert "lies in the project" in refused(project.path / "exports" / "mine")


def test_a_mounted_project_is_a_project(tmp_path: Path, project: ProjectFolder) -> None:
    there = tmp_path / "there"
    there.mkdir()
    code = (
        "import sys; from ladarreg_core.export.targets.folder import check_folder\n"
        "try: check_folder(sys.argv[1], force=True, apart_from=[sys.argv[2]])\n"
        "except Exception as error: print(error)"
    )
    mounted = 'mount --bind "$1" "$3" && exec "$0" -c "$4" "$3" "$2"'
    for source, said in ((tmp_path, "contains the project"), (project.path, "is a project")):
        done = subprocess.run(
            ["unshare", "-rm", "sh", "-c", mounted, sys.executable, source, project.path, there, code],
            capture_output=True, text=True,
        ) if sys.platform == "linux" else None  # fmt: skip
        if done is None or done.returncode:
            pytest.skip("nothing can be mounted here")
        assert said in done.stdout


def test_an_input_is_never_replaced(tmp_path: Path, spelled: Callable[[Path], Path | str]) -> None:
    out = tmp_path / "out"
    write_folder(out, lambda: results(1))
    for given in (out / "model.glb", tmp_path / "above" / "out" / "model.glb"):
        assert "contains the input model.glb" in refused(spelled(out), inputs=[given])
    assert "lies in the input" in refused(spelled(out), inputs=[tmp_path])
    assert generation_of(out) == 1


@pytest.mark.parametrize("name", ["a\0b", "x" * 300, "/" * 5000 + "x" * 300, "\udcff\n" + "y" * 400, "/", "/proc/x/y"])
def test_odd_names_are_refused_in_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ExportError) as caught:
        write_folder(name, lambda: results(1), force=True)
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 500
    assert not list(tmp_path.iterdir())


# --- killed ----------------------------------------------------------------------------------------------------------

killing = pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="this system has no SIGKILL")
PROCESSES = multiprocessing.get_context("spawn" if sys.platform == "win32" else "forkserver")


@pytest.fixture(scope="session", autouse=True)
def _loaded_once() -> None:
    if sys.platform != "win32":
        PROCESSES.set_forkserver_preload(
            [__name__, "ladarreg_core.export.targets.folder", "testing.scenes.small_registration"]
        )


def die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def dying_at(call: int, real: Callable[..., object], *, after: bool) -> Callable[..., object]:
    """A function that kills its process just before or after a call."""
    calls = 0

    def dies(*args: object, **options: object) -> object:
        nonlocal calls
        calls += 1
        if calls == call and not after:
            die()
        result = real(*args, **options)
        if calls == call:
            die()
        return result

    return dies


MOMENTS = {
    "write": (PARTS, (False, True)),
    "exchange": ((1,), (False, True)),
    "rename": ((1, 2, 3), (False, True)),
    "remove": ((1, 2, 3, 4, 5), (False, True)),
}


def export_and_die(out: Path, what: str, at: object, after: bool) -> None:
    """Replace results, and die meanwhile."""
    files = results(2)
    if what == "write":
        files = [(name, dying_at(1, write, after=after) if name == at else write) for name, write in files]
    elif what == "exchange":
        staging._exchange = dying_at(1, staging._exchange, after=after)
    elif what == "rename":
        staging._exchange = lambda first, second: False
        os.rename = dying_at(at, os.rename, after=after)
    elif at == 5:
        os.rmdir = dying_at(1, os.rmdir, after=after)
    else:
        os.unlink = dying_at(at, os.unlink, after=after)
    write_folder(out, lambda: files, force=True)


@killing
@pytest.mark.parametrize(
    ("what", "at", "after"), [(what, at, a) for what, (ats, afters) in MOMENTS.items() for at in ats for a in afters]
)
def test_killed_at_any_moment_the_old_or_the_new_is_whole(tmp_path: Path, what: str, at: object, after: bool) -> None:
    out = tmp_path / "out"
    write_folder(out, lambda: results(1))
    killed(PROCESSES.Process(target=export_and_die, args=(out, what, at, after)))
    if what != "rename":
        assert generation_of(out) in (1, 2)  # the target always exists where folders can be exchanged
    elif not out.exists():
        (aside,) = tmp_path.glob(".out.*.old")
        assert generation_of(aside) == 1
    check_folder(tmp_path / "beside")  # like the next run
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    late = what == "remove" or (what == "exchange" and after) or (what == "rename" and (at, after) >= (2, True))
    assert generation_of(out) == (2 if late else 1)
    write_folder(out, lambda: results(3), force=True)
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    assert generation_of(out) == 3


def killed(process: multiprocessing.process.BaseProcess) -> None:
    process.start()
    process.join(60)
    assert process.exitcode == -signal.SIGKILL


def export_for_ever(out: Path, exchange: bool, told: Connection) -> None:
    if not exchange:
        staging._exchange = lambda first, second: False
    for k in range(1, 10**9):
        write_folder(out, lambda k=k: results(k), force=True)
        told.send(k)


@killing
@pytest.mark.parametrize("exchange", [True, False])
def test_killed_again_and_again_nothing_is_lost_and_nothing_stays(tmp_path: Path, exchange: bool) -> None:
    out, draw = tmp_path / "out", random.Random(exchange)
    write_folder(out, lambda: results(0))
    for _ in range(8):
        heard, told = PROCESSES.Pipe(duplex=False)
        process = PROCESSES.Process(target=export_for_ever, args=(out, exchange, told))
        process.start()
        told.close()
        for _ in range(draw.randrange(1, 8)):
            heard.recv()
        if draw.random() < 0.7:  # in the middle of the next one
            while len(list(tmp_path.iterdir())) < 2:
                pass
        process.kill()
        process.join()
        check_folder(tmp_path / "beside")
        generation_of(out)
        assert [path.name for path in tmp_path.iterdir()] == ["out"]


def export_beside_others(out: Path, times: int, exchange: bool, together: Barrier) -> None:
    if not exchange:
        staging._exchange = lambda first, second: False
    together.wait(60)
    for _ in range(times):
        try:
            write_folder(out, lambda: results(os.getpid()), force=True)
        except ExportError:
            continue


@pytest.mark.parametrize("exchange", [True, False])
def test_concurrent_programs_leave_one_complete_result(tmp_path: Path, exchange: bool) -> None:
    out = tmp_path / "out"
    write_folder(out, lambda: results(0))
    together = PROCESSES.Barrier(3)
    processes = [PROCESSES.Process(target=export_beside_others, args=(out, 30, exchange, together)) for _ in range(3)]
    for process in processes:
        process.start()
    for process in processes:
        process.join(60)
        assert process.exitcode == 0
    check_folder(tmp_path / "beside")
    assert generation_of(out) in {0, *(process.pid for process in processes)}
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def zip_and_die(path: Path) -> None:
    files = results(2)
    write_zip(path, lambda: [*files, ("last", lambda path: die())])


@killing
def test_a_zip_that_was_killed_leaves_the_old_one(tmp_path: Path) -> None:
    target = tmp_path / "p1.zip"
    write_zip(target, lambda: results(1))
    before = target.read_bytes()
    killed(PROCESSES.Process(target=zip_and_die, args=(target,)))
    assert target.read_bytes() == before
    assert len(list(tmp_path.iterdir())) == 2
    write_zip(target, lambda: results(2))
    assert [path.name for path in tmp_path.iterdir()] == ["p1.zip"]
    assert target.read_bytes() != before


def test_folders_that_only_look_like_leftovers_stay(tmp_path: Path) -> None:
    for name in (".out.123-0123456z.part", ".out.part", "out.123-01234567.part", "..123-01234567.part"):
        photographs(tmp_path / name)
    photographs(tmp_path / ".out.999999-01234567.part")  # ours by name, but not by content
    (tmp_path / ".out.999999-01234568.part").write_bytes(b"a file")
    (tmp_path / ".out.999999-01234569.part").symlink_to(tmp_path / "out.123-01234567.part")
    before = tree(tmp_path)
    write_folder(tmp_path / "out", lambda: results(1))
    assert tree(tmp_path).items() >= before.items()
    replacement.remove_results(tmp_path / "out")
    assert tree(tmp_path) == before
