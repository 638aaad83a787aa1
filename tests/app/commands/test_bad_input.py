"""Bad input is one line, errors have their exit codes, and nothing is left behind."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from ladarreg.cli import main
from ladarreg.exit_codes import ExitCode

from ladarreg_core.errors import Cancelled
from ladarreg_core.simulate.sample import sample_folder
from testing.command_line import complaint, sample
from testing.workbench.processes import restore_stop_signals

NO_COUNTS = np.zeros((9, 9), np.uint16)


def npz(**arrays: object) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        np.savez(folder / "scan.npz", **arrays)  # type: ignore[arg-type]
        return folder / "scan.npz"

    return write


def file(name: str, content: bytes) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        (folder / name).write_bytes(content)
        return folder / name

    return write


HUGE_PCD = """VERSION .7
FIELDS x y z intensity
SIZE 4 4 4 4
TYPE F F F F
COUNT 1 1 1 1
WIDTH 200000000
HEIGHT 1
POINTS 200000000
DATA binary
"""


SCALARS = {"r0_m": 1.0, "dr_m": 0.002, "d_azimuth_rad": 0.001, "d_elevation_rad": 0.001}


BAD_SCANS: dict[str, Callable[[Path], Path]] = {
    "missing": lambda folder: folder / "none.npz",
    "a name with a line break": lambda folder: folder / "two\nlines.e57",
    "a folder": lambda folder: folder,
    "empty": file("empty.e57", b""),
    "random": file("random.pcd", np.random.default_rng(0).bytes(5000)),
    "truncated": file("half.npz", (sample_folder() / "scan.npz").read_bytes()[:200_000]),
    "a claim without data": file("claim.pcd", HUGE_PCD.encode()),
    "pickled": npz(xyz=np.array([{}]), intensity=np.ones((4, 4))),
    "no returns": npz(counts=NO_COUNTS, intensity=np.ones((9, 9)), **SCALARS),
    "one cell": npz(xyz=np.ones((1, 1, 3)), intensity=np.ones((1, 1))),
    "shapes that disagree": npz(xyz=np.ones((9, 9, 3)), intensity=np.ones((9, 8))),
    "not numbers": npz(xyz=np.full((9, 9, 3), np.nan), intensity=np.full((9, 9), np.inf)),
}


@pytest.mark.parametrize("kind", BAD_SCANS)
def test_a_bad_scan_is_one_line_and_leaves_no_files(
    kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data, out = tmp_path / "data", tmp_path / "results"
    data.mkdir()
    out.mkdir()
    scan = BAD_SCANS[kind](data)
    words = ["register", str(scan), *sample()[2:], "-o", str(out / "new")]
    started = time.process_time()
    assert main(words) == ExitCode.BAD_INPUT
    complaint(capsys)
    assert not list(out.iterdir())
    assert time.process_time() - started < 20, "refusing took too long"


@pytest.mark.parametrize(
    "change",
    [
        {"width": 767},
        {"fx": 0},
        {"fx": -974.0},
        {"fy": "NaN"},
        {"distortion": [1, 2, 3]},
        {"height": None},
    ],
    ids=str,
)
def test_a_bad_camera_is_one_line(
    change: dict[str, object], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    camera = json.loads((sample_folder() / "camera.json").read_text())
    path = tmp_path / "camera.json"
    path.write_text(json.dumps({**camera, **change}))
    words = [*sample()[:-1], str(path), "-o", str(tmp_path / "new")]
    assert main(words) == ExitCode.BAD_INPUT
    complaint(capsys)
    assert not (tmp_path / "new").exists()


def test_a_photo_without_focal_length_names_the_missing_options(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [*sample()[:-2], "-o", str(tmp_path / "new")]
    assert main(words) == ExitCode.BAD_INPUT
    line = complaint(capsys)
    assert "--camera" in line
    assert "--focal-px" in line


@pytest.mark.parametrize("option", ["--matches", "--initial"])
def test_a_missing_extra_file_is_one_line(option: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = sample(option, str(tmp_path / "none.json"), "-o", str(tmp_path / "new"))
    assert main(words) == ExitCode.BAD_INPUT
    assert "none.json" in complaint(capsys)


def test_an_existing_folder_is_refused_before_any_work(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mine = tmp_path / "results"
    mine.mkdir()
    (mine / "notes.txt").write_text("mine")
    for force in ([], ["--force"]):
        assert main(sample("-o", str(mine), *force)) == ExitCode.BAD_INPUT
        assert "contains notes.txt, which ladarreg did not write" in complaint(capsys)
    assert (mine / "notes.txt").read_text() == "mine"


@pytest.mark.parametrize("kind", ["missing", "empty", "random", "truncated", "pickled", "a claim without data"])
def test_info_of_a_bad_file_is_one_line(kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", str(BAD_SCANS[kind](tmp_path))]) == ExitCode.BAD_INPUT
    complaint(capsys)


def fails_with(error: BaseException, monkeypatch: pytest.MonkeyPatch) -> None:
    def run(arguments: object) -> int:
        raise error

    monkeypatch.setattr("ladarreg.commands.info.run", run)


def test_an_error_raised_from_an_interruption_is_one(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    wrapped = RuntimeError("Error calling __set_name__")  # of an import that was interrupted
    wrapped.__cause__ = KeyboardInterrupt()
    fails_with(wrapped, monkeypatch)
    assert main(["info", "x"]) == ExitCode.INTERRUPTED
    assert "interrupted" in complaint(capsys)


def test_an_internal_error_is_one_line_too(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    fails_with(ZeroDivisionError("a\nb"), monkeypatch)
    assert main(["info", "x"]) == ExitCode.FAILED
    assert "--debug" in complaint(capsys)
    assert main(["info", "x", "--debug"]) == ExitCode.FAILED
    assert "Traceback" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (KeyboardInterrupt(), ExitCode.INTERRUPTED),
        (Cancelled(), ExitCode.INTERRUPTED),
        (PermissionError(13, "Permission denied", "/locked"), ExitCode.BAD_INPUT),
        (MemoryError(), ExitCode.FAILED),
    ],
    ids=lambda value: type(value).__name__,
)
def test_every_error_has_its_exit_code(
    error: BaseException, code: ExitCode, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    fails_with(error, monkeypatch)
    assert main(["info", "x"]) == code
    complaint(capsys)


@pytest.mark.slow
@pytest.mark.parametrize("after", ["Read photo", "Image verification"])
@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGTERM], ids=["ctrl-c", "kill"])
@pytest.mark.skipif(sys.platform == "win32", reason="no POSIX signals")
def test_an_interruption_leaves_no_files(after: str, signum: int, tmp_path: Path, checkout: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "ladarreg", *sample("-o", str(tmp_path / "new"))],
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, cwd=checkout, preexec_fn=restore_stop_signals,
    )  # fmt: skip
    assert process.stderr is not None
    for line in process.stderr:
        if line.startswith(after):
            break
    process.send_signal(signum)
    rest = process.stderr.read()
    assert process.wait(timeout=60) == ExitCode.INTERRUPTED, rest
    assert "Traceback" not in rest
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(sys.platform == "win32", reason="no POSIX signals")
def test_an_interruption_of_evaluated_text_has_its_exit_code(tmp_path: Path) -> None:
    (tmp_path / "interrupted.py").write_text(
        "import sys\n"
        "import ladarreg.messages, ladarreg_core.errors\n"  # later, these would evaluate texts of their own
        "from ladarreg import cli\n"
        "def interrupt():\n"
        "    raise KeyboardInterrupt\n"
        "cli._run = lambda *words, **options: eval('interrupt()')\n"
        "sys.argv[1:] = ['info', 'x']\n"
        "cli.entry_point()\n"
    )
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])}
    result = subprocess.run([sys.executable, "-m", "interrupted"], capture_output=True, text=True, env=env)
    assert result.returncode == ExitCode.INTERRUPTED
    assert result.stderr.startswith("ladarreg: interrupted")
