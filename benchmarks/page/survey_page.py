"""A large survey in the page: python -m benchmarks.page.survey_page [--stations N] [--cells N] [--photos N] [--json F].

Simulates stations and photographs (`survey_project`), 10 of 10 million cells and 80 of 12 megapixels by default, makes
a project of them as an adjustment leaves it, and serves it in a process of its own. Measured are the server's memory
while photographs beside all stations are looked at, the page's times, what its 3-D view draws, its memory, the same
over a link of 1.5 Mbit/s (Chromium's own emulation), and the edits of ten clients. With `--folder` files and project
are kept and used again.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np

from benchmarks.page.panorama_page import MemoryWatch
from benchmarks.page.survey_project import make_files, make_project
from benchmarks.shared.bars import Row, table
from testing.workbench.browser import CHEAP, FLAGS, find_chromium
from testing.workbench.served import Page, Served, random_pick

_BARS: dict[str, tuple[str, float]] = {
    "first picture": ("s", 1.5),
    "list": ("s", 0.2),
    "memory of the server": ("MB", 2500),
    "memory of the page": ("MB", 600),
    "vertices": ("", 400_000),
    "draw calls": ("", 120),
    "textures": ("MB", 64),
    "useful at 1.5 Mbit/s": ("s", 5.0),
    "thumbnails": ("kB", 400),
    "edits of ten clients, p99": ("ms", 50),
}
"""What is asked for, at most."""
_BYTES_PER_S, _LATENCY_MS = 187_500, 75
_CLIENTS, _EDITS = 10, 60
_PATIENCE_MS = 240_000
_WATCH = """
(() => {
  const top = window.top;
  const now = () => performance.timeOrigin + performance.now();
  const stamps = (top.stamps ??= {});
  const draw = CanvasRenderingContext2D.prototype.drawImage;
  const seen = (element) => {
    const pane = element.closest?.("#scan-pane, #photo-pane");
    if (pane) stamps[pane.id] ??= now();
  };
  CanvasRenderingContext2D.prototype.drawImage = function (...given) {
    if (this.canvas.matches?.(".pane-picture")) seen(this.canvas);
    return draw.apply(this, given);
  };
  // Not on the window: such events do not reach it.
  document.addEventListener("load", ({ target }) => target.matches?.(".pane-body img") && seen(target), true);
  const gl = WebGL2RenderingContext.prototype;
  const drawn = (top.drawn ??= { textures: new Map(), calls: 0, most: 0 });
  // A frame of the 3-D view is what is drawn between two callbacks of this kind in its window.
  const frame = () => {
    if (window !== top) [drawn.most, drawn.calls] = [Math.max(drawn.most, drawn.calls), 0];
    requestAnimationFrame(frame);
  };
  requestAnimationFrame(frame);
  const names = ["drawArrays", "drawElements", "drawRangeElements", "drawArraysInstanced", "drawElementsInstanced"];
  for (const name of names) {
    const draw = gl[name];
    gl[name] = function (...given) { drawn.calls++; return draw.apply(this, given); };
  }
  const bytes = { [gl.R8]: 1, [gl.RG8]: 2, [gl.R16F]: 2, [gl.RGBA16F]: 8, [gl.R32F]: 4, [gl.RGBA32F]: 16 };
  const bind = gl.bindTexture, remove = gl.deleteTexture, image = gl.texImage2D, storage = gl.texStorage2D;
  const keep = (context, format, width, height, factor) =>
    context.bound && drawn.textures.set(context.bound, (bytes[format] ?? 4) * width * height * factor);
  gl.bindTexture = function (target, texture) { this.bound = texture; return bind.call(this, target, texture); };
  gl.deleteTexture = function (texture) { drawn.textures.delete(texture); return remove.call(this, texture); };
  gl.texStorage2D = function (target, levels, format, width, height) {
    keep(this, format, width, height, levels > 1 ? 4 / 3 : 1);
    return storage.apply(this, arguments);
  };
  gl.texImage2D = function (...given) {
    const [width, height] = given.length > 6 ? given.slice(3, 5) : [given[5].width, given[5].height];
    if (given[1] === 0) keep(this, given[2], width, height, 4 / 3);
    return image.apply(this, given);
  };
})();
"""
_VERTICES = """
() => {
  let root = document.querySelector("iframe.model-frame")?.contentWindow?.__viserMutable?.nodeRefFromName?.["/model"];
  while (root?.parent) root = root.parent;
  let sum = 0;
  root?.traverseVisible((each) => {
    if (each.isMesh || each.isPoints || each.isLine) {
      sum += (each.geometry?.attributes?.position?.count ?? 0) * (each.count ?? 1);
    }
  });
  return sum;
}
"""
_CAMERAS = """
() => Object.keys(document.querySelector("iframe.model-frame")?.contentWindow?.__viserMutable?.nodeRefFromName ?? {})
  .filter((name) => name.startsWith("/cameras/")).length
