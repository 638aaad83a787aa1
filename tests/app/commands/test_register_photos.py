"""`ladarreg register` with several photos or a folder: its arguments, its answers, and a run that is killed."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest
from ladarreg.cli import main
from ladarreg.commands.register import Arguments
from ladarreg.exit_codes import ExitCode
from ladarreg.photos import PhotosArguments

from ladarreg_core.batches.photos.folder import PAGE_FILE, SUMMARY_FILE
from ladarreg_core.formats.scans.npz import write_npz_xyz
from testing.scenes.photo_set import small_photo_set, write_photo_set
from testing.scenes.small_registration import sample_photo, sample_scan

CHECKOUT = Path(__file__).resolve().parents[3]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Files that can be told apart, and not registered."""
    from ladarreg_core.export.pictures.images import write_png

    write_npz_xyz(tmp_path / "scan.npz", sample_scan())
    (tmp_path / "photos").mkdir()
    for name in ("1.png", "2.png", "photos/3.png"):
        write_png(tmp_path / name, sample_photo().pixels)
    return tmp_path


@pytest.mark.parametrize(
    ("words", "several"),
    [
        ("scan.npz 1.png -o out", False),
        ("scan.npz scan.npz 1.png -o out", False),
        ("scan.npz missing.png -o out", False),
        ("scan.npz 1.png -o photos", False),
        ("--quiet scan.npz 1.png --camera photos --force", False),
        ("1.png scan.npz 2.png -o out", True),
        ("--focal-px 500 --quiet scan.npz 1.png 2.png -o=out", True),
        ("scan.npz photos -o out", True),
        ("photos -o out", True),
    ],
)
def test_the_arguments_are_those_of_several_photos_if_several_or_a_folder_are_named(
    folder: Path, monkeypatch: pytest.MonkeyPatch, words: str, several: bool
) -> None:
    monkeypatch.chdir(folder)
    assert Arguments.chosen_by(words.split()) is (PhotosArguments if several else Arguments)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("photos -o out", "there is no scan among the files"),
        ("scan.npz photos/empty -o out", "there is no photo among the files"),
        ("both -o out", "contains 2 scans (a.npz, b.npz)"),
        ("scan.npz photos missing.png -o out", "missing.png"),
        ("scan.npz photos -o out --processes 0", "--processes"),
        ("scan.npz photos -o photos", "contains the input 3.png"),
        ("scan.npz photos -o out --matches m.json", "--matches"),
        ("scan.npz photos -o out --frame world", "world"),
        ("scan.npz photos", "missing"),
    ],
)
def test_bad_input_of_the_whole_is_refused_in_a_line_and_nothing_is_left(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], words: str, said: str
) -> None:
    (folder / "photos" / "empty").mkdir()
    (folder / "both").mkdir()
    for name in ("a.npz", "b.npz"):
        shutil.copy(folder / "scan.npz", folder / "both" / name)
    monkeypatch.chdir(folder)
    assert main(["register", *words.split(), "--cache", "cache", "--quiet"]) == ExitCode.BAD_INPUT
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
    assert not (folder / "out").exists()


def test_info_of_a_folder_says_what_register_would_do(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", str(folder)]) == ExitCode.ACCEPTED
    said = capsys.readouterr().out
    assert "2 photos on scan.npz" in said
    assert main(["info", str(folder), "--json"]) == ExitCode.ACCEPTED
    assert json.loads(capsys.readouterr().out)["photos"] == ["1.png", "2.png"]
    (folder / "empty").mkdir()
    assert main(["info", str(folder / "empty")]) == ExitCode.BAD_INPUT


def command(words: Sequence[str], **more: object) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "ladarreg", "register", *words], cwd=CHECKOUT, text=True, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, **more,  # type: ignore[call-overload]
    )  # fmt: skip


def workers_of(pid: int) -> list[int]:
    children = Path(f"/proc/{pid}/task").glob("*/children")
    return [int(child) for path in children for child in path.read_text().split()]


@pytest.mark.long
@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
@pytest.mark.parametrize(("number", "code"), [(signal.SIGKILL, -signal.SIGKILL), (signal.SIGINT, ExitCode.INTERRUPTED)])
def test_a_killed_or_interrupted_command_leaves_no_process_and_goes_on_where_it_was(
    tmp_path: Path, number: signal.Signals, code: int
) -> None:
    pytest.importorskip("embreex")
    photos = write_photo_set(tmp_path, small_photo_set("boxes", seed=2, photos=3), focal_error=0.02)[:2]
    out = tmp_path / "out"
    words = [str(tmp_path / "scan.npz"), *map(str, photos), "-o", str(out), "--cache", str(tmp_path / "cache")]
    process = command([*words, "--processes", "1"], start_new_session=True)
    assert process.stderr is not None
    for line in process.stderr:
        if "estimated" in line:
            break
    children = workers_of(process.pid)
    assert children
    os.killpg(process.pid, number) if number == signal.SIGINT else os.kill(process.pid, number)
    _, error = process.communicate(timeout=60)
    assert process.returncode == code
    assert "Traceback" not in error
    for child in children:
        assert not _is_working(child)
    journal = (out / ".ladarreg-batch.jsonl").read_bytes()
    again = command([*words, "--quiet"])
    said, error = again.communicate(timeout=300)
    assert (again.returncode, said) == (ExitCode.ACCEPTED, "2 of 2 photos were accepted.\n"), error
    assert (out / ".ladarreg-batch.jsonl").read_bytes().startswith(journal)
    assert (out / PAGE_FILE).is_file()
    assert json.loads((out / SUMMARY_FILE).read_text())["cameras"]["camera-1"]["pooled"] == ["IMG_0001", "IMG_0002"]


def _is_working(pid: int) -> bool:
    """Return whether a process is there and does anything: the resource tracker of a killed program ends by itself."""
    try:
        line = Path(f"/proc/{pid}/cmdline").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return False
    return "spawn_main" in line
