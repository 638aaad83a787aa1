"""Kills without warning while clients edit: edits reported as saved must be there afterwards."""

from __future__ import annotations

import random
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from ladarreg_core.simulate.sample import sample_folder
from testing.attacks.server_process import Editor, Server, ServerGone, matches_of, start_server

_EDITORS = 3
_MAX_EDITS = 60


@dataclass
class KillRound:
    """Outcome of one kill."""

    answered: int
    """Edits reported as saved before the kill."""
    lost: list[str] = field(default_factory=list)
    """Edits missing afterwards, or the reason why the project could not be opened."""


def with_photo(room: Path, project: Path, *, scan: bool) -> Server:
    """Start a server on a new project with the sample's photograph, and its scan if wanted."""
    sample = sample_folder()
    photo = next(sample.glob("photo.*"))
    if scan:
        return start_server(room, project, sample / "scan.npz", photo)
    server = start_server(room, project)
    answer = server.upload("photo", photo)
    if not answer["ok"]:
        server.kill()
        raise ServerGone(str(answer))
    return server


def kill_rounds(room: Path, count: int, *, seed: int, scan: bool) -> Iterator[KillRound]:
    """Edit, kill, reopen and compare, several times on one project.

    Args:
        room: an empty folder.
        count: kills.
        seed: of edits and moments.
        scan: whether the project has a scan, too.

    Yields:
        What each kill cost.
    """
    rng = random.Random(seed)
    project = room / "project"
    server = with_photo(room, project, scan=scan)
    try:
        page = server.page()
        photo = page.slices["shown"]
        editors = [Editor(photo, random.Random(f"{seed} {k}")) for k in range(_EDITORS)]
        page.close()
        for _ in range(count):
            before = sum(editor.answered for editor in editors)
            _edit_and_kill(server, editors, rng)
            found = KillRound(sum(editor.answered for editor in editors) - before)
            try:
                server = start_server(room, project)
                page = server.page()
            except ServerGone as error:
                found.lost.append(f"the project cannot be opened: {error}")
                yield found
                return
            there = matches_of(page, photo) if f"picks:{photo}" in page.slices else {}
            page.close()
            found.lost += [text for editor in editors for text in editor.lost(there)]
            yield found
    finally:
        if server.process.poll() is None:
            server.kill()


def _edit_and_kill(server: Server, editors: list[Editor], rng: random.Random) -> None:
    """Let all clients edit at once, and kill the server at a random moment."""
    ready = threading.Barrier(len(editors) + 1)
    failures: list[BaseException] = []
    begun = sum(editor.answered for editor in editors)

    def work(editor: Editor) -> None:
        page = server.page()
        ready.wait(60)
        try:
            while True:
                editor.edit(page)
        except ServerGone:
            return
        except BaseException as error:
            failures.append(error)
            server.kill()
        finally:
            page.close()

    workers = [threading.Thread(target=work, args=(editor,), daemon=True) for editor in editors]
    for worker in workers:
        worker.start()
    ready.wait(60)
    wanted, until = rng.randrange(_MAX_EDITS), time.monotonic() + 120
    while sum(editor.answered for editor in editors) - begun < wanted and time.monotonic() < until:
        time.sleep(0.001)
    time.sleep(rng.choice((0.0, rng.uniform(0, 0.01), rng.uniform(0, 1.2))))
    server.kill()
    for worker in workers:
        worker.join(60)
    if failures:
        raise failures[0]
