"""A surveyor at the page, from files to an export: python -m benchmarks.page.surveyor [--rooms N] [--first-seed N].

Each room is scanned from two stations and photographed twelve times by two cameras whose stated focal lengths are 1 to
3 % wrong, and once more elsewhere. Playwright chooses the files, says that the scans are stations, adjusts, looks at
the worst photograph, and exports the whole for COLMAP. Counted are what a person does, a click, a choice or a key, and
the time of all of it; what was exported is read again and compared with the truth. With `--shots FOLDER` every step
leaves pictures in both themes and four sizes.
"""

from __future__ import annotations

import argparse
import io
import re
import tempfile
import time
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.page.survey_page import Tab, served_project
from benchmarks.shared.bars import Row, table
from ladarreg_core.frames import Rigid
from testing.scenes.survey_set import SurveySet, simulate_survey, write_survey_set

if TYPE_CHECKING:
    from playwright.sync_api import Locator

SCENES = ("office", "boxes", "desk", "people")
PHOTOS, STATIONS = 12, 2
_MAX_ACTIONS = 12
_PATIENCE_MS = 1_800_000
_SIZES = ((1440, 900), (1920, 1080), (1280, 720), (768, 1024))
_RIGHT_PX = 1.0
"""Displacement of the laser's points in a photograph up to which its pose is right, px, the median."""


class Surveyor:
    """A person at the page, whose actions are counted.

    Args:
        tab: the page.
        shots: where to leave pictures of it; None: nowhere.
    """

    def __init__(self, tab: Tab, shots: Path | None) -> None:
        self.tab, self.page, self.shots = tab, tab.page, shots
        self.actions: list[str] = []
        self.page.set_default_timeout(_PATIENCE_MS)

    def clicks(self, what: Locator, name: str) -> None:
        """Click something, as soon as that is possible."""
        what.click()
        self.actions.append(name)

    def looks(self, name: str) -> None:
        """Leave pictures of the page, if they are wanted."""
        if self.shots is None:
            return
        self.shots.mkdir(parents=True, exist_ok=True)
        for theme in ("light", "dark"):
            self.page.evaluate("(theme) => { document.documentElement.dataset.theme = theme; }", theme)
            for width, height in _SIZES:
                self.page.set_viewport_size({"width": width, "height": height})
                self.page.wait_for_timeout(400)
                self.page.screenshot(path=self.shots / f"{name}-{theme}-{width}.png")
        self.page.set_viewport_size({"width": _SIZES[0][0], "height": _SIZES[0][1]})

    def works(self, files: list[Path]) -> bytes:
        """Go from files to an export, and return its archive."""
        page = self.page
        page.get_by_role("button", name="connected").wait_for()
        with page.expect_file_chooser() as chooser:
            self.clicks(page.get_by_role("button", name="Choose files…"), "Choose files")
        chooser.value.set_files(files)
        self.actions.append("all files of the job")
        self.clicks(page.get_by_role("button", name="Stations", exact=True), "they are stations")
        page.wait_for_function(
            f"document.querySelector('.photo-button')?.textContent.includes('/{len(files) - STATIONS}')"
        )
        self.clicks(page.get_by_role("tab", name="Survey", exact=True), "step Survey")
        every = page.get_by_role("region", name="All photographs")
        self.looks("waiting")
        self.clicks(every.get_by_role("button", name="Adjust", exact=True), "Adjust")
        every.get_by_text(re.compile("Adjusted together")).wait_for()
        page.locator('[data-whole="yes"]').wait_for()
        self.looks("adjusted")
        every.get_by_label("Order of the photographs").select_option(label="Worst first")
        self.actions.append("worst first")
        self.clicks(every.locator(".survey-name").first, "the worst photograph")
        self.looks("worst")
        self.clicks(page.get_by_role("tab", name="Export", exact=True), "step Export")
        self.clicks(page.get_by_role("checkbox", name="COLMAP"), "COLMAP")
        self.looks("export")
        with page.expect_download() as saved:
            self.clicks(page.get_by_role("button", name="Download zip"), "Download zip")
        return Path(saved.value.path()).read_bytes()


def displacements_px(found: SurveySet, archive: bytes) -> dict[str, float]:
    """Return by how much the laser's points lie elsewhere in each exported photograph than they are, px, the median."""
    import pycolmap

    with tempfile.TemporaryDirectory() as folder:
        with zipfile.ZipFile(io.BytesIO(archive)) as file:
            file.extractall(folder)
        (sparse,) = Path(folder).rglob("sparse/0")
        model = pycolmap.Reconstruction(str(sparse))
    points = found.scans[0].points[found.scans[0].valid][::97].astype(np.float64)
    truth = {Path(one.name).stem: one for one in found.photos}
    off = {}
    for image in model.images.values():
        one = truth[Path(image.name).stem]
        if one.camera_from_world is None:
            off[one.name] = float("inf")
            continue
        moved = image.cam_from_world()
        seen = Rigid(moved.rotation.matrix(), moved.translation) @ points
        places = model.cameras[image.camera_id].img_from_cam(seen) - 0.5  # COLMAP's first pixel ends at 1
        true_camera = found.cameras[one.camera]
        true_places = true_camera.project(found.in_first(one.camera_from_world) @ points)
        inside = true_camera.contains(true_places) & (seen[:, 2] > 0)
        off[one.name] = float(np.median(np.linalg.norm(places - true_places, axis=1)[inside]))
    return off


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rooms", type=int, default=1)
    parser.add_argument("--first-seed", type=int, default=300)
    parser.add_argument("--shots", type=Path, help="a folder for pictures of the page")
    options = parser.parse_args()
    rows = []
    for seed in range(options.first_seed, options.first_seed + options.rooms):
        scene = SCENES[seed % len(SCENES)]
        found = simulate_survey(scene, seed=seed, photos=PHOTOS, stations=STATIONS)
        with tempfile.TemporaryDirectory() as temporary:
            job = Path(temporary) / "job"
            job.mkdir()
            write_survey_set(job, found)
            with served_project(Path(temporary) / "project") as (served, _):
                tab = Tab(served)
                surveyor = Surveyor(tab, options.shots)
                begun = time.monotonic()
                archive = surveyor.works(sorted(job.iterdir()))
                seconds = time.monotonic() - begun
                tab.close()
        off = displacements_px(found, archive)
        right = sum(px < _RIGHT_PX for px in off.values())
        count = len(surveyor.actions)
        rows += [
            Row(f"{scene} {seed}: actions", f"<= {_MAX_ACTIONS}", str(count), count <= _MAX_ACTIONS),
            Row(f"{scene} {seed}: time", "reported", f"{seconds:.0f} s", True),
            Row(f"{scene} {seed}: exported and right", f"{PHOTOS}", str(right), right == PHOTOS),
            Row(f"{scene} {seed}: exported and wrong", "0", str(len(off) - right), len(off) == right),
        ]
        print(f"{scene} {seed}: {', '.join(surveyor.actions)}")
    print(table(rows))


if __name__ == "__main__":
    main()
