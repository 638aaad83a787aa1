"""Stations in the page: a scan is added, registered, and shown in place of the first."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from testing.workbench.pages import without_model
from testing.workbench.shared import SharedWorkbench

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytest.importorskip("embreex", reason="the simulator needs the extra `simulate`")
pytestmark = pytest.mark.slow


@pytest.mark.long
def test_a_station_is_added_registered_and_shown(browser: Browser, workbench: SharedWorkbench, tmp_path: Path) -> None:
    from testing.scenes.station_scans import write_station_scans

    (first, second), photo, camera = write_station_scans(tmp_path)
    workbench.open_files([first, photo, camera]).socket.close()
    page = browser.new_page(viewport={"width": 1000, "height": 620})
    page.set_default_timeout(120_000)
    without_model(page)
    page.goto(f"{workbench.server.address}?token={workbench.server.token}")
    page.get_by_role("tab", name="Survey").click()
    part = page.get_by_role("region", name="Stations", exact=True)
    part.get_by_text("Add scans of the same place").wait_for()
    part.locator("input[type=file]").set_input_files(str(second))
    part.get_by_role("button", name="Show window.npz").wait_for()
    part.get_by_role("button", name="Register", exact=True).click()
    page.get_by_text("hall – window: verified").wait_for()
    part.get_by_text(re.compile(r"σ ≤ 0\.\d mm")).wait_for()
    part.get_by_role("button", name="Place window.npz").click()
    part.get_by_label("x, m of window.npz").wait_for()
    part.get_by_role("checkbox", name="Show the points of window.npz").uncheck()
    with page.expect_download() as download:
        part.get_by_role("button", name="Export all stations").click()
    assert download.value.suggested_filename == "hall-export.zip"
    part.get_by_role("button", name="Show window.npz").click()
    part.get_by_role("button", name="Show hall.npz").wait_for()
    page.get_by_role("button", name=re.compile("Undo")).first.click()
    part.get_by_role("button", name="Show window.npz").wait_for()
    page.close()
