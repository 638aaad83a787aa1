"""Floods of connections and of files that grow: what others feel of them, and what they cost the server."""

from __future__ import annotations

import json
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
from ladarreg_core.formats.npz import write_npz_counts
from ladarreg_core.scanner.grids import AzimuthElevation
from tests.abuse.kill_rounds import with_photo
from tests.abuse.server_process import TOKEN, Page, Server, ServerGone

SECTION = "floods"
_PAUSE_S = 0.03
_ADDRESS_SPACE = 14 << 30
"""A server that takes more is stopped by the system, and this machine lives on."""
_LONGEST_S = 180.0
_NEWCOMER_WAITS_S = 5.0
_AFTER_S = 5.0


@dataclass(frozen=True, slots=True)
class Flood:
    """An attack by name."""

    name: str
    words: Callable[[Path], Sequence[object]]
    """Makes what it needs in a folder, and returns the words for `attacks.main`; none: nobody attacks."""


@dataclass
class Felt:
    """What somebody else felt."""

    ms: list[float] = field(default_factory=list)
    """Until each edit was answered."""
    unsaved: int = 0
    failures: list[str] = field(default_factory=list)
    newcomers: int = 0
    shut_out: int = 0
    """Of the newcomers with the right token."""
    peak_mb: float = 0.0


def run(log: Log, seconds: float) -> None:
    """Try every flood, for so long each, on a server of its own."""
    for flood in FLOODS:
        if not log.of(SECTION, flood=flood.name):
            log.add(SECTION, **_flooded(flood, seconds))


def _flooded(flood: Flood, seconds: float) -> dict[str, Any]:
    with tempfile.TemporaryDirectory(prefix="flood-") as name:
        room = Path(name)
        words = [str(word) for word in flood.words(room)]
        server = with_photo(room, room / "project", scan=True)
        _limit(server)
        felt, over = Felt(), threading.Event()
        watchers = [
            threading.Thread(target=work, args=(server, felt, over), daemon=True)
            for work in (_watch_memory, _watch_newcomers)
        ]
        try:
            page = server.page()
            photo = page.slices["shown"]
            pick = _new_pick(page, photo)
            for _ in range(20):  # the first edits of a server take longer
                _edit(page, photo, pick, Felt())
            base = server.memory_mb()
            for watcher in watchers:
                watcher.start()
            attack = _attack(server, words, seconds, lambda: _edit(page, photo, pick, felt), felt)
            over.set()
            time.sleep(_AFTER_S)
            after = server.memory_mb()
            joins = _joins(server)
            page.close()
        except (ServerGone, TimeoutError) as error:
            over.set()
            felt.failures.append(f"the editor was thrown out: {error}")
            base = after = float("nan")
            attack, joins = {}, _joins(server)
        finally:
            over.set()
            server.kill()
        ms = np.array(felt.ms or [float("nan")])
        return {
            "flood": flood.name, "edits": len(felt.ms), "p50_ms": _round(np.percentile(ms, 50)),
            "p99_ms": _round(np.percentile(ms, 99)), "worst_ms": _round(ms.max()), "unsaved": felt.unsaved,
            "newcomers": felt.newcomers, "shut_out": felt.shut_out, "joins_after": joins, "base_mb": _round(base),
            "peak_mb": _round(felt.peak_mb), "after_mb": _round(after), "failures": felt.failures[:5], "attack": attack,
        }  # fmt: skip


def _attack(server: Server, words: list[str], seconds: float, edit: Callable[[], None], felt: Felt) -> dict[str, Any]:
    """Run the attack, and edit until it is over."""
    process = None
    if words:
        process = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.abuse.attacks", str(server.port), server.cookie, str(seconds), *words],
            stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
    least, most = time.monotonic() + seconds, time.monotonic() + _LONGEST_S
    try:
        while time.monotonic() < least or (process is not None and process.poll() is None):
            if time.monotonic() > most:
                felt.failures.append(f"the attack was not over within {_LONGEST_S:g} s")
                break
            edit()
            time.sleep(_PAUSE_S)
    finally:
        said = ""
        if process is not None:
            process.kill()
            said = process.communicate()[0]
    found = json.loads(said) if said.strip() else {}
    assert isinstance(found, dict)
    return found


