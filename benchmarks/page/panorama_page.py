"""A panorama of 28 million cells in the page, with ten clients: memory of the server, vertices and waiting times.

Run it as `python -m benchmarks.stations page_28m [--quick]`, or as `python -m benchmarks.page.panorama_page [--columns
N] [--pictures FOLDER]`. The server runs in a process of its own, as a user starts it. Nine clients are document sockets
that ask for what a page asks for, each in another direction; the tenth is the page in Chromium.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from benchmarks.shared.bars import Row
from testing.workbench.browser import FLAGS, find_chromium
from testing.workbench.served import Page, Served

SHAPE = (4000, 7000)
"""Rows and columns of the panorama."""
_QUICK_SHAPE = (1000, 1750)
_CLIENTS = 10
_TURNS = 4
_MAX_MB, _MAX_VERTICES = 2500, 400_000
_PATIENCE_S = 900.0
_PART_PX = 256
_NAIVE_BYTES_PER_VERTEX, _NAIVE_BYTES_PER_FACE = 20, 12  # position and texture place as float32; three indices
_WATCH = """
window.most = { model: 0, scene: 0 };
const look = () => {
  const frame = document.querySelector("iframe.model-frame")?.contentWindow;
  let root = frame?.__viserMutable?.nodeRefFromName?.["/model"];
  const node = root;
  while (root?.parent) root = root.parent;
  const verticesOf = (from) => {
    let sum = 0;
    from?.traverse((each) => {
      if (each.isMesh || each.isPoints) sum += each.geometry?.attributes?.position?.count ?? 0;
    });
    return sum;
  };
  const [model, scene] = [verticesOf(node), verticesOf(root)];
  let blocks = "";
  node?.traverse((each) => { if (each.name === "block") blocks += each.uuid; });
  window.now = { model, scene, blocks };
  window.most.model = Math.max(window.most.model, model);
  window.most.scene = Math.max(window.most.scene, scene);
};
if (window.top === window) setInterval(() => { try { look(); } catch {} }, 100);
"""


def make_panorama(folder: Path, shape: tuple[int, int]) -> None:
    """Write the simulator's office, all around, with a photograph, its camera and the true pose, into a folder."""
    from benchmarks.shared.dome import CAMERA, POSE, SCENE
    from ladarreg_core.formats.cameras.camera_file import write_camera
    from ladarreg_core.formats.parsing.json_file import write_json
    from ladarreg_core.formats.scans.npz import write_npz_panorama
    from ladarreg_core.photo import Photo
    from ladarreg_core.scan import Scan
    from ladarreg_core.scanner.grids import SphericalGrid
    from ladarreg_core.simulate.case import case_world, png_of
    from ladarreg_core.simulate.photograph import Lighting, take_photograph
    from ladarreg_core.simulate.ray_cast import RayCaster
    from ladarreg_core.simulate.terrestrial import scan_around

    world = case_world(SCENE, seed=0)
    caster = RayCaster(world.triangles)
    rows, columns = shape
    top, low = np.radians(89.0), np.radians(-60.0)
    grid = SphericalGrid(rows, columns, 2 * np.pi / columns, (top - low) / (rows - 1), 0.0, top)
    ranges, light = scan_around(world, caster, grid, rng=np.random.default_rng(0))
    write_npz_panorama(folder / "panorama.npz", Scan(grid, ranges, light))
    pixels = take_photograph(
        world, caster, CAMERA, POSE, lighting=Lighting(), rng=np.random.default_rng([0, 1]), noise=1.0
    )
    (folder / "photo.png").write_bytes(png_of(Photo(pixels=pixels, camera=CAMERA, name="photo")))
    write_camera(folder / "camera.json", CAMERA)
    write_json(folder / "truth.json", {"camera_from_scanner": POSE.matrix.tolist()})


