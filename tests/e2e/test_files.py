"""Files dropped together on the page: what belongs together, what is missing, and what has to be chosen."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from ladarreg_core.simulate.sample import sample_folder
from testing.files.small_scans import make_scan, picture_e57
from testing.workbench.audits import hard_to_read
from testing.workbench.operator import SLICE, drop, opened, shot
from testing.workbench.pages import without_model
from testing.workbench.shared import SharedWorkbench
from tests.app.workbench.test_batches import depth_scan

if TYPE_CHECKING:
    from playwright.sync_api import Browser


def with_picture(folder: Path) -> Path:
    """Write an E57 with an embedded picture."""
    return picture_e57(folder / "hall.e57", make_scan(60, 90))[0]


@pytest.mark.slow
def test_a_dropped_batch(browser: Browser, workbench: SharedWorkbench, tmp_path: Path) -> None:
    """A descriptor waits for its image; a second scan is a question, or a project that offers the scan's picture."""
    pytest.importorskip("pye57")
    photo, scan = next(sample_folder().glob("photo.*")).read_bytes(), (sample_folder() / "scan.npz").read_bytes()
    camera = (sample_folder() / "camera.json").read_bytes()
    parts = depth_scan()
    depth = parts.pop("depth.png")
    context = browser.new_context(viewport={"width": 1024, "height": 720})
    without_model(context)
    workbench.open_new()
    page = opened(context, workbench.server)
    dialog = page.get_by_role("dialog", name="Open files")
    dialog.get_by_text("E57, NPZ, PCD").wait_for()
    drop(page, "#photo-pane .pane-body", {"photo.txt": photo, **parts, "camera.dat": camera})
    waits = dialog.get_by_role("list", name="Files that wait")
    waits.get_by_text("The descriptor names depth.png, which was not among the files: drop it as well.").wait_for()
    assert waits.get_by_role("button", name="Open").count() == 0, "neither part can be opened alone"
    dialog.get_by_text("Opened as camera.").wait_for()
    assert [each["camera"]["calibrated"] for each in page.evaluate(SLICE, "photos")] == [True]
    shot(page, "batch-waits")
    for theme in ("dark", "light"):
        page.emulate_media(color_scheme=theme)
        assert hard_to_read(page) == []
    drop(page, "#photo-pane .pane-body", {"depth.png": depth})
    dialog.wait_for(state="hidden")
    assert page.evaluate(SLICE, "scan")["name"] == "kinect.json"

    drop(page, "#scan-pane .pane-body", {"other.dat": scan})
    question = dialog.get_by_role("group", name="What the scans are")
    question.get_by_text("kinect.json").wait_for()
    shot(page, "batch-asks")
    assert page.evaluate(SLICE, "scan")["name"] == "kinect.json"
    for _ in range(2):
        page.keyboard.press("Tab")  # from the first answer, which has the focus, to the third
    page.keyboard.press("Enter")
    dialog.wait_for(state="hidden")
    assert page.evaluate(SLICE, "scan")["name"] == "other.dat"

    drop(page, "#scan-pane .pane-body", {"hall.e57": with_picture(tmp_path).read_bytes()})
    question.get_by_role("button", name="New project with it").click()
    page.get_by_text("The scan contains a picture").wait_for()
    page.get_by_role("button", name="Show", exact=True).click()
    offer = dialog.get_by_role("list", name="Pictures in the scan")
    offer.get_by_text("pose stated").wait_for()
    shot(page, "embedded")
    offer.get_by_role("button", name="Add front_door.jpg").press("Enter")
    offer.get_by_text("Added").wait_for()
    assert [each["name"] for each in page.evaluate(SLICE, "photos")] == ["front_door.jpg"]
    context.close()
