"""A newcomer's way from two files to a verified manual registration: python -m benchmarks.newcomer [--hand sloppy].

Starts the workbench on an empty project, drops the sample's scan and photograph on it, draws six lines by hand in both
panes, which the workbench solves by itself, and exports, with Chromium's mouse and keyboard only. Counts what the hands
do (a drop, a drag, a click and a key count one each) and the time from the drop to the verdict and to the file. The
photograph carries its focal length in its EXIF data, as a phone's does. A sloppy hand misses each end of a line by 2 px
(standard deviation along and across, in either picture, before it snaps) and draws one line on the wrong edge of a
shelf.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import numpy as np
from PIL import Image
from playwright.sync_api import sync_playwright

import ladarreg_core as lr
from ladarreg_core.inspection.pictures import inspection_views
from ladarreg_core.simulate.sample import sample_folder
from testing.workbench.browser import FLAGS, find_chromium
from testing.workbench.operator import drop
from testing.workbench.served import Page as Socket
from testing.workbench.served import Served

if TYPE_CHECKING:
    from playwright.sync_api import Page

MAX_ACTIONS = 18
_TOKEN = "a-token-for-newcomers-only"
_FILM_WIDTH_MM, _FILM_DIAGONAL_MM = 36.0, 43.267
_TAG_EXIF, _TAG_FOCAL_35MM = 0x8769, 0xA405
LINES = (
    ((79.5, 58.0), (76.0, 240.0)),
    ((496.0, 92.0), (606.0, 98.0)),
    ((609.0, 101.0), (606.0, 242.0)),
    ((207.0, 163.0), (468.0, 174.0)),
    ((656.0, 161.0), (654.5, 266.0)),
    ((205.0, 237.0), (465.0, 243.0)),
)
"""Edges in the sample's photograph as a person would choose them: of posters and of shelves; pixels."""
WRONG_EDGE = 3
"""The line that a sloppy hand draws on the next board of the shelf in the photograph ..."""
_WRONG_BY_PX = (0.0, 9.0)
"""... which is this far away."""
_SCATTER_PX = 2.0
_SOLVE = "Solve from matches"
_LONGEST_SOLUTION_S = 120


class Hands:
    """The mouse and the keyboard of a newcomer, counted."""

    def __init__(self, page: Page, socket: Socket) -> None:
        self.page, self.socket = page, socket
        self.counts: dict[str, int] = {}

    @property
    def actions(self) -> int:
        """The number of actions so far."""
        return sum(self.counts.values())

    def count(self, kind: str) -> None:
        """Count an action."""
        self.counts[kind] = self.counts.get(kind, 0) + 1

    def drop(self, files: dict[str, bytes]) -> None:
        """Drop files onto the page."""
        self.count("drops")
        drop(self.page, "#scan-pane .pane-body", files)

    def click(self, role: Any, *names: str) -> bool:
        """Click the first control of these names that can be seen and pressed; False if there is none."""
        for name in names:
            control = self.page.get_by_role(role, name=name, exact=True).first
            if control.count() and control.is_visible() and control.is_enabled():
                self.count("clicks")
                control.click()
                return True
        return False

    def draw(self, side: str, ends: Any, size: tuple[int, int]) -> None:
        """Drag a line between two pixels while the whole picture is shown."""
        self.count("drags")
        body = self.page.locator(f"#{side}-pane .pane-body")
        box = body.bounding_box()
        assert box is not None
        width, height = body.evaluate("(body) => [body.clientWidth, body.clientHeight]")
        zoom = min(width / size[0], height / size[1])
        left, top = box["x"] + (width - size[0] * zoom) / 2, box["y"] + (height - size[1] * zoom) / 2
        (x0, y0), (x1, y1) = ((left + (u + 0.5) * zoom, top + (v + 0.5) * zoom) for u, v in ends)
        mouse = self.page.mouse
        mouse.move(x0, y0)
        mouse.down()
        mouse.move((x0 + x1) / 2, (y0 + y1) / 2, steps=6)
        mouse.move(x1, y1, steps=6)
        self.page.wait_for_timeout(150)  # a hand rests before it lets go
        mouse.up()

    def slice(self, name: str) -> Any:
        """Return the current value of a slice."""
        self.socket.ask("list_served")
        return self.socket.slices.get(name)

    def wait(self, name: str, true: Any, seconds: float = 180) -> Any:
        """Return a slice as soon as it satisfies a condition."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            found = self.slice(name)
            if true(found):
                return found
            self.page.wait_for_timeout(50)
        raise TimeoutError(f"the slice {name} did not change as expected within {seconds:g} s")


def photo_with_exif() -> bytes:
    """Return the sample's photograph as a JPEG file with its focal length as a 35 mm equivalent."""
    folder = sample_folder()
    camera = json.loads((folder / "camera.json").read_text())
    image = Image.open(next(folder.glob("photo.*"))).convert("RGB")
    exif = Image.Exif()
    exif.get_ifd(_TAG_EXIF)[_TAG_FOCAL_35MM] = round(
        camera["fx"] * _FILM_DIAGONAL_MM / float(np.hypot(camera["width"], camera["height"]))
    )
    held = io.BytesIO()
    image.save(held, "JPEG", quality=97, exif=exif)
    return held.getvalue()