@contextmanager
def served_panorama(folder: Path) -> Iterator[tuple[Served, MemoryWatch, float]]:
    """Serve the panorama of a folder; also yield its memory, watched from the start, and when that was."""
    project = Path(tempfile.mkdtemp(prefix="project-", dir=folder))
    command = [
        sys.executable, "-m", "ladarreg", "serve", str(folder / "panorama.npz"), str(folder / "photo.png"),
        "--camera", str(folder / "camera.json"), "--project", str(project), "--port", "0", "--no-browser",
    ]  # fmt: skip
    surroundings = {**os.environ, "LADARREG_HOME": str(folder), "OMP_NUM_THREADS": "1"}
    begun = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=surroundings)
    watch = MemoryWatch(process.pid)
    try:
        assert process.stdout is not None
        words = process.stdout.readline().split()
        address = next((word for word in words if "://" in word), None)
        if address is None:
            raise SystemExit("the server did not start")
        parts = urlsplit(address)
        found = Served(process, parts.hostname or "", parts.port or 0, parts.query.removeprefix("token="))
        found.enter()
        yield found, watch, begun
    finally:
        watch.close()
        process.terminate()
        process.wait(120)


class MemoryWatch:
    """The memory of a process and of its children, watched in a thread.

    Args:
        pid: of the process.
    """

    def __init__(self, pid: int) -> None:
        self._pid, self._ends = pid, threading.Event()
        self.own = self.children = self.together = 0
        self.most_at = ""
        self.stage = "start"
        self.by_stage: dict[str, float] = {}
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End."""
        self._ends.set()
        self._thread.join()

    def _watch(self) -> None:
        while not self._ends.wait(0.05):
            mine = _status_bytes(self._pid, "VmRSS")
            theirs = sum(_status_bytes(pid, "VmRSS") for pid in _descendants(self._pid))
            self.own = max(self.own, _status_bytes(self._pid, "VmHWM"))
            self.children = max(self.children, theirs)
            self.together = max(self.together, mine + theirs)
            self.by_stage[self.stage] = max(self.by_stage.get(self.stage, 0), round((mine + theirs) / 1e6))


def _status_bytes(pid: int, name: str) -> int:
    try:
        for line in Path(f"/proc/{pid}/status").read_text(encoding="ascii", errors="replace").splitlines():
            if line.startswith(f"{name}:"):
                return 1024 * int(line.split()[1])
    except OSError:
        pass  # it has ended
    return 0


def _descendants(pid: int) -> list[int]:
    found, waiting = [], [pid]
    while waiting:
        one = waiting.pop()
        try:
            tasks = list(Path(f"/proc/{one}/task").glob("*/children"))
        except OSError:  # it has ended
            continue
        for task in tasks:
            try:
                children = [int(word) for word in task.read_text().split()]
            except OSError:
                continue
            found += children
            waiting += children
    return found


class Looker:
    """A client that asks for what a page asks for, in a direction of its own.

    Args:
        served: the server.
        number: which of the clients it is.
    """

    def __init__(self, served: Served, number: int) -> None:
        self._served, self._number = served, number
        self.page = Page(served)
        self.errors: list[str] = []
        self.waited_s: list[float] = []
        self.seen_at: list[float] = []

    def get(self, path: str) -> bytes:
        """Request a picture or a part of the model; note a failure."""
        begun = time.perf_counter()
        try:
            status, body, _ = self._served.get(path)
        except OSError as error:
            self.errors.append(f"{path}: {error}")
            return b""
        self.waited_s.append(time.perf_counter() - begun)
        if status != 200:
            self.errors.append(f"{path}: {status} {body[:80].decode(errors='replace')}")
        return body

    def arrive(self) -> None:
        """Load what a page loads first."""
        scan = self.page.slices["scan"]
        self.get(f"{self._view(self._number % len(scan['views']))}&form=quick")
        self.seen_at.append(time.perf_counter())
        self.get(f"picture/model/mesh?detail=coarse&rev={scan['id']}")
        self.get(f"picture/model/texture?photo=none&kind=intensity&detail=coarse&rev={scan['id']}")
        self.seen_at.append(time.perf_counter())
        self.get(f"picture/strip?rev={scan['id']}")
        for detail in ("coarse", "standard"):
            self.get(f"picture/model/mesh?detail={detail}&rev={scan['id']}")
            self.get(f"picture/model/texture?photo=none&kind=intensity&detail={detail}&rev={scan['id']}")

    def look_around(self) -> None:
        """Turn to other views, at other contrasts, and zoom in: parts of the picture at full and at half resolution."""
        rng = np.random.default_rng(self._number)
        views = self.page.slices["scan"]["views"]
        for turn in range(_TURNS):
            k = (self._number + turn) % len(views)
            show = ("intensity", "range", "intensity", "edges")[(self._number + turn) % 4]
            address = self._view(k, show, gamma=(0.6, 0.8)[self._number % 2])
            self.get(f"{address}&form=quick")
            block = f"{rng.integers(2, 6)}"
            place = ".".join(str(rng.integers(2 ** int(block))) for _ in range(2))
            self.get(f"picture/model/mesh?block={block}.{place}&rev={self.page.slices['scan']['id']}")
            for level in (1, 0):
                across, down = (max(1, (views[k][name] >> level) // _PART_PX) for name in ("width", "height"))
                for _ in range(6):
                    self.get(f"{address}&part={level}.{rng.integers(across)}.{rng.integers(down)}")

    def see_model(self, photo: str) -> None:
        """Load the model with the photograph, as accepted."""
        model = self.page.slices["model"]
        for detail in ("standard", "dense") if self._number % 3 == 0 else ("standard",):
            kind = ("colour", "label", "resolution")[self._number % 3]
            rest = f"detail={detail}&rev={model['rev']}"
            self.get(f"picture/model/mesh?detail={detail}&rev={self.page.slices['scan']['id']}")
            self.get(f"picture/model/texture?photo={photo}&kind={kind}&z_buffer=1&{rest}")
            self.get(f"picture/model/layer?photo={photo}&{rest}")
            self.get(f"picture/model/photo?photo={photo}&{rest}")
        self.get(f"picture/overlay/{photo}?show=intensity&rev=1&form=quick")
        self.get(f"picture/registered/{photo}?view={self._number % len(self.page.slices['scan']['views'])}&form=quick")

    def _view(self, view: int, show: str = "intensity", gamma: float = 0.6) -> str:
        rev = self.page.slices["scan"]["id"]
        return f"picture/scan?view={view}&show={show}&low=1&high=99.5&equalise=0&gamma={gamma}&rev={rev}"


class RealPage:
    """The page in Chromium, which is looked at and turned.

    Args:
        served: the server.
        shots: folder for screenshots; None: none are kept.
    """

    def __init__(self, served: Served, shots: Path | None) -> None:
        from playwright.sync_api import sync_playwright

        self._playwright = sync_playwright().start()
        self._chromium = self._playwright.chromium.launch(executable_path=find_chromium(), args=list(FLAGS))
        # The driver evaluates scripts, which the page's policy forbids.
        self._tab = self._chromium.new_context(bypass_csp=True, viewport={"width": 1600, "height": 900}).new_page()
        self.errors: list[str] = []
        self._tab.on("pageerror", lambda error: self.errors.append(str(error)))
        self._tab.on("console", lambda told: self.errors.append(told.text) if told.type == "error" else None)
        self._tab.add_init_script(_WATCH)
        self._shots = shots
        self._begun = time.perf_counter()
        self._tab.goto(f"{served.address}?token={served.token}", wait_until="commit")

    def close(self) -> None:
        """Close the browser."""
        self._chromium.close()
        self._playwright.stop()

    def arrives(self) -> dict[str, float]:
        """Return the seconds until the scan's picture and the coarse model are drawn."""
        found = {}
        self._tab.locator("#scan-pane .pane-picture").first.wait_for(state="attached", timeout=1e3 * _PATIENCE_S)
        found["page_first_picture_s"] = time.perf_counter() - self._begun
        self._until("window.now?.model > 1000")
        found["page_coarse_model_s"] = time.perf_counter() - self._begun
        self.shoot("start")
        return found

    def looks(self, viewpoint: str, name: str) -> float:
        """Take a viewpoint, turn, and return the seconds until finer parts are drawn."""
        self._tab.get_by_role("group", name="Viewpoint").get_by_role("button", name=viewpoint).click()
        self._until("window.now.blocks", 120)
        before = self._tab.evaluate("window.now.blocks")
        box = self._tab.locator("iframe.model-frame").bounding_box()
        assert box is not None
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        self._tab.mouse.move(x, y)
        self._tab.mouse.down()
        for k in range(12):
            self._tab.mouse.move(x + 6 * k, y + 2 * k)
        self._tab.mouse.up()
        begun = time.perf_counter()
        self._until(f"window.now.blocks && window.now.blocks !== {before!r}", 120)
        taken = time.perf_counter() - begun
        self._tab.wait_for_timeout(3000)
        self.shoot(name)
        return taken

    def zooms(self) -> None:
        """Zoom in on what is in the middle."""
        box = self._tab.locator("iframe.model-frame").bounding_box()
        assert box is not None
        self._tab.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        for _ in range(12):
            self._tab.mouse.wheel(0, -240)
            self._tab.wait_for_timeout(100)
        self._tab.wait_for_timeout(6000)
        self.shoot("zoomed")

    def textured(self) -> None:
        """Wait for the photograph on the model, in dense detail."""
        self._tab.get_by_role("group", name="Viewpoint").get_by_role("button", name="Camera").click()
        self._tab.wait_for_timeout(15_000)
        self.shoot("textured")
        self._tab.get_by_role("button", name="Display").click()
        self._tab.get_by_label("Detail").select_option("dense")
        self._tab.keyboard.press("Escape")
        self._tab.wait_for_timeout(20_000)
        self.shoot("dense")

    def most(self) -> dict[str, int]:
        """Return the largest numbers of vertices that were held at once: of the model, and in the scene altogether."""
        found: dict[str, int] = self._tab.evaluate("window.most")
        return found

    def shoot(self, name: str) -> None:
        """Keep a screenshot."""
        if self._shots is not None:
            self._shots.mkdir(parents=True, exist_ok=True)
            self._tab.screenshot(path=self._shots / f"{name}.png")

    def _until(self, true: str, seconds: float = _PATIENCE_S) -> None:
        self._tab.wait_for_function(f"() => {true}", timeout=1e3 * seconds)


