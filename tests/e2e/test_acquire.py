"""The step 'Acquire' in the page, with simulated devices: what a newcomer does, and a second person."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from testing.workbench.pages import wait_for_store

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform == "win32", reason="the server is ended by a signal")]
SIZE = {"width": 1280, "height": 720}


@pytest.fixture
def address(tmp_path: Path) -> Iterator[str]:
    process = subprocess.Popen(
        [sys.executable, "-m", "ladarreg", "demo", "--acquire", "--project", str(tmp_path / "project"), "--port", "0",
         "--no-browser"],
        stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert process.stdout is not None
    yield next(word for word in process.stdout.readline().split() if "://" in word)
    process.terminate()
    process.wait(60)


def opened(browser: Browser, address: str) -> tuple[Page, list[str]]:
    page = browser.new_context(viewport=SIZE, bypass_csp=True).new_page()  # type: ignore[arg-type]
    page.set_default_timeout(90_000)  # a server, two simulated devices and a browser share the cores with other tests
    errors: list[str] = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.goto(address)
    return page, errors


def awaits(page: Page, state: str) -> None:
    wait_for_store(page, f"store.get('acquisition').state === {state!r}")


@pytest.mark.long
def test_a_newcomer_scans_all_around(browser: Browser, address: str) -> None:
    page, errors = opened(browser, address)
    page.get_by_role("tab", name="Acquire", selected=True).wait_for()  # it opens by itself, without the file dialog
    page.get_by_role("button", name="Connect", exact=True).click()
    awaits(page, "ready")
    page.get_by_role("button", name="Left", exact=True).click()
    page.locator(".dial output").first.filter(has_text="5.0").wait_for()

    assert page.get_by_role("button", name="Quick overview").is_enabled()
    overview = page.locator(".run-overview").bounding_box()
    assert overview is not None
    x, y = overview["x"] + overview["width"] / 2, overview["y"] + overview["height"] / 2
    page.mouse.move(x - 12, y)
    page.mouse.down()
    page.mouse.move(x + 12, y, steps=4)
    page.mouse.up()
    low, high = (float(page.get_by_label(f"Pan, {end}").input_value()) for end in ("from", "to"))
    assert low < 0 < high
    assert high - low < 60
    page.get_by_label("Pan, step").fill("99")
    page.keyboard.press("Tab")
    page.locator(".acquire-plan .form-wrong").filter(has_text="beyond its end").wait_for()
    page.get_by_label("Pan, step").fill("1")
    page.keyboard.press("Tab")
    page.locator(".plan-ahead").filter(has_text="stops").wait_for()

    page.get_by_role("button", name="Start", exact=True).click()
    page.locator(".live-scan").wait_for()
    wait_for_store(page, "store.get('acquisition').done >= 2 && store.get('acquisition').points > 0")
    page.get_by_role("button", name="Pause").dispatch_event("click")  # click() waits for a still page, no run does
    awaits(page, "paused")
    page.locator("iframe.model-frame[src]").wait_for()
    page.locator(".model-cover.gone").wait_for(state="attached")

    other, more = opened(browser, address)
    other.get_by_role("tab", name="Acquire", selected=True).wait_for()
    other.get_by_text("Operator 1 drives").wait_for()
    assert other.get_by_role("button", name="Resume").is_disabled()
    other.keyboard.press("F8")
    awaits(page, "ready")
    page.get_by_text("pieces are kept.").first.wait_for()

    page.get_by_role("button", name="Go on with the run").click()
    awaits(page, "running")
    page.get_by_role("tab", name="Match").dispatch_event("click")
    page.get_by_role("button", name="Stop the unit", exact=True).wait_for()  # whatever step is open
    page.frame_locator("iframe.model-frame").locator("body").press("F8")  # viser's page has the focus
    awaits(page, "ready")
    page.get_by_role("tab", name="Acquire").click()
    page.get_by_role("button", name="Go on with the run").click()
    page.get_by_role("button", name="Open as the scan").wait_for()
    listed = page.get_by_role("list", name="Runs of this project").get_by_role("listitem")
    listed.filter(has_text="run-001").get_by_role("button", name="Open").wait_for()
    page.get_by_role("button", name="Open as the scan").click()
    page.locator("#scan-pane canvas").first.wait_for()
    wait_for_store(page, "store.get('scan')?.name === 'run-001.npz'")
    page.locator(".live-scan").wait_for(state="hidden")
    assert not errors
    assert not more
