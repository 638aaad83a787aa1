"""A page in a real browser: its console must be clean, and a failed test leaves a screenshot."""

from __future__ import annotations

import contextlib
import io
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from PIL import Image

from testing.workbench.browser import CHEAP, FLAGS, find_chromium

if TYPE_CHECKING:
    from playwright.sync_api import Browser, BrowserContext, BrowserType, Page, Route

SIZE = (1280, 720)
LONGEST_MS = 90_000
"""What a browser may take for anything on a busy computer."""
ROUND_TRIP = "import('./js/net/connection.js').then(({ ask }) => ask('list_served').then(() => null))"
"""Its answer follows that of every command that the page has sent before, and all messages of before."""
FAILED = pytest.StashKey[bool]()


@pytest.fixture(scope="session")
def browsers() -> Iterator[BrowserType]:
    """What starts the browsers of a process: there is one event loop for all of them."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    if find_chromium() is None:
        pytest.skip("no Chromium: install chromium, or name one in LADARREG_CHROMIUM")
    with sync_api.sync_playwright() as playwright:
        yield playwright.chromium


@pytest.fixture(scope="session")
def browser(browsers: BrowserType) -> Iterator[Browser]:
    """A headless Chromium that draws its pages without a graphics card, emulated or not."""
    with browsers.launch(executable_path=find_chromium(), args=[*FLAGS, *CHEAP]) as chromium:
        yield chromium


@pytest.fixture(scope="session")
def browser_3d(browsers: BrowserType) -> Iterator[Browser]:
    """A headless Chromium whose 3-D pictures can be photographed: it takes twice the processor time of `browser`."""
    with browsers.launch(executable_path=find_chromium(), args=FLAGS) as chromium:
        yield chromium


@contextlib.contextmanager
def watched_page(browser: Browser, request: pytest.FixtureRequest) -> Iterator[Page]:
    """A new page; an error in its console fails the test."""
    tab = browser.new_page(viewport={"width": SIZE[0], "height": SIZE[1]})
    tab.set_default_timeout(LONGEST_MS)
    errors: list[str] = []
    tab.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
    tab.on("pageerror", lambda error: errors.append(str(error)))
    yield tab
    if request.node.stash.get(FAILED, False):
        keep(tab, request.getfixturevalue("checkout"), request.node.name)
    tab.close()
    assert not errors, f"the page's console: {errors}"


@pytest.fixture
def page(browser: Browser, request: pytest.FixtureRequest) -> Iterator[Page]:
    """A page that is watched."""
    with watched_page(browser, request) as tab:
        yield tab


@pytest.fixture
def page_3d(browser_3d: Browser, request: pytest.FixtureRequest) -> Iterator[Page]:
    """One whose 3-D pictures can be photographed."""
    with watched_page(browser_3d, request) as tab:
        yield tab


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Iterator[None]:
    """Record on the test that it failed, for the teardown of its page."""
    outcome = yield
    if outcome.get_result().failed:  # type: ignore[attr-defined]
        item.stash[FAILED] = True


def without_model(pages: Page | BrowserContext) -> None:
    """Leave the 3-D page empty: software rendering takes all of a small machine, and it has tests of its own."""

    def empty(route: Route) -> None:
        route.fulfill(body="<!doctype html><title>left out</title>", content_type="text/html")

    pages.route("**/viser/**", empty)


def keep(page: Page, checkout: Path, name: str) -> None:
    """Keep a screenshot under artifacts/."""
    folder = checkout / "artifacts"
    folder.mkdir(exist_ok=True)
    page.screenshot(path=folder / f"{name}.png")


def wait_for_store(page: Page, wanted: str, *, seconds: float = 90) -> None:
    """Wait until an expression of `store` holds in the page; `wait_for_function` awaits no promise.

    A page that is loading another document meanwhile is asked again.
    """
    from playwright.sync_api import Error

    end = time.monotonic() + seconds
    while True:
        with contextlib.suppress(Error):
            if page.evaluate(f"import('./js/net/store.js').then(({{ store }}) => Boolean({wanted}))"):
                return
        if time.monotonic() > end:
            pytest.fail(f"not so within {seconds:g} s: {wanted}")
        page.wait_for_timeout(50)


def pixels(page: Page) -> np.ndarray:
    """Return a screenshot of the page, (h, w, 3) uint8 RGB."""
    return np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB"))


def two_frames(page: Page) -> None:
    """Wait until everything is drawn that was due when this was called."""
    page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")


def wait_for_pixels(page: Page, wanted: Callable[[np.ndarray], bool], *, what: str, seconds: float = 90) -> np.ndarray:
    """Return the first screenshot that satisfies `wanted` and no longer changes, since new things fade in."""
    end = time.monotonic() + seconds
    before = pixels(page)
    while time.monotonic() < end:
        page.wait_for_timeout(200)  # a fade is slower than two frames
        shown = pixels(page)
        if wanted(shown) and np.array_equal(shown, before):
            return shown
        before = shown
    pytest.fail(f"not seen within {seconds:g} s: {what}")


def choose_photo(page: Page, name: str) -> None:
    """Choose a photograph in the list."""
    page.locator(".photo-button").click()
    page.locator(".photo-entry", has_text=name).click()
    page.locator(".photo-panel").wait_for(state="hidden")


def photo_in_list(page: Page, name: str) -> None:
    """Open the list of photographs, wait until it has one of a name, and close it."""
    page.locator(".photo-button").click()
    page.locator(".photo-entry", has_text=name).wait_for()
    page.keyboard.press("Escape")
    page.locator(".photo-panel").wait_for(state="hidden")
