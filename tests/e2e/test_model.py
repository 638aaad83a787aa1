"""The 3-D model in the page: what is loaded when, its colours, viewpoints, marks, and what each person sees."""

from __future__ import annotations

import io
import json
import sys
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from PIL import Image

from ladarreg_core.palette import VISIBILITY
from ladarreg_core.simulate.sample import sample_folder
from tests.served_workbench import Page as Socket
from tests.served_workbench import Served, served

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Frame, Page, Request

pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform == "win32", reason="the server is ended by a signal")]
SIZE = {"width": 1280, "height": 720}
DRAWN = "#model-pane [data-model=drawn]"
TEXTURE = "Texture of the model"
MESHES = """() => {
  let count = 0;
  window.__viserMutable.scene.traverse((o) => {
    const big = o.isMesh && (o.geometry.attributes.position?.count ?? 0) > 1000;
    if (big) { let seen = true; for (let p = o; p; p = p.parent) seen &&= p.visible; count += seen; }
  });
  return count;
}"""
PROJECTED = """() => {
  let points = null;
  const { camera, nodeRefFromName } = window.__viserMutable;
  nodeRefFromName["/matches/points"].traverse((o) => { if (o.isPoints) points = o; });
  points.updateWorldMatrix(true, false);
  const places = points.geometry.attributes.position;
  return Array.from({ length: places.count }, (_, k) => {
    const at = camera.position.clone().fromArray(places.array, 3 * k).applyMatrix4(points.matrixWorld).project(camera);
    return [(at.x + 1) / 2 * innerWidth, (1 - at.y) / 2 * innerHeight];
  });
}"""


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """A workbench with the registered sample."""
    with served(tmp_path_factory.mktemp("model") / "project") as (found, _):
        socket = Socket(found)
        camera = json.loads((sample_folder() / "camera.json").read_text())
        assert socket.ask("set_camera", photo="p1", focal_px=camera["fx"])["ok"]
        assert socket.ask("run", photo="p1", job="auto")["ok"]
        socket.until(lambda slices: slices["photos"][0]["state"] == "accepted", 240)
        socket.socket.close()
        yield found


class Visit:
    """A person's page, with the parts of the model that it requested."""

    def __init__(self, browser: Browser, server: Served) -> None:
        # The driver evaluates text in frames, which the policy of the 3-D page rightly forbids.
        self.context = browser.new_context(viewport=SIZE, bypass_csp=True)  # type: ignore[arg-type]
        self.context.add_init_script("localStorage.setItem('ladarreg-software-drawing', 'dismissed')")
        self.page: Page = self.context.new_page()
        self.errors: list[str] = []
        self.requested: list[str] = []
        self.page.on("console", lambda m: self.errors.append(m.text) if m.type == "error" else None)
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("request", self._note)
        self.page.goto(f"{server.address}?token={server.token}")

    def _note(self, request: Request) -> None:
        if "picture/model/" in request.url:
            self.requested.append(request.url.partition("picture/model/")[2])

    def drawn(self) -> Frame:
        """Wait for the model and return viser's frame."""
        self.page.locator(DRAWN).wait_for(timeout=90_000)
        self.page.locator(".model-loading").wait_for(state="hidden")
        frame = self.page.frame(url=lambda address: "/viser/" in address)
        assert frame is not None
        return frame

    def pixels(self) -> np.ndarray:
        """Return what is seen in the 3-D pane, without its controls."""
        shot = self.page.locator("#model-pane .pane-body").screenshot()
        return np.asarray(Image.open(io.BytesIO(shot)).convert("RGB")).astype(int)[60:]

    def until(self, true: Any, what: str, seconds: int = 60) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if true(self.pixels()):
                return
            self.page.wait_for_timeout(100)
        pytest.fail(f"not seen: {what}")


@pytest.fixture
def visit(browser: Browser, server: Served) -> Iterator[Visit]:
    found = Visit(browser, server)
    yield found
    found.context.close()
    assert not found.errors


def colourful(pixels: np.ndarray) -> float:
    return float((pixels.max(axis=-1) - pixels.min(axis=-1) > 24).mean())


