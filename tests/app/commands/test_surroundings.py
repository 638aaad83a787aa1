"""Closed streams and names that are no UTF-8 are no faults of the program."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from ladarreg.cli import _explain, main
from ladarreg.exit_codes import ExitCode

from ladarreg_core.simulate.sample import sample_folder

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="names are text elsewhere, and shells are others")
PROGRAM = f"{sys.executable} -m ladarreg"
CAMERA = sample_folder() / "camera.json"


@pytest.mark.slow
@pytest.mark.parametrize("closed", [">&-", "2>&-", "<&-", "<&- >&- 2>&-"])
def test_a_closed_stream_is_no_fault(checkout: Path, closed: str) -> None:
    done = subprocess.run(
        ["sh", "-c", f"{PROGRAM} info {CAMERA} {closed}"], cwd=checkout, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert ("camera" in done.stdout) == (closed in ("2>&-", "<&-"))


@pytest.mark.slow
def test_a_file_with_a_latin_1_name_is_described(tmp_path: Path, checkout: Path) -> None:
    name = os.fsencode(tmp_path) + b"/caf\xe9.json"
    Path(os.fsdecode(name)).write_bytes(CAMERA.read_bytes())
    done = subprocess.run([*PROGRAM.split(), "info", name], cwd=checkout, capture_output=True, check=False)
    assert done.returncode == 0
    assert b"camera" in done.stdout


def test_a_latin_1_name_is_refused_before_the_work_where_it_would_be_recorded(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    name = os.fsdecode(b"caf\xe9.png")
    code = main(["apply", "scan.npz", str(tmp_path / name), "--pose", "pose.json", "-o", str(tmp_path / "out")])
    said = capsys.readouterr().err
    assert code == ExitCode.BAD_INPUT
    assert "is not UTF-8" in said
    assert "fault of this program" not in said
    with pytest.raises(UnicodeEncodeError) as caught:
        name.encode()
    assert _explain(caught.value)[1] == ExitCode.BAD_INPUT
