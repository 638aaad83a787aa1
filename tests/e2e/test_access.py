"""Use with a screen reader: axe-core has no serious finding, in any step, panel and theme."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

from testing.workbench.audits import serious_findings
from testing.workbench.operator import Operator, at_work
from testing.workbench.pages import two_frames
from testing.workbench.shared import SharedWorkbench

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytest.importorskip("axe_playwright_python", reason="axe-core is not installed")
STEPS = ("Acquire", "Survey", "Match", "Solve", "Judge", "Export")
PANELS = (".photo-button", ".camera-button", ".clients-button", ".history-button", ".pane-opener")
THEMES = ("dark", "light")


@pytest.fixture
def reader(browser: Browser, workbench: SharedWorkbench, request: pytest.FixtureRequest) -> Iterator[Operator]:
    """Somebody who looks at a project with a pose."""
    workbench.look_at("solved")
    with at_work(browser, workbench.server, request, size=(1440, 900)) as found:
        found.open()
        yield found


@pytest.mark.long
@pytest.mark.parametrize("theme", THEMES)
def test_no_part_of_the_page_has_a_serious_finding(reader: Operator, theme: str) -> None:
    page = reader.page
    page.evaluate("theme => { document.documentElement.dataset.theme = theme; }", theme)
    page.locator(".row-line[data-pick]").first.wait_for()
    found = []
    for step in STEPS:
        reader.step(step)
        two_frames(page)
        found += [f"{step}: {each}" for each in serious_findings(page)]
    reader.step("Match")
    for panel in PANELS:
        for index in range(page.locator(panel).count()):
            opener = page.locator(panel).nth(index)
            if not opener.is_visible() or opener.is_disabled():
                continue
            opener.click()
            page.locator(":popover-open").first.wait_for()
            found += [f"{panel}: {each}" for each in serious_findings(page)]
            page.keyboard.press("Escape")
            page.locator(":popover-open").wait_for(state="hidden")
    page.keyboard.press("?")
    page.get_by_role("dialog").first.wait_for()
    found += [f"keys: {each}" for each in serious_findings(page)]
    assert not found, "\n".join(dict.fromkeys(found))
