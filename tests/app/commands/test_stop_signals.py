"""Stop signals of the server: which are handled, what is saved, and the effect of a second one."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from ladarreg.exit_codes import ExitCode

from ladarreg_core.simulate import sample_folder
from testing.workbench.gateway_driver import TOKEN, closing_code, soon
from testing.workbench.processes import restore_stop_signals
from testing.workbench.serve_process import (
    PATIENT_PROGRAM,
    Server,
    ask,
    begin_upload,
    is_listening,
    name_of,
    serving,
    start,
)

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")


@pytest.mark.slow
@pytest.mark.parametrize("sent", [signal.SIGTERM, pytest.param(signal.SIGHUP, marks=pytest.mark.long)])
def test_sigterm_and_sighup_save_and_exit(tmp_path: Path, sent: signal.Signals) -> None:
    with serving(tmp_path / "project") as server, server.there.socket() as page:
        assert ask(page, "rename", name="kept")["ok"]
        server.process.send_signal(sent)
        assert not server.end().strip()
        assert server.process.returncode == 0
        assert name_of(tmp_path / "project") == "kept"


@pytest.mark.long
def test_a_closed_terminal_ends_the_server(tmp_path: Path) -> None:
    import pty

    project = tmp_path / "project"
    process, terminal = pty.fork()
    if process == 0:
        restore_stop_signals()
        os.environ |= {"LADARREG_TOKEN": TOKEN, "LADARREG_HOME": str(tmp_path)}
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

        assert soon(has_ended)
        assert [os.waitstatus_to_exitcode(status) for status in ended] == [0]
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.kill(process, signal.SIGKILL)
    assert name_of(project) == "untitled"


@pytest.mark.long
def test_signals_ignored_by_nohup_stay_ignored(tmp_path: Path) -> None:
    def as_nohup_does() -> None:
        signal.signal(signal.SIGHUP, signal.SIG_IGN)

    words = ["serve", "--project", str(tmp_path / "project"), "--port", "0", "--no-browser"]
    process = subprocess.Popen(
        [sys.executable, "-m", "ladarreg", *words],
        cwd=Path(__file__).parents[3],
        env=os.environ | {"LADARREG_TOKEN": TOKEN, "LADARREG_HOME": str(tmp_path)},
        stdout=subprocess.PIPE,
        text=True,
        preexec_fn=as_nohup_does,
    )
    try:
        server = Server(process)
        status = Path(f"/proc/{process.pid}/status")
        if status.is_file():
            ignored = next(line for line in status.read_text().splitlines() if line.startswith("SigIgn:"))
            assert int(ignored.split()[1], 16) >> (signal.SIGHUP - 1) & 1
        process.send_signal(signal.SIGHUP)
        with server.there.socket() as page:
            assert ask(page, "rename", name="after the signal")["ok"]
        process.terminate()
        assert process.wait(60) == 0
    finally:
        process.kill()
        process.communicate()


@pytest.mark.slow
def test_a_second_signal_saves_and_exits_at_once(tmp_path: Path) -> None:
    project = tmp_path / "project"
    program = ("-c", PATIENT_PROGRAM.format(one_request_s=0.5, grace_s=600))
    with serving(project, program=program) as server, server.there.socket() as page:
        assert ask(page, "rename", name="kept")["ok"]
        with begin_upload(server.there):
            assert soon(lambda: len(list((project / "inputs").iterdir())) == 1)
            server.process.send_signal(signal.SIGTERM)
            assert closing_code(page) == 1012
            assert soon(lambda: not is_listening(server.there))
            assert server.process.poll() is None, "it waits for the upload"

            def ends_by_another() -> bool:
                server.process.send_signal(signal.SIGTERM)
                return server.process.poll() is not None

            assert soon(ends_by_another)
            said = server.end()
        assert server.process.returncode == ExitCode.INTERRUPTED
        assert "everything is saved" in said
        assert "Traceback" not in said
        assert name_of(project) == "kept"


def has_loaded(process: int, library: str) -> bool:
    """Whether a process has a library, where that can be known."""
    maps = Path(f"/proc/{process}/maps")
    return not maps.is_file() or library in maps.read_text()


MOMENTS: dict[str, Callable[[int, Path], bool]] = {
    "at once": lambda process, project: True,
    "as it loads libraries": lambda process, project: has_loaded(process, "numpy"),
    "as it opens the project": lambda process, project: project.is_dir(),
    "as it has saved the project": lambda process, project: (project / "project.json").is_file(),
}


@pytest.mark.slow
@pytest.mark.parametrize("moment", MOMENTS)
def test_signals_during_the_start_end_the_server(tmp_path: Path, moment: str) -> None:
    inputs, project = sample_folder(), tmp_path / "project"
    process = start(project, str(inputs / "scan.npz"), str(inputs / "photo.png"))
    try:
        assert soon(lambda: MOMENTS[moment](process.pid, project))
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
