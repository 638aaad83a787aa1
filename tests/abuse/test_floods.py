"""Floods of connections against a real server that may open few files: new clients get in, and every edit is saved."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from ladarreg_core.simulate.sample import sample_folder
from testing.attacks.held_connections import HeldConnections, Starvation, descriptors, edits_until, newcomers_until
from testing.workbench.served import Page, Served, with_camera_and_picks

pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(
        not sys.platform.startswith("linux"), reason="counts descriptors and memory in /proc, which only Linux has"
    ),
]
DESCRIPTORS = 256
EDITED_S = 1.5
LEAST_NEWCOMERS = 3
LONGEST_WAIT_S, MEDIAN_EDIT_MS = 3.0, 250.0
"""On idle processors; more where other programs starve the server and this test of them."""
FLOOD_S = 20.0
"""Time in which the flood comes, at most."""


def few_descriptors() -> None:
    import resource

    resource.setrlimit(resource.RLIMIT_NOFILE, (DESCRIPTORS, DESCRIPTORS))


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("floods") / "project"


@pytest.fixture(scope="module")
def found(project: Path) -> Iterator[Served]:
    inputs = sample_folder()
    process = subprocess.Popen(
        [sys.executable, "-m", "ladarreg", "serve", str(inputs / "scan.npz"), str(next(inputs.glob("photo.*"))),
         "--project", str(project), "--port", "0", "--no-browser"],
        stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, preexec_fn=few_descriptors,
        env={**os.environ, "OMP_NUM_THREADS": "1"}, cwd=Path(__file__).parents[2],
    )  # fmt: skip
    try:
        assert process.stdout is not None
        parts = urlsplit(process.stdout.readline().split()[1])
        found = Served(process, str(parts.hostname), parts.port or 0, parts.query.removeprefix("token="))
        found.enter()
        yield found
    finally:
        process.terminate()
        process.wait(60)


@pytest.fixture(scope="module")
def page(found: Served) -> Page:
    page = Page(found)
    with_camera_and_picks(page, 5)
    return page


@contextmanager
def flooded(found: Served, kind: str, count: int) -> Iterator[HeldConnections]:
    """Hold connections open, and open again what the server closes."""
    held = HeldConnections(kind, count, found.host, found.port, found.cookie)
    over = threading.Event()

    def hold() -> None:
        while not over.is_set():
            held.fill()
            held.pass_time(0.2)

    holding = threading.Thread(target=hold)
    holding.start()
    try:
        end = time.monotonic() + FLOOD_S
        time.sleep(0.5)
        while held.opened < count and time.monotonic() < end:
            time.sleep(0.05)
        yield held
    finally:
        over.set()
        holding.join()
        for line in held.open:
            line.close()


@pytest.mark.parametrize(("kind", "count"), [("idle", 400), ("slow", 300), ("cookie", 100), ("document", 100)])
def test_a_flood_neither_locks_out_new_clients_nor_stops_saving(
    found: Served, page: Page, project: Path, kind: str, count: int
) -> None:
    saved = (project / "history.jsonl").read_bytes().count(b"\n")
    with flooded(found, kind, count) as held:
        starved = [Starvation(pid) for pid in (found.process.pid, os.getpid())]
        end = time.monotonic() + EDITED_S
        waits: list[float] = []
        coming = threading.Thread(target=lambda: waits.extend(newcomers_until(found, end, least=LEAST_NEWCOMERS)))
        coming.start()
        spent, unsaved = edits_until(page, end)
        coming.join()
        slower = max(each.factor() for each in starved)
        assert held.opened >= count, "the flood came"
        assert descriptors(found) < DESCRIPTORS - 30
    assert unsaved == 0
    assert (project / "history.jsonl").read_bytes().count(b"\n") >= saved + len(spent)
    assert len(waits) >= LEAST_NEWCOMERS
    assert max(waits) < LONGEST_WAIT_S * slower, slower
    assert sorted(spent)[len(spent) // 2] < MEDIAN_EDIT_MS * slower, slower


def test_idle_views_are_limited_and_release_their_memory(found: Served, page: Page) -> None:
    page.ask("run", photo="p1", job="auto")
    page.until(lambda slices: slices["job"] and slices["job"]["state"] not in ("running", "paused"))
    before = found.memory_mb()
    with flooded(found, "viser", 80) as held:
        spent, unsaved = edits_until(page, time.monotonic() + EDITED_S)
        assert held.opened >= 80
        assert descriptors(found) < DESCRIPTORS - 30
    assert unsaved == 0
    assert spent
    end = time.monotonic() + 15
    while found.memory_mb() > before + 60 and time.monotonic() < end:
        time.sleep(0.2)
    assert found.memory_mb() < before + 60
    end = time.monotonic() + 30
    while found.get("viser/")[0] == 503 and time.monotonic() < end:  # the last views close one after another
        time.sleep(0.2)
    assert found.get("viser/")[0] == 200
