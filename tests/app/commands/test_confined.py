"""Commands read scans and photographs in confined processes, with the same results."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ladarreg_core.errors import Cancelled, FormatError, LadarregError
from ladarreg_core.formats import read_photo, read_scan, recognise
from ladarreg_core.formats.isolated.forked import confined_reads
from ladarreg_core.formats.parsing.begun_read import BegunRead
from ladarreg_core.formats.photo_file import begin_photo
from ladarreg_core.formats.registry import begin_scan
from ladarreg_core.foundations.progress import Progress, Report
from ladarreg_core.scan import Scan
from ladarreg_core.simulate.sample import sample_folder
from testing.files.seed_files import write_seeds

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="files are read in the command's own process there")
SAMPLE = sample_folder()
ELSEWHERE = """
import os, sys
from ladarreg.cli import main
from ladarreg_core.errors import FormatError
from ladarreg_core.formats import registry

command = os.getpid()

def refuse(*args, **kwargs):
    raise FormatError("read here" if os.getpid() == command else "read elsewhere")

registry._read_one = refuse
for words in sys.stdin.read().splitlines():
    main(words.split())
"""


def differing(one: Any, other: Any, where: str = "") -> list[str]:
    """Return where two values differ in any bit."""
    if is_dataclass(one) and type(one) is type(other):
        names = [field.name for field in fields(one)]
        return [at for name in names for at in differing(getattr(one, name), getattr(other, name), f"{where}.{name}")]
    if isinstance(one, np.ndarray) and isinstance(other, np.ndarray):
        same = (one.dtype, one.shape, one.tobytes()) == (other.dtype, other.shape, other.tobytes())
        return [] if same else [where]
    return [] if type(one) is type(other) and repr(one) == repr(other) else [where]


@pytest.mark.long
def test_results_are_the_same_in_every_bit(tmp_path: Path, checkout: Path) -> None:
    """In a process of its own: libraries have threads in this one, which is not forked then."""
    write_seeds(tmp_path)
    command = [sys.executable, "-m", "tests.app.commands.test_confined", str(tmp_path)]
    done = subprocess.run(command, cwd=checkout, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def compare_reads(folder: Path) -> None:
    """Compare the scans and a photograph, read in confined processes and here."""
    files = [file for file in sorted(folder.rglob("*.*")) if recognised(file) == "scan"]
    assert len(files) > 8
    given = {"camera": SAMPLE / "camera.json"}
    with confined_reads():
        reads = [begin_scan(file) for file in files]
        photo = begin_photo(SAMPLE / "photo.png", **given)
        assert all(read.is_elsewhere for read in (*reads, photo))
        scans, confined = [outcome(read.result) for read in reads], photo.result()
    for file, scan in zip(files, scans, strict=True):
        assert differing(outcome(lambda file=file: read_scan(file)), scan) == [], file.name
    assert sum(isinstance(scan, Scan) for scan in scans) > 8
    assert differing(read_photo(SAMPLE / "photo.png", **given), confined) == []


def outcome(read: Callable[[], Scan]) -> Scan | str:
    try:
        return read()
    except LadarregError as error:
        return f"{type(error).__name__}: {error}"


def recognised(file: Path) -> str:
    try:
        return recognise(file).kind
    except FormatError:
        return ""


def count(path: Path, report: Report | None = None) -> int:
    assert report is not None
    for done in range(3):
        report(Progress(done, 3, f"step {done}"))
    return os.getpid()


def test_progress_is_passed_on_and_may_stop_the_read() -> None:
    told: list[str] = []
    with confined_reads(), BegunRead(count, [SAMPLE / "scan.npz"], {}) as read:
        read.result(lambda progress: told.append(progress.label))
    assert told == ["step 0", "step 1", "step 2"]

    def stop(progress: Progress) -> None:
        raise Cancelled

    with confined_reads(), BegunRead(count, [SAMPLE / "scan.npz"], {}) as read, pytest.raises(Cancelled):
        read.result(stop)


@pytest.mark.slow
def test_commands_read_strangers_files_in_other_processes(tmp_path: Path, checkout: Path) -> None:
    scan, photo, camera, pose = (SAMPLE / name for name in ("scan.npz", "photo.png", "camera.json", "truth.json"))
    (tmp_path / "rig.csv").write_text(f"scan,photo\n{scan},{photo}\n{scan},{tmp_path / 'b.png'}\n")
    (tmp_path / "b.png").write_bytes(photo.read_bytes())
    both = f"{scan} {photo} --camera {camera} -o {tmp_path / 'out'} --quiet"
    commands = [
        f"register {both}",
        f"apply {both} --pose {pose}",
        f"compare {both}",
        f"selftest {scan} --camera {camera} --quiet",
        f"register-scans {scan} {scan} -o {tmp_path / 'out'} --quiet",
        f"register --rig {tmp_path / 'rig.csv'} --camera {camera} -o {tmp_path / 'out'} --quiet",
    ]
    done = subprocess.run(
        [sys.executable, "-c", ELSEWHERE],
        input="\n".join(commands), cwd=checkout, capture_output=True, text=True, check=False,
    )  # fmt: skip
    said = done.stderr.splitlines()
    assert len(said) == len(commands), done.stderr
    assert all("read elsewhere" in line for line in said), done.stderr


if __name__ == "__main__":
    compare_reads(Path(sys.argv[1]))
