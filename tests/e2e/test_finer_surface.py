"""The surface of a large scan in the 3-D view: coarse everywhere, finer where somebody looks, never too much of it."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from ladarreg_core.formats.scans.npz import write_npz_panorama
from testing.workbench.pages import LONGEST_MS
from testing.workbench.shared import SharedWorkbench
from tests.unit.surface.test_grid_block import room_scan

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

pytestmark = pytest.mark.slow
MAX_VERTICES = 400_000
SURFACES = """() => {
  const { scene } = document.querySelector("iframe.model-frame").contentWindow.__viserMutable;
  const found = { block: [], whole: [] };
  scene.traverse((o) => {
    const { position, uv } = o.geometry?.attributes ?? {};
    if (!o.isMesh || !uv || position.count < 1000) return;
    const [u, v] = [0, 1].map((k) => Array.from({ length: uv.count }, (_, n) => uv.array[2 * n + k]));
    const ends = (values) => [values.reduce((a, b) => Math.min(a, b)), values.reduce((a, b) => Math.max(a, b))];
    found[o.name === "block" ? "block" : "whole"].push([position.count, o.geometry.index.count / 3, ends(u), ends(v)]);
  });
  return found;
}"""


def surfaces(page: Page, wanted: Any, meanwhile: Callable[[], None] = lambda: None) -> dict[str, list[Any]]:
    """Return the surfaces that are drawn, once they are as wanted."""
    end = time.monotonic() + 90
    while True:
        meanwhile()
        found: dict[str, list[Any]] = page.evaluate(SURFACES)
        if wanted(found):
            return found
        assert time.monotonic() < end, found
        page.wait_for_timeout(200)


def turn(page: Page) -> None:
    """Turn the view by dragging."""
    frame = page.locator("iframe.model-frame").bounding_box()
    assert frame is not None
    x, y = frame["x"] + frame["width"] / 2, frame["y"] + frame["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 200, y, steps=6)
    page.mouse.up()


@pytest.mark.long
def test_the_surface_is_finer_where_somebody_looks(
    browser_3d: Browser, workbench: SharedWorkbench, tmp_path: Path
) -> None:
    write_npz_panorama(tmp_path / "scan.npz", room_scan((1000, 2000)))
    workbench.open_files([tmp_path / "scan.npz"]).socket.close()
    page = browser_3d.new_context(viewport={"width": 1024, "height": 640}, bypass_csp=True).new_page()
    page.set_default_timeout(LONGEST_MS)
    errors: list[str] = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.goto(f"{workbench.server.address}?token={workbench.server.token}")
    page.locator("#model-pane [data-model=drawn]").wait_for()
    page.get_by_role("button", name="Scanner", exact=True).click()
    first = surfaces(page, lambda found: found["block"])
    ((vertices, faces, _, _),) = first["whole"]
    whole = sum(count for count, *_ in first["block"]) + vertices
    assert whole <= MAX_VERTICES
    for count, _, (left, right), (top, bottom) in first["block"]:
        density = count / ((right - left) * (bottom - top))  # vertices over the whole grid
        assert density > 3 * vertices

    def moved(found: dict[str, list[Any]]) -> bool:
        return bool(found["block"]) and found["block"] != first["block"]

    # Again, if the view from the scanner came after it and took it back.
    second = surfaces(page, moved, meanwhile=lambda: turn(page))
    assert sum(count for kind in second.values() for count, *_ in kind) <= MAX_VERTICES

    page.get_by_role("button", name="Display", exact=True).click()
    page.get_by_label("Detail").select_option("coarse")
    last = surfaces(page, lambda found: found["whole"] and found["whole"][0][0] < vertices / 2)
    assert not last["block"]  # a computer without a graphics card draws as little as possible
    assert last["whole"][0][1] < faces
    assert not errors
