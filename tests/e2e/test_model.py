"""The 3-D model in the page: what is loaded when, its colours, viewpoints, marks, and what each person sees."""

from __future__ import annotations

import io
import json
import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
from PIL import Image

from ladarreg_core.foundations.palette import VISIBILITY
from ladarreg_core.simulate.sample import sample_folder
from testing.scenes.true_matches import true_points
from testing.workbench.pages import LONGEST_MS, two_frames
from testing.workbench.served import Page as Socket
from testing.workbench.served import Served
from testing.workbench.shared import SharedWorkbench

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Frame, Page, Request

pytestmark = pytest.mark.slow
SIZE = {"width": 1024, "height": 640}
DRAWN = "#model-pane [data-model=drawn]"
TEXTURE = "Texture of the model"
MESHES = """() => {
  let count = 0;
  window.__viserMutable.scene.traverse((o) => {
    const big = o.isMesh && o.name !== 'photo layer' && (o.geometry.attributes.position?.count ?? 0) > 1000;
    if (big) { let seen = true; for (let p = o; p; p = p.parent) seen &&= p.visible; count += seen; }
  });
  return count;
}"""
HIDDEN = """(names) => names.every((name) => {
  for (let node = window.__viserMutable.nodeRefFromName[name]; node; node = node.parent) if (!node.visible) return true;
  return !window.__viserMutable.nodeRefFromName[name];
})"""
"""Whether nodes of viser's scene are not seen."""
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
LAYER = """() => {
  const { camera, scene } = window.__viserMutable;
  const layer = scene.getObjectByName("photo layer");
  if (!layer) return null;
  layer.updateWorldMatrix(true, false);
  const { position, uv } = layer.geometry.attributes;
  const { width, height } = layer.material.map.source.data;
  const every = Array.from({ length: Math.floor(position.count / 7) }, (_, k) => 7 * k);
  const project = (k) => {
    const at = camera.position.clone().fromArray(position.array, 3 * k);
    const { x, y } = at.applyMatrix4(layer.matrixWorld).project(camera);
    return [(x + 1) / 2 * innerWidth, (1 - y) / 2 * innerHeight];
  };
  return [every.map(project), every.map((k) => [uv.array[2 * k], uv.array[2 * k + 1]]), [width, height]];
}"""


@pytest.fixture
def server(workbench: SharedWorkbench) -> Served:
    """A workbench with the solved sample, for those who change nothing."""
    workbench.look_at("solved")
    return workbench.server


class Visit:
    """A person's page, with the parts of the model that it requested."""

    def __init__(self, browser: Browser, server: Served) -> None:
        # The driver evaluates text in frames, which the policy of the 3-D page rightly forbids.
        self.context = browser.new_context(viewport=SIZE, bypass_csp=True)  # type: ignore[arg-type]
        self.context.set_default_timeout(LONGEST_MS)
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
        # Notices lie over the picture, and come and go by the clock.
        self.page.add_style_tag(content=".notice { display: none }")
        frame = self.page.frame(url=lambda address: "/viser/" in address)
        assert frame is not None
        return frame

    def pixels(self) -> np.ndarray:
        """Return what is seen in the 3-D pane, without its controls."""
        shot = self.page.locator("#model-pane .pane-body").screenshot()
        return np.asarray(Image.open(io.BytesIO(shot)).convert("RGB")).astype(int)[60:]

    def until(self, true: Any, what: str, seconds: int = 90) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if true(self.pixels()):
                return
            self.page.wait_for_timeout(100)
        pytest.fail(f"not seen: {what}")


@pytest.fixture
def visit(browser_3d: Browser, server: Served) -> Iterator[Visit]:
    found = Visit(browser_3d, server)
    yield found
    found.context.close()
    assert not found.errors


def colorful(pixels: np.ndarray) -> float:
    return float((pixels.max(axis=-1) - pixels.min(axis=-1) > 24).mean())


@pytest.mark.long
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
    visit.until(lambda pixels: colorful(pixels) > 0.05, "the colours of the photograph")

    held: list[Any] = []
    page.route("**/picture/model/texture?*kind=label*", lambda route: held.append(route))
    page.get_by_label(TEXTURE).select_option("label")
    visit.until(lambda _: held, "the request for the texture")
    before = visit.pixels()
    for _ in range(5):
        two_frames(page)
        frame.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
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


def test_the_camera_sees_the_textures_own_colors_and_matches_can_be_clicked(visit: Visit) -> None:
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
        return bool((off <= 3).mean() > 0.65 and seen.mean() > 0.3)  # edges are a large part of a small pane

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
    frame.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    page.mouse.click(box["x"] + u, box["y"] + v)
    frame.wait_for_function("() => window.__viserMutable.nodeRefFromName['/highlight/point']")


