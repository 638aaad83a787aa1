"""Floods of connections and of files that grow when read: their effect on other clients and on the server."""

from __future__ import annotations

import json
import os
import random
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.abuse.log import Log
from ladarreg_core.formats.scans.npz import write_npz_counts
from ladarreg_core.scanner.grids import AzimuthElevation
from testing.attacks.kill_rounds import with_photo
from testing.attacks.server_process import TOKEN, Page, Server, ServerGone

SECTION = "floods"
_PAUSE_S = 0.03
_ADDRESS_SPACE = 14 << 30
"""The system stops a server that takes more memory, before the machine runs out of it."""
_LONGEST_S = 180.0
_NEWCOMER_WAITS_S = 5.0
_AFTER_S = 5.0


@dataclass(frozen=True, slots=True)
class Flood:
    """An attack by name."""

    name: str
    arguments: Callable[[Path], Sequence[object]]
    """Writes the files it needs into a folder, and returns the arguments for `attacks.main`; empty: no attack."""


@dataclass
class Effects:
    """Effects on other clients and on the server."""

    ms: list[float] = field(default_factory=list)
    """Latency of each edit."""
    unsaved: int = 0
    failures: list[str] = field(default_factory=list)
    newcomers: int = 0
    shut_out: int = 0
    """Number of new clients with the right token that did not get in."""
    peak_mb: float = 0.0
    descriptors: int = 0
    """Largest number of open file descriptors of the server."""


def run(log: Log, seconds: float) -> None:
    """Run every flood for this time, each on a server of its own."""
    for flood in FLOODS:
        if not log.of(SECTION, flood=flood.name):
            log.add(SECTION, **_run_flood(flood, seconds))


def _run_flood(flood: Flood, seconds: float) -> dict[str, Any]:
    with tempfile.TemporaryDirectory(prefix="flood-") as name:
        room = Path(name)
        arguments = [str(argument) for argument in flood.arguments(room)]
        server = with_photo(room, room / "project", scan=True)
        _limit(server)
        effects, over = Effects(), threading.Event()
        watchers = [
            threading.Thread(target=work, args=(server, effects, over), daemon=True)
            for work in (_watch_server, _watch_newcomers)
        ]
        try:
            page = server.page()
            photo = page.slices["shown"]
            pick = _new_pick(page, photo)
            for _ in range(20):  # the first edits of a server are slower
                _edit(page, photo, pick, Effects())
            base = server.memory_mb()
            for watcher in watchers:
                watcher.start()
            attack = _attack(server, arguments, seconds, lambda: _edit(page, photo, pick, effects), effects)
            over.set()
            time.sleep(_AFTER_S)
            after = server.memory_mb()
            joins = _joins(server)
            page.close()
        except (ServerGone, TimeoutError) as error:
            over.set()
            effects.failures.append(f"the editing client was disconnected: {error}")
            base = after = float("nan")
            attack, joins = {}, _joins(server)
        finally:
            over.set()
            server.kill()
        ms = np.array(effects.ms or [float("nan")])
        return {
            "flood": flood.name, "edits": len(effects.ms), "p50_ms": _round(np.percentile(ms, 50)),
            "p99_ms": _round(np.percentile(ms, 99)), "worst_ms": _round(ms.max()), "unsaved": effects.unsaved,
            "newcomers": effects.newcomers, "shut_out": effects.shut_out, "joins_after": joins, "base_mb": _round(base),
            "peak_mb": _round(effects.peak_mb), "after_mb": _round(after), "descriptors": effects.descriptors,
            "failures": effects.failures[:5], "attack": attack,
        }  # fmt: skip


def _attack(
    server: Server, arguments: list[str], seconds: float, edit: Callable[[], None], effects: Effects
) -> dict[str, Any]:
    """Run the attack, and edit until it has ended."""
    process = None
    if arguments:
        process = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.abuse.attacks", str(server.port), server.access.cookie,
            server.access.path, str(seconds), *arguments], stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
    least, most = time.monotonic() + seconds, time.monotonic() + _LONGEST_S
    try:
        while time.monotonic() < least or (process is not None and process.poll() is None):
            if time.monotonic() > most:
                effects.failures.append(f"the attack did not end within {_LONGEST_S:g} s")
                break
            edit()
            time.sleep(_PAUSE_S)
    finally:
        output = ""
        if process is not None:
            process.kill()
            output = process.communicate()[0]
    found = json.loads(output) if output.strip() else {}
    assert isinstance(found, dict)
    return found


def _edit(page: Page, photo: str, pick: list[str], effects: Effects) -> None:
    began = time.perf_counter()
    uv = [random.uniform(5, 700), random.uniform(5, 500)]
    reply = page.ask("set_pick", photo=photo, pick=pick[0], photo_uv=[uv])
    effects.ms.append(1e3 * (time.perf_counter() - began))
    if not reply["ok"]:  # an accepted scan removes the matches of the previous one
        pick[:] = _new_pick(page, photo)
    elif not page.is_saved(reply):
        effects.unsaved += 1


