"""Pictures in a browser: on a slow link small ones first, exact where they are looked at; contrast while dragging."""

from __future__ import annotations

import base64
import io
import re
import sys
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
from PIL import Image

from benchmarks.page.throttling_proxy import ThrottlingProxy
from testing.workbench.pages import LONGEST_MS, two_frames, without_model
from testing.workbench.served import Served
from testing.workbench.shared import SharedWorkbench

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page, Route

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="the proxy needs a Unix loop")
SLOW_BYTES_PER_S = 400_000
PICTURE = re.compile("^Loading the picture")
SIZE: Any = {"width": 1600, "height": 900}
CANVAS = """
(side) => document.querySelector(`#${side}-pane .pane-body > .pane-picture`).toDataURL("image/png").split(",")[1]
"""
PATCH_PX = 50


@pytest.fixture
def server(workbench: SharedWorkbench) -> Served:
    workbench.look_at("sample")
    return workbench.server


@pytest.fixture
def tab(browser: Browser) -> Iterator[Page]:
    """A new browser profile, with an empty cache; an error in the console fails the test."""
    context = browser.new_context(viewport=SIZE, bypass_csp=True, color_scheme="dark", reduced_motion="reduce")
    context.set_default_timeout(LONGEST_MS)
    page = context.new_page()
    without_model(page)
    errors: list[str] = []
    page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
    page.on("pageerror", lambda error: errors.append(str(error)))
    yield page
    context.close()
    assert not errors, f"the page's console: {errors}"


def enter(page: Page, server: Served, port: int) -> None:
    page.goto(f"http://127.0.0.1:{port}/?token={server.token}")
    page.get_by_role("button", name="connected").wait_for()


def until(page: Page, true: Any, what: str, seconds: float = 90) -> Any:
    for _ in range(int(10 * seconds)):
        found = true()
        if isinstance(found, np.ndarray) or found:
            return found
        page.wait_for_timeout(100)
    pytest.fail(f"it did not happen: {what}")


def shown(page: Page, side: str) -> np.ndarray:
    """Return what is on the canvas of a pane's picture, (h, w, 3)."""
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(page.evaluate(CANVAS, side)))).convert("RGB")).astype(int)


def exact_scan(server: Served, query: str = "") -> np.ndarray:
    """Return the scan's default picture as the workbench renders it, with other parameters."""
    status, data, _ = server.get(f"picture/scan?view=0&show=intensity{query}")
    assert status == 200
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB")).astype(int)


@pytest.mark.slow
def test_on_a_slow_link_only_what_is_looked_at_is_loaded_exactly(tab: Page, server: Served) -> None:
    with ThrottlingProxy(server.port, bytes_per_s=SLOW_BYTES_PER_S, one_way_s=0.01) as link:
        enter(tab, server, link.port)

        def pictures() -> list[str]:
            return [path for path in link.downloaded if re.search(r"/picture/(scan|photo)", path)]

        until(tab, lambda: shown(tab, "scan").max() > 100 and shown(tab, "photo").max() > 100, "both pictures")
        assert not tab.locator(".first-picture").count(), "the canvas has taken over"
        assert len(pictures()) == 2, "each once, although the page and its scripts both request them"
        assert all(path.endswith("&form=quick") for path in pictures())

        body = tab.locator("#scan-pane .pane-body")
        tab.keyboard.press("Escape")  # closes the form that asks for the focal length, which lies over the button
        tab.locator(":popover-open").wait_for(state="detached")
        tab.get_by_role("button", name="Show the scan one to one").click()
        truth = exact_scan(server)

        def is_exact() -> bool:
            found = shown(tab, "scan")
            height, width = found.shape[:2]
            # The view keeps the middle of what was fitted, which need not be that of the picture.
            v, u = height // 2 - PATCH_PX, width // 2 - PATCH_PX
            patch = found[v : v + 2 * PATCH_PX, u : u + 2 * PATCH_PX].astype(np.float32)
            differs = cv2.matchTemplate(truth.astype(np.float32), patch, cv2.TM_SQDIFF)
            row, column = (int(at) for at in np.unravel_index(int(differs.argmin()), differs.shape))
            top, left = row - v, column - u
            rows, columns = slice(max(0, top), top + height), slice(max(0, left), left + width)
            wanted = truth[rows, columns]
            inner = found[max(0, -top) :, max(0, -left) :][: wanted.shape[0], : wanted.shape[1]]
            return bool(np.abs(inner - wanted)[4:-4, 4:-4].mean() < 0.5)

        until(tab, is_exact, "every pixel of the visible part is exact")
        spent = pictures()
        assert all("&form=quick" in path or "&part=0." in path for path in spent)
        assert sum("&part=" in path for path in spent) < np.prod(np.ceil(np.array(truth.shape[:2]) / 256))
        until(tab, lambda: tab.get_by_role("progressbar", name=PICTURE).count() == 0, "no picture is being loaded")
        assert body.is_visible()