def lines_in_both() -> tuple[list[tuple[Any, Any]], tuple[int, int], tuple[int, int]]:
    """Return the lines as (ends in the view, ends in the photograph), and the sizes of both pictures."""
    folder = sample_folder()
    scan = lr.read_scan(folder / "scan.npz")
    camera = lr.read_photo(next(folder.glob("photo.*")), camera=folder / "camera.json").camera
    truth = lr.Rigid.from_matrix(json.loads((folder / "truth.json").read_text())["camera_from_scanner"])
    view = inspection_views(scan)[0].view
    points = scan.points[scan.valid]
    seen = truth @ points
    pixels = camera.project(seen)

    def in_view(uv: tuple[float, float]) -> list[float]:
        """Return the view pixel of the surface that the photograph shows at a pixel."""
        near = np.flatnonzero(np.nan_to_num(np.abs(pixels - uv).max(axis=1), nan=np.inf) < 4)
        depth = np.quantile(seen[near, 2], 0.3)  # the surface in front; lower ones are range spikes
        surface = near[np.abs(seen[near, 2] - depth) < 0.15]
        here = np.column_stack([np.ones(len(surface)), pixels[surface] - uv])
        point = np.linalg.lstsq(here, points[surface], rcond=None)[0][0]
        return [float(x) for x in view.project(point[None])[0]]

    drawn = [([in_view(end) for end in line], line) for line in LINES]
    return drawn, view.camera.size, camera.size


@contextmanager
def empty_workbench(project: Path) -> Iterator[Served]:
    """A workbench on a new project."""
    surroundings = {**os.environ, "LADARREG_HOME": str(project.parent), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "ladarreg", "serve", "--project", str(project), "--port", "0", "--no-browser"]
    process = subprocess.Popen([*command, "--token", _TOKEN], stdout=subprocess.PIPE, text=True, env=surroundings)
    try:
        assert process.stdout is not None
        parts = urlsplit(next(word for word in process.stdout.readline().split() if "://" in word))
        found = Served(process, parts.hostname or "", parts.port or 0, _TOKEN)
        found.enter()
        yield found
    finally:
        process.terminate()
        process.wait(60)


def sloppily(drawn: list[tuple[Any, Any]], seed: int) -> list[tuple[Any, Any]]:
    """Return the lines as a sloppy hand draws them."""
    rng = np.random.default_rng(seed)
    found = []
    for number, (in_view, in_photo) in enumerate(drawn):
        wrong = _WRONG_BY_PX if number == WRONG_EDGE else (0.0, 0.0)
        found.append(
            (
                (np.asarray(in_view) + rng.normal(0, _SCATTER_PX, (2, 2))).tolist(),
                (np.asarray(in_photo) + wrong + rng.normal(0, _SCATTER_PX, (2, 2))).tolist(),
            )
        )
    return found


def error_mm(pose: Any) -> float:
    """Return how far a camera centre is from the true one."""
    truth = lr.Rigid.from_matrix(json.loads((sample_folder() / "truth.json").read_text())["camera_from_scanner"])
    return float(1000 * np.linalg.norm(np.asarray(pose) - truth.centre))


