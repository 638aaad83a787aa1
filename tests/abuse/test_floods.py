"""Floods of connections against a real server that may open few files: new clients get in, and every edit is saved."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from ladarreg_core.simulate.sample import sample_folder
from testing.attacks.held_connections import HeldConnections, descriptors, edits, newcomers
from testing.workbench.gateway_driver import soon
from testing.workbench.served import Page, Served, with_camera_and_picks

pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(
        not sys.platform.startswith("linux"), reason="counts descriptors and memory in /proc, which only Linux has"
    ),
]
DESCRIPTORS = 256
MORE_FLOODS = (("slow", 300), ("cookie", 100), ("document", 100))
EDITS, NEWCOMERS = 40, 3


def few_descriptors() -> None:
    import resource

    resource.setrlimit(resource.RLIMIT_NOFILE, (DESCRIPTORS, DESCRIPTORS))


@pytest.fixture(scope="session")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("floods") / "project"


@pytest.fixture(scope="session")
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


@pytest.fixture(scope="session")
def page(found: Served) -> Page:
    page = Page(found)
    with_camera_and_picks(page, 5)
    return page


@contextmanager
def flooded(found: Served, kind: str, count: int) -> Iterator[HeldConnections]:
    """Hold connections open, and open again what the server closes."""
    held = HeldConnections(kind, count, found.host, found.port, found.access)
    over = threading.Event()

    def hold() -> None:
        while not over.is_set():
            held.fill()
            held.pass_time(0.2)

    holding = threading.Thread(target=hold)
    holding.start()
    try:
        assert soon(lambda: held.opened >= count), "the flood came"
        yield held
    finally:
        over.set()
        holding.join()
        for line in held.open:
            line.close()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "count"),
    [("idle", 400), *(pytest.param(*flood, marks=pytest.mark.long) for flood in MORE_FLOODS)],
)
def test_a_flood_neither_locks_out_new_clients_nor_stops_saving(
    found: Served, page: Page, project: Path, kind: str, count: int
) -> None:
    saved = (project / "history.jsonl").read_bytes().count(b"\n")
    with flooded(found, kind, count) as held:
        welcome: list[bool] = []
        coming = threading.Thread(target=lambda: welcome.extend(newcomers(found, NEWCOMERS)))
        coming.start()
        unsaved = edits(page, EDITS)
        coming.join()
        assert held.opened >= count
        assert descriptors(found) < DESCRIPTORS - 30
    assert unsaved == 0
    assert (project / "history.jsonl").read_bytes().count(b"\n") >= saved + EDITS
    assert welcome == [True] * NEWCOMERS


@pytest.mark.long
def test_idle_views_are_limited_and_release_their_memory(found: Served, page: Page) -> None:
    page.ask("run", photo="p1", job="auto")
    page.until(lambda slices: slices["job"] and slices["job"]["state"] not in ("running", "paused"))
    before = found.memory_mb()
    with flooded(found, "viser", 80) as held:
        unsaved = edits(page, EDITS)
        assert held.opened >= 80
        assert descriptors(found) < DESCRIPTORS - 30
    assert unsaved == 0
    assert soon(lambda: found.memory_mb() < before + 60)
    assert soon(lambda: found.get("viser/")[0] == 200), "the last views close one after another"
