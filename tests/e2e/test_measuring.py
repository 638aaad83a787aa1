"""Measuring in the page: clicked points, whose values and intervals are compared with the simulated scene."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from numpy.typing import NDArray

from ladarreg_core.formats import read_scan
from ladarreg_core.formats.cameras.camera_file import read_camera
from ladarreg_core.formats.scans.npz import write_npz_xyz
from ladarreg_core.simulate.case import case_world
from ladarreg_core.simulate.sample import SCENE, SEED, sample_folder
from testing.scenes.thinned_scan import thinned
from testing.workbench.audits import layout_faults
from testing.workbench.measured_truth import page_measurements
from testing.workbench.operator import Operator, at_work
from testing.workbench.page_truth import facts_of

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from playwright.sync_api import Browser

    from testing.workbench.shared import SharedWorkbench


@pytest.fixture
def measurer(browser: Browser, workbench: SharedWorkbench, request: pytest.FixtureRequest) -> Iterator[Operator]:
    """An operator at the sample with a registered photograph."""
    workbench.open("solved")
    with at_work(browser, workbench.server, request) as found:
        found.open()
        yield found


@pytest.fixture
def modeller(browser: Browser, workbench: SharedWorkbench, request: pytest.FixtureRequest) -> Iterator[Operator]:
    """The same with the model, which other tests leave out."""
    workbench.open("solved")
    with at_work(browser, workbench.server, request) as found:
        found.page.unroute("**/viser/**")
        found.page.add_init_script("localStorage.setItem('ladarreg-software-drawing', 'dismissed')")
        found.open()
        yield found


def first_hit(origin: NDArray[np.float64], ray: NDArray[np.float64]) -> float:
    """Return the distance to the first triangle of the sample's scene along a ray. Source: Moeller and Trumbore."""
    a, b, c = np.moveaxis(np.asarray(case_world(SCENE, seed=SEED).triangles, np.float64), 1, 0)
    p = np.cross(ray, c - a)
    determinant = ((b - a) * p).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1 / determinant
        t = origin - a
        u = (t * p).sum(axis=1) * inverse
        q = np.cross(t, b - a)
        v = (q @ ray) * inverse
        distance = ((c - a) * q).sum(axis=1) * inverse
    hits = (u >= 0) & (v >= 0) & (u + v <= 1) & (distance > 1e-6)
    return float(distance[hits].min())


def ray_of(operator: Operator, uv: Any) -> NDArray[np.float64]:
    """Return the unit ray (3,) of the scanner through a pixel of the scan's first view."""
    view = operator.slice("scan")["views"][0]
    ray = np.array([(uv[0] - view["cx"]) / view["f"], (uv[1] - view["cy"]) / view["f"], 1.0])
    ray = np.array(view["rotation"]).reshape(3, 3).T @ ray
    return np.asarray(ray / np.linalg.norm(ray))


def true_place(operator: Operator, place: dict[str, Any]) -> NDArray[np.float64]:
    """Return the point of the scene where a point was picked, by the true pose; scanner frame, m."""
    if "ray" in place:
        ray = np.array(place["ray"])
        return np.asarray(ray * first_hit(np.zeros(3), ray))
    pose = np.array(json.loads((sample_folder() / "truth.json").read_text())["camera_from_scanner"])
    camera = read_camera(sample_folder() / "camera.json")
    ray = camera.unproject(np.array(place["uv"])) @ pose[:3, :3]
    ray /= np.linalg.norm(ray)
    centre = -pose[:3, :3].T @ pose[:3, 3]
    return np.asarray(centre + ray * first_hit(centre, ray))


def click(operator: Operator, side: str, uv: tuple[float, float]) -> None:
    x, y = operator.place(side, uv)
    operator.page.mouse.move(x, y)
    operator.page.mouse.down()
    operator.page.mouse.up()


