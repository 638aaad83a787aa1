"""A page in a real browser; its screenshot and console are kept under artifacts/."""

from __future__ import annotations

import io
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from PIL import Image

from tests.e2e.browser import FLAGS, find_chromium

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

SIZE = (1600, 900)


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    """A headless Chromium."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    path = find_chromium()
    if path is None:
        pytest.skip("no Chromium: install chromium, or name one in LADARREG_CHROMIUM")
    with sync_api.sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=path, args=list(FLAGS))
        yield chromium
        chromium.close()


@pytest.fixture
def page(browser: Browser, request: pytest.FixtureRequest, checkout: Path) -> Iterator[Page]:
    """A fresh page; what its console calls an error fails the test."""
    tab = browser.new_page(viewport={"width": SIZE[0], "height": SIZE[1]})
    errors: list[str] = []
    tab.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
    tab.on("pageerror", lambda error: errors.append(str(error)))
    yield tab
    folder = checkout / "artifacts"
    folder.mkdir(exist_ok=True)
    tab.screenshot(path=folder / f"{request.node.name}.png")
    tab.close()
    assert not errors, f"the page's console: {errors}"


def pixels(page: Page) -> np.ndarray:
    """Return what the page shows, (h, w, 3) uint8 RGB."""
    return np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB"))


def wait_for_pixels(page: Page, wanted: Callable[[np.ndarray], bool], *, what: str, seconds: float = 60) -> np.ndarray:
    """Return the first picture that satisfies `wanted` and stands still: what is new fades in."""
    end = time.monotonic() + seconds
    before = pixels(page)
    while time.monotonic() < end:
        page.wait_for_timeout(500)
        shown = pixels(page)
        if wanted(shown) and np.array_equal(shown, before):
            return shown
        before = shown
    pytest.fail(f"not seen within {seconds:g} s: {what}")