def newcomer(hands: Hands, shots: Path | None, *, sloppy: bool, seed: int) -> dict[str, Any]:
    """Do the whole work; return the figures."""
    page = hands.page

    def shot(name: str) -> None:
        if shots is not None:
            shots.mkdir(parents=True, exist_ok=True)
            page.wait_for_timeout(1500)
            page.screenshot(path=shots / f"{name}.png")

    drawn, view_size, photo_size = lines_in_both()
    if sloppy:
        drawn = sloppily(drawn, seed)
    shot("1-empty")
    begun = time.monotonic()
    hands.drop({"scan.npz": (sample_folder() / "scan.npz").read_bytes(), "photo.jpg": photo_with_exif()})
    photos = hands.wait("photos", lambda photos: bool(photos) and photos[0]["camera"] is not None)
    hands.wait("scan", bool)
    page.get_by_role("dialog").first.wait_for(state="hidden", timeout=60_000)
    page.wait_for_timeout(1000)  # a look at the pictures
    shot("2-opened")
    name = photos[0]["id"]
    for number, (in_view, in_photo) in enumerate(drawn, 1):
        hands.draw("scan", in_view, view_size)
        hands.draw("photo", in_photo, photo_size)
        hands.wait(f"picks:{name}", lambda picks, n=number: picks is not None and len(picks) == n, 20)
        if number == 3:
            shot("3-drawn")

    def accepted(photos: Any) -> bool:
        return bool(photos[0]["state"] == "accepted")

    def solved(solving: Any) -> bool:
        """Return whether the matches were solved without being asked, or could not be."""
        poses = hands.slice(f"poses:{name}")
        current = any(stage["stage"] == poses["shown"] and not stage["stale"] for stage in poses["stages"])
        return not solving["busy"] and (current or bool(solving["sentence"]))

    hands.wait(f"solving:{name}", solved, _LONGEST_SOLUTION_S)
    if not accepted(hands.slice("photos")):
        assert hands.click("button", _SOLVE)
    hands.wait("photos", accepted, _LONGEST_SOLUTION_S)
    to_verdict = time.monotonic() - begun
    poses = hands.slice(f"poses:{name}")
    stage = next(each for each in poses["stages"] if each["stage"] == poses["shown"])
    shot("4-accepted")
    export = page.get_by_role("tab", name=re.compile("Export"))
    hands.count("clicks")
    export.click()
    page.locator("button:enabled", has_text="Download zip").first.wait_for(timeout=20_000)
    with page.expect_download(timeout=120_000) as download:
        assert hands.click("button", "Download zip")
    download.value.path()
    to_file = time.monotonic() - begun
    shot("5-exported")
    return {
        "actions": hands.actions,
        "light": stage["summary"]["words"],
        "matches": stage["summary"]["matches"],
        "position": stage["summary"]["position"],
        "off, mm": round(error_mm(stage["centre"]), 1),
        "to the verdict, s": round(to_verdict, 1),
        "to the file, s": round(to_file, 1),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shots", type=Path, help="write screenshots into this folder")
    parser.add_argument("--theme", choices=("dark", "light"), default="dark")
    parser.add_argument("--hand", choices=("careful", "sloppy"), default="careful")
    parser.add_argument("--seed", type=int, default=0, help="of a sloppy hand")
    options = parser.parse_args()
    with (
        tempfile.TemporaryDirectory() as folder,
        empty_workbench(Path(folder) / "project") as server,
        sync_playwright() as driver,
    ):
        chromium = driver.chromium.launch(executable_path=find_chromium(), args=list(FLAGS))
        context = chromium.new_context(
            viewport={"width": 1440, "height": 900}, bypass_csp=True, color_scheme=options.theme
        )
        page = context.new_page()
        page.goto(f"{server.address}?token={server.token}")
        page.get_by_role("button", name="connected", exact=True).wait_for()
        hands = Hands(page, Socket(server))
        found = newcomer(hands, options.shots, sloppy=options.hand == "sloppy", seed=options.seed)
        chromium.close()
    counts = ", ".join(f"{number} {kind}" for kind, number in hands.counts.items())
    verdict = "met" if found["actions"] <= MAX_ACTIONS and found["light"] == "verified" else "not met"
    print(f"actions: {found['actions']} ({counts}); asked: a verified pose by at most {MAX_ACTIONS}: {verdict}")
    print(f"pose: {found['light']}, {found['matches']}, {found['off, mm']} mm off at a stated {found['position']}")
    print(f"from the drop to the verdict: {found['to the verdict, s']} s; to the file: {found['to the file, s']} s")


if __name__ == "__main__":
    main()
