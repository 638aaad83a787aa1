"""An operator at the workbench in a browser: opens it, drops files, draws with mouse and finger, takes screenshots."""

from __future__ import annotations

import base64
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import pytest

from testing.workbench.pages import FAILED, LONGEST_MS, two_frames, without_model
from testing.workbench.served import CHECKOUT, Served
from testing.workbench.served import Page as Socket

if TYPE_CHECKING:
    from playwright.sync_api import Browser, BrowserContext, ConsoleMessage, Locator, Page

TOKEN = "a-newcomers-token-of-tests"
DROP = """([selector, files]) => {
  const held = new DataTransfer();
  for (const [name, text] of files)
    held.items.add(new File([Uint8Array.from(atob(text), (c) => c.charCodeAt(0))], name));
  const given = { bubbles: true, cancelable: true, dataTransfer: held };
  for (const kind of ["dragenter", "dragover", "drop"])
    document.querySelector(selector).dispatchEvent(new DragEvent(kind, given));
}"""
CLOSE_REOPENED = """() => {
  for (const notice of document.querySelectorAll(".notice"))
    if (notice.textContent.includes("Reopened")) notice.querySelector("button").click();
}"""
SLICE = "(name) => import('./js/net/store.js').then(({ store }) => store.get(name))"


class Operator:
    """A browser tab at the workbench, and a websocket with the same document."""

    def __init__(self, page: Page, server: Served, pictures: Path) -> None:
        self.page, self.server, self.pictures = page, server, pictures
        self.socket = Socket(server)
        self._shots = 0

    def open(self) -> None:
        """Open the page at the address that the server printed."""
        self.page.goto(f"{self.server.address}?token={self.server.token}")
        self.page.get_by_role("button", name="connected").wait_for()
        two_frames(self.page)
        self.page.evaluate(CLOSE_REOPENED)  # it lies over the pictures, and may go by itself at any moment

    def slice(self, name: str) -> Any:
        """Return the current value of a slice."""
        self.socket.ask("list_served")  # its answer follows all earlier messages
        return self.socket.slices.get(name)

    def wait(self, true: Callable[[], Any], what: str, seconds: float = 90) -> Any:
        """Wait until a condition is true."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            found = true()
            if found:
                return found
            self.page.wait_for_timeout(100)
        pytest.fail(f"it did not happen: {what}")

    def shot(self, name: str) -> None:
        """Save a screenshot of the page if LADARREG_SHOTS is set."""
        if os.environ.get("LADARREG_SHOTS"):
            self.keep(name)

    def keep(self, name: str) -> None:
        """Save a screenshot of the page."""
        self.pictures.mkdir(parents=True, exist_ok=True)
        self._shots += 1
        self.page.screenshot(path=self.pictures / f"{self._shots:02d}-{name}.png")

    def button(self, name: str) -> Locator:
        """Return the button with a name."""
        return self.page.get_by_role("button", name=name)

    def step(self, name: str) -> None:
        """Go to one of the four steps."""
        self.page.get_by_role("tab", name=name, exact=True).click()

    def place(self, side: str, uv: tuple[float, float]) -> tuple[float, float]:
        """Return the window position of a pixel while the whole picture is shown."""
        two_frames(self.page)  # a pane that has just been shown is fitted in its first frame
        body = self.page.locator(f"#{side}-pane .pane-body")
        box = body.bounding_box()
        assert box is not None
        width, height = body.evaluate("(body) => [body.clientWidth, body.clientHeight]")  # whole CSS pixels
        if side == "scan":
            view = (self.slice("beside") or self.slice("scan"))["views"][0]
            size = (view["width"], view["height"])
        else:
            photo = self.slice("photos")[0]
            size = (photo["width"], photo["height"])
        zoom = min(width / size[0], height / size[1])
        left, top = box["x"] + (width - size[0] * zoom) / 2, box["y"] + (height - size[1] * zoom) / 2
        return left + (uv[0] + 0.5) * zoom, top + (uv[1] + 0.5) * zoom

    def draw(self, side: str, ends: list[tuple[float, float]]) -> None:
        """Draw a line with the mouse."""
        (x0, y0), (x1, y1) = (self.place(side, uv) for uv in ends)
        mouse = self.page.mouse
        mouse.move(x0, y0)
        mouse.down()
        mouse.move((x0 + x1) / 2, (y0 + y1) / 2, steps=4)
        mouse.move(x1, y1, steps=4)
        mouse.up()


@contextmanager
def at_work(
    browser: Browser,
    server: Served,
    request: pytest.FixtureRequest,
    *,
    size: tuple[int, int] = (1600, 900),
    expected: str = "",
) -> Iterator[Operator]:
    """An operator with a tab that has not opened the workbench yet; an error in the page's console fails the test.

    Args:
        browser: the browser.
        server: the workbench.
        request: of the test, which leaves a screenshot if it fails.
        size: of the window.
        expected: part of errors that the test provokes.
    """
    # The driver evaluates text in frames, which the policy of the 3-D page rightly forbids.
    context = browser.new_context(
        viewport={"width": size[0], "height": size[1]}, bypass_csp=True, accept_downloads=True, color_scheme="dark"
    )
    context.set_default_timeout(LONGEST_MS)
    page = context.new_page()
    without_model(page)
    errors: list[str] = []

    def complained(message: ConsoleMessage) -> None:
        if message.type == "error":
            errors.append(f"{message.text} {message.location.get('url', '')}".strip())

    page.on("console", complained)
    page.on("pageerror", lambda error: errors.append(str(error)))
    found = Operator(page, server, CHECKOUT / "artifacts" / request.node.name)
    try:
        yield found
    except BaseException:
        request.node.stash[FAILED] = True
        raise
    finally:
        if request.node.stash.get(FAILED, False):
            found.keep("failed")
        found.slice("photos")  # unread messages would delay the end of the connection
        found.socket.socket.close()
        context.close()
    errors = [text for text in errors if not expected or expected not in text]
    assert not errors, f"the page's console: {errors}"


@contextmanager
def started(project: Path, port: int = 0) -> Iterator[Served]:
    """A workbench on a new or existing project, with a small upload limit."""
    surroundings = {**os.environ, "LADARREG_HOME": str(project.parent), "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(
        [sys.executable, "-m", "ladarreg", "serve", "--project", str(project), "--port", str(port), "--no-browser",
         "--upload-limit-mb", "2", "--token", TOKEN],
        stdout=subprocess.PIPE, text=True, env=surroundings,
    )  # fmt: skip
    try:
        assert process.stdout is not None
        address = next(word for word in process.stdout.readline().split() if "://" in word)
        parts = urlsplit(address)
        yield Served(process, parts.hostname or "", parts.port or 0, TOKEN)
    finally:
        process.terminate()  # a shell's background jobs, and so the tests it started there, ignore SIGINT
        process.wait(60)


def opened(context: BrowserContext, server: Served) -> Page:
    """A tab at the workbench."""
    context.set_default_timeout(LONGEST_MS)
    page = context.new_page()
    without_model(page)
    page.goto(f"{server.address}?token={server.token}")
    page.get_by_role("button", name="connected", exact=True).wait_for()
    return page


def drop(page: Page, selector: str, files: dict[str, bytes]) -> None:
    """Drop files onto an element."""
    page.evaluate(DROP, [selector, [(name, base64.b64encode(data).decode()) for name, data in files.items()]])


def place(page: Page, side: str, share: tuple[float, float]) -> tuple[float, float]:
    """Return the window position of a share of a pane."""
    box = page.locator(f"#{side}-pane .pane-body").bounding_box()
    assert box is not None
    return box["x"] + share[0] * box["width"], box["y"] + share[1] * box["height"]


def draw(page: Page, side: str) -> None:
    """Draw a line with the mouse."""
    page.mouse.move(*place(page, side, (0.4, 0.4)))
    page.mouse.down()
    page.mouse.move(*place(page, side, (0.6, 0.55)), steps=4)
    page.mouse.up()


def touch_line(page: Page, side: str) -> None:
    """Draw a line with a finger."""
    fingers = page.context.new_cdp_session(page)
    (x0, y0), (x1, y1) = place(page, side, (0.35, 0.6)), place(page, side, (0.55, 0.7))
    for kind, share in (("touchStart", 0.0), ("touchMove", 0.5), ("touchMove", 1.0), ("touchEnd", None)):
        at = [] if share is None else [{"x": x0 + (x1 - x0) * share, "y": y0 + (y1 - y0) * share}]
        fingers.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": at})
    fingers.detach()


def pinch(page: Page, side: str) -> None:
    """Spread two fingers."""
    fingers = page.context.new_cdp_session(page)
    x, y = place(page, side, (0.5, 0.5))
    for kind, apart in (("touchStart", 40), ("touchMove", 80), ("touchMove", 120), ("touchEnd", 0)):
        at = [{"x": x + k * apart, "y": y, "id": k} for k in (-1, 1)] if apart else []
        fingers.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": at})
    fingers.detach()


def shot(page: Page, name: str) -> None:
    """Keep a screenshot if LADARREG_SHOTS names a folder."""
    if folder := os.environ.get("LADARREG_SHOTS"):
        page.screenshot(path=f"{folder}/{name}.png")