"""
_OPEN_LIST = """
async () => {
  const begun = performance.now();
  document.querySelector(".photo-button").click();
  const entries = () => document.querySelectorAll(".photo-entry").length;
  while (!entries()) await new Promise(requestAnimationFrame);
  await new Promise(requestAnimationFrame);
  return [(performance.now() - begun) / 1000, entries()];
}
"""


@contextmanager
def served_project(project: Path) -> Iterator[tuple[Served, MemoryWatch]]:
    """Serve a project in a process of its own; also yield its memory, watched from the start."""
    command = [sys.executable, "-m", "ladarreg", "serve", "--project", str(project), "--port", "0", "--no-browser"]
    home = project.parent / "home"
    surroundings = {**os.environ, "LADARREG_HOME": str(home), "XDG_CACHE_HOME": str(home), "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=surroundings)
    watch = MemoryWatch(process.pid)
    try:
        assert process.stdout is not None
        address = next((word for word in process.stdout.readline().split() if "://" in word), "")
        parts = urlsplit(address)
        found = Served(process, parts.hostname or "", parts.port or 0, parts.query.removeprefix("token="))
        found.enter()
        yield found, watch
    finally:
        watch.close()
        process.terminate()
        process.wait(120)


class Tab:
    """The page in Chromium.

    Args:
        served: the server.
        slow: whether the link is slow.
        emulates: whether an emulated graphics card draws the whole page, as no browser does by itself: whatever waits
            for it then takes seconds, the first painting of the list for one. Without, it draws the 3-D view alone.
    """

    def __init__(self, served: Served, *, slow: bool = False, emulates: bool = False) -> None:
        from playwright.sync_api import sync_playwright

        self._playwright = sync_playwright().start()
        flags = FLAGS if emulates else (*FLAGS, *CHEAP)
        self._chromium = self._playwright.chromium.launch(executable_path=find_chromium(), args=list(flags))
        # The driver evaluates scripts, which the page's policy forbids.
        context = self._chromium.new_context(bypass_csp=True, viewport={"width": 1440, "height": 900})
        self.page = context.new_page()
        self.page.set_default_timeout(_PATIENCE_MS)
        self.page.add_init_script(_WATCH)
        session = context.new_cdp_session(self.page)
        session.send("Network.enable")
        self.received: dict[str, int] = {}
        paths: dict[str, str] = {}
        session.on("Network.requestWillBeSent", lambda told: paths.update({told["requestId"]: told["request"]["url"]}))
        session.on(
            "Network.loadingFinished",
            lambda told: self.received.update({paths.get(told["requestId"], ""): int(told["encodedDataLength"])}),
        )
        if slow:
            limits = {"offline": False, "latency": 2 * _LATENCY_MS}
            limits |= {"downloadThroughput": _BYTES_PER_S, "uploadThroughput": _BYTES_PER_S}
            session.send("Network.emulateNetworkConditions", limits)
        self._begun = time.time()
        self.page.goto(f"{served.address}?token={served.token}", wait_until="commit")

    def close(self) -> None:
        """Close the browser."""
        self._chromium.close()
        self._playwright.stop()

    def first_pictures_s(self) -> float:
        """Return when both panes showed a picture: as the page requests it before its scripts, or drawn by them."""
        self.page.wait_for_function("window.stamps?.['scan-pane'] && window.stamps['photo-pane']")
        return float(self.page.evaluate("Math.max(stamps['scan-pane'], stamps['photo-pane']) / 1000")) - self._begun

    def opens_list(self, count: int) -> float:
        """Return the time until the list of photographs is open, s."""
        self.page.wait_for_function("document.querySelector('.photo-button')?.textContent.includes('photo-')")
        seconds, entries = self.page.evaluate(_OPEN_LIST)
        assert entries == count, f"{entries} of {count} photographs are listed"
        return float(seconds)

    def scrolls_list(self, count: int) -> int:
        """Look at all thumbnails, close the list, and return their bytes."""

        def thumbnails() -> dict[str, int]:
            return {url: size for url, size in self.received.items() if "form=small" in url}

        for number in range(count):  # entries are made again while the server reads the photographs
            entry = f"document.querySelectorAll('.photo-entry')[{number}]"
            self.page.evaluate(f"{entry}?.scrollIntoView()")
            self.page.wait_for_function(f"{entry}?.querySelector('img')?.naturalWidth > 0")
        end = time.monotonic() + _PATIENCE_MS / 1e3
        while len(thumbnails()) < count and time.monotonic() < end:
            self.page.wait_for_timeout(200)
        assert len(thumbnails()) == count, f"{len(thumbnails())} thumbnails"
        self.page.keyboard.press("Escape")
        return sum(thumbnails().values())

    def _request(self, command: str, fields: dict[str, str]) -> None:
        module = "import('./js/net/requests.js').then(({ request }) => request(command, fields))"
        self.page.evaluate(f"([command, fields]) => {module}", [command, fields])

    def shows(self, photo: str) -> float:
        """Choose a photograph, and return the seconds until the scan beside it is drawn."""
        self.page.evaluate("delete window.stamps['scan-pane']; delete window.stamps['photo-pane']")
        begun = time.time()
        self._request("show_photo", {"photo": photo})
        self.page.wait_for_function("window.stamps?.['scan-pane'] && window.stamps['photo-pane']")
        return float(self.page.evaluate("Math.max(stamps['scan-pane'], stamps['photo-pane']) / 1000")) - begun

    def drawn(self, count: int) -> dict[str, float]:
        """Wait for the 3-D view with the cameras of so many photographs, look at all, and return what it draws."""
        self.page.wait_for_function(f"({_VERTICES})() > 20000 && ({_CAMERAS})() > {min(count, 2) - 2}")
        self.page.wait_for_timeout(15_000)  # finer parts follow
        self._request("look", {"viewpoint": "overview"})
        self.page.evaluate("drawn.most = 0")
        box = self.page.locator("iframe.model-frame").bounding_box()
        assert box is not None
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        self.page.mouse.move(x, y)
        self.page.mouse.down()
        for step in range(1, 5):  # it draws only what changes
            self.page.mouse.move(x + 10 * step, y)
            self.page.wait_for_timeout(1000)
        self.page.mouse.up()
        self.page.wait_for_function("drawn.most > 0")
        textures = self.page.evaluate("[...drawn.textures.values()].reduce((a, b) => a + b, 0)")
        return {
            "vertices": self.page.evaluate(f"({_VERTICES})()"),
            "draw calls": self.page.evaluate("drawn.most"),
            "textures": textures / 1e6,
        }

    @staticmethod
    def memory_mb() -> float:
        """Return the proportional memory of the largest page process."""
        found = [0.0]
        for process in Path("/proc").glob("[0-9]*"):
            try:
                if b"--type=renderer" in (process / "cmdline").read_bytes():
                    lines = (process / "smaps_rollup").read_text().splitlines()
                    found.append(next(int(line.split()[1]) for line in lines if line.startswith("Pss:")) / 1024)
            except (OSError, StopIteration):
                continue  # it has ended
        return max(found)


def edits_ms(served: Served, photos: list[str]) -> list[float]:
    """Let ten clients draw and move matches, each in a photograph of its own, and return how long each edit took."""
    taken: list[float] = []

    def work(number: int) -> None:
        rng = np.random.default_rng(number)
        page = Page(served)
        photo = photos[number % len(photos)]
        page.ask("show_photo", photo=photo)
        ray, uv = random_pick(_Random(rng))
        pick = page.ask("add_pick", photo=photo, kind="point", scan=[ray], photo_uv=[uv])["pick"]
        for _ in range(_EDITS):
            time.sleep(rng.uniform(0.3, 1.0))
            begun = time.perf_counter()
            page.ask("set_pick", photo=photo, pick=pick, photo_uv=[random_pick(_Random(rng))[1]])
            taken.append(1e3 * (time.perf_counter() - begun))
        page.socket.close()

    workers = [threading.Thread(target=work, args=(number,)) for number in range(_CLIENTS)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    return taken


class _Random:
    """`random_pick` with NumPy's generator."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.uniform = rng.uniform


