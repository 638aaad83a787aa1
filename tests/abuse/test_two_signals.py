"""Two different stop signals in quick succession, to a real server: a clean end for all signals and gaps."""

from __future__ import annotations

import signal
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from testing.workbench.serve_process import ask, name_of, serving

TRIES = 6
TOGETHER = 2


def try_once(project: Path, first: signal.Signals, second: signal.Signals, gap_s: float) -> tuple[int | None, str, str]:
    """Return the exit code, stderr and the project's name after two signals."""
    with serving(project) as server, server.there.socket() as page:
        assert ask(page, "rename", name=project.parent.name)["ok"]
        server.process.send_signal(first)
        time.sleep(gap_s)
        server.process.send_signal(second)
        said = server.end()
        return server.process.returncode, said.strip(), name_of(project)


@pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
def test_two_stop_signals_end_the_server_as_one_does(tmp_path: Path) -> None:
    pairs = [(signal.SIGINT, signal.SIGTERM), (signal.SIGTERM, signal.SIGHUP)]
    with ThreadPoolExecutor(TOGETHER) as pool:
        tries = [
            pool.submit(try_once, tmp_path / f"try {n}" / "project", *pairs[n % 2], (n // 2) * 0.06)
            for n in range(TRIES)
        ]
        ends = [each.result(120) for each in tries]
    assert ends == [(0, "", f"try {n}") for n in range(TRIES)]
