"""Hostile messages to a real server: each gets a one-sentence reply, and accepted edits survive a kill."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from ladarreg_core.simulate.sample import sample_folder
from testing.attacks.kill_rounds import with_photo
from testing.attacks.protocol_fuzz import fuzz_protocol, shown_state
from testing.attacks.server_process import start_server

pytestmark = pytest.mark.skipif(os.name != "posix", reason="no kill -9 to send")


@pytest.mark.slow
@pytest.mark.parametrize("count", [140, pytest.param(700, marks=pytest.mark.long)])
def test_hostile_messages_are_refused_and_accepted_edits_read_back(tmp_path: Path, count: int) -> None:
    served = tmp_path / "served"
    served.mkdir()
    shutil.copy(sample_folder() / "camera.json", served)
    project = tmp_path / "project"
    with_photo(tmp_path / "room", project, scan=True).stop()
    with start_server(tmp_path / "room", project, more=("--folder", str(served))) as server:
        found = fuzz_protocol(server, count, seed=1)
        assert found.faults == []
        assert found.done > count / 7
        assert found.refused > count / 7
        page = server.page()
        page.ask("job_control", action="stop")
        page.close()
        page = server.page()
        before = shown_state(page)
        page.close()
        server.kill()
    with start_server(tmp_path / "room", project, more=("--folder", str(served))) as server:
        page = server.page()
        assert shown_state(page) == before
        page.close()
