"""`ladarreg batch`: its outcomes, its answers, and a batch that is killed."""

from __future__ import annotations

import io
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from ladarreg.batch_table import batch_table, time_left
from ladarreg.cli import main
from ladarreg.exit_codes import ExitCode

from ladarreg_core.batches.jobs.run import BatchProgress
from ladarreg_core.export.pictures.images import write_png
from ladarreg_core.formats.scans.npz import write_npz_xyz
from testing.scenes.small_registration import sample_photo, sample_scan

CHECKOUT = Path(__file__).resolve().parents[3]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A list of two pairs, one that is refused and one that cannot be read."""
    monkeypatch.chdir(tmp_path)
    write_npz_xyz("scan.npz", sample_scan())
    write_png("1.png", sample_photo().pixels)
    Path("2.png").write_bytes(Path("1.png").read_bytes()[:900])
    Path("jobs.csv").write_text("scan,photo,name,focal-px\nscan.npz,1.png,one,100\nscan.npz,2.png,two,100\n")
    return tmp_path


@pytest.mark.slow
def test_a_batch_says_what_was_refused_and_what_failed(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["batch", "jobs.csv", "-o", "out", "--workers", "1"]) == ExitCode.NOT_ACCEPTED
    said = capsys.readouterr()
    assert "0 of 2 jobs were accepted, 1 refused, 1 failed." in said.out
    assert said.out.index("Failed   two: ") < said.out.index("Refused  one: ")
    assert "one: refused." in said.err
    assert "(2 of 2)" in said.err
    assert main(["info", "out"]) == ExitCode.ACCEPTED
    assert "results of a batch" in capsys.readouterr().out
    assert main(["check", "out"]) == ExitCode.ACCEPTED
    assert "nothing is damaged" in capsys.readouterr().out
    assert main(["batch", "jobs.csv", "-o", "out", "--json"]) == ExitCode.NOT_ACCEPTED
    said = capsys.readouterr()
    fields = json.loads(said.out)
    assert (fields["outcomes"], fields["jobs"]["one"]["outcome"]) == (
        {"accepted": 0, "refused": 1, "failed": 1}, "refused",
    )  # fmt: skip
    assert not said.err.strip()


@pytest.mark.parametrize(
    ("words", "said", "lines"),
    [
        ("jobs.csv -o out --workers 0", "workers is 0", 1),
        ("jobs.csv -o out --memory-gb 0", "--memory-gb is 0.0", 1),
        ("none.csv -o out", "none.csv: there is no such file or folder", 1),
        ("bad.csv -o out", "bad.csv has 2 faults, and nothing was done", 3),
        ("jobs.csv jobs.csv -o out", "give one list of jobs, or folders only", 1),
        ("jobs.csv -o .", "current working folder", 1),
        ("jobs.csv", "missing", 1),
        ("'*' -o out", "no such file or folder", 1),
    ],
)
def test_bad_input_is_refused_and_nothing_is_left(
    folder: Path, capsys: pytest.CaptureFixture[str], words: str, said: str, lines: int
) -> None:
    Path("bad.csv").write_text("scan,photo\nnone.npz,1.png\nscan.npz,none.png\n")
    assert main(["batch", *words.split(), "--quiet"]) == ExitCode.BAD_INPUT
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == lines
    assert not (folder / "out").exists()


def shown(*progress: BatchProgress) -> list[str]:
    stream = io.StringIO()
    with batch_table(quiet=False, stream=stream) as table:
        for one in progress:
            table.show(one)
    return stream.getvalue().splitlines()


def test_lines_say_what_was_done_and_what_is_waited_for_once() -> None:
    outcomes = {"accepted": 1, "refused": 0, "failed": 0}
    found = shown(
        BatchProgress(3, 5, "starting", resumed=3),
        BatchProgress(4, 5, "a: accepted.", outcomes, resumed=3),  # type: ignore[arg-type]
        BatchProgress(4, 5, "waiting", resumed=3, remark="the disk is full"),
        BatchProgress(4, 5, "waiting", resumed=3, remark="the disk is full"),
        BatchProgress(5, 5, "b: failed.", resumed=3),
    )
    assert found[0] == "3 of 5 jobs are done already"
    assert found[1].startswith("a: accepted. (4 of 5, ")
    assert found[2:] == ["Waiting: the disk is full", "b: failed. (5 of 5)"]


@pytest.mark.parametrize(
    ("progress", "left"),
    [
        (BatchProgress(0, 5, ""), ""),
        (BatchProgress(3, 5, "", resumed=3), ""),
        (BatchProgress(4, 5, "", resumed=3), "1 min 40 s"),
        (BatchProgress(1, 2, ""), "1 min 40 s"),
        (BatchProgress(10, 1000, ""), "2 h 45 min"),
        (BatchProgress(90, 100, ""), "11 s"),
        (BatchProgress(5, 5, ""), ""),
    ],
)
def test_the_time_left_follows_the_pace_of_this_run(progress: BatchProgress, left: str) -> None:
    assert time_left(progress, 100.0) == left


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="terminals of POSIX")
def test_a_terminal_shows_a_table(folder: Path) -> None:
    import pty

    ours, theirs = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, "-m", "ladarreg", "batch", "jobs.csv", "-o", "out", "--workers", "1"], stderr=theirs,
        stdout=subprocess.DEVNULL, env={**os.environ, "TERM": "xterm", "PYTHONPATH": str(CHECKOUT)},
    )  # fmt: skip
    os.close(theirs)
    parts = []
    while True:
        try:
            data = os.read(ours, 65536)
        except OSError:
            break
        if not data:
            break
        parts.append(data)
    os.close(ours)
    text = b"".join(parts).decode()
    assert process.wait(60) == ExitCode.NOT_ACCEPTED
    for words in ("accepted", "refused", "failed", "time left", "2 of 2", "one: refused."):
        assert words in text, text


@pytest.mark.long
@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
@pytest.mark.parametrize(("number", "code"), [(signal.SIGKILL, -signal.SIGKILL), (signal.SIGINT, ExitCode.INTERRUPTED)])
def test_a_killed_or_interrupted_batch_goes_on_where_it_was(folder: Path, number: signal.Signals, code: int) -> None:
    names = [f"{k}.png" for k in range(1, 9)]
    for k, name in enumerate(names):  # so many that some are left when the signal comes
        write_png(name, np.roll(sample_photo().pixels[:, ::-1], 5 * k, axis=1))
    Path("jobs.csv").write_text("\n".join(["scan,photo,focal-px", *(f"scan.npz,{name},100" for name in names)]) + "\n")
    words = [sys.executable, "-m", "ladarreg", "batch", "jobs.csv", "-o", "out", "--workers", "1"]
    process = subprocess.Popen(words, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
    assert process.stderr is not None
    assert "(1 of 8" in process.stderr.readline()
    process.send_signal(number)
    _, error = process.communicate(timeout=60)
    assert process.returncode == code
    assert "Traceback" not in error
    done = Path("out/manifest.jsonl").read_bytes()
    again = subprocess.run([*words, "--quiet"], capture_output=True, text=True, timeout=300, check=False)
    assert again.stdout == "0 of 8 jobs were accepted, 8 refused, 0 failed.\n"
    assert Path("out/manifest.jsonl").read_bytes().startswith(done)


@pytest.mark.slow
def test_check_looks_into_every_job(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["batch", "jobs.csv", "-o", "out", "--workers", "1", "--quiet"])
    Path("out/jobs/one/report.html").write_text("another")
    assert main(["check", "out"]) == ExitCode.BAD_INPUT
    assert "jobs/one/report.html" in capsys.readouterr().out
