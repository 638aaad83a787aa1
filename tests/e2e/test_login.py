"""Login in a real browser: the token is left nowhere, and no other page gets in or locks anyone out."""

from __future__ import annotations

import json
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

import pytest

from testing.workbench.gateway_driver import LOOK_TOKEN, TOKEN, Running, running
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


@dataclass
class Elsewhere:
    """Another server on the same machine, and what browsers send it."""

    port: int
    cookies: list[str] = field(default_factory=list)
    paths: list[str] = field(default_factory=list)


@contextmanager
def another_server(text: str) -> Iterator[Elsewhere]:
    """Serve a page under every path."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            found.paths.append(self.path)
            found.cookies += self.headers.get_all("Cookie", [])
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.end_headers()
            self.wfile.write(text.encode())

        def log_message(self, *_: object) -> None:
            return

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    found = Elsewhere(server.server_port)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield found
    finally:
        server.shutdown()
        server.server_close()


@contextmanager
def elsewhere(text: str) -> Iterator[str]:
    """Serve a page of another site and return its address."""
    with another_server(text) as found:
        yield f"http://localhost:{found.port}/"


def session_address(run: Running) -> re.Pattern[str]:
    return re.compile(re.escape(run.origin) + "/s/[0-9a-f]{32}/$")


def assert_logged_in(page: Page, run: Running) -> str:
    """Wait for the workbench and return its address."""
    page.wait_for_url(session_address(run), wait_until="domcontentloaded")
    page.locator("#scan-pane").wait_for(state="attached")
    return page.url


@pytest.mark.slow
def test_an_address_with_the_token_leaks_nowhere(run: Running, context: BrowserContext) -> None:
    page = context.new_page()
    page.goto("about:blank")
    page.goto(f"{run.origin}/?token={TOKEN}", wait_until="commit")
    assert_logged_in(page, run)
    left = page.evaluate(LEFT)
    assert left["referrer"] == ""
    assert left["address"] == page.url
    assert TOKEN not in str(left)
    page.go_back()
    assert page.url == "about:blank"


@pytest.mark.long
def test_a_browser_keeps_its_session(run: Running, context: BrowserContext) -> None:
    """The bare address, the link, and the same address from another page lead back to it; each tab is the same."""
    page = context.new_page()
    page.goto(f"{run.origin}/?token={LOOK_TOKEN}", wait_until="commit")
    looking = assert_logged_in(page, run)
    page.goto(f"{run.origin}/?token={TOKEN}", wait_until="commit")
    page.wait_for_url(lambda address: re.match(session_address(run), address) is not None and address != looking)
    mine = assert_logged_in(page, run)
    page.reload()
    assert assert_logged_in(page, run) == mine
    for path in ("/", "/enter", f"/?token={TOKEN}", f"/?token={LOOK_TOKEN}", f"/s/{'0' * 32}/", "/tokens.css"):
        tab = context.new_page()
        tab.goto(f"{run.origin}{path}", wait_until="commit")
        assert assert_logged_in(tab, run) == mine, path
        tab.close()
    with elsewhere(f'<a href="{mine}">open</a>') as address:
        page.goto(address)
        page.get_by_text("open").click()
        assert assert_logged_in(page, run) == mine
        page.reload()
        assert assert_logged_in(page, run) == mine


@pytest.mark.slow
def test_an_expired_address_leads_to_the_form(run: Running, context: BrowserContext) -> None:
    page = context.new_page()
    page.goto(f"{run.origin}/?token={TOKEN}", wait_until="commit")
    expired = assert_logged_in(page, run)
    context.clear_cookies()  # as when the browser was closed
    for address in (expired, f"{expired}export/p1.html"):
        page.goto(address)
        page.get_by_role("alert").filter(has_text="expired").wait_for()
    page.get_by_label("Token").fill(TOKEN)
    page.get_by_role("button", name="Enter").click()
    assert assert_logged_in(page, run) != expired


ATTACK = """async (victim) => {
  const seen = {};
  const attempt = async (name, make) => {
    try { seen[name] = await make(); } catch (error) { seen[name] = `refused: ${error.name}`; }
  };
  await attempt("read", () => fetch(victim, { credentials: "include" }).then((answer) => answer.text()));
  await attempt("post", () => fetch(`${victim}upload?what=scan`,
    { method: "POST", credentials: "include", mode: "no-cors", body: "data" }).then((answer) => answer.type));
  await attempt("script", () => new Promise((done) => {
    const script = document.createElement("script");
    script.onload = () => done("loaded");
    script.onerror = () => done("refused");
    script.src = `${victim}js/net/store.js`;
    document.head.append(script);
  }));
  await attempt("frame", () => new Promise((done) => {
    const frame = document.createElement("iframe");
    frame.onload = () => { try { done(frame.contentDocument?.title ?? "refused"); } catch { done("refused"); } };
    frame.src = victim;
    document.body.append(frame);
  }));
  await attempt("socket", () => new Promise((done) => {
    const socket = new WebSocket(`${victim.replace("http", "ws")}document`);
    socket.onopen = () => done("open");
    socket.onerror = () => done("refused");
  }));
  await attempt("cookies", () => document.cookie);
  await attempt("storage", () => JSON.stringify(localStorage));
  return seen;
}"""


@pytest.mark.slow
def test_another_port_of_the_host_gets_neither_the_cookie_nor_an_answer(run: Running, context: BrowserContext) -> None:
    with another_server("<!doctype html><title>another port</title><body>") as other:
        page = context.new_page()
        page.goto(f"{run.origin}/?token={TOKEN}", wait_until="commit")
        mine = assert_logged_in(page, run)
        page.wait_for_function("import('./js/net/connection.js').then((m) => m.connectionState() === 'connected')")
        joined, taken = run.bench.joined, len(run.bench.taken)
        attacker = context.new_page()
        for path in ("/", "/s/", f"/s/{'0' * 32}/", "/document", "/enter"):
            attacker.goto(f"http://127.0.0.1:{other.port}{path}")
        assert other.paths
        assert other.cookies == [], "what a server gets, it can use"
        # Even one that knows the address can do nothing in this browser.
        for victim in (f"{run.origin}/", mine):
            seen = attacker.evaluate(ATTACK, victim)
            assert TOKEN not in json.dumps(seen)
            assert seen["read"] == "refused: TypeError"
            assert seen["post"] in ("opaque", "refused: TypeError")
            assert (seen["script"], seen["frame"], seen["socket"]) == ("refused", "refused", "refused")
            assert (seen["cookies"], seen["storage"]) == ("", "{}")
        assert (run.bench.joined, len(run.bench.taken)) == (joined, taken)
        with context.expect_page() as opened:
            attacker.evaluate("(address) => { window.opened = open(address); }", f"{run.origin}/")
        assert_logged_in(opened.value, run)
        assert attacker.evaluate("opened.closed"), "a window that it opens belongs to it no more"


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