@pytest.mark.long
def test_two_people_have_their_own_textures_and_views(browser_3d: Browser, server: Served, visit: Visit) -> None:
    other = Visit(browser_3d, server)
    try:
        frames = visit.drawn(), other.drawn()
        other.page.keyboard.press("m")  # matches have colours
        other.page.get_by_label(TEXTURE).select_option("intensity")
        other.until(lambda pixels: colorful(pixels[:, : pixels.shape[1] // 2]) < 0.02, "gray for one")
        assert visit.page.get_by_label(TEXTURE).input_value() == "colour"
        assert colorful(visit.pixels()) > 0.05, "the photograph for the other"
        addresses = [frame.url for frame in frames]
        assert addresses[0] != addresses[1]
        status = "async (url) => (await fetch(url)).status"
        assert visit.page.evaluate(status, addresses[1]) == 401, "a session of another browser"
        theirs = addresses[1].rstrip("/").rpartition("/")[2].partition("?")[0]
        mine = addresses[0].partition("?")[0].rstrip("/").rpartition("/")[0]
        assert visit.page.evaluate(status, f"{mine}/{theirs}/") == 403, "their view in one's own session"
        visit.errors[:] = [text for text in visit.errors if "401" not in text and "403" not in text]
    finally:
        other.context.close()


@pytest.mark.long
def test_the_view_serves_as_a_rough_pose(browser_3d: Browser, workbench: SharedWorkbench) -> None:
    """The registration starts from where the person looks from in the 3-D view."""
    workbench.open("solved")
    server = workbench.server
    visit = Visit(browser_3d, server)
    visit.drawn()
    page, socket = visit.page, Socket(server)
    page.get_by_role("button", name="Scanner", exact=True).click()
    page.get_by_role("button", name="Display", exact=True).click()
    sheet = page.get_by_role("region", name="Rough pose")
    sheet.get_by_text("until it looks like the photograph").wait_for()
    sheet.get_by_role("button", name="Refine from here").click()
    sheet.wait_for(state="hidden")
    socket.until(
        lambda slices: [(slices["job"] or {}).get(key) for key in ("kind", "state")] == ["refine", "done"], 240
    )
    socket.until(lambda slices: slices["photos"][0]["state"] == "accepted", 60)
    socket.socket.close()
    visit.context.close()
    assert not visit.errors


@pytest.mark.long
def test_a_finer_photograph_is_drawn_with_its_own_pixels(
    browser_3d: Browser, workbench: SharedWorkbench, tmp_path: Path
) -> None:
    """All of its pixels are where the camera saw them, and are what is seen: a test card in its place appears."""
    finer = 3
    pixels = np.asarray(Image.open(next(sample_folder().glob("photo.*"))).convert("RGB"))
    large = cv2.resize(pixels, None, fx=finer, fy=finer, interpolation=cv2.INTER_CUBIC)
    Image.fromarray(large).save(tmp_path / "finer.png")
    height, width = large.shape[:2]
    row, column = np.mgrid[:height, :width] // 128
    colors = np.array([(200, 40, 40), (40, 160, 60), (50, 70, 200), (220, 190, 60)], np.uint8)
    card = colors[(row + 2 * column) % 4]
    encoded = io.BytesIO()
    Image.fromarray(card).save(encoded, "PNG")
    socket = workbench.open_files([sample_folder() / "scan.npz", tmp_path / "finer.png"])
    focal_px = json.loads((sample_folder() / "camera.json").read_text())["fx"]
    assert socket.ask("set_camera", photo="p1", focal_px=finer * focal_px)["ok"]
    assert socket.ask("set_settings", solve_automatically=False)["ok"]
    for point in true_points(16):
        ((u, v),) = point["photo_uv"]
        there = [[finer * (u + 0.5) - 0.5, finer * (v + 0.5) - 0.5]]
        assert socket.ask("add_pick", photo="p1", **(point | {"photo_uv": there}))["ok"]
    assert socket.ask("run", photo="p1", job="robust")["ok"]
    socket.until(lambda slices: slices["photos"][0]["state"] == "accepted")
    socket.socket.close()
    server = workbench.server
    visit = Visit(browser_3d, server)
    visit.page.route(
        "**/picture/model/photo*", lambda route: route.fulfill(body=encoded.getvalue(), content_type="image/png")
    )
    page, frame = visit.page, visit.drawn()
    page.get_by_role("button", name="Display", exact=True).click()
    page.get_by_role("checkbox", name="Legend").uncheck()
    page.keyboard.press("Escape")
    page.keyboard.press("m")
    page.get_by_role("button", name="Camera", exact=True).click()
    frame.wait_for_function(LAYER)

    def card_is_seen(_: np.ndarray) -> bool:
        shot = np.asarray(Image.open(io.BytesIO(page.locator(".model-frame").screenshot())).convert("RGB"))
        on_screen, uv, size = (np.array(part) for part in frame.evaluate(LAYER))
        assert size.tolist() == [width, height]
        warp, near = cv2.findHomography(uv * size - 0.5, on_screen, cv2.RANSAC, 1.0)
        if near.mean() < 0.98:  # the view still flies to the camera, from which the photograph is undistorted
            return False
        inside = on_screen[(on_screen > 40).all(axis=1) & (on_screen < np.array(shot.shape[1::-1]) - 40).all(axis=1)]
        places = cv2.perspectiveTransform(inside[None], np.linalg.inv(warp))[0].round().astype(int)
        clear = ((places % 128 > 24) & (places % 128 < 104)).all(axis=1)
        u, v = inside[clear].round().astype(int).T
        off = np.abs(shot[v, u].astype(int) - card[places[clear, 1], places[clear, 0]].astype(int)).max(axis=1)
        return bool(
            clear.sum() > 300 and (off < 12).mean() > 0.8
        )  # vertices at edges of the surface show what is beside it

    visit.until(card_is_seen, "the test card where the photograph's pixels belong")
    visit.context.close()


SLIDING = """() => {
  const { nodeRefFromName } = window.__viserMutable;
  let found = null;
  nodeRefFromName["/model"].traverse((o) => { if (o.name === "sliding photograph") found = o; });
  return found && [...found.geometry.attributes.uv.array.slice(0, 2000)];
}"""


@pytest.mark.long
def test_the_photograph_slides_over_the_model_and_is_replayed(browser: Browser, workbench: SharedWorkbench) -> None:
    workbench.open("solved")
    visit = Visit(browser, workbench.server)
    page, frame = visit.page, visit.drawn()
    assert frame.evaluate(SLIDING) is None
    socket = Socket(workbench.server)
    assert socket.ask("set_settings", start_from="scanner")["ok"]
    assert socket.ask("run", photo="p1", job="simplex")["ok"]
    frame.wait_for_function(f"({SLIDING})() !== null")
    socket.until(lambda slices: (slices.get("job") or {}).get("state") == "done")
    frame.wait_for_function(f"({SLIDING})() === null")
    page.get_by_role("tab", name="Solve", exact=True).click()
    slider = page.get_by_role("slider", name="Iteration")
    slider.fill("2")
    frame.wait_for_function(f"({SLIDING})() !== null")
    early = frame.evaluate(SLIDING)
    page.get_by_role("combobox", name="Speed of the replay").select_option("240")
    page.get_by_role("button", name="Replay", exact=True).click()
    visit.until(lambda _: slider.input_value() == slider.get_attribute("max"), "it is replayed to its end")
    visit.until(lambda _: frame.evaluate(SLIDING) != early, "the photograph has moved")
    page.get_by_role("button", name="End the replay").click()
    frame.wait_for_function(f"({SLIDING})() === null")
    socket.socket.close()
    assert not visit.errors
    visit.context.close()


SHEET = """() => {
  const { camera, scene } = window.__viserMutable;
  const sheet = scene.getObjectByName("photograph before its camera");
  if (!sheet) return null;
  sheet.updateWorldMatrix(true, false);
  const { position, uv } = sheet.geometry.attributes;
  return Array.from({ length: position.count }, (_, k) => {
    const at = camera.position.clone().fromArray(position.array, 3 * k).applyMatrix4(sheet.matrixWorld).project(camera);
    return [(at.x + 1) / 2 * innerWidth, (1 - at.y) / 2 * innerHeight, uv.array[2 * k], uv.array[2 * k + 1]];
  });
}"""


def test_who_looks_from_the_camera_sees_its_photograph_as_opaque_as_the_slider_says(visit: Visit) -> None:
    """At 100 % the photograph is what is seen, pixel by pixel; at 0 %, and from elsewhere, nothing of it is."""
    page, frame = visit.page, visit.drawn()
    slider = page.get_by_role("group", name="Opacity of the photograph").get_by_role("slider")
    page.get_by_role("button", name="Overview", exact=True).click()
    slider.wait_for(state="hidden")
    page.get_by_role("button", name="Camera", exact=True).click()
    slider.wait_for()
    assert frame.evaluate(SHEET) is None, "nobody asked for it yet"
    photograph = np.asarray(Image.open(next(sample_folder().glob("photo.*"))).convert("RGB")).astype(int)
    height, width = photograph.shape[:2]

    def seen(_: np.ndarray) -> bool:
        if frame.evaluate(SHEET) is None:
            return False
        shot = np.asarray(Image.open(io.BytesIO(page.locator(".model-frame").screenshot())).convert("RGB"))
        corners = np.array(frame.evaluate(SHEET))
        warp, _ = cv2.findHomography(corners[:, 2:] * [width, height] - 0.5, corners[:, :2] - 0.5)
        shown = cv2.warpPerspective(photograph.astype(np.uint8), warp, shot.shape[1::-1], flags=cv2.INTER_AREA)
        inside = cv2.warpPerspective(np.ones((height, width), np.uint8), warp, shot.shape[1::-1]) > 0
        inside[:70] = False  # the controls
        inside[-110:] = False
        blurred = [cv2.GaussianBlur(picture, (0, 0), 3).astype(int) for picture in (shot, shown)]
        off = np.abs(blurred[0] - blurred[1]).max(axis=-1)[inside]
        return bool(inside.mean() > 0.15 and np.median(off) < 4)

    slider.fill("1")
    visit.until(seen, "the photograph where it was taken")
    slider.fill("0.3")
    assert page.get_by_role("group", name="Opacity of the photograph").locator("output").text_content() == "30 %"
    page.keyboard.press("m")
    slider.fill("0")
    frame.wait_for_function(f"({SHEET})() === null")
    slider.fill("0.6")
    frame.wait_for_function(f"({SHEET})() !== null")
    page.get_by_role("button", name="Overview", exact=True).click()
    slider.wait_for(state="hidden")
    assert frame.evaluate(SHEET) is None, "from elsewhere nothing would lie on its place"


def test_two_textures_are_mixed_as_the_slider_says_without_another_transfer(visit: Visit) -> None:
    page = visit.page
    page.set_viewport_size({"width": 1280, "height": 900})
    frame = visit.drawn()
    page.locator("#model-pane [data-whole]").wait_for()
    page.keyboard.press("m")  # without matches and camera, once the workbench has taken them away
    frame.wait_for_function(f"() => ({HIDDEN})(['/matches/points', '/camera', '/scanner'])")
    legend, bar = page.get_by_role("group", name="Legend"), page.get_by_role("group", name="Blend of two textures")
    titles = {"intensity": "laser intensity", "range": "Range from the scanner, m"}

    def texture(kind: str) -> None:
        page.get_by_label(TEXTURE).select_option(kind)
        legend.locator("p", has_text=re.compile(titles[kind], re.IGNORECASE)).wait_for()

    def mix(kind: str) -> None:
        page.get_by_role("button", name="Display", exact=True).click()
        page.get_by_label("Blend with").select_option(kind)
        page.keyboard.press("Escape")

    def smooth(picture: np.ndarray) -> np.ndarray:
        """The browser may move a frame that lies between pixels by half of one at any time."""
        return np.asarray(cv2.GaussianBlur(picture.astype(np.float32), (0, 0), 3))

    def still() -> np.ndarray:
        """Return what is seen once it is the same twice."""
        before = visit.pixels()
        while True:
            two_frames(page)
            shown = visit.pixels()
            if np.array_equal(shown, before):
                return smooth(shown)
            before = shown

    texture("range")
    second = still()
    texture("intensity")
    first = still()
    assert colorful(first) < 0.02, "gray alone"
    assert colorful(second) > 0.1
    assert bar.is_hidden()

    mix("range")
    page.locator("#model-pane [data-mixed]").wait_for()
    for title in titles.values():
        legend.locator("p", has_text=re.compile(title, re.IGNORECASE)).wait_for()
    box, body = legend.bounding_box(), page.locator("#model-pane .pane-body").bounding_box()
    assert box is not None
    assert body is not None
    rows = int(box["y"] - body["y"]) - 60 - 4  # above the legends and the slider
    first, second = first[:rows], second[:rows]
    requested = len(visit.requested)
    for share in (0.0, 0.5, 1.0, 0.25):
        bar.get_by_role("slider").fill(str(share))
        expected = (1 - share) * first + share * second
        visit.until(
            lambda seen, expected=expected: np.abs(smooth(seen)[:rows] - expected).mean() < 2,
            f"both textures, {share:.0%} of the second",
        )
    shown = still()[:rows]
    assert np.percentile(np.abs(shown - (0.75 * first + 0.25 * second)), 95) < 8, "at nearly every pixel"
    assert np.abs(shown - (0.25 * first + 0.75 * second)).mean() > 4, "the control: shares exchanged"
    assert len(visit.requested) == requested, "the graphics card mixes them"

    texture("range")  # the one that was mixed in
    page.locator("#model-pane [data-mixed]").wait_for(state="detached")
    assert bar.is_hidden()
    visit.until(lambda seen: np.abs(smooth(seen)[:rows] - second).mean() < 2, "it alone")
    page.get_by_label(TEXTURE).select_option("colour")  # a texture with single colours, mixed with one with a scale
    page.locator("#model-pane [data-mixed]").wait_for()
    legend.locator("p", has_text="Colour of the photograph").wait_for()
    mix("")
    page.locator("#model-pane [data-mixed]").wait_for(state="detached")
    assert bar.is_hidden()
