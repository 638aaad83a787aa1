"""The page's modules over HTTP, and a page with only the two image panes."""

from __future__ import annotations

import functools
import io
import json
import threading
from collections.abc import Iterator
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from PIL import Image

from ladarreg_core.camera import Camera
from ladarreg_core.frames import rotation_from_rotvec

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

VIEW_CAMERA = Camera.from_focal(400, 260, 320.0)
VIEW_FROM_SCANNER = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]) @ rotation_from_rotvec((0.05, -0.1, 0.2))


def picture(width: int, height: int) -> np.ndarray:
    """A picture whose colours encode the pixel position: (h, w, 3) uint8."""
    v, u = np.mgrid[:height, :width]
    return np.stack([u % 256, v % 256, (u // 256) * 16 + (u + v) % 2 * 128], axis=-1).astype(np.uint8)


class Handler(SimpleHTTPRequestHandler):
    """Serves static/, the bare page, and pictures with distinguishable pixels."""

    def do_GET(self) -> None:
        path = urlsplit(self.path).path
        if path == "/bare.html":
            self.answer((Path(__file__).parent / "bare.html").read_bytes(), "text/html")
        elif path == "/blank.html":
            self.answer(b'<!doctype html><title>blank</title><link rel="icon" href="logo.svg">', "text/html")
        elif path == "/lens.json":
            self.answer(json.dumps(lens()).encode(), "application/json")
        elif path.startswith("/picture/"):
            png = io.BytesIO()
            Image.fromarray(picture(*((400, 260) if path.startswith("/picture/scan") else (300, 200)))).save(png, "PNG")
            self.answer(png.getvalue(), "image/png")
        else:
            super().do_GET()

    def answer(self, body: bytes, kind: str) -> None:
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002
        """Do not log."""


def lens() -> dict[str, Any]:
    """The view as in slice `scan`."""
    c = VIEW_CAMERA
    rotation = [float(value) for value in VIEW_FROM_SCANNER.ravel()]
    return {"width": c.width, "height": c.height, "f": c.fx, "cx": c.cx, "cy": c.cy, "rotation": rotation, "label": ""}


@pytest.fixture(scope="session")
def modules(checkout: Path) -> Iterator[str]:
    """Address of a server of static/."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Handler, directory=str(checkout / "static")))
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield f"http://127.0.0.1:{server.server_address[1]}"
    server.shutdown()
    server.server_close()
    thread.join()


@pytest.fixture(scope="session")
def blank(browser: Browser, modules: str) -> Iterator[Page]:
    """An empty page of the same origin, for modules without DOM."""
    tab = browser.new_page()
    tab.goto(f"{modules}/blank.html")
    yield tab
    tab.close()


@pytest.fixture
def panes(page: Page, modules: str) -> Page:
    """The bare page with both pictures shown."""
    page.goto(f"{modules}/bare.html")
    page.wait_for_function("window.ready")
    return page
