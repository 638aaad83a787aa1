"""Two different stop signals in quick succession, to a real server: a clean end for all signals and moments."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from websockets.sync.client import ClientConnection

from testing.workbench.gateway_driver import Running, closing_code, soon
from testing.workbench.serve_process import PATIENT_PROGRAM, ask, is_listening, name_of, serving

pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")]
PAIRS = ((signal.SIGINT, signal.SIGTERM), (signal.SIGTERM, signal.SIGHUP))
MOMENTS: dict[str, Callable[[Running, ClientConnection], bool]] = {
    "at once": lambda there, page: True,
    "when pages are closed": lambda there, page: closing_code(page) == 1012,
    "when it no longer listens": lambda there, page: soon(lambda: not is_listening(there)),
}
USUAL = {(PAIRS[0], "at once"), (PAIRS[1], "when pages are closed")}
"""The others are tried by `make test-all` only."""


@pytest.mark.parametrize(
    ("signals", "moment"),
    [
        pytest.param(pair, moment, marks=() if (pair, moment) in USUAL else pytest.mark.long)
        for pair in PAIRS
        for moment in MOMENTS
    ],
)
def test_two_stop_signals_end_the_server_as_one_does(
    tmp_path: Path, signals: tuple[signal.Signals, signal.Signals], moment: str
) -> None:
    project = tmp_path / "project"
    program = ("-c", PATIENT_PROGRAM.format(one_request_s=600, grace_s=2))
    with serving(project, program=program) as server, server.there.socket() as page:
        assert ask(page, "rename", name="kept")["ok"]
        server.process.send_signal(signals[0])
        assert MOMENTS[moment](server.there, page)
        server.process.send_signal(signals[1])
        said = server.end()
        assert (server.process.returncode, said.strip(), name_of(project)) == (0, "", "kept")
