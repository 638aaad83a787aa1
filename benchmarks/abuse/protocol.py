"""Thousands of hostile messages to a real server, and a kill after each thousand."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

from benchmarks.abuse.log import Log
from ladarreg_core.simulate.sample import sample_folder
from testing.attacks.kill_rounds import with_photo
from testing.attacks.protocol_fuzz import ProtocolFindings, fuzz_protocol, shown_state
from testing.attacks.server_process import Server, ServerGone, start_server

SECTION = "protocol"
_AT_A_TIME = 1000


def run(log: Log, messages: int) -> None:
    """Send this many messages, with a new project after each thousand."""
    done = {row["first"] for row in log.of(SECTION)}
    for first in range(0, messages, _AT_A_TIME):
        if first not in done:
            found = _thousand(min(_AT_A_TIME, messages - first), seed=first)
            log.add(
                SECTION, first=first, messages=found.messages, done=found.done, refused=found.refused,
                closed=found.closed, seconds=round(found.seconds, 3), faults=found.faults[:20], count=len(found.faults),
            )  # fmt: skip


def _thousand(count: int, *, seed: int) -> ProtocolFindings:
    with tempfile.TemporaryDirectory(prefix="protocol-") as name:
        room = Path(name)
        served = room / "served"
        served.mkdir()
        shutil.copy(sample_folder() / "camera.json", served)
        with_photo(room, room / "project", scan=True).stop()
        with start_server(room, room / "project", more=("--folder", str(served))) as server:
            found = fuzz_protocol(server, count, seed=seed)
            try:
                before = _state(server)
            except (ServerGone, TimeoutError) as error:
                found.faults.append(f"no client can join any more: {error}")
                return found
            server.kill()
        try:
            with start_server(room, room / "project") as server:
                after = _state(server)
        except (ServerGone, TimeoutError) as error:
            found.faults.append(f"the project cannot be opened after it: {error}")
            return found
        names = [name for name in before if before[name] != after.get(name)]
        if names:
            found.faults.append(f"after a kill these were others: {', '.join(names)}")
        return found


def _state(server: Server) -> dict[str, object]:
    page = server.page()
    page.ask("job_control", action="stop")
    page.close()
    page = server.page()
    try:
        return shown_state(page)
    finally:
        page.close()
