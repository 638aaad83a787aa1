"""Login in a real browser: the token is left nowhere, and no other page can lock anyone out."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

import pytest

from testing.workbench.gateway_driver import TOKEN, Running, running
from testing.workbench.pages import LONGEST_MS, SIZE

if TYPE_CHECKING:
    from playwright.sync_api import Browser, BrowserContext, Page

WRONG = "not-the-token-of-it"
HOSTILE = """<!doctype html><title>elsewhere</title><script>
const ways = 14;
let left = 3 * ways;
const done = () => { left -= 1; if (!left) document.title = "done"; };
for (let k = 0; k < ways; k += 1) {
  const address = `%s?token=%s${k}`;
  const image = new Image();
  image.onload = image.onerror = done;
  image.src = address;
  const frame = document.createElement("iframe");
  frame.onload = done;
  frame.src = address;
  document.documentElement.append(frame);
  fetch(address, { mode: "no-cors" }).then(done, done);
}
</script>"""
LEFT = """() => ({
  referrer: document.referrer,
  address: location.href,
  entries: navigation.entries().map((entry) => entry.url),
  loaded: performance.getEntriesByType("navigation").map((entry) => entry.name),
})"""


@pytest.fixture
def run(tmp_path: Path) -> Iterator[Running]:
    with running(tmp_path) as found:
        yield found


@pytest.fixture
def context(browser: Browser) -> Iterator[BrowserContext]:
    found = browser.new_context(viewport={"width": SIZE[0], "height": SIZE[1]})
    found.set_default_timeout(LONGEST_MS)
    yield found
    found.close()


@contextmanager
def elsewhere(text: str) -> Iterator[str]:
    """Serve a page of another site and return its address."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.end_headers()
            self.wfile.write(text.encode())

        def log_message(self, *_: object) -> None:
            return

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://localhost:{server.server_port}/"
    finally:
        server.shutdown()
        server.server_close()


def assert_logged_in(page: Page, run: Running) -> None:
    page.wait_for_url(f"{run.origin}/", wait_until="domcontentloaded")
    page.locator("#scan-pane").wait_for(state="attached")


@pytest.mark.slow
def test_an_address_with_the_token_leaks_nowhere(run: Running, context: BrowserContext) -> None:
    page = context.new_page()
    page.goto("about:blank")
    page.goto(f"{run.origin}/?token={TOKEN}", wait_until="commit")
    assert_logged_in(page, run)
    left = page.evaluate(LEFT)
    assert left["referrer"] == ""
    assert left["address"] == f"{run.origin}/"
    assert TOKEN not in str(left)
    page.go_back()
    assert page.url == "about:blank"


@pytest.mark.slow
def test_a_link_on_another_site_logs_in_and_leaks_nothing(run: Running, context: BrowserContext) -> None:
    with elsewhere(f'<a href="{run.origin}/?token={TOKEN}">open</a>') as address:
        page = context.new_page()
        page.goto(address)
        page.get_by_text("open").click()
        assert_logged_in(page, run)
        assert TOKEN not in str(page.evaluate(LEFT))
        page.go_back()
        assert page.url == address


@pytest.mark.slow
def test_the_form_accepts_the_token_and_a_wrong_one_leaks_nowhere(run: Running, context: BrowserContext) -> None:
    page = context.new_page()
    page.goto(f"{run.origin}/?token={WRONG}")
    page.get_by_role("alert").wait_for()
    assert page.url == f"{run.origin}/"
    page.get_by_label("Token").fill(TOKEN)
    page.get_by_role("button", name="Enter").click()
    assert_logged_in(page, run)
    left = page.evaluate(LEFT)
    assert TOKEN not in str(left)
    assert WRONG not in str(left)
    assert left["referrer"] == ""


@pytest.mark.slow
def test_no_page_of_another_site_can_delay_the_login(run: Running, context: BrowserContext) -> None:
    with elsewhere(HOSTILE % (f"{run.origin}/", quote(WRONG))) as address:
        page = context.new_page()
        page.goto(address)
        page.wait_for_function("document.title === 'done'")
        for k in range(2):  # pages of their own, opened by the hostile one
            page.evaluate("address => { location.href = address }", f"{run.origin}/?token={WRONG}{k}")
            page.get_by_role("alert").wait_for()
            page.goto(address, wait_until="commit")
        client = context.new_page()
        client.goto(f"{run.origin}/?token={TOKEN}", wait_until="commit")
        assert_logged_in(client, run)
