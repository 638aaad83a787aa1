"""The page over a slow link: python -m benchmarks.page.slow_link [--kbit 1500] [--round-trip-ms 150] [--json F].

Registers the embedded sample, then opens the page in Chromium with an empty cache through `ThrottlingProxy`, and
reports when the two pictures, the verdict, the coarse model and everything are there, and what the bytes were spent on.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from ladarreg.gateway.login import session_name_and_path

from benchmarks.page.throttling_proxy import ThrottlingProxy
from testing.workbench.browser import FLAGS, find_chromium
from testing.workbench.served import Page as Socket
from testing.workbench.served import Served

ASKED_S = {"first two pictures": 4.0, "verdict": 6.0, "coarse model": 12.0, "everything": 25.0}
ASKED_MB = 3.5
_QUIET_S, _QUIET_BYTES = 6.0, 4096
"""Quiet: the connections carry no more than this many bytes within this time (websockets are kept alive)."""
_PATIENCE_S = 120.0
_MODEL_INDICES = 5000
"""The least that a draw call of a model has; frusta and matches have fewer."""
_WATCH = f"""
(() => {{
  const seen = (name) => {{
    const stamps = (window.top.stamps ??= {{}});
    stamps[name] ??= Date.now() / 1000;
  }};
  const shown = (element) => element.checkVisibility?.() && element.complete !== false;
  new MutationObserver(() => {{
    for (const side of ["scan", "photo"]) {{
      const picture = document.querySelector(`#${{side}}-pane .pane-body img`);
      if (!picture || picture.watched) continue;
      picture.watched = true;
      const done = () => picture.naturalWidth > 0 && shown(picture) && seen(`${{side}} picture`);
      picture.addEventListener("load", done);
      if (picture.complete) done();
    }}
    if (/accepted/i.test(document.querySelector("#header")?.textContent ?? "")) seen("verdict");
  }}).observe(document, {{ childList: true, subtree: true, characterData: true }});
  const draw = CanvasRenderingContext2D.prototype.drawImage;
  CanvasRenderingContext2D.prototype.drawImage = function (...given) {{
    const pane = this.canvas.matches?.(".pane-body > .pane-picture") && this.canvas.closest("section");
    if (pane) seen(`${{pane.id.split("-")[0]}} picture`);
    return draw.apply(this, given);
  }};
  const get = HTMLCanvasElement.prototype.getContext;
  HTMLCanvasElement.prototype.getContext = function (kind, options) {{
    const gl = get.call(this, kind, options);
    if (kind !== "webgl2" || !gl || gl.watched) return gl;
    gl.watched = true;
    for (const name of ["drawElements", "drawArrays"]) {{
      const draw = gl[name].bind(gl);
      gl[name] = (...given) => {{
        draw(...given);
        const count = name === "drawElements" ? given[1] : given[2];
        if (count >= {_MODEL_INDICES}) {{
          seen("coarse model");
          const stamps = window.top.stamps;
          (stamps.models ??= []).includes(count) || stamps.models.push(count);
        }}
      }};
    }}
    return gl;
  }};
}})();
"""


@contextmanager
def registered_sample(project: Path) -> Iterator[Served]:
    """A workbench on the embedded sample, registered and accepted."""
    surroundings = {**os.environ, "LADARREG_HOME": str(project.parent), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "ladarreg", "demo", "--project", str(project), "--port", "0", "--no-browser"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=surroundings)
    try:
        assert process.stdout is not None
        parts = urlsplit(next(word for word in process.stdout.readline().split() if "://" in word))
        found = Served(process, parts.hostname or "", parts.port or 0, parts.query.removeprefix("token="))
        found.enter()
        page = Socket(found)
        page.until(lambda slices: slices["photos"] and slices["photos"][0]["state"] == "accepted", 180)
        page.until(lambda slices: slices["job"] is None or slices["job"]["state"] not in ("running", "paused"), 60)
        page.socket.close()
        found.get("viser/")
        time.sleep(6)  # the fine model follows the draft
        yield found
    finally:
        process.terminate()
        process.wait(60)


def kind_of(path: str) -> str:
    """Return what the bytes of a request are spent on."""
    address = path.removeprefix("websocket ")
    path = path.removesuffix(address) + session_name_and_path(address.partition("?")[0])[1]
    if path.endswith((".js", ".css", ".svg")):
        return "scripts and styles"
    if path.startswith(("/picture/model/", "websocket /viser")):
        return "model"
    if path.startswith("/picture/"):
        return "pictures"
    if path.startswith("/viser"):
        return "viser's page"
    return "document" if path.startswith("websocket ") else "the page itself"


def visit(found: Served, proxy: ThrottlingProxy) -> tuple[dict[str, Any], float]:
    """Open the page through the proxy; return the times at which things were first seen, and when it began."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=find_chromium(), args=list(FLAGS))
        tab = chromium.new_context(bypass_csp=True, viewport={"width": 1440, "height": 900}).new_page()
        tab.add_init_script(_WATCH)
        begun = time.time()
        tab.goto(f"http://127.0.0.1:{proxy.port}/?token={found.token}", wait_until="commit")
        stamps: dict[str, Any] = {}
        while time.time() < begun + _PATIENCE_S:
            tab.wait_for_timeout(250)
            try:
                stamps = tab.evaluate("window.stamps ?? {}")
            except Exception:  # the page that takes the token is being left
                continue
            if "coarse model" in stamps and proxy.quiet(_QUIET_S, _QUIET_BYTES):
                break
        chromium.close()
    return stamps, begun


