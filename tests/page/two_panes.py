"""Drives the page with only the two image panes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from tests.page.conftest import VIEW_CAMERA, VIEW_FROM_SCANNER

if TYPE_CHECKING:
    from playwright.sync_api import Page

PHOTO = (300, 200)
VIEW = VIEW_CAMERA.size
SCAN_LINE = [[60.25, 40.5], [310.75, 200.0]]
PHOTO_LINE = [[50.5, 30.25], [250.0, 150.75]]


def run(page: Page, module: str, body: str, given: Any = None) -> Any:
    """Return the result of `body`, with the module as m and the argument as a."""
    return page.evaluate(f"async (a) => {{ const m = await import('/js/{module}.js'); {body} }}", given)


def place(page: Page, side: str, uv: Any) -> tuple[float, float]:
    """Return the window position of a pixel while the whole picture is fitted, by the protocol's pixel convention."""
    box = page.locator(f"#{side}-pane .pane-body").bounding_box()
    assert box is not None
    size = np.array(VIEW if side == "scan" else PHOTO)
    room = np.array([box["width"], box["height"]])
    zoom = (room / size).min()
    x, y = np.array([box["x"], box["y"]]) + (room - size * zoom) / 2 + (np.asarray(uv) + 0.5) * zoom
    return float(x), float(y)


def drag(page: Page, side: str, a: Any, b: Any) -> None:
    """Press at one pixel, release at another."""
    page.mouse.move(*place(page, side, a))
    page.mouse.down()
    page.mouse.move(*place(page, side, (np.asarray(a) + b) / 2))
    page.mouse.move(*place(page, side, b))
    page.mouse.up()


def rays(uv: Any) -> np.ndarray:
    """Return the rays of view pixels, computed by the core."""
    return np.asarray(VIEW_CAMERA.unproject(uv) @ VIEW_FROM_SCANNER)


def pixels(given: Any) -> np.ndarray:
    """Return the view pixels of rays, computed by the core."""
    return np.asarray(VIEW_CAMERA.project(np.asarray(given) @ VIEW_FROM_SCANNER.T))


def wait_for_picks(page: Page, count: int) -> list[dict[str, Any]]:
    """Return the picks once there are `count`."""
    page.wait_for_function("(n) => store.picksOf().length === n", arg=count)
    return list(page.evaluate("store.picksOf()"))


def asked(page: Page, what: str) -> list[dict[str, Any]]:
    """Return the arguments of all commands of a kind."""
    return [args for name, args in page.evaluate("asked") if name == what]


def settled(page: Page) -> None:
    """Wait until every command that was sent is answered."""
    page.evaluate("new Promise((done) => setTimeout(done))")


def wait_for_snap(page: Page, uv: Any) -> None:
    """Wait until it is known what the end at a pixel snaps to: questions are sent one at a time, the newest at last."""
    page.wait_for_function(
        """([u, v]) => asked.some(([what, { ends }]) =>
        what === 'snap' && Math.hypot(ends.at(-1)[0] - u, ends.at(-1)[1] - v) < 0.05)""",
        arg=[float(value) for value in uv],
    )
    settled(page)
