"""Files dropped together on the page: what belongs together, what is missing, and what has to be chosen."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from ladarreg_core.simulate.sample import sample_folder
from tests.app.workbench.test_batches import depth_scan
from tests.e2e.audits import hard_to_read
from tests.e2e.test_newcomer import SLICE, drop, opened, started

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform == "win32", reason="started as a process group")]


def shot(page: Page, name: str) -> None:
    """Keep a screenshot if LADARREG_SHOTS names a folder."""
    if folder := os.environ.get("LADARREG_SHOTS"):
        page.screenshot(path=f"{folder}/{name}.png")


def test_a_dropped_batch(browser: Browser, tmp_path: Path) -> None:
    """A descriptor without one of its images waits; the image completes it; a second scan is a question."""
    photo, scan = next(sample_folder().glob("photo.*")).read_bytes(), (sample_folder() / "scan.npz").read_bytes()
    camera = (sample_folder() / "camera.json").read_bytes()
    parts = depth_scan()
    depth = parts.pop("depth.png")
    context = browser.new_context(viewport={"width": 1024, "height": 720})
    with started(tmp_path / "project") as server:
        page = opened(context, server)
        dialog = page.get_by_role("dialog", name="Open files")
        dialog.get_by_text("E57, NPZ, PCD").wait_for()
        drop(page, "#photo-pane .pane-body", {"photo.txt": photo, **parts, "camera.dat": camera})
        waits = dialog.get_by_role("list", name="Files that wait")
        waits.get_by_text("The descriptor names depth.png, which was not among the files: drop it as well.").wait_for()
        assert waits.get_by_role("button", name="Open").count() == 0, "neither part can be opened alone"
        assert [each["camera"]["calibrated"] for each in page.evaluate(SLICE, "photos")] == [True]
        shot(page, "batch-waits")
        for theme in ("dark", "light"):
            page.emulate_media(color_scheme=theme)
            assert hard_to_read(page) == []
        drop(page, "#photo-pane .pane-body", {"depth.png": depth})
        dialog.wait_for(state="hidden")
        assert page.evaluate(SLICE, "scan")["name"] == "kinect.json"

        drop(page, "#scan-pane .pane-body", {"other.dat": scan})
        question = dialog.get_by_role("group", name="A second scan")
        question.get_by_text("kinect.json").wait_for()
        shot(page, "batch-asks")
        assert page.evaluate(SLICE, "scan")["name"] == "kinect.json"
        page.keyboard.press("Tab")
        page.keyboard.press("Enter")  # from the first answer, which has the focus, to the second
        dialog.wait_for(state="hidden")
        assert page.evaluate(SLICE, "scan")["name"] == "other.dat"
        context.close()
