"""Makes the pictures of the tutorial: python -m tests.e2e.tutorial_pictures [FOLDER], by default docs/pictures.

With --potree, the picture of an export for Potree alone.

Does what docs/tutorial.md and docs/manual.md describe, on the simulated pair that they name, and keeps what is seen.
"""

from __future__ import annotations

import io
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image
from playwright.sync_api import sync_playwright

import ladarreg_core as lr
from benchmarks.newcomer import Hands, empty_workbench, newcomer
from ladarreg_core.export.registered_scan import RegisteredPhoto, RegisteredScan
from ladarreg_core.export.targets.pipeline import export_to
from ladarreg_core.photo import Photo
from ladarreg_core.simulate.sample import sample_folder
from testing.files.web_folder import published
from testing.scenes.small_registration import sample_registration
from testing.scenes.spiked_scan import spiked_sample
from testing.scenes.survey_set import simulate_survey
from testing.workbench.browser import FLAGS, find_chromium
from testing.workbench.operator import drop
from testing.workbench.served import Page as Socket

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

WINDOW = {"width": 1440, "height": 900}
SCENE = ("simulate", "office", "--seed", "4", "-o")
_COLORS = 256
_POTREE = "--potree"
CHECKOUT = Path(__file__).resolve().parents[2]
_NO_HINT = "localStorage.setItem('ladarreg-software-drawing', 'dismissed')"
_MEASURED = (
    (("photo", 0.62, 0.32), ("photo", 0.82, 0.62)),
    (("scan", 0.62, 0.22), ("photo", 0.93, 0.45)),
)
"""Sides and places in their panes, parts of width and height."""
_MANUAL = {"3-drawn": "drawn", "4-accepted": "solved"}


def main() -> None:
    words = [word for word in sys.argv[1:] if word != _POTREE]
    target = Path(words[0]) if words else CHECKOUT / "docs" / "pictures"
    target.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as driver:
        chromium = driver.chromium.launch(executable_path=find_chromium(), args=list(FLAGS))
        if _POTREE not in sys.argv:
            _tutorial(Path(folder), chromium, target)
            _manual(Path(folder), chromium, target)
            _smoothing(Path(folder), chromium, target)
        _potree(Path(folder), chromium, target)
        chromium.close()


def _tutorial(folder: Path, chromium: Browser, target: Path) -> None:
    pair = folder / "tutorial"
    subprocess.run([sys.executable, "-m", "ladarreg", *SCENE, str(pair)], check=True, stdout=subprocess.DEVNULL)
    with _page(folder / "first", chromium) as page:
        names = ("scan.npz", "photo.png", "camera.json")
        drop(page, "#photo-pane", {name: (pair / name).read_bytes() for name in names})
        page.locator("#model-pane [data-model=drawn]").wait_for(timeout=120_000)
        page.wait_for_timeout(3000)
        _keep(page, target / "opened.png")
        page.get_by_role("button", name="Register automatically").click()
        page.get_by_text("Accepted:").first.wait_for(timeout=120_000)
        page.wait_for_timeout(6000)
        _keep(page, target / "accepted.png")
        page.get_by_role("tab", name=re.compile("Judge")).click()
        page.get_by_label("Overlay of the scan on the photograph").select_option("edges")
        page.get_by_role("button", name="Camera", exact=True).click()
        page.get_by_label("Texture of the model").select_option("uncertainty")
        page.wait_for_timeout(4000)
        _keep(page, target / "judged.png")
        _measure(page, target)
        _blend(page, target)
        page.get_by_role("tab", name=re.compile("Export")).click()
        page.locator(".target-list li").first.wait_for()
        _keep(page, target / "exports.png")
    results = folder / "results"
    scan = lr.read_scan(pair / "scan.npz")
    photo = lr.read_photo(pair / "photo.png", camera=pair / "camera.json")
    from ladarreg_core.export.targets.folder import export_registration

    export_registration(results, lr.register(scan, photo), scan, photo)
    page = chromium.new_page(viewport={"width": 1100, "height": 900})
    page.goto((results / "report.html").as_uri())
    page.wait_for_timeout(1000)
    _keep(page, target / "report.png")
    page.close()


