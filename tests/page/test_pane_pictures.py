"""What the two image panes show: pictures, matches, predictions, and the same place in both."""

from __future__ import annotations

import base64
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest

from testing.workbench.pages import two_frames
from tests.page.conftest import picture
from tests.page.two_panes import PHOTO, VIEW, asked, place, rays

if TYPE_CHECKING:
    from playwright.sync_api import Page


@pytest.mark.slow
def test_each_pixel_of_the_picture_is_drawn_at_its_position(panes: Page) -> None:
    centre = place(panes, "photo", [120.25, 80.75])
    panes.mouse.move(*centre)
    for _ in range(14):
        panes.mouse.wheel(0, -120)
    panes.wait_for_function("view.get().readout && view.get().readout.zoom > 20")
    readout = panes.evaluate("view.get().readout")
    np.testing.assert_allclose(readout["uv"], [120.25, 80.75], atol=1e-6)
    box = panes.locator("#photo-pane .pane-body").bounding_box()
    assert box is not None
    at = np.array(centre) - [box["x"], box["y"]]
    zoom = readout["zoom"]
    two_frames(panes)
    u, v = (axis.ravel() for axis in np.meshgrid(np.arange(118, 123), np.arange(79, 83)))
    places = at + (np.stack([u, v], axis=-1) - [120.25, 80.75]) * zoom
    got = panes.evaluate(
        """(places) => { const c = document.querySelector('#photo-pane canvas.pane-picture').getContext('2d');
        return places.map(([x, y]) => [...c.getImageData(x, y, 1, 1).data].slice(0, 3)) }""",
        np.floor(places).tolist(),
    )
    np.testing.assert_array_equal(got, picture(*PHOTO)[v, u])


def matches_layers(page: Page) -> dict[str, np.ndarray]:
    """Return what is drawn of the matches in each pane, (h, w, 4) uint8."""
    found = page.evaluate(
        """() => Object.fromEntries(["scan", "photo"].map((side) => {
        const canvas = document.querySelector(`#${side}-pane canvas.pane-matches`);
        const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
        let text = "";
        for (let k = 0; k < data.length; k += 8192) text += String.fromCharCode(...data.subarray(k, k + 8192));
        return [side, [canvas.height, canvas.width, btoa(text)]];
        }))"""
    )
    return {
        side: np.frombuffer(base64.b64decode(text), np.uint8).reshape(height, width, 4)
        for side, (height, width, text) in found.items()
    }


def difference(a: np.ndarray, b: np.ndarray) -> float:
    """Return how much two layers differ over 5 x 5 pixels: a clipped stroke has other edges, but is not elsewhere."""
    over = [layer[..., :3].astype(np.float32) * layer[..., 3:] / 255 for layer in (a, b)]
    return float(np.abs(cv2.blur(over[0], (5, 5)) - cv2.blur(over[1], (5, 5))).max())


@pytest.mark.slow
def test_changes_are_painted_as_a_whole_layer_would_be(panes: Page) -> None:
    rng = np.random.default_rng(8)

    def random_match(number: int) -> dict[str, Any]:
        count = int(rng.integers(1, 3))
        scan = rays(rng.uniform([5, 5], [395, 255], (count, 2)))
        photo = rng.uniform([5, 5], [295, 195], (count, 2))
        return {
            "id": f"m{number}", "number": number, "kind": "line" if count == 2 else "point", "scan": scan.tolist(),
            "photo": photo.tolist(), "on": bool(rng.random() < 0.8), "weight": 1, "origin": "manual",
        }  # fmt: skip

    def show(picks: list[dict[str, Any]]) -> dict[str, Any]:
        judged = {
            "by_pick": {pick["id"]: {"inlier": bool(rng.random() < 0.7)} for pick in picks},
            "predicted": {pick["id"]: [[u + 6, v - 4] for u, v in pick["photo"]] for pick in picks[::3]},
        }
        panes.evaluate(
            """async ([picks, judged]) => {
            store.take({ slices: { 'picks:p1': picks, ...(judged ? { 'judged:p1': judged } : {}) } });
            await new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done))); }""",
            [picks, judged if rng.random() < 0.2 else None],
        )

    picks = [random_match(number) for number in range(1, 61)]
    show(picks)
    panes.evaluate("""() => {
      const { clip } = CanvasRenderingContext2D.prototype;
      window.clipped = 0;
      CanvasRenderingContext2D.prototype.clip = function () { window.clipped += 1; return clip.call(this); };
    }""")
    size = panes.viewport_size
    assert size is not None
    for _ in range(3):
        for _ in range(8):
            k = int(rng.integers(len(picks)))
            match int(rng.integers(4)):
                case 0:
                    picks[k] = random_match(picks[k]["number"])
                case 1:
                    picks = picks[:k] + picks[k + 1 :]
                case 2:
                    picks = [*picks, random_match(max(pick["number"] for pick in picks) + 1)]
                case _:
                    picks[k] = {**picks[k], "on": not picks[k]["on"]}
            show(picks)
        piecewise = matches_layers(panes)
        for width in (size["width"] - 100, size["width"]):  # a pane of another size is painted anew
            panes.set_viewport_size({**size, "width": width})
            panes.wait_for_function(
                "(w) => document.querySelector('#scan-pane canvas.pane-matches').width === w", arg=width // 2
            )
        whole = matches_layers(panes)
        for side in ("scan", "photo"):
            assert difference(piecewise[side], whole[side]) < 25
        panes.evaluate("store.take({ slices: { 'picks:p1': store.picksOf().slice(1) } })")
        two_frames(panes)
        assert difference(matches_layers(panes)["photo"], whole["photo"]) > 50  # one match that is missing is seen
        show(picks)
    assert panes.evaluate("clipped") >= 24