def measure(folder: Path, show: Callable[[str], None], *, shots: Path | None = None) -> dict[str, Any]:
    """Return the figures of ten clients on the panorama of a folder.

    Args:
        folder: what `make_panorama` wrote.
        show: receives a line at each stage.
        shots: folder for screenshots of the page.
    """
    figures: dict[str, Any] = {}
    with served_panorama(folder) as (found, watch, begun):

        def stage(name: str) -> None:
            watch.stage = name
            show(json.dumps({"stage": name, "s": round(time.perf_counter() - begun, 1), "most_mb": watch.by_stage}))

        stage("first")
        first = Looker(found, 0)
        first.arrive()
        figures["first_picture_s"], figures["coarse_model_s"] = (at - begun for at in first.seen_at)
        real = RealPage(found, shots) if find_chromium() else None
        try:
            if real is not None:
                figures |= real.arrives()
                figures["finer_s"] = real.looks("Scanner", "turned")
                real.zooms()
            lookers = [first, *(Looker(found, number) for number in range(1, _CLIENTS - (real is not None)))]
            stage("arrive")
            _at_once(lookers[1:], Looker.arrive)
            stage("look around")
            _at_once(lookers, Looker.look_around)
            stage("register")
            photo = first.page.slices["photos"][0]["id"]
            reply = first.page.ask("run", photo=photo, job="auto")
            if not reply["ok"]:
                raise SystemExit(f"it cannot be registered: {reply}")
            first.page.until(
                lambda slices: slices["job"] and slices["job"]["state"] in ("done", "failed", "stopped"), _PATIENCE_S
            )
            figures["photograph"] = first.page.slices["photos"][0]["state"]
            for looker in lookers:
                looker.page.until(lambda slices: slices["model"]["accepted"], 60)
            for uv in ([400, 500], [1200, 800], [2000, 1100]):
                first.page.ask("predict", photo=photo, side="photo", photo_uv=[uv])
            stage("textured")
            _at_once(lookers, lambda looker: looker.see_model(photo))
            if real is not None:
                real.textured()
            stage("look around, textured")
            _at_once(lookers, Looker.look_around)
            stage("end")
            waited = [seconds for each in lookers for seconds in each.waited_s]
            figures["answer_s"] = {"median": float(np.median(waited)), "slowest": max(waited)}
            figures["errors"] = [error for each in lookers for error in each.errors]
            if real is not None:
                figures["vertices"] = real.most()
                figures["errors"] += real.errors
            time.sleep(3)
            figures["at_rest_mb"] = _status_bytes(found.process.pid, "VmRSS") / 1e6
            for looker in lookers:
                looker.page.socket.close()
        finally:
            if real is not None:
                real.close()
        figures |= {
            "server_mb": watch.own / 1e6, "children_mb": watch.children / 1e6, "together_mb": watch.together / 1e6,
            "by_stage_mb": watch.by_stage,
        }  # fmt: skip
    return figures