def _measure(page: Page, target: Path) -> None:
    """Measure two distances, one of them from the scan to the photograph."""
    page.get_by_label("Overlay of the scan on the photograph").select_option("none")
    page.get_by_label("Texture of the model").select_option("colour")
    page.keyboard.press("d")
    page.keyboard.press("x")
    for count, places in enumerate(_MEASURED, start=1):
        for side, x, y in places:
            body = page.locator(f"#{side}-pane .pane-body").bounding_box()
            assert body is not None
            page.mouse.click(body["x"] + x * body["width"], body["y"] + y * body["height"])
        page.locator(f".measurement:nth-child({count}) .measurement-value", has_text="±").wait_for()
    page.get_by_role("heading", name="Measurements").hover()
    page.wait_for_timeout(4000)
    _keep(page, target / "measuring.png")
    page.keyboard.press("x")
    page.keyboard.press("v")
    for _ in _MEASURED:
        page.keyboard.press("Control+z")


def _blend(page: Page, target: Path) -> None:
    """Look at the photograph and its uncertainty on one surface, half and half."""
    page.locator("#model-pane").get_by_role("button", name="Maximise").click()
    page.keyboard.press("m")  # without matches
    display = page.locator("#model-pane").get_by_role("button", name="Display")
    display.click()
    page.get_by_label("Blend with").select_option("uncertainty")
    page.keyboard.press("Escape")
    page.locator("#model-pane [data-mixed]").wait_for()
    page.wait_for_timeout(3000)
    box = page.locator("#model-pane").bounding_box()
    assert box is not None, "the model pane is seen"
    _write(page.screenshot(clip=box), target / "blend.png")  # type: ignore[arg-type]
    page.keyboard.press("m")
    page.keyboard.press("Escape")


def _manual(folder: Path, chromium: Browser, target: Path) -> None:
    with empty_workbench(folder / "second") as server:
        context = chromium.new_context(viewport=WINDOW, bypass_csp=True, color_scheme="dark")  # type: ignore[arg-type]
        context.add_init_script(_NO_HINT)
        page = context.new_page()
        page.goto(f"{server.address}?token={server.token}")
        page.get_by_role("button", name="connected", exact=True).wait_for()
        newcomer(Hands(page, Socket(server)), folder / "shots", sloppy=False, seed=0)
        _keep_panes(page, target / "lines-to-model.png")
        context.close()
    for name, kept in _MANUAL.items():
        _write((folder / "shots" / f"{name}.png").read_bytes(), target / f"{kept}.png")


def _smoothing(folder: Path, chromium: Browser, target: Path) -> None:
    """Preview the ranges that a pose would replace in a scan with spikes."""
    spiked, sample = spiked_sample(folder / "spiked.npz"), sample_folder()
    with empty_workbench(folder / "third") as server:
        socket = Socket(server)
        files = [spiked.file, next(sample.glob("photo.*")), sample / "camera.json"]
        socket.ask("open_files", files=[server.upload(path) for path in files])
        socket.ask("set_settings", solve_automatically=False)
        for match in spiked.matches:
            socket.ask("add_pick", photo="p1", **match)
        socket.ask("run", photo="p1", job="solve")
        socket.until(lambda slices: slices["photos"][0]["state"] == "accepted")
        socket.socket.close()
        context = chromium.new_context(viewport=WINDOW, bypass_csp=True, color_scheme="dark")  # type: ignore[arg-type]
        context.add_init_script(_NO_HINT)
        page = context.new_page()
        page.goto(f"{server.address}?token={server.token}")
        page.get_by_role("tab", name=re.compile("Judge")).click()
        page.get_by_role("button", name="Smooth ranges…").click()
        page.locator(".smoothed-range").first.wait_for()
        page.locator("#model-pane [data-model=drawn]").wait_for(timeout=120_000)
        page.wait_for_timeout(6000)
        _keep(page, target / "smoothing.png")
        context.close()