@pytest.mark.slow
def test_linked_panes_show_corresponding_points_at_the_same_relative_zoom(panes: Page) -> None:
    pose = {"shown": "linear", "stages": [{"stage": "linear", "parameters": []}]}
    panes.evaluate("(poses) => store.take({ slices: { 'poses:p1': poses } })", pose)
    panes.get_by_role("button", name="Linked").click()
    panes.mouse.move(*place(panes, "scan", [100.0, 100.0]))
    for _ in range(5):
        panes.mouse.wheel(0, -120)
    fit = {side: panes.locator(f"#{side}-pane .pane-body").bounding_box() for side in ("scan", "photo")}
    ratio = min(fit["photo"]["width"] / PHOTO[0], fit["photo"]["height"] / PHOTO[1]) / min(
        fit["scan"]["width"] / VIEW[0], fit["scan"]["height"] / VIEW[1]
    )
    panes.wait_for_function(
        """(ratio) => {
        const [scan, photo] = ["scan", "photo"].map((side) =>
          parseFloat(document.querySelector(`#${side}-pane .pane-zoom`).textContent));
        return Math.abs(photo / (scan * ratio) - 1) < 0.02 }""",
        arg=ratio,
    )
    at = [panes.locator(f"#{side}-pane .pane-body").bounding_box() for side in ("scan", "photo")]
    shown = []
    for box in at:
        panes.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        two_frames(panes)
        shown.append(panes.evaluate("view.get().readout.uv"))
    np.testing.assert_allclose(np.array(shown[1]) - shown[0], [10, -5], atol=0.6)


@pytest.mark.slow
def test_each_pane_says_what_to_do_while_it_is_empty(panes: Page) -> None:
    panes.evaluate("store.take({ slices: { scan: null, photos: [], shown: null, 'picks:p1': null } })")
    for side, what in (("scan", "No scan yet"), ("photo", "No photograph yet")):
        assert what in str(panes.locator(f"#{side}-pane .pane-middle").text_content())
        panes.locator(f"#{side}-pane .pane-body").click()
    assert asked(panes, "add_pick") == []


@pytest.mark.slow
def test_a_running_simplex_moves_its_predictions_over_the_photograph_until_it_ends(panes: Page) -> None:
    match = {"id": "m1", "number": 1, "kind": "point", "scan": rays([[200.0, 100.0]]).tolist(), "photo": [[50, 50]]}
    panes.evaluate("(pick) => store.take({ slices: { 'picks:p1': [{ ...pick, on: true }] } })", match)
    ring = """(at) => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => {
        const c = document.querySelector('#photo-pane canvas.pane-live').getContext('2d');
        done([...c.getImageData(at[0] - 8, at[1] - 8, 16, 16).data].some((value) => value > 0)) })))"""
    box = panes.locator("#photo-pane .pane-body").bounding_box()
    assert box is not None
    for uv in ([200.0, 120.0], [220.0, 90.0]):
        x, y = place(panes, "photo", uv)
        at = [round(x - box["x"]), round(y - box["y"])]
        assert not panes.evaluate(ring, at)
        step = {"event": "simplex", "photo": "p1", "predicted": {"m1": [uv]}}
        panes.evaluate("(step) => { store.take({ slices: { job: { state: 'paused' } } }); store.take(step) }", step)
        assert panes.evaluate(ring, at)
    panes.evaluate("store.take({ slices: { job: { state: 'done' } } })")
    assert not panes.evaluate(ring, at)