@pytest.mark.slow
def test_dragging_the_contrast_loads_nothing_until_it_is_released(tab: Page, server: Served) -> None:
    enter(tab, server, server.port)
    until(tab, lambda: shown(tab, "scan").max() > 100, "the scan")
    tab.wait_for_load_state("networkidle")
    requested: list[str] = []
    tab.on("request", lambda request: requested.append(request.url) if "/picture/scan" in request.url else None)
    tab.locator("#scan-pane").get_by_role("button", name="Contrast").click()
    slider = tab.get_by_role("slider", name="White at")
    box = slider.bounding_box()
    assert box is not None
    before = shown(tab, "scan")
    y = box["y"] + box["height"] / 2
    tab.mouse.move(box["x"] + 0.97 * box["width"], y)
    tab.mouse.down()
    for share in np.linspace(0.95, 0.5, 12):
        tab.mouse.move(box["x"] + share * box["width"], y)
        two_frames(tab)
    preview = until(
        tab, lambda: s if np.abs((s := shown(tab, "scan")) - before).mean() > 3 else None, "the preview follows"
    )
    assert requested == []  # nor is one on its way: it would have another value than the slider has at last
    white = float(slider.input_value())
    tab.mouse.up()
    until(tab, lambda: requested, "the exact picture is requested")
    tab.wait_for_load_state("networkidle")
    assert all(f"high={slider.input_value()}" in url for url in requested)
    exact = until(
        tab, lambda: s if not np.array_equal((s := shown(tab, "scan")), preview) else None, "the exact one is shown"
    )
    assert white < 95
    assert np.abs(exact - preview).mean() < 4, "the preview was right"
    assert np.abs(exact - before).mean() > 3

    tab.get_by_role("button", name="Reset", exact=True).first.click()
    until(tab, lambda: np.array_equal(shown(tab, "scan"), before), "as at first")


@pytest.mark.slow
def test_the_range_is_previewed_in_its_own_colors(tab: Page, server: Served) -> None:
    enter(tab, server, server.port)
    tab.get_by_label("Channel of the scan").select_option("range")

    def colorful() -> bool:
        found = shown(tab, "scan")
        return bool((found.max(axis=-1) - found.min(axis=-1) > 60).mean() > 0.2)

    until(tab, colorful, "the range")
    tab.wait_for_load_state("networkidle")
    before = shown(tab, "scan")
    tab.locator("#scan-pane").get_by_role("button", name="Contrast").click()
    slider = tab.get_by_role("slider", name="White at")
    box = slider.bounding_box()
    assert box is not None
    y = box["y"] + box["height"] / 2
    tab.mouse.move(box["x"] + 0.97 * box["width"], y)
    tab.mouse.down()
    tab.mouse.move(box["x"] + 0.6 * box["width"], y, steps=5)
    preview = until(
        tab, lambda: s if np.abs((s := shown(tab, "scan")) - before).mean() > 3 else None, "the preview follows"
    )
    tab.mouse.up()
    exact = until(
        tab, lambda: s if not np.array_equal((s := shown(tab, "scan")), preview) else None, "the exact one is shown"
    )
    assert np.abs(exact - preview).mean() < 0.4 * np.abs(exact - before).mean()


@pytest.mark.slow
@pytest.mark.parametrize("side", ["scan", "photo"])
def test_a_spinner_turns_while_a_picture_is_loaded(tab: Page, server: Served, side: str) -> None:
    held: list[Route] = []
    tab.route(f"**/picture/{side}*" + ("/**" if side == "photo" else ""), lambda route: held.append(route))
    name = {"scan": "Loading the picture of the scan", "photo": "Loading the picture of the photograph"}
    tab.goto(f"{server.address}?token={server.token}", wait_until="commit")
    tab.get_by_role("button", name="connected").wait_for()
    spinner = tab.get_by_role("progressbar", name=name[side])
    spinner.wait_for()
    assert held

    def released() -> bool:
        while held:
            held.pop().continue_()
        return shown(tab, side).max() > 100

    def ended() -> bool:
        released()  # the exact squares are asked for later
        return spinner.count() == 0 or not spinner.is_visible()

    until(tab, released, "the picture")
    until(tab, ended, "the spinner ends")
    other = {"scan": "photo", "photo": "scan"}[side]
    assert not tab.get_by_role("progressbar", name=name[other]).is_visible()


@pytest.mark.slow
def test_returning_to_another_display_does_not_flash_the_default(tab: Page, server: Served) -> None:
    enter(tab, server, server.port)
    tab.get_by_label("Channel of the scan").select_option("range")
    tab.wait_for_function("JSON.parse(sessionStorage.getItem('ladarreg-view') ?? '{}').scan?.show === 'range'")
    tab.reload(wait_until="commit")
    tab.locator("html.returning").wait_for(state="attached")
    assert not tab.locator(".first-picture:visible").count()
    tab.get_by_role("button", name="connected").wait_for()
    assert tab.get_by_label("Channel of the scan").input_value() == "range"