def _new_pick(page: Page, photo: str) -> list[str]:
    reply = page.ask("add_pick", photo=photo, kind="point", scan=[[1.0, 0.1, 0.0]], photo_uv=[[10.0, 10.0]])
    return [reply.get("pick", "")]


def _watch_server(server: Server, effects: Effects, over: threading.Event) -> None:
    while not over.wait(0.1):
        effects.peak_mb = max(effects.peak_mb, server.memory_mb())
        with suppress(OSError):
            effects.descriptors = max(effects.descriptors, len(os.listdir(f"/proc/{server.process.pid}/fd")))


def _watch_newcomers(server: Server, effects: Effects, over: threading.Event) -> None:
    """Request the page with the right token, without a cookie, once a second."""
    while not over.wait(1.0):
        effects.newcomers += 1
        try:
            status, _, _ = server.ask("GET", f"/?token={TOKEN}", headers={"Cookie": ""}, timeout_s=_NEWCOMER_WAITS_S)
        except OSError:
            status = 0
        effects.shut_out += status != 200


def _joins(server: Server) -> bool:
    """Return whether a page can be opened."""
    with suppress(ServerGone, TimeoutError, OSError):
        Page(server, timeout_s=20).close()
        return True
    return False


def _limit(server: Server) -> None:
    if sys.platform == "linux":
        import resource

        resource.prlimit(server.process.pid, resource.RLIMIT_AS, (_ADDRESS_SPACE, resource.RLIM_INFINITY))


def _round(value: float) -> float | None:
    return None if value != value else round(float(value), 1)


def _hostile(
    make: str, name: str, copies: int = 1, what: str = "scan", **fields: Any
) -> Callable[[Path], list[object]]:
    """Return a flood that writes a file of `testing.attacks.bombs`, and uploads it this many times."""

    def arguments(room: Path) -> list[object]:
        from testing.attacks import bombs

        path = getattr(bombs, make)(room / name, **fields)
        return ["upload", what, "p1", *[path] * copies]

    return arguments


def _unviewable(room: Path) -> list[object]:
    """Write a valid scan that cannot be rendered: its rows are 1e-5 rad apart."""
    rng = np.random.default_rng(0)
    write_npz_counts(
        room / "unviewable.npz", counts=rng.integers(500, 2000, (24, 36)).astype(np.uint16),
        intensity=rng.uniform(0, 255, (24, 36)), geometry=AzimuthElevation(24, 36, 0.01, 1e-5), r0_m=1.0, dr_m=0.002,
    )  # fmt: skip
    return ["upload", "scan", "p1", room / "unviewable.npz"]


def _at_once(room: Path) -> list[object]:
    """Write a valid scan of 3 million cells, and upload it from 50 browsers at once."""
    rng = np.random.default_rng(0)
    rows, columns = 1_500, 2_000
    write_npz_counts(
        room / "large.npz", counts=rng.integers(500, 2000, (rows, columns)).astype(np.uint16),
        intensity=rng.uniform(0, 255, (rows, columns)).astype(np.uint8),
        geometry=AzimuthElevation(rows, columns, 0.0008, 0.0008), r0_m=1.0, dr_m=0.002,
    )  # fmt: skip
    return ["uploads", 50, "scan", "p1", room / "large.npz"]


FLOODS = (
    Flood("no attack", lambda room: []),
    Flood("1,100 idle connections", lambda room: ["hold", "idle", 1100]),
    Flood("1,100 slow headers", lambda room: ["hold", "slow", 1100]),
    Flood("100 requests with a cookie", lambda room: ["hold", "cookie", 100]),
    Flood("100 document sockets", lambda room: ["hold", "document", 100]),
    Flood("200 viser sockets", lambda room: ["hold", "viser", 200]),
    Flood("60 wrong tokens", lambda room: ["tokens", 60]),
    Flood("camera YAML, one line of 60 kB", _hostile("long_camera_yaml", "c.yaml", what="camera", size=60_000)),
    Flood("camera YAML, one line of 900 kB", _hostile("long_camera_yaml", "c.yaml", what="camera", size=900_000)),
    Flood("E57 of 20 kB", _hostile("e57_of_constants", "a.e57", points=16_000_000, padding=20_000)),
    Flood("4 PNG pictures of 0.17 MB", _hostile("blank_png", "a.png", 4, "photo", width=13_000, height=13_000)),
    Flood("NPZ of 0.08 MB", _hostile("counts_npz", "a.npz", rows=6_000, columns=7_000)),
    Flood("PCD of 11 MB, compressed", _hostile("compressed_pcd", "a.pcd", width=7_500, height=8_000)),
    Flood("50 uploads at once", _at_once),
    Flood("matches JSON, 0.9 M", _hostile("matches_json", "m.json", what="matches", count=900_000)),
    Flood("matches CSV, 2 M", _hostile("matches_csv", "m.csv", what="matches", count=2_000_000)),
    Flood("a scan that cannot be shown", _unviewable),
)
"""All floods, in the order in which they run."""
