"""Several frames of one standpoint in the page: dropped together, added later, and refused from elsewhere."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from testing.scenes.room_frames import CAMERA, PHOTO, elsewhere, frame, room_matches
from testing.workbench.audits import hard_to_read
from testing.workbench.operator import SLICE, drop, opened, shot
from testing.workbench.pages import without_model
from testing.workbench.shared import SharedWorkbench

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

PANE = "#scan-pane .pane-body"
DRAW = """async (matches) => {
  const { request, requestForPhoto } = await import("./js/net/requests.js");
  await request("set_settings", { solve_automatically: false });
  for (const match of matches) await requestForPhoto("add_pick", match);
  await requestForPhoto("run", { job: "robust" });
}"""


def files_of(page: Page) -> list[str]:
    found: list[str] = page.evaluate(SLICE, "scan")["files"]
    return found


@pytest.mark.slow
def test_frames_are_added_and_matches_stay(browser: Browser, workbench: SharedWorkbench) -> None:
    context = browser.new_context(viewport={"width": 1280, "height": 720})
    without_model(context)
    context.set_default_timeout(90_000)
    batch = {
        "sweep10.npz": frame(1), "sweep9.npz": frame(0), "photo.png": PHOTO.read_bytes(),
        "camera.json": CAMERA.read_bytes(),
    }  # fmt: skip
    workbench.open_new()
    page = opened(context, workbench.server)
    dialog = page.get_by_role("dialog", name="Open files")
    question = dialog.get_by_role("group", name="What the scans are")
    drop(page, PANE, batch)
    question.get_by_text("Are sweep9.npz and sweep10.npz frames of one standpoint, or stations?").wait_for()
    shot(page, "frames-several")
    page.keyboard.press("Enter")  # the first answer has the focus
    dialog.wait_for(state="hidden")
    assert files_of(page) == ["sweep9.npz", "sweep10.npz"]
    more = page.get_by_role("button", name="Add frames", exact=True)
    assert more.inner_text() == "2 clouds"
    page.locator(".scan-chip[title*='2 clouds of one standpoint: sweep9.npz, sweep10.npz']").wait_for()

    page.evaluate(DRAW, room_matches())
    verdict = page.get_by_role("region", name="Verdict", exact=True)
    verdict.get_by_text("Not accepted:").wait_for()
    drop(page, PANE, {"yard.npz": elsewhere()})
    question.get_by_role("button", name="Add as a frame").click()
    question.get_by_role("alert").filter(has_text="yard.npz was not taken from where sweep9.npz was").wait_for()
    shot(page, "frames-refused")
    for theme in ("dark", "light"):
        page.emulate_media(color_scheme=theme)
        assert hard_to_read(page) == []
    question.get_by_role("button", name="Leave it for later").click()
    dialog.get_by_role("button", name="Remove yard.npz").click()
    page.keyboard.press("Escape")

    more.click()
    dialog.get_by_text("Drop further frames of the scan here").wait_for()
    drop(page, PANE, {"sweep11.npz": frame(2)})  # said already that it is a frame: nothing is asked
    dialog.wait_for(state="hidden")
    assert files_of(page) == ["sweep9.npz", "sweep10.npz", "sweep11.npz"]
    assert len(page.evaluate(SLICE, "picks:p1")) == len(room_matches())
    verdict.get_by_text("Out of date: solved on fewer clouds.").wait_for()
    shot(page, "frames-stale")
    page.get_by_role("button", name="Undo: Add frame sweep11.npz").click()
    verdict.get_by_text("Out of date:").wait_for(state="hidden")
    assert files_of(page) == ["sweep9.npz", "sweep10.npz"]
    context.close()