def measure(project: Path, *, photos: int, stations: int) -> dict[str, float]:
    """Return the figures of `_BARS`, and others, of a project."""
    ids = [f"p{number}" for number in range(1, photos + 1)]
    figures: dict[str, float] = {}
    shutil.rmtree(project.parent / "home", ignore_errors=True)  # opened for the first time
    begun = time.perf_counter()
    with served_project(project) as (found, watch):
        figures["server is up, s"] = time.perf_counter() - begun
        first = Page(found)
        first.ask("show_photo", photo=ids[0])
        figures["first page is served, s"] = time.perf_counter() - begun
        tab = Tab(found, emulates=True)
        figures["first picture, of a server that has just begun, s"] = tab.first_pictures_s()
        tab.opens_list(photos)
        figures["thumbnails"] = tab.scrolls_list(photos) / 1e3
        watch.stage = "3-D"
        figures |= tab.drawn(photos)
        watch.stage = "stations"
        tour = [tab.shows(name) for name in ids[1 : stations + 1]]
        figures["another station's scan, median, s"], figures["worst, s"] = float(np.median(tour)), max(tour)
        figures["memory of the page"] = tab.memory_mb()
        tab.close()
        watch.stage = "later"
        for name, slow in (("first picture", False), ("useful at 1.5 Mbit/s", True)):
            tab = Tab(found, slow=slow)
            figures[name] = tab.first_pictures_s()
            seconds = tab.opens_list(photos)
            if not slow:
                figures["list"] = seconds
            else:
                figures[name] = max(figures[name], time.time() - tab._begun)
                figures["its requests"], figures["its kB"] = len(tab.received), sum(tab.received.values()) / 1e3
            tab.close()
        watch.stage = "edits"
        taken = edits_ms(found, ids)
        figures["edits of ten clients, median, ms"] = float(np.median(taken))
        figures["edits of ten clients, p99"] = float(np.percentile(taken, 99))
        first.socket.close()
        figures["memory of the server"] = watch.own / 1e6
        figures["with its readers, MB"] = watch.together / 1e6
        for stage, megabytes in watch.by_stage.items():
            figures[f"memory, {stage}, MB"] = megabytes
    return figures