def pixels_on_surfaces(operator: Operator, side: str) -> list[tuple[float, float]]:
    """Return some pixels where a point can be measured, without notes."""
    if side == "photo":
        width, height = (operator.slice("photos")[0][name] for name in ("width", "height"))
    else:
        width, height = (operator.slice("scan")["views"][0][name] for name in ("width", "height"))
    found = []
    for x, y in ((0.25, 0.75), (0.4, 0.3), (0.55, 0.8), (0.6, 0.25), (0.7, 0.35), (0.8, 0.8), (0.3, 0.2), (0.75, 0.6)):
        uv = (round(width * x), round(height * y))
        if side == "photo":
            place: dict[str, Any] = {"photo": "p1", "uv": list(uv)}
        else:
            place = {"ray": ray_of(operator, uv).tolist()}
        reply = operator.socket.ask("measure", kind="point", places=[place])
        if not reply["refusal"] and not reply["notes"]:
            found.append(uv)
    assert len(found) >= 3, found
    return found


def only_measured(operator: Operator, count: int) -> dict[str, Any]:
    """Return the last measurement once there are that many, with values."""
    found: dict[str, Any] = operator.wait(
        lambda: items[-1] if len(items := operator.slice("measured")) == count else None, f"{count} measurements"
    )
    return found


@pytest.mark.slow
def test_a_distance_is_clicked_and_its_interval_contains_the_truth(measurer: Operator) -> None:
    page = measurer.page
    measurer.step("Judge")
    assert page.get_by_role("region", name="Measurements").is_hidden()
    page.keyboard.press("d")
    photo, scan = pixels_on_surfaces(measurer, "photo"), pixels_on_surfaces(measurer, "scan")
    pairs = [(("photo", photo[0]), ("photo", photo[-1])), (("scan", scan[0]), ("scan", scan[-1])),
             (("scan", scan[1]), ("photo", photo[1]))]  # fmt: skip
    for count, pair in enumerate(pairs, start=1):
        for side, uv in pair:
            click(measurer, side, uv)
        found = only_measured(measurer, count)
        places = measurer.slice("measurements")[-1]["places"]
        truth = float(np.linalg.norm(np.subtract(*(true_place(measurer, place) for place in places))))
        low, high = (float(word) for word in found["interval"].removesuffix(" m").split(" to "))
        value, sigma = (float(word) for word in found["value"].removesuffix(" m").split(" ± "))
        # 95 % of the intervals contain the truth; four standard deviations nearly always do
        assert abs(value - truth) < 4 * sigma + 1e-3, (truth, found)
        assert low < value < high
        page.get_by_role("region", name="Measurements").get_by_text(found["value"], exact=True).wait_for()
    measurer.shot("three-distances")
    # each is a step of its own
    for left in (2, 1, 0, 1):
        page.keyboard.press("Control+z" if left != 1 or len(measurer.slice("measurements")) == 2 else "Control+y")
        measurer.wait(lambda left=left: len(measurer.slice("measurements")) == left, f"{left} left")
    name = page.get_by_label("Name of Distance 1")
    name.fill("Desk")
    name.press("Enter")
    measurer.wait(lambda: measurer.slice("measurements")[0]["name"] == "Desk", "the new name")
    with page.expect_download() as saved:
        page.get_by_role("button", name="Export the measurements").click()
    assert saved.value.suggested_filename.endswith(".zip")
    page.get_by_role("button", name="Remove Desk").click()
    measurer.wait(lambda: measurer.slice("measurements") == [], "an empty list")


