"""The page that is opened when the workbench serves its maximum number of pages."""

from __future__ import annotations

import select
import socket
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from testing.attacks.held_connections import HeldConnections
from testing.workbench.pages import LONGEST_MS
from testing.workbench.served import served

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform == "win32", reason="no kill to send")]


def wait_for_first_message(line: socket.socket) -> None:
    """Wait until a websocket is not only open: the first message is sent to a page that has its place."""
    while True:
        assert select.select([line], [], [], 60)[0]
        head, _, message = line.recv(4096, socket.MSG_PEEK).partition(b"\r\n\r\n")
        assert head.startswith(b"HTTP/1.1 101")
        if message:
            return


@pytest.mark.long
def test_a_page_beyond_the_limit_shows_the_reason_and_connects_when_another_closes(
    browser: Browser, tmp_path: Path
) -> None:
    with served(tmp_path / "project") as (found, _):
        others = HeldConnections("document", 64, found.host, found.port, found.access)
        views = HeldConnections("viser", 64, found.host, found.port, found.access)
        others.fill()
        views.fill()
        for line in (*others.open, *views.open):
            wait_for_first_message(line)
        context = browser.new_context(viewport={"width": 1280, "height": 720})
        context.set_default_timeout(LONGEST_MS)
        page = context.new_page()
        try:
            page.goto(f"{found.address}?token={found.token}")
            page.get_by_role("alert").get_by_text("64 pages are open").wait_for()
            page.get_by_role("button", name="too many pages are open: trying again").wait_for()
            for line in others.open:
                line.close()
            page.get_by_role("button", name="connected", exact=True).wait_for()
            page.locator(".model-cover").get_by_text("64 pages show the 3-D view").wait_for()
        finally:
            for line in (*others.open, *views.open):
                line.close()
            context.close()