def test_only_the_scene_is_seen_of_viser_and_textures_follow_each_other_without_a_gap(visit: Visit) -> None:
    page, cover = visit.page, visit.page.locator(".model-cover")
    assert cover.is_visible()
    assert cover.evaluate("(cover) => getComputedStyle(cover).backgroundColor") == "rgb(15, 17, 21)"
    frame = visit.drawn()
    cover.wait_for(state="hidden")
    seen = frame.evaluate(
        "() => [...document.body.querySelectorAll('*')].filter((e) => e.tagName !== 'CANVAS'"
        " && getComputedStyle(e).visibility !== 'hidden').length"
    )
    assert seen == 0, "viser's panel, logo and notices"
    assert frame.evaluate("() => document.querySelectorAll('body button').length") > 0, "which are there"
    assert frame.evaluate("() => getComputedStyle(document.documentElement).backgroundColor") == "rgb(15, 17, 21)"
    details = [url.partition("detail=")[2].partition("&")[0] for url in visit.requested if url.startswith("mesh")]
    assert details == ["coarse", "standard"]
    assert frame.evaluate(MESHES) == 1
    visit.until(lambda pixels: colourful(pixels) > 0.05, "the colours of the photograph")

    held: list[Any] = []
    page.route("**/picture/model/texture?*kind=label*", lambda route: held.append(route))
    page.get_by_label(TEXTURE).select_option("label")
    visit.until(lambda _: held, "the request for the texture")
    before = visit.pixels()
    page.wait_for_timeout(500)
    assert frame.evaluate(MESHES) == 1
    assert np.abs(visit.pixels() - before).max() <= 2, "nothing changes while the texture is on its way"
    held.pop().continue_()
    legend = page.get_by_role("group", name="Legend")
    legend.get_by_text("seen by the camera").wait_for()
    assert frame.evaluate(MESHES) == 1
    count = len(visit.requested)
    page.get_by_label(TEXTURE).select_option("colour")
    legend.get_by_text("Colour of the photograph").wait_for()
    assert len(visit.requested) == count, "a recent texture is shown without a transfer"


def test_the_camera_sees_the_textures_own_colours_and_matches_can_be_clicked(visit: Visit) -> None:
    page, frame = visit.page, visit.drawn()
    page.get_by_role("button", name="Display", exact=True).click()
    page.get_by_role("checkbox", name="Legend").uncheck()
    page.keyboard.press("Escape")
    page.get_by_label(TEXTURE).select_option("label")
    page.get_by_role("button", name="Camera", exact=True).click()
    page.keyboard.press("m")

    def exact(pixels: np.ndarray) -> bool:
        off = np.abs(pixels[:, :, None] - np.array([*VISIBILITY, (15, 17, 21)])).max(axis=-1).min(axis=-1)
        seen = np.abs(pixels - np.array(VISIBILITY[1])).max(axis=-1) <= 3
        return bool((off <= 3).mean() > 0.75 and seen.mean() > 0.3)

    visit.until(exact, "the colours of the classes, of which the camera sees most")
    page.keyboard.press("m")
    frame.wait_for_function("() => window.__viserMutable.nodeRefFromName['/matches/points']?.visible")
    box = page.locator(".model-frame").bounding_box()
    assert box is not None
    inside = [
        (u, v) for u, v in frame.evaluate(PROJECTED) if 30 < u < box["width"] - 30 and 30 < v < box["height"] - 30
    ]
    u, v = min(inside, key=lambda at: abs(at[0] - box["width"] / 2) + abs(at[1] - box["height"] / 2))
    page.mouse.move(box["x"] + u + 1, box["y"] + v)
    page.wait_for_timeout(200)
    page.mouse.click(box["x"] + u, box["y"] + v)
    frame.wait_for_function("() => window.__viserMutable.nodeRefFromName['/highlight/point']")


def test_two_people_have_their_own_textures_and_views(browser: Browser, server: Served, visit: Visit) -> None:
    other = Visit(browser, server)
    try:
        frames = visit.drawn(), other.drawn()
        other.page.keyboard.press("m")  # matches have colours
        other.page.get_by_label(TEXTURE).select_option("intensity")
        other.until(lambda pixels: colourful(pixels[:, : pixels.shape[1] // 2]) < 0.02, "gray for one")
        assert visit.page.get_by_label(TEXTURE).input_value() == "colour"
        assert colourful(visit.pixels()) > 0.05, "the photograph for the other"
        addresses = [frame.url for frame in frames]
        assert addresses[0] != addresses[1]
        status = visit.page.evaluate("async (url) => (await fetch(url)).status", addresses[1])
        assert status == 403, "a view of another browser"
        visit.errors[:] = [text for text in visit.errors if "403" not in text]
    finally:
        other.context.close()


def test_the_view_serves_as_a_rough_pose(visit: Visit, server: Served) -> None:
    """The registration starts from where the person looks from in the 3-D view."""
    visit.drawn()
    page, socket = visit.page, Socket(server)
    page.get_by_role("button", name="Scanner", exact=True).click()
    page.get_by_role("button", name="Display", exact=True).click()
    sheet = page.get_by_role("region", name="Rough pose")
    sheet.get_by_text("until it looks like the photograph").wait_for()
    sheet.get_by_role("button", name="Refine from here").click()
    sheet.wait_for(state="hidden")
    socket.until(lambda slices: (slices["job"]["kind"], slices["job"]["state"]) == ("refine", "done"), 240)
    socket.until(lambda slices: slices["photos"][0]["state"] == "accepted", 60)
    socket.socket.close()