def rows_of(figures: dict[str, float]) -> list[Row]:
    """Return the figures as rows of a table."""
    rows = []
    for name, value in figures.items():
        unit, most = _BARS.get(name, ("", float("inf")))
        bar = f"<= {most:,g} {unit}".strip() if name in _BARS else ""
        rows.append(Row(name, bar, f"{value:,.2f} {unit}".strip(), value <= most))
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--stations", type=int, default=10)
    parser.add_argument("--cells", type=float, default=1e7, help="of each scan")
    parser.add_argument("--photos", type=int, default=80)
    parser.add_argument("--width", type=int, default=4000, help="of the photographs, px; 4 : 3")
    parser.add_argument("--folder", type=Path, help="keeps the files, and uses those that are there")
    parser.add_argument("--json", type=Path, help="write the figures here")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.folder or Path(temporary)
        if not (folder / "poses.npz").exists():
            folder.mkdir(exist_ok=True)
            size = options.width, 3 * options.width // 4
            make_files(folder, stations=options.stations, cells=options.cells, photos=options.photos, size=size)
        if not (folder / "project").exists():
            make_project(folder, folder / "project")
        figures = measure(folder / "project", photos=options.photos, stations=options.stations)
    figures["load of the machine"] = os.getloadavg()[0]
    print(table(rows_of(figures)))
    if options.json:
        options.json.write_text(json.dumps(figures, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
