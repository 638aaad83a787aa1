"""Smoothing of ranges in the page, on a simulated scan with spikes whose true ranges are known."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import numpy as np
import pytest

import ladarreg_core as lr
from ladarreg_core.simulate.sample import sample_folder
from testing.scenes.spiked_scan import SpikedScan, spiked_sample
from testing.workbench.audits import layout_faults
from testing.workbench.measured_truth import page_smoothing
from testing.workbench.operator import Operator, at_work
from testing.workbench.page_truth import facts_of

if TYPE_CHECKING:
    from collections.abc import Iterator

    from playwright.sync_api import Browser

    from ladarreg_core.foundations.arrays import FloatArray
    from testing.workbench.shared import SharedWorkbench

_RING = np.array([242, 114, 111])


@pytest.fixture(scope="module")
def spiked(tmp_path_factory: pytest.TempPathFactory) -> SpikedScan:
    return spiked_sample(tmp_path_factory.mktemp("spiked") / "spiked.npz")


@pytest.fixture
def smoother(
    browser: Browser, workbench: SharedWorkbench, spiked: SpikedScan, request: pytest.FixtureRequest
) -> Iterator[Operator]:
    """An operator at the spiked scan with a photograph that is registered by points, some of them on spikes."""
    folder = sample_folder()
    socket = workbench.open_files([spiked.file, next(folder.glob("photo.*")), folder / "camera.json"])
    assert socket.ask("set_settings", solve_automatically=False)["ok"]
    for match in spiked.matches:
        assert socket.ask("add_pick", photo="p1", **match)["ok"]
    assert socket.ask("run", photo="p1", job="robust")["ok"]
    socket.until(lambda slices: slices["photos"][0]["state"] == "accepted")
    socket.socket.close()
    with at_work(browser, workbench.server, request) as found:
        found.open()
        found.step("Judge")
        yield found


def listed(operator: Operator) -> dict[tuple[int, int], list[str]]:
    """Return the rows of the preview, by cell."""
    rows = facts_of(operator.page)["smoothing"]["rows"]
    return {tuple(map(int, row[0].split("."))): row[1:] for row in rows}  # type: ignore[misc]


def probed(operator: Operator, spiked: SpikedScan, cell: tuple[int, int]) -> float:
    """Return the range of a cell as the workbench reads it."""
    reply = operator.socket.ask("probe", scan=ray_of(spiked, cell).tolist())
    return float(reply["range_m"])


def ray_of(spiked: SpikedScan, cell: tuple[int, int]) -> FloatArray:
    return np.asarray(lr.read_scan(spiked.file).geometry.ray_at(np.array([cell], float))[0])


def ringed_pixels(operator: Operator, uv: tuple[float, float]) -> int:
    """Return how many pixels about a place of the scan have the colour of a ring."""
    import cv2

    x, y = operator.place("scan", uv)
    clip = {"x": x - 14, "y": y - 14, "width": 28, "height": 28}
    picture = cv2.imdecode(np.frombuffer(operator.page.screenshot(clip=clip), np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    return int((np.abs(picture[..., ::-1].astype(int) - _RING).max(axis=2) < 24).sum())


def uv_of(operator: Operator, spiked: SpikedScan, cell: tuple[int, int]) -> tuple[float, float]:
    """Return the pixel of a cell in the scan's first view."""
    view = operator.slice("scan")["views"][0]
    ray = np.array(view["rotation"]).reshape(3, 3) @ ray_of(spiked, cell)
    return float(view["f"] * ray[0] / ray[2] + view["cx"]), float(view["f"] * ray[1] / ray[2] + view["cy"])


@pytest.mark.slow
def test_spikes_are_seen_before_they_are_smoothed_and_edges_are_left(smoother: Operator, spiked: SpikedScan) -> None:
    page, before = smoother.page, smoother.slice("scan")
    smoother.button("Smooth ranges…").click()
    page.get_by_role("button", name="Difference", exact=True).wait_for()
    rows = listed(smoother)
    edges = {cell for cell, row in rows.items() if row[0] == "Depth edge"}
    spikes = set(rows) - edges
    assert len(spikes) >= 12
    assert edges
    nearer = [
        abs(float(row[2]) - spiked.truth[cell]) < abs(float(row[1]) - spiked.truth[cell]) for cell, row in rows.items()
    ]
    assert np.mean(nearer) >= 0.9
    assert all(spiked.spiked[cell] for cell in rows)
    assert smoother.slice("scan") == before  # nothing is applied unseen

    chosen = sorted(spikes)[0]
    at = uv_of(smoother, spiked, chosen)
    smoother.wait(lambda: ringed_pixels(smoother, at) > 10, "a ring in the scan")
    page.locator(f'[data-range="{chosen[0]}.{chosen[1]}"]').get_by_role("button").click()
    page.locator(f'[data-range="{chosen[0]}.{chosen[1]}"].chosen').wait_for()
    page.locator("#scan-pane").get_by_text("200 %", exact=True).wait_for()
    for name in ("Before", "After", "Difference"):
        shown = page.get_by_role("button", name=name, exact=True)
        shown.click()
        smoother.wait(lambda shown=shown: shown.get_attribute("aria-pressed") == "true", name)
    assert layout_faults(page) == []
    smoother.shot("smoothing-preview")

    page.get_by_role("button", name="Discard").click()
    page.get_by_role("region", name="Smoothed ranges").wait_for(state="hidden")
    assert smoother.slice("scan") == before
    page.locator("#scan-pane").get_by_role("button", name="Fit").click()
    smoother.wait(lambda: ringed_pixels(smoother, at) == 0, "no ring any more")

    smoother.button("Smooth ranges…").click()
    page.get_by_label("At depth edges, too").check()
    smoother.button(f"Apply to {len(rows)} ranges").wait_for()
    page.get_by_label("At depth edges, too").uncheck()
    smoother.button(f"Apply to {len(spikes)} ranges").click()
    smoother.wait(lambda: smoother.slice("smoothing")["replaced"] == len(spikes), "the replaced ranges")
    page.get_by_text(f"{len(spikes)} ranges were replaced by stereo").wait_for()
    for cell in spikes:
        assert probed(smoother, spiked, cell) == pytest.approx(float(rows[cell][2]), abs=0.02), cell
    assert page_smoothing(facts_of(page), smoother.slice("smoothing")) == []
    smoother.shot("smoothing-applied")

    page.keyboard.press("Control+z")
    smoother.wait(lambda: smoother.slice("smoothing")["replaced"] == 0, "the measured ranges")
    assert smoother.slice("scan") == before
    page.keyboard.press("Control+y")
    smoother.wait(lambda: smoother.slice("smoothing")["replaced"] == len(spikes), "the replaced ranges once more")
    smoother.button("Restore the measured ranges").click()
    smoother.wait(lambda: smoother.slice("photos")[0]["state"] == "stale", "a pose that is out of date")
    assert re.search("other ranges", smoother.slice("photos")[0]["stale"])