def _potree(folder: Path, chromium: Browser, target: Path) -> None:
    """Export a survey for Potree; show its photographs in the cloud, and one of them half over it."""
    survey = simulate_survey("office", seed=3, stations=1, photos=9, strangers=0, step_deg=0.1, size=0.75)
    photos = []
    for one in survey.photos:
        assert one.camera_from_world is not None
        camera, pose = survey.cameras[one.camera], survey.in_first(one.camera_from_world)
        known = replace(sample_registration(), camera=camera, camera_from_scanner=pose)
        photos.append(RegisteredPhoto(f"p{len(photos) + 1}", Photo(one.pixels, camera, name=one.name), known))
    out = folder / "potree"
    export_to(out, RegisteredScan(survey.scans[0], photos), ["potree"])
    npm, view = CHECKOUT / "node_modules", CHECKOUT / "testing" / "files" / "potree_view"
    page = chromium.new_page(viewport={"width": 900, "height": 600})
    shots = []
    with published({"/export": out / "potree", "/npm": npm, "/view": view}) as address:
        page.goto(f"{address}/view/")
        page.wait_for_selector("html[data-ready]", state="attached", timeout=120_000)
        for call in ("overview([2.4, -3.4, 0.75], [-0.8, 0.6, -0.25])", "show('cloud', 3)", "show('shown', 3)"):
            page.evaluate(call)
            page.wait_for_timeout(2000)  # until it is drawn once
            page.wait_for_function("points().waiting === 0", timeout=120_000)
            page.wait_for_timeout(2000)
            shots.append(np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB")))
    page.close()
    middle = shots[1].shape[1] // 2
    through = np.concatenate([shots[1][:, :middle], shots[2][:, middle:]], axis=1)
    png = io.BytesIO()
    Image.fromarray(np.concatenate([shots[0], np.full((600, 8, 3), 255, np.uint8), through], axis=1)).save(png, "PNG")
    _write(png.getvalue(), target / "potree.png")


@contextmanager
def _page(project: Path, chromium: Browser) -> Iterator[Page]:
    with empty_workbench(project) as server:
        context = chromium.new_context(viewport=WINDOW, bypass_csp=True, color_scheme="dark")  # type: ignore[arg-type]
        context.add_init_script(_NO_HINT)
        page = context.new_page()
        page.goto(f"{server.address}?token={server.token}")
        page.get_by_role("button", name="connected", exact=True).wait_for()
        yield page
        context.close()


def _keep_panes(page: Page, path: Path) -> None:
    """Keep the three panes alone: the lines in both pictures, and the model that they led to."""
    page.mouse.move(WINDOW["width"] / 2, WINDOW["height"] - 2)  # so that the magnifier is not seen
    page.wait_for_timeout(3000)
    boxes = [page.locator(pane).bounding_box() for pane in ("#scan-pane", "#model-pane")]
    assert boxes[0] is not None, "the scan pane is seen"
    assert boxes[1] is not None, "the model pane is seen"
    first, last = boxes[0], boxes[1]
    clip = {
        "x": first["x"],
        "y": first["y"],
        "width": last["x"] + last["width"] - first["x"],
        "height": first["height"],
    }
    _write(page.screenshot(clip=clip), path)  # type: ignore[arg-type]


def _keep(page: Page, path: Path) -> None:
    _write(page.screenshot(), path)


def _write(png: bytes, path: Path) -> None:
    """Write a picture with few colours: a third of the size, and nobody sees it."""
    image = Image.open(io.BytesIO(png)).convert("RGB").quantize(_COLORS, dither=Image.Dither.NONE)
    image.save(path, optimize=True)


if __name__ == "__main__":
    main()