def _edit(page: Page, photo: str, pick: list[str], felt: Felt) -> None:
    began = time.perf_counter()
    uv = [random.uniform(5, 700), random.uniform(5, 500)]
    reply = page.ask("set_pick", photo=photo, pick=pick[0], photo_uv=[uv])
    felt.ms.append(1e3 * (time.perf_counter() - began))
    if not reply["ok"]:  # an accepted scan takes the matches of the old one away
        pick[:] = _new_pick(page, photo)
    elif not page.is_saved(reply):
        felt.unsaved += 1


def _new_pick(page: Page, photo: str) -> list[str]:
    reply = page.ask("add_pick", photo=photo, kind="point", scan=[[1.0, 0.1, 0.0]], photo_uv=[[10.0, 10.0]])
    return [reply.get("pick", "")]


def _watch_memory(server: Server, felt: Felt, over: threading.Event) -> None:
    while not over.wait(0.1):
        felt.peak_mb = max(felt.peak_mb, server.memory_mb())


def _watch_newcomers(server: Server, felt: Felt, over: threading.Event) -> None:
    """Have somebody come with the right token, now and then, without a cookie."""
    while not over.wait(1.0):
        felt.newcomers += 1
        try:
            status, _, _ = server.ask("GET", f"/?token={TOKEN}", headers={"Cookie": ""}, timeout_s=_NEWCOMER_WAITS_S)
        except OSError:
            status = 0
        felt.shut_out += status != 200


def _joins(server: Server) -> bool:
    """Tell whether a page can be opened."""
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
    """Return what has a file of `tests.abuse.bombs` written, and uploaded so many times."""

    def words(room: Path) -> list[object]:
        from tests.abuse import bombs

        path = getattr(bombs, make)(room / name, **fields)
        return ["upload", what, "p1", *[path] * copies]

    return words


def _unviewable(room: Path) -> list[object]:
    """Write a sound scan of which no picture can be made: its rows lie a hundred-thousandth of a radian apart."""
    rng = np.random.default_rng(0)
    write_npz_counts(
        room / "unviewable.npz", counts=rng.integers(500, 2000, (24, 36)).astype(np.uint16),
        intensity=rng.uniform(0, 255, (24, 36)), geometry=AzimuthElevation(24, 36, 0.01, 1e-5), r0_m=1.0, dr_m=0.002,
    )  # fmt: skip
    return ["upload", "scan", "p1", room / "unviewable.npz"]


FLOODS = (
    Flood("nobody attacks", lambda room: []),
    Flood("1,100 idle connections", lambda room: ["idle", 1100]),
    Flood("1,100 slow headers", lambda room: ["slow", 1100]),
    Flood("200 viser sockets", lambda room: ["viser", 200]),
    Flood("60 wrong tokens", lambda room: ["tokens", 60]),
    Flood("camera YAML, one line of 60 kB", _hostile("long_camera_yaml", "c.yaml", what="camera", size=60_000)),
    Flood("camera YAML, one line of 900 kB", _hostile("long_camera_yaml", "c.yaml", what="camera", size=900_000)),
    Flood("E57 of 20 kB", _hostile("e57_of_constants", "a.e57", points=16_000_000, padding=20_000)),
    Flood("4 PNG pictures of 0.17 MB", _hostile("blank_png", "a.png", 4, "photo", width=13_000, height=13_000)),
    Flood("NPZ of 0.08 MB", _hostile("counts_npz", "a.npz", rows=6_000, columns=7_000)),
    Flood("PCD of 11 MB, compressed", _hostile("compressed_pcd", "a.pcd", width=7_500, height=8_000)),
    Flood("matches JSON, 0.9 M", _hostile("matches_json", "m.json", what="matches", count=900_000)),
    Flood("matches CSV, 2 M", _hostile("matches_csv", "m.csv", what="matches", count=2_000_000)),
    Flood("a scan that cannot be shown", _unviewable),
)
"""All floods, in the order in which they are tried."""