@pytest.mark.slow
def test_a_measurement_is_of_the_scan_in_which_it_is_picked_and_drawn_where_that_is_shown(
    measurer: Operator, tmp_path: Path
) -> None:
    page, station = measurer.page, tmp_path / "window.npz"
    write_npz_xyz(station, thinned(read_scan(sample_folder() / "scan.npz"), 2))
    reply = measurer.socket.ask("open_files", files=[measurer.server.upload(station)], scan="stations")
    assert reply["ok"], reply
    beside = page.get_by_label("Scan beside the photograph")
    beside.select_option(label="window.npz")
    measurer.wait(lambda: (measurer.slice("beside") or {}).get("name") == "window.npz", "the station's scan")
    (window,) = (one["id"] for one in measurer.slice("stations")["stations"] if one["id"])
    measurer.step("Judge")
    page.keyboard.press("d")
    view = measurer.slice("beside")["views"][0]
    ends = [(round(view["width"] * x), round(view["height"] * y)) for x, y in ((0.25, 0.3), (0.7, 0.35))]
    bar = page.locator("#scan-pane .pane-measure")
    click(measurer, "scan", ends[0])
    bar.get_by_text("second point").wait_for()
    # A point in another scan is not part of this measurement.
    beside.select_option(index=0)
    measurer.wait(lambda: measurer.slice("beside") is None, "the project's scan")
    click(measurer, "scan", pixels_on_surfaces(measurer, "scan")[0])
    bar.get_by_text("Started in window.npz: continue there").wait_for()
    beside.select_option(label="window.npz")
    measurer.wait(lambda: (measurer.slice("beside") or {}).get("name") == "window.npz", "the station's scan again")
    click(measurer, "scan", ends[1])
    found = only_measured(measurer, 1)
    assert measurer.slice("measurements")[0]["station"] == window
    truth = float(np.linalg.norm(np.subtract(
        *(true_place(measurer, place) for place in measurer.slice("measurements")[0]["places"])
    )))  # fmt: skip
    value, sigma = (float(word) for word in found["value"].removesuffix(" m").split(" ± "))
    assert abs(value - truth) < 4 * sigma + 1e-3, (truth, found)
    page.get_by_role("region", name="Measurements").get_by_text("on window.npz").wait_for()
    measurer.shot("on-a-station")
    # It is selected where it is drawn, which is in its own scan only.
    page.keyboard.press("v")
    selected = "import('./js/state/view.js').then(({ view }) => view.get().measurement)"
    page.evaluate("import('./js/state/view.js').then(({ view }) => view.set({ measurement: null }))")
    click(measurer, "scan", ends[0])
    measurer.wait(lambda: page.evaluate(selected), "it is selected in its own scan")
    page.evaluate("import('./js/state/view.js').then(({ view }) => view.set({ measurement: null }))")
    beside.select_option(index=0)
    measurer.wait(lambda: measurer.slice("beside") is None, "the project's scan")
    scale = measurer.slice("scan")["views"][0]["width"] / view["width"]
    click(measurer, "scan", (ends[0][0] * scale, ends[0][1] * scale))
    assert page.evaluate(selected) is None


IN_MODEL = """(xyz) => {
  const { camera, nodeRefFromName } = window.__viserMutable;
  const at = camera.position.clone().fromArray(xyz).applyMatrix4(nodeRefFromName["/model"].matrixWorld).project(camera);
  return [(at.x + 1) / 2, (1 - at.y) / 2];
}"""
"""Where a place of the scanner's frame is seen in the model's frame, as shares of its width and height."""


@pytest.mark.slow
def test_points_are_clicked_on_the_model_and_their_interval_contains_the_truth(modeller: Operator) -> None:
    measurer, page = modeller, modeller.page
    page.locator("#model-pane [data-whole]").wait_for()
    page.get_by_role("button", name="Scanner", exact=True).click()
    frame = page.locator("iframe.model-frame")
    inner = page.frame_locator("iframe.model-frame").locator("body")
    scan = pixels_on_surfaces(measurer, "scan")
    truths = [true_place(measurer, {"ray": ray_of(measurer, uv).tolist()}) for uv in (scan[0], scan[-1])]

    def seen(truth: NDArray[np.float64]) -> list[float]:
        found: list[float] = inner.evaluate(f"(_, xyz) => ({IN_MODEL})(xyz)", truth.tolist())
        return found

    def inside() -> bool:
        return all(0.02 < share < 0.98 for truth in truths for share in seen(truth))

    measurer.wait(inside, "both places in the model's view")
    page.keyboard.press("d")
    box = frame.bounding_box()
    assert box is not None
    looked = inner.evaluate("() => window.__viserMutable.camera.matrixWorld.elements.join()")
    for truth in truths:
        u, v = seen(truth)
        page.mouse.move(box["x"] + u * box["width"], box["y"] + v * box["height"])
        page.mouse.down()
        page.mouse.up()
        page.locator("#model-pane .pane-measure").get_by_text("second point").or_(
            page.locator("#model-pane .pane-measure strong").filter(has_text="Distance")
        ).first.wait_for()
    found = only_measured(measurer, 1)
    measurer.shot("on-the-model")
    places = measurer.slice("measurements")[-1]["places"]
    for place, truth in zip(places, truths, strict=True):
        off = np.arccos(np.clip(place["ray"] @ truth / np.linalg.norm(truth), -1, 1))
        assert off < 4 * place["sigma_rad"] + 1e-3, "a click is where it was seen"
        assert place["sigma_rad"] > 2e-4, "a pixel of the model is coarser than a cell"
    distance = float(np.linalg.norm(truths[0] - truths[1]))
    value, sigma = (float(word) for word in found["value"].removesuffix(" m").split(" ± "))
    assert abs(value - distance) < 4 * sigma
    assert looked == inner.evaluate("() => window.__viserMutable.camera.matrixWorld.elements.join()"), (
        "nobody has flown"
    )
    # the measurement is selected where it is drawn
    page.mouse.move(*measurer.place("scan", (5, 5)))
    page.keyboard.press("v")
    ends = measurer.slice("measured")[0]["drawn"]["ends"]
    middle = np.mean(ends, axis=0)
    measurer.step("Judge")
    item = page.locator("[data-measurement]")
    click(measurer, "scan", tuple(pixel_of(measurer, middle)))
    page.locator("[data-measurement].chosen").wait_for()
    click(measurer, "scan", tuple(pixel_of(measurer, middle) + np.array([0, 60])))
    measurer.wait(lambda: "chosen" not in (item.get_attribute("class") or ""), "nothing selected")


