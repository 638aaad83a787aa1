"""The demo as a person meets it: one command, one address, one page."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from PIL import Image

from app.panel import BLEND_LABEL
from app.scene import BACKGROUND
from ladarreg_core.simulate.embedded import sample_folder
from tests.e2e.conftest import SIZE, keep, wait_for_pixels
from tests.processes import hear_ctrl_c

if TYPE_CHECKING:
    from playwright.sync_api import Page

pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform == "win32", reason="no Ctrl-C to send")]
SMALL = (1100, 620)
PANEL_WIDTH = 350


@pytest.fixture(scope="module")
def demo(checkout: Path) -> Iterator[str]:
    """The address of a running demo; it must end cleanly at Ctrl-C."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    process = subprocess.Popen(
        [sys.executable, "-m", "app", "demo", "--port", str(port), "--no-browser"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=checkout, preexec_fn=hear_ctrl_c,
    )  # fmt: skip
    assert process.stdout is not None
    said = []
    for line in process.stdout:
        said.append(line)
        if line.startswith("Open "):
            break
    assert said, process.communicate()[1]
    assert said[-1].startswith("Open "), "".join(said)
    assert [word for line in said for word in line.split() if "://" in word] == [f"http://127.0.0.1:{port}"]
    yield f"http://127.0.0.1:{port}"
    process.send_signal(signal.SIGINT)
    rest, errors = process.communicate(timeout=60)
    assert process.returncode == 0, errors
    assert rest == ""
    assert "Traceback" not in errors


def model_part(shown: np.ndarray) -> np.ndarray:
    """The page without viser's panel and notice."""
    return shown[160:, :-PANEL_WIDTH]


def drawn(shown: np.ndarray) -> float:
    """Return the share of the scene that is not background."""
    return float((np.abs(model_part(shown).astype(int) - BACKGROUND).max(axis=-1) > 6).mean())


def colourful(shown: np.ndarray) -> float:
    """Return the share of the scene that is clearly not gray."""
    part = model_part(shown).astype(int)
    return float((part.max(axis=-1) - part.min(axis=-1) > 20).mean())


def open_page(page: Page, address: str, *, size: tuple[int, int] | None = None) -> np.ndarray:
    """Open the demo; with a size, draw half as many pixels that way: rendering in software is slow."""
    if size is not None:
        page.set_viewport_size({"width": size[0], "height": size[1]})
    page.goto(address + ("/?fixedDpr=0.5" if size else ""))
    page.get_by_role("status").wait_for(timeout=60_000)
    return wait_for_pixels(page, lambda shown: drawn(shown) > 0.15, what="the model")


def test_the_first_look(page: Page, demo: str, checkout: Path) -> None:
    assert drawn(open_page(page, demo)) > 0.3, "the model does not fill the view"
    assert "Accepted" in page.get_by_role("status").inner_text()
    assert page.get_by_text("hold,").count() == 1
    page.get_by_label("Close").first.or_(page.locator(".mantine-Notification-closeButton").first).click()
    page.mouse.move(SIZE[0] / 2, SIZE[1] - 5)
    keep(page, checkout, "demo")


def test_from_the_cameras_place_the_model_is_the_photograph(page: Page, demo: str) -> None:
    """Pose, texture, colours and viewpoint in one: any of them wrong, and the two pictures differ."""
    photo = np.asarray(Image.open(sample_folder() / "photo.png").convert("RGB"))
    height, width = photo.shape[:2]
    open_page(page, demo, size=(2 * width, 2 * height))
    page.get_by_text("Camera", exact=True).click()

    def difference(shown: np.ndarray, shift: int = 0) -> float:
        small = np.asarray(Image.fromarray(shown).resize((width, height), Image.Resampling.BOX)).astype(int)
        seen, taken = small[90:, 10 : width - 190], np.roll(photo, shift, axis=1)[90:, 10 : width - 190].astype(int)
        return float(np.median(np.abs(seen - taken).max(axis=-1)))

    shown = wait_for_pixels(page, lambda shown: difference(shown) < 14, what="the photograph, as a model")
    assert difference(shown, 6) > 1.3 * difference(shown)
    assert difference(shown, -6) > 1.3 * difference(shown)


def test_the_slider_goes_from_colour_to_laser_and_back(page: Page, demo: str) -> None:
    open_page(page, demo, size=SMALL)
    for box in page.get_by_role("checkbox").all():
        box.set_checked(False, force=True)
    before = wait_for_pixels(page, lambda shown: colourful(shown) > 0.05, what="the model alone")
    slider = page.get_by_role("slider").first
    slider.focus()
    page.keyboard.press("Home")
    gray = wait_for_pixels(page, lambda shown: colourful(shown) < 0.002, what="the laser's own gray")
    assert drawn(gray) > 0.2
    page.keyboard.press("End")
    wait_for_pixels(
        page,
        lambda shown: np.abs(model_part(shown).astype(int) - model_part(before)).mean() < 0.5,
        what="the colours again",
    )
    assert page.get_by_text(BLEND_LABEL).count() == 1
