"""A scan of a whole room in the page: the strip turns the view, poses turn it, and what is drawn is a direction."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from testing.workbench.pages import LONGEST_MS, choose_photo, without_model
from testing.workbench.shared import SharedWorkbench

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Locator, Page

pytest.importorskip("embreex", reason="the simulator needs the extra `simulate`")
pytestmark = pytest.mark.slow
STRIP = "Overview of the scan: look around"
SLICE = "(name) => import('./js/net/store.js').then(({ store }) => store.get(name))"
AXIS = """() => Promise.all([import('./js/net/store.js'), import('./js/state/view.js')]).then(([{ store }, { view }]) =>
  store.get('scan').views[view.get().scan.view].rotation.slice(6, 9))"""


@pytest.fixture(scope="session")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, float]:
    """Folder of the room's scan and photographs, and their focal length in pixels."""
    from testing.scenes.whole_room import whole_room

    folder = tmp_path_factory.mktemp("panorama")
    room = whole_room(step_deg=0.25)
    room.write(folder)
    return folder, next(iter(room.photos.values())).camera.focal_px


@pytest.fixture
def operator(browser: Browser, workbench: SharedWorkbench, simulated: tuple[Path, float]) -> Iterator[Page]:
    """A page with the room and its two photographs."""
    folder, focal = simulated
    socket = workbench.open_files([folder / name for name in ("scan.npz", "behind.png", "ahead.png")])
    for photo in socket.slices["photos"]:
        assert socket.ask("set_camera", photo=photo["id"], focal_px=focal)["ok"]
    socket.socket.close()
    page = browser.new_context(viewport={"width": 1280, "height": 720}, bypass_csp=True).new_page()
    page.set_default_timeout(LONGEST_MS)
    errors: list[str] = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    without_model(page)
    page.goto(f"{workbench.server.address}?token={workbench.server.token}")
    page.get_by_role("slider", name=STRIP).wait_for()
    page.locator("#scan-pane .pane-zoom", has_text="%").wait_for(state="attached")
    yield page
    page.context.close()
    assert not errors


def until(page: Page, true: Any, what: str, seconds: float = 90) -> None:
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, what
        page.wait_for_timeout(100)


def axis(page: Page) -> np.ndarray:
    """Return the direction in which the shown view looks."""
    return np.array(page.evaluate(AXIS))


def look_to(page: Page, strip: Locator, azimuth_deg: float) -> None:
    """Drag the strip from its middle to an azimuth."""
    box = strip.bounding_box()
    assert box is not None
    y = box["y"] + 0.6 * box["height"]
    page.mouse.move(box["x"] + 0.5 * box["width"], y)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] * (0.5 - azimuth_deg / 360), y, steps=5)
    page.mouse.up()


def test_the_strip_turns_the_view_and_a_half_drawn_match_stays(operator: Page) -> None:
    from playwright.sync_api import expect

    page, strip = operator, operator.get_by_role("slider", name=STRIP)
    pane = page.locator("#scan-pane .pane-body")
    look_to(page, strip, 40)
    assert np.degrees(np.arctan2(*axis(page)[1::-1])) == pytest.approx(40, abs=16)
    look_to(page, strip, -172)
    expect(strip).to_have_attribute("aria-valuenow", re.compile(r"^-17[0-4]$"))
    box = pane.bounding_box()
    assert box is not None
    page.mouse.click(box["x"] + 0.45 * box["width"], box["y"] + 0.6 * box["height"])  # the first end of a line
    strip.press("Shift+ArrowRight")  # across the seam
    expect(strip).to_have_attribute("aria-valuenow", re.compile(r"^15[6-9]|16[0-1]$"))
    page.mouse.click(box["x"] + 0.5 * box["width"], box["y"] + 0.6 * box["height"])
    page.locator("#photo-pane .pane-body.awaits-partner").wait_for()
    photo = page.locator("#photo-pane .pane-body").bounding_box()
    assert photo is not None
    for u in (0.4, 0.6):
        page.mouse.click(photo["x"] + u * photo["width"], photo["y"] + 0.5 * photo["height"])
    shown = page.evaluate(SLICE, "shown")
    until(page, lambda: page.evaluate(SLICE, f"picks:{shown}"), "the match is kept")
    (match,) = page.evaluate(SLICE, f"picks:{shown}")
    ends = np.array(match["scan"])
    assert (ends[:, 0] < -0.5).all()  # behind the scanner
    assert ends[0, 1] < ends[1, 1]  # from one side of the seam to the other
    assert 10 < np.degrees(np.arccos(ends[0] @ ends[1])) < 70
    page.keyboard.press("Control+z")
    until(page, lambda: not page.evaluate(SLICE, f"picks:{shown}"), "the match is taken back")


@pytest.mark.long
def test_a_pose_turns_the_view_and_the_strip_shows_where_photographs_lie(operator: Page) -> None:
    page, strip = operator, operator.get_by_role("slider", name=STRIP)
    choose_photo(page, "ahead.png")
    look_to(page, strip, 120)
    assert page.get_by_role("button", name="Look where the photograph looks").is_hidden()
    until(page, lambda: page.evaluate(SLICE, "shown") == "p2", "the photograph is shown")
    page.get_by_role("button", name="Register automatically").click()
    until(page, lambda: (page.evaluate(SLICE, "outline:p2") or {}).get("registered"), "the photograph is registered")
    true = np.array([1.0, 0.25, 0.0]) / np.linalg.norm([1.0, 0.25, 0.0])
    until(page, lambda: axis(page) @ true > np.cos(np.deg2rad(22)), "the view turns to the pose")
    assert re.search(r"ahead.png: (\d|1\d) degrees left", str(strip.get_attribute("aria-description")))
    middle = np.mean(page.evaluate(SLICE, "outline:p2")["rays"], axis=0)
    assert middle @ true / np.linalg.norm(middle) > np.cos(np.deg2rad(10))  # it is seen from beside the camera

    look_to(page, strip, -90)
    assert axis(page) @ true < 0.5
    page.get_by_role("button", name="Look where the photograph looks").click()
    until(page, lambda: axis(page) @ true > np.cos(np.deg2rad(22)), "the button turns back")
    choose_photo(page, "behind.png")
    until(page, lambda: page.evaluate(SLICE, "shown") == "p1", "the other photograph is shown")
    look_to(page, strip, 170)
    choose_photo(page, "ahead.png")
    until(page, lambda: axis(page) @ true > np.cos(np.deg2rad(22)), "choosing the photograph turns to it")