def naive_bytes(folder: Path) -> float:
    """Return what the whole mesh and its texture would weigh in a browser, bytes: what tiles and levels replace."""
    from ladarreg_core.formats import read_scan

    returns = int(read_scan(folder / "panorama.npz").valid.sum())
    # Nearly every cell is a vertex with a place and two triangles; the texture has a byte a channel.
    return returns * (_NAIVE_BYTES_PER_VERTEX + 2 * _NAIVE_BYTES_PER_FACE + 4)


def page_rows(quick: bool, show: Callable[[str], None]) -> list[Row]:
    """Measure ten clients on a panorama of 28 million cells, with `quick` on one of 1.75 million."""
    with tempfile.TemporaryDirectory() as aside:
        folder, shape = Path(aside), _QUICK_SHAPE if quick else SHAPE
        make_panorama(folder, shape)
        naive = naive_bytes(folder)
        figures = measure(folder, show)
    show(json.dumps(figures))
    size, most = f"{shape[0] * shape[1] / 1e6:.1f} M cells", figures["together_mb"]
    rows = [
        Row(f"{size}, ten clients: server and its readers, peak", "<= 2500 MB", f"{most:.0f} MB", most <= _MAX_MB),
        Row("the server alone; at rest", "reported",
            f"{figures['server_mb']:.0f}; {figures['at_rest_mb']:.0f} MB", True),
        Row("from the start to the first picture; the coarse model", "reported",
            f"{figures['first_picture_s']:.1f}; {figures['coarse_model_s']:.1f} s", True),
        Row("answers: median; slowest", "reported",
            f"{figures['answer_s']['median']:.2f}; {figures['answer_s']['slowest']:.1f} s", True),
        Row("the photograph", "accepted", figures["photograph"], figures["photograph"] == "accepted"),
        Row("errors", "0", str(len(figures["errors"])), not figures["errors"]),
        Row("control: the whole mesh with its texture, for each page", "> 400000 vertices",
            f"{shape[0] * shape[1] / 1e6:.1f} M vertices, {naive / 1e6:.0f} MB", shape[0] * shape[1] > _MAX_VERTICES),
    ]  # fmt: skip
    if "vertices" in figures:
        held = figures["vertices"]["model"]
        rows[1:1] = [
            Row("vertices that the page in Chromium holds at once", "<= 400000", str(held), held <= _MAX_VERTICES),
            Row("from turning to the finer parts, in Chromium", "reported", f"{figures['finer_s']:.1f} s", True),
        ]
    return rows


def _at_once(lookers: list[Looker], act: Callable[[Looker], None]) -> None:
    threads = [threading.Thread(target=act, args=(looker,)) for looker in lookers]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


def main() -> None:
    """Measure, and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, help="keep the panorama here, and use one that is there")
    parser.add_argument("--pictures", type=Path, help="keep screenshots of the page here")
    parser.add_argument("--columns", type=int, default=SHAPE[1])
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as aside:
        folder = given.folder or Path(aside)
        if not (folder / "truth.json").exists():
            folder.mkdir(parents=True, exist_ok=True)
            make_panorama(folder, (round(given.columns * SHAPE[0] / SHAPE[1]), given.columns))
        print(json.dumps(measure(folder, lambda text: print(text, flush=True), shots=given.pictures), indent=1))


if __name__ == "__main__":
    main()
