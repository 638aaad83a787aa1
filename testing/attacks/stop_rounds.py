"""One or two stop signals while a client edits: an orderly end without losses."""

from __future__ import annotations

import random
import signal
import subprocess
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

from testing.attacks.kill_rounds import with_photo
from testing.attacks.server_process import Editor, ServerGone, matches_of, start_server

_FIRST_EDITS = 20
ORDERLY = (0, 130)
"""Exit codes of a server stopped by a signal."""


@dataclass
class StopRound:
    """Outcome of stopping a server."""

    signals: str
    answered: int
    """Edits reported as saved."""
    faults: list[str] = field(default_factory=list)


def stopped_while_editing(room: Path, *signals: signal.Signals, apart_s: float, seed: int = 0) -> StopRound:
    """Start a server, edit, send the signals, and open the project again.

    Args:
        room: an empty folder.
        signals: sent one after the other.
        apart_s: time between them.
        seed: of the edits.
    """
    project = room / "project"
    server = with_photo(room, project, scan=False)
    page = server.page()
    photo = page.slices["shown"]
    editor = Editor(photo, random.Random(seed))

    def work() -> None:
        try:
            while True:
                editor.edit(page)
        except ServerGone:
            return

    worker = threading.Thread(target=work, daemon=True)
    worker.start()
    until = time.monotonic() + 120
    while editor.answered < _FIRST_EDITS and worker.is_alive() and time.monotonic() < until:
        time.sleep(0.002)
    found = StopRound(f"{' '.join(sent.name for sent in signals)}, {apart_s:.2f} s apart", 0)
    try:
        code = server.stop(*signals, apart_s=apart_s, within_s=60)
        if code not in ORDERLY:
            found.faults.append(f"exit code {code}")
    except subprocess.TimeoutExpired:
        found.faults.append("it did not end within a minute")
    worker.join(60)
    page.close()
    said = server.stderr()
    if "Traceback" in said or "nternal error" in said:
        found.faults.append(f"it said {said.strip()[-300:]!r}")
    try:
        with start_server(room, project) as again:
            page = again.page()
            found.faults += editor.lost(matches_of(page, photo))
            page.close()
    except ServerGone as error:
        found.faults.append(f"the project cannot be opened: {error}")
    found.answered = editor.answered
    return found