def measure(found: Served, *, kbit: float, round_trip_s: float) -> dict[str, Any]:
    """Return times, s, and bytes by kind of one visit with an empty cache."""
    with ThrottlingProxy(found.port, bytes_per_s=kbit * 125, one_way_s=round_trip_s / 2) as proxy:
        stamps, begun = visit(found, proxy)
        spent: dict[str, int] = {}
        for path, count in proxy.downloaded.items():
            spent[kind_of(path)] = spent.get(kind_of(path), 0) + count
        pictures = [stamps.get(f"{side} picture") for side in ("scan", "photo")]
        seen = {
            "first two pictures": max(pictures) if all(pictures) else None,
            "verdict": stamps.get("verdict"),
            "coarse model": stamps.get("coarse model"),
            "everything": proxy.last_busy(_QUIET_BYTES),
        }
        return {
            "seconds": {name: round(at - begun, 1) if at else None for name, at in seen.items()},
            "bytes": dict(sorted(spent.items(), key=lambda item: -item[1])),
            "requests": proxy.requests,
            "uploaded": proxy.uploaded,
            "indices of the models": stamps.get("models", []),
            "each request": [
                {
                    "path": path,
                    "bytes": count,
                    "from": proxy.arrived[path][0] - begun,
                    "to": proxy.arrived[path][1] - begun,
                }
                for path, count in sorted(proxy.downloaded.items(), key=lambda item: -item[1])
            ],
        }


def report(figures: dict[str, Any]) -> None:
    """Print the figures, each with what is asked."""

    def verdict(value: float | None, most: float) -> str:
        return f"required <= {most:g}: {'met' if value is not None and value <= most else 'MISSED'}"

    for name, seconds in figures["seconds"].items():
        shown = "never" if seconds is None else f"{seconds:.1f} s"
        print(f"{name:24} {shown:>10}   {verdict(seconds, ASKED_S[name])}")
    total = sum(figures["bytes"].values()) / 1e6
    print(f"{'downloaded':24} {total:>7.2f} MB   {verdict(total, ASKED_MB)}")
    for name, count in figures["bytes"].items():
        print(f"  {name:22} {count / 1e3:>7.0f} kB")
    print(f"requests: {figures['requests']}, uploaded: {figures['uploaded'] / 1e3:.0f} kB")
    print(f"indices of the models drawn: {figures['indices of the models']}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kbit", type=float, default=1500.0, help="bandwidth of the link each way, kbit/s")
    parser.add_argument("--round-trip-ms", type=float, default=150.0, help="latency of the link, there and back")
    parser.add_argument("--list", action="store_true", help="list every request with its bytes and times")
    parser.add_argument("--json", type=Path, help="write the figures here")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, registered_sample(Path(folder) / "project") as found:
        figures = measure(found, kbit=options.kbit, round_trip_s=options.round_trip_ms / 1e3)
    report(figures)
    if options.list:
        for one in figures["each request"]:
            print(f"{one['bytes']:>9} {one['from']:6.2f} - {one['to']:6.2f} s  {one['path']}")
    load = os.getloadavg()[0]
    print(f"load of the machine during the last minute: {load:.1f}")
    if options.json:
        options.json.write_text(json.dumps(figures | {"load": load}, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
