"""How long Stop takes, from a page's message to the unit's halt: row `latency` of the acquisition benchmark.

A workbench is served by a process of its own, as `ladarreg serve` does it; the simulated unit stands behind a port of
this machine and belongs to this process, which sees the halt arrive. Each time the unit is on its way.
"""

from __future__ import annotations

import json
import statistics
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.shared.bars import Row
from ladarreg_core.acquisition.simulated.devices import TwinDevices
from testing.workbench.served import Page, Served, random_pick, served, with_camera_and_picks

_STOPS, _QUICK_STOPS = 50, 5
_BAR_MS = 200.0
_CLIENTS = 10
_CROWD = "20 slow commands of its page"
_JOG_DEG, _SPEED_DEG_S = 20.0, 10.0
_LONGEST_S = 20.0


class _Bench:
    """A served workbench whose page drives a simulated unit."""

    def __init__(self, twins: TwinDevices, server: Served) -> None:
        self.twins, self.server = twins, server
        self.halted = threading.Event()
        feed = twins.unit.feed

        def heard(data: bytes, now_s: float) -> None:
            if b"H" in data:
                self.halted.set()
            feed(data, now_s)

        twins.unit.feed = heard  # type: ignore[method-assign]
        self.page = Page(server)
        with_camera_and_picks(self.page, 0)
        self.plan = self.page.ask("acquire_ports")["example"]
        self.plan["unit"] |= {"port": twins.addresses["flir-ptu"], "speed_deg_s": _SPEED_DEG_S}
        self.plan["scanner"]["port"] = twins.addresses["scip2"]
        self._do("acquire_connect", plan=self.plan)
        self._await_ready()
        self._sign = 1

    def stop_ms(self, meanwhile: Callable[[Page], None]) -> float:
        """Move, have something else done, press Stop, and return the milliseconds until the unit hears of it."""
        self._do("acquire_jog", pan_deg=self._sign * _JOG_DEG, tilt_deg=0)
        self._sign = -self._sign
        while not self.twins.state()["moving"]:
            time.sleep(0.001)
        meanwhile(self.page)
        self.halted.clear()
        begun = time.perf_counter()
        self.page.number += 1
        self.page.socket.send(json.dumps({"id": self.page.number, "do": "acquire_stop"}))
        assert self.halted.wait(_LONGEST_S), "the unit was never halted"
        ms = 1000 * (time.perf_counter() - begun)
        self._await_ready()
        return ms

    def _await_ready(self) -> None:
        self.page.until(lambda slices: slices["acquisition"]["state"] != "connecting")
        self.page.until(lambda slices: slices["acquisition"]["state"] == "ready")

    def _do(self, do: str, **fields: Any) -> None:
        reply = self.page.ask(do, **fields)
        assert reply["ok"], reply


def latency_rows(quick: bool, show: Callable[[str], None]) -> list[Row]:
    """Press Stop while nothing else goes on, and while other things do."""
    count, rows = (_QUICK_STOPS if quick else _STOPS), []
    with TwinDevices("office", 5) as twins, tempfile.TemporaryDirectory() as name:
        at = twins.addresses
        program = ("-m", "benchmarks.acquisition.latency", at["flir-ptu"], at["scip2"])
        with served(Path(name) / "project", program=program) as (server, _):
            bench = _Bench(twins, server)
            crowd = _crowd(bench.plan)
            for what, meanwhile in (("nothing else", _nothing), ("a registration", _register), (_CROWD, crowd)):
                rows.append(_row(what, [bench.stop_ms(meanwhile) for _ in range(count)], show))
            ended = threading.Event()
            others = [threading.Thread(target=_edit, args=(server, ended)) for _ in range(_CLIENTS)]
            for other in others:
                other.start()
            rows.append(
                _row(f"{_CLIENTS} other pages that edit", [bench.stop_ms(_nothing) for _ in range(count)], show)
            )
            ended.set()
            for other in others:
                other.join()
    return rows


def _row(what: str, ms: list[float], show: Callable[[str], None]) -> Row:
    show(f"{what}: " + " ".join(f"{one:.1f}" for one in ms))
    reached = f"{statistics.median(ms):.1f} ms median, {max(ms):.1f} worst of {len(ms)}"
    return Row(f"Stop during {what}", f"<= {_BAR_MS:.0f} ms", reached, max(ms) <= _BAR_MS)


def _nothing(page: Page) -> None:
    pass


def _register(page: Page) -> None:
    page.ask("run", photo="p1", job="auto")
    time.sleep(0.1)


def _crowd(plan: dict[str, Any]) -> Callable[[Page], None]:
    slow = {**plan, "pan_deg": [-150, 150, 0.1], "tilt_deg": [-16, 16, 1]}

    def crowd(page: Page) -> None:
        for _ in range(20):
            page.number += 1
            page.socket.send(json.dumps({"id": page.number, "do": "acquire_check", "plan": slow}))

    return crowd


def _edit(server: Served, ended: threading.Event) -> None:
    import random

    rng, page = random.Random(), Page(server)
    while not ended.is_set():
        ray, uv = random_pick(rng)
        reply = page.ask("add_pick", photo="p1", kind="point", scan=[ray], photo_uv=[uv])
        if reply["ok"]:
            page.ask("remove_picks", photo="p1", picks=[reply["pick"]])
        time.sleep(rng.uniform(0.02, 0.1))
    page.socket.close()


def _serve(ports: list[str], arguments: list[str]) -> int:
    """Serve a workbench that takes the ports of the simulated devices for ports of this machine, which they are."""
    from ladarreg.cli import main

    from ladarreg_core.acquisition import serial_port

    serial_port.port_names = lambda: ports
    return int(main(arguments))


if __name__ == "__main__":
    sys.exit(_serve(sys.argv[1:3], sys.argv[3:]))
