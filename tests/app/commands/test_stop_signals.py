"""Stop signals of the server: which are handled, what is saved, and the effect of a second one."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from ladarreg.exit_codes import ExitCode
from ladarreg.stop_signals import ONE_REQUEST_S

from ladarreg_core.simulate import sample_folder
from testing.workbench.gateway_driver import soon
from testing.workbench.processes import restore_ctrl_c
from testing.workbench.serve_process import ask, begin_upload, name_of, serving, start

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")


@pytest.mark.parametrize("sent", [signal.SIGTERM, signal.SIGHUP])
def test_sigterm_and_sighup_save_and_exit(tmp_path: Path, sent: signal.Signals) -> None:
    with serving(tmp_path / "project") as server, server.there.socket() as page:
        assert ask(page, "rename", name="kept")["ok"]
        server.process.send_signal(sent)
        assert not server.end().strip()
        assert server.process.returncode == 0
        assert name_of(tmp_path / "project") == "kept"


def test_a_closed_terminal_ends_the_server(tmp_path: Path) -> None:
    import pty

    project = tmp_path / "project"
    process, terminal = pty.fork()
    if process == 0:
        restore_ctrl_c()
        os.environ |= {"LADARREG_TOKEN": "a-token-of-tests", "LADARREG_HOME": str(tmp_path)}
        words = ["-m", "ladarreg", "serve", "--project", str(project), "--port", "0", "--no-browser"]
        os.execv(sys.executable, [sys.executable, *words])
    try:
        shown = b""
        while b"Ctrl-C" not in shown:
            shown += os.read(terminal, 4096)
        os.close(terminal)
        ended: list[int] = []

        def has_ended() -> bool:
            found, status = os.waitpid(process, os.WNOHANG)
            ended.extend([status] if found else [])
            return bool(found)

        assert soon(has_ended, seconds=30)
        assert [os.waitstatus_to_exitcode(status) for status in ended] == [0]
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.kill(process, signal.SIGKILL)
    assert name_of(project) == "untitled"


def test_signals_ignored_by_nohup_stay_ignored(tmp_path: Path) -> None:
    def as_nohup_does() -> None:
        signal.signal(signal.SIGHUP, signal.SIG_IGN)

    words = ["serve", "--project", str(tmp_path / "project"), "--port", "0", "--no-browser"]
    process = subprocess.Popen(
        [sys.executable, "-m", "ladarreg", *words],
        cwd=Path(__file__).parents[3],
        env=os.environ | {"LADARREG_HOME": str(tmp_path)},
        stdout=subprocess.PIPE,
        text=True,
        preexec_fn=as_nohup_does,
    )
    try:
        assert process.stdout is not None
        assert "://" in process.stdout.readline()
        process.send_signal(signal.SIGHUP)
        time.sleep(0.5)
        assert process.poll() is None
        process.terminate()
        assert process.wait(30) == 0
    finally:
        process.kill()
        process.communicate()


def test_a_second_signal_saves_and_exits_at_once(tmp_path: Path) -> None:
    project = tmp_path / "project"
    with serving(project) as server, server.there.socket() as page:
        assert ask(page, "rename", name="kept")["ok"]
        with begin_upload(server.there):
            assert soon(lambda: len(list((project / "inputs").iterdir())) == 1)
            server.process.send_signal(signal.SIGTERM)
            time.sleep(ONE_REQUEST_S + 0.2)
            assert server.process.poll() is None, "it waits for the upload, at most two seconds"
            server.process.send_signal(signal.SIGTERM)
            said = server.end()
        assert server.process.returncode == ExitCode.INTERRUPTED
        assert "everything is saved" in said
        assert "Traceback" not in said
        assert name_of(project) == "kept"


@pytest.mark.parametrize("after_s", [0.2, 0.5, 0.8, 1.1])
def test_signals_during_the_start_end_the_server(tmp_path: Path, after_s: float) -> None:
    inputs = sample_folder()
    process = start(tmp_path / "project", str(inputs / "scan.npz"), str(inputs / "photo.png"))
    try:
        time.sleep(after_s)
        process.send_signal(signal.SIGINT)
        process.send_signal(signal.SIGTERM)
        _, said = process.communicate(timeout=60)
    finally:
        process.kill()
        process.communicate()
    # The system ends it before Python runs any of its lines.
    assert process.returncode in (ExitCode.ACCEPTED, ExitCode.INTERRUPTED, -signal.SIGTERM, -signal.SIGINT), said
    if process.returncode >= 0:
        assert "Traceback" not in said
        assert "fault" not in said
