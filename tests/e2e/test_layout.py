"""Every control is whole, in reach and large enough, at all usual widths and in both themes."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

from ladarreg_core.simulate import sample_folder
from testing.workbench.audits import layout_faults
from testing.workbench.operator import Operator, at_work
from testing.workbench.pages import two_frames
from testing.workbench.shared import SharedWorkbench

if TYPE_CHECKING:
    from playwright.sync_api import Browser

WIDTHS = {390: 844, 768: 1024, 1024: 768, 1280: 800, 1440: 900, 1600: 900, 1920: 1080}
STEPS = ("Acquire", "Survey", "Match", "Solve", "Judge", "Export")
THEMES = ("dark", "light")


@pytest.fixture
def busy(browser: Browser, workbench: SharedWorkbench, request: pytest.FixtureRequest) -> Iterator[Operator]:
    """An operator at a project with a pose, and two further photographs, whose focal length is not known."""
    workbench.open("solved")
    picture = next(sample_folder().glob("photo.*"))
    with at_work(browser, workbench.server, request) as found:
        found.open()
        for name in ("IMG_20261126_154212_pump room, north wall.png", "another photograph of the pump room.png"):
            held = workbench.server.upload(picture, name=name)
            assert found.socket.ask("open_files", files=[held])["ok"]
        found.page.locator(".photo-button", has_text="1/3").wait_for()
        yield found


def faults_at(operator: Operator, width: int, name: str) -> list[str]:
    operator.page.set_viewport_size({"width": width, "height": WIDTHS[width]})
    two_frames(operator.page)
    operator.shot(f"{width}-{name}")
    return [f"{width}, {name}: {fault}" for fault in layout_faults(operator.page)]


@pytest.mark.slow
def test_every_step_fits(busy: Operator) -> None:
    found = []
    for step in STEPS:
        busy.page.set_viewport_size({"width": 1440, "height": 900})
        busy.step(step)
        for width in WIDTHS:
            found += faults_at(busy, width, step.lower())
    assert not found, "\n".join(found)


@pytest.mark.slow
def test_every_part_and_panel_fits(busy: Operator) -> None:
    found = []
    openers = {".camera-button": "focal length", ".photo-button": "photographs", ".clients-button": "clients"}
    for theme in THEMES:
        busy.page.evaluate("theme => { document.documentElement.dataset.theme = theme; }", theme)
        for width in WIDTHS:
            found += faults_at(busy, width, f"pictures, {theme}")
            for opener, name in openers.items():
                busy.page.locator(opener).click()
                busy.page.locator(":popover-open").wait_for()
                found += faults_at(busy, width, f"{name}, {theme}")
                busy.page.keyboard.press("Escape")
    busy.page.set_viewport_size({"width": 390, "height": 844})
    for part in ("Photograph", "Model", "Matches"):
        busy.page.get_by_role("navigation", name="Shown part").get_by_role("button", name=part, exact=True).click()
        found += faults_at(busy, 390, part.lower())
    assert not found, "\n".join(found)


DRAWN = """(side) => {
  const canvas = document.querySelector(`#${side}-pane .pane-matches`);
  const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
  let count = 0;
  for (let k = 3; k < data.length; k += 4) count += data[k] > 0;
  return count;
}"""


@pytest.mark.slow
def test_matches_can_be_hidden_in_the_pictures(busy: Operator) -> None:
    page = busy.page
    busy.wait(lambda: min(page.evaluate(DRAWN, side) for side in ("scan", "photo")) > 100, "matches are drawn")
    page.locator("#photo-pane .pane-body").focus()
    page.keyboard.press("x")
    busy.wait(lambda: not any(page.evaluate(DRAWN, side) for side in ("scan", "photo")), "matches are hidden")
    eye = page.get_by_role("button", name="Matches in the pictures").first
    assert eye.get_attribute("aria-pressed") == "false"
    eye.click()
    busy.wait(lambda: min(page.evaluate(DRAWN, side) for side in ("scan", "photo")) > 100, "matches are drawn again")