def pixel_of(operator: Operator, ray: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the pixel of the scan's first view that a ray of the scanner meets; the inverse of `ray_of`."""
    view = operator.slice("scan")["views"][0]
    x, y, z = np.array(view["rotation"]).reshape(3, 3) @ ray
    return np.array([view["f"] * x / z + view["cx"], view["f"] * y / z + view["cy"]])


@pytest.mark.slow
@pytest.mark.parametrize("theme", ["dark", "light"])
def test_the_list_and_the_bar_fit(measurer: Operator, theme: str) -> None:
    page = measurer.page
    page.evaluate("(theme) => { document.documentElement.dataset.theme = theme; }", theme)
    measurer.step("Judge")
    page.keyboard.press("d")
    scan = pixels_on_surfaces(measurer, "scan")
    for kind, count in (("distance", 2), ("area", 3), ("point", 1)):
        places = [{"ray": ray_of(measurer, uv).tolist()} for uv in scan[:count]]
        assert measurer.socket.ask("add_measurement", kind=kind, places=places)["ok"]
    only_measured(measurer, 3)
    page.locator(".measurement-value", has_text="±").nth(2).wait_for()
    click(measurer, "scan", scan[0])
    found = []
    for width, height in ((768, 900), (1280, 800), (1440, 800)):
        page.set_viewport_size({"width": width, "height": height})
        measurer.shot(f"{width}-{theme}")
        found += [f"{width}: {fault}" for fault in layout_faults(page)]
    assert not found
    slices = [measurer.slice(name) for name in ("measurements", "measured", "stations")]
    assert page_measurements(facts_of(page), *slices) == []


@pytest.mark.slow
def test_a_point_without_a_surface_is_said_and_the_others_stay(measurer: Operator) -> None:
    page = measurer.page
    page.keyboard.press("d")
    bar = page.locator("#scan-pane .pane-measure")
    bar.get_by_role("combobox").select_option("area")
    scan = pixels_on_surfaces(measurer, "scan")
    view = measurer.slice("scan")["views"][0]
    rng = np.random.default_rng(3)
    candidates = (rng.uniform(5, [view["width"] - 5, view["height"] - 5]).round() for _ in range(300))
    refused = next(
        (at, reply["refusal"])
        for at in candidates
        if (reply := measurer.socket.ask("measure", kind="point", places=[{"ray": ray_of(measurer, at).tolist()}]))[
            "refusal"
        ]
    )
    for uv in scan[:2]:
        click(measurer, "scan", uv)
        page.wait_for_function("() => true")
    click(measurer, "scan", tuple(refused[0]))
    bar.get_by_text(refused[1]).wait_for()
    measurer.shot("refused")
    click(measurer, "scan", scan[2])
    value = bar.locator("strong")
    value.filter(has_text="m²").wait_for()
    measurer.shot("area")
    page.keyboard.press("Enter")
    only_measured(measurer, 1)
    assert [len(one["places"]) for one in measurer.slice("measurements")] == [3]
    page.keyboard.press("Escape")
