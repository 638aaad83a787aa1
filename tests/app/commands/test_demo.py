"""`ladarreg demo`: prints one address, registers the sample, and exits cleanly."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from testing.workbench.processes import restore_stop_signals

pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform == "win32", reason="no Ctrl-C to send")]


def start(checkout: Path, project: Path, *more: str) -> tuple[subprocess.Popen[str], str]:
    process = subprocess.Popen(
        [sys.executable, "-m", "ladarreg", "demo", "--project", str(project), "--port", "0", "--no-browser", *more],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=checkout, preexec_fn=restore_stop_signals,
    )  # fmt: skip
    assert process.stdout is not None
    return process, process.stdout.readline()


def end(process: subprocess.Popen[str]) -> None:
    process.send_signal(signal.SIGINT)
    rest, errors = process.communicate(timeout=200)
    assert process.returncode == 0, errors
    # The second line, or all of it but its end, may have been read ahead with the first one.
    assert {line.partition(":")[0] for line in rest.splitlines() if line} <= {"Read-only"}
    assert "Traceback" not in errors


def poses(project: Path) -> list[dict[str, object]]:
    photos = json.loads((project / "project.json").read_bytes())["photos"]
    return [pose for photo in photos for pose in photo["poses"]]


def test_the_sample_is_registered_once(checkout: Path, tmp_path: Path) -> None:
    project = tmp_path / "demo"
    process, line = start(checkout, project)
    assert line.startswith("Open http://127.0.0.1:"), process.communicate()[1]
    assert "?token=" in line
    until = time.monotonic() + 240
    while not poses(project) and time.monotonic() < until:
        time.sleep(0.5)
    end(process)
    (pose,) = poses(project)
    assert pose["accepted"]

    process, _ = start(checkout, project)
    end(process)
    assert poses(project) == [pose], "existing work stays as it was"
