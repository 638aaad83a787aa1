"""Memory growth of the server over hours of work by ten clients."""

from __future__ import annotations

import random
import shutil
import threading
import time
from dataclasses import dataclass, field
from typing import Any

from benchmarks.abuse.log import Log
from ladarreg_core.simulate.sample import sample_folder
from testing.attacks.kill_rounds import with_photo
from testing.attacks.server_process import Page, Server, ServerGone, start_server

SECTION = "clients"
CLIENTS = 10
_PAUSE_S = (0.5, 3.0)
"""Pause between the edits of one client."""
_SAMPLED_H = 1 / 6
_MAX_OF_ONE = 12
_STAYS_H = (0.1, 0.5)
"""Time for which a client keeps the page open."""


@dataclass
class _Work:
    """Totals over all clients."""

    edits: int = 0
    unsaved: int = 0
    times_ms: list[float] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)
    lock: threading.Lock = field(default_factory=threading.Lock)


def run(log: Log, hours: float, pace: float) -> None:
    """Run ten clients for these hours, at `pace` times the speed of people; log memory every ten minutes of their time.

    What was logged before counts, but the server is a new one: memory is compared within one server.
    """
    done = max((row["hours"] for row in log.of(SECTION)), default=0.0)
    if done >= hours - 1e-6:
        return
    room = log.work / "clients"
    project = room / "project"
    part = len({row["part"] for row in log.of(SECTION)})
    if done == 0.0 and room.exists():
        shutil.rmtree(room)
    server = (
        start_server(room, project) if (project / "history.jsonl").exists() else with_photo(room, project, scan=True)
    )
    work, over = _Work(), threading.Event()
    try:
        page = server.page()
        camera = page.ask("set_camera", photo=page.slices["shown"], focal_px=_focal())
        assert camera["ok"], camera
        page.close()
        workers = [
            threading.Thread(target=_person, args=(server, k, pace, work, over), daemon=True) for k in range(CLIENTS)
        ]
        began = time.monotonic()
        for worker in workers:
            worker.start()
        samples = 0
        while done < hours - 1e-6 and server.process.poll() is None:
            samples += 1
            step_h = min(_SAMPLED_H, hours - done)
            done += step_h
            until = began + 3600 / pace * _SAMPLED_H * samples
            while time.monotonic() < until and server.process.poll() is None:
                time.sleep(min(1.0, max(0.01, until - time.monotonic())))
            log.add(SECTION, part=part, hours=round(done, 4), pace=pace, **_sample(server, work))
        if server.process.poll() is not None:
            log.add(
                SECTION,
                part=part,
                hours=round(done, 4),
                pace=pace,
                faults=["the server ended"],
                mb=None,
                edits=work.edits,
            )
    finally:
        over.set()
        for worker in workers:
            worker.join(60)
        server.stop() if server.process.poll() is None else None


def _sample(server: Server, work: _Work) -> dict[str, Any]:
    with work.lock:
        times, work.times_ms = sorted(work.times_ms), []
        faults, work.faults = work.faults[:5], []
        edits, unsaved = work.edits, work.unsaved
    p99 = round(times[int(0.99 * (len(times) - 1))], 1) if times else None
    return {
        "mb": round(server.memory_mb(), 1), "edits": edits, "unsaved": unsaved, "p99_ms": p99, "faults": faults,
    }  # fmt: skip


def _focal() -> float:
    from ladarreg_core.formats.cameras.camera_file import read_camera

    return read_camera(sample_folder() / "camera.json").focal_px


def _person(server: Server, k: int, pace: float, work: _Work, over: threading.Event) -> None:
    """Connect, edit for a while, disconnect, and repeat."""
    rng = random.Random(f"{k} {time.monotonic_ns()}")
    while not over.is_set():
        try:
            page = server.page()
            _visit(page, rng, pace, work, over)
            page.close()
        except (ServerGone, TimeoutError, OSError) as error:
            with work.lock:
                work.faults.append(f"person {k}: {error}")
            over.wait(5.0)


def _visit(page: Page, rng: random.Random, pace: float, work: _Work, over: threading.Event) -> None:
    photo = page.slices["shown"]
    mine: list[str] = []
    there = [pick["id"] for pick in page.slices[f"picks:{photo}"]]
    if len(there) > 2 * CLIENTS * _MAX_OF_ONE:  # undo restores matches that no client owns any more
        page.ask("remove_picks", photo=photo, picks=there[: -CLIENTS * _MAX_OF_ONE])
    leaves = time.monotonic() + 3600 / pace * rng.uniform(*_STAYS_H)
    while time.monotonic() < leaves and not over.is_set():
        uv = [rng.uniform(5, 700), rng.uniform(5, 500)]
        what = rng.random()
        began = time.perf_counter()
        if (what < 0.4 and len(mine) < _MAX_OF_ONE) or not mine:
            ray = [1.0, rng.uniform(-0.35, 0.35), rng.uniform(-0.2, 0.2)]
            reply = page.ask("add_pick", photo=photo, kind="point", scan=[ray], photo_uv=[uv])
            mine += [reply["pick"]] if reply["ok"] else []
        elif what < 0.7:
            reply = page.ask("set_pick", photo=photo, pick=rng.choice(mine), photo_uv=[uv])
        elif what < 0.95:
            reply = page.ask("remove_picks", photo=photo, picks=[mine.pop(rng.randrange(len(mine)))])
        else:
            reply = page.ask(rng.choice(("undo", "redo")))
        with work.lock:
            work.edits += 1
            work.times_ms.append(1e3 * (time.perf_counter() - began))
            work.unsaved += bool(reply["ok"]) and not page.is_saved(reply)
        _listen(page, rng.uniform(*_PAUSE_S) / pace)
    if mine and not over.is_set():  # a leaving client removes its matches
        page.ask("remove_picks", photo=photo, picks=mine)


def _listen(page: Page, seconds: float) -> None:
    """Receive the edits of others for a while."""
    until = time.monotonic() + seconds
    while (left := until - time.monotonic()) > 0:
        try:
            page.take(page.hear(left))
        except TimeoutError:
            return
