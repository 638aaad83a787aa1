"""The first hour of a new user: empty project, bad files, focal length, touch, and a server that is killed."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from ladarreg_core.simulate.sample import sample_folder
from testing.workbench.operator import SLICE, draw, drop, opened, pinch, started, touch_line
from testing.workbench.pages import two_frames, wait_for_store

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform == "win32", reason="no kill -9 to send")]
SIZE: Any = {"width": 1366, "height": 768}
HOSTILE = "<img src=x onerror=hit=1>.png"


def test_a_first_hour(browser: Browser, tmp_path: Path) -> None:
    """Empty project; bad files; good ones; focal length; touch; a server killed while a line is half drawn."""
    project = tmp_path / "project"
    photo, scan = next(sample_folder().glob("photo.*")).read_bytes(), (sample_folder() / "scan.npz").read_bytes()
    context = browser.new_context(viewport=SIZE, bypass_csp=True, has_touch=True)
    faults: list[str] = []
    with started(project) as server:
        page = opened(context, server)
        page.on("pageerror", lambda error: faults.append(str(error)))
        files = page.get_by_role("dialog", name="Open files")
        files.wait_for()  # it opens by itself in an empty project
        page.keyboard.press("Escape")
        page.get_by_text("Open a scan and a photograph first.", exact=True).wait_for()

        bad = {"invoice.png": b"%PDF-1.7", "notes.txt": b"hello", "big.png": bytes(3 << 20), HOSTILE: photo[:5000]}
        drop(page, "#scan-pane .pane-body", bad)
        row = files.locator(".file-row")
        for number, said in enumerate(
            ["a PDF, which is not supported", "format is unknown", "larger than the 2.0 MB", "damaged|truncated"]
        ):
            row.nth(number).locator(".file-status[role=status]").filter(has_text=re.compile(said)).wait_for()
        assert row.nth(3).locator(f"[title='{HOSTILE}']").inner_text() == HOSTILE
        for _ in bad:
            row.first.get_by_role("button", name="Remove").click()

        # two at once on a pane, and one more during their upload
        drop(page, "#photo-pane .pane-body", {"ä photo.png": photo, "scan.npz": scan})
        drop(page, "#photo-pane .pane-body", {HOSTILE: photo})
        files.wait_for(state="hidden")
        assert [each["name"] for each in page.evaluate(SLICE, "photos")] == ["ä photo.png", HOSTILE]
        assert page.evaluate(SLICE, "scan")["name"] == "scan.npz"
        assert page.evaluate("window.hit") is None

        form = page.get_by_role("dialog", name="Camera of the photograph")
        form.wait_for()  # it opens by itself
        film, mm, _, px = form.get_by_role("textbox").all()
        for field, text, said in (
            (film, "wide", "is not a number"),
            (mm, "5", "Sensor width is missing"),
            (px, "3", "most lenses"),
        ):
            field.fill(text)
            page.keyboard.press("Enter")
            form.get_by_role("alert").filter(has_text=said).wait_for()
            field.fill("")
        film.fill("45,6")
        page.keyboard.press("Enter")
        form.wait_for(state="hidden")
        wait_for_store(page, "Math.abs(store.photo().camera?.fx - 972.8) < 1")

        for side in ("scan", "photo"):
            touch_line(page, side)
        page.locator(".row-line[data-pick]").wait_for()
        zoom = page.locator("#scan-pane .pane-zoom")
        before = zoom.inner_text()
        pinch(page, "scan")
        assert zoom.inner_text() != before
        assert page.locator(".awaits-partner").count() == 0, "two fingers do not draw"
        touch_line(page, "scan")
        discard = page.get_by_role("button", name="Discard the drawing")
        discard.wait_for()
        for _ in range(5):  # on a busy machine a tap may last so long that the browser takes it for a long press
            if discard.is_visible():
                discard.tap()
                two_frames(page)
        page.locator(".awaits-partner").wait_for(state="hidden")

        draw(page, "scan")
        page.locator("#photo-pane .awaits-partner").wait_for()
        server.process.kill()
        server.process.wait(30)
        page.get_by_role("button", name="not connected").wait_for()
        draw(page, "photo")
        page.get_by_role("alert").filter(has_text="nothing was changed").wait_for()
    with started(project, server.port):
        page.get_by_role("button", name="connected", exact=True).wait_for()
        page.locator(".row-line[data-pick]").wait_for()  # of the photograph shown last, not of the first
        draw(page, "photo")  # its first side is still open
        page.locator(".row-line[data-pick]").nth(1).wait_for()
        context.close()
    assert not faults
