"""The two image panes: their arithmetic against the core's, and drawing by mouse and by keyboard, sub-pixel."""

from __future__ import annotations

import base64
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest

from tests.page.conftest import VIEW_CAMERA, VIEW_FROM_SCANNER, lens, picture

if TYPE_CHECKING:
    from collections.abc import Iterator

    from playwright.sync_api import Browser, Page

PHOTO = (300, 200)
VIEW = VIEW_CAMERA.size


@pytest.fixture
def panes(page: Page, modules: str) -> Page:
    """The bare page with both pictures shown."""
    page.goto(f"{modules}/bare.html")
    page.wait_for_function("window.ready")
    return page


@pytest.fixture(scope="module")
def blank(browser: Browser, modules: str) -> Iterator[Page]:
    """An empty page of the same origin, for modules without DOM."""
    tab = browser.new_page()
    tab.goto(f"{modules}/blank.html")
    yield tab
    tab.close()


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


SCAN_LINE = [[60.25, 40.5], [310.75, 200.0]]
PHOTO_LINE = [[50.5, 30.25], [250.0, 150.75]]


def test_positions_and_pixels_are_inverse_and_zooming_keeps_the_point_under_the_cursor(blank: Page) -> None:
    rng = np.random.default_rng(11)
    cases = [
        {
            "viewport": {"zoom": float(np.exp(rng.uniform(-3, 4))), "x": float(x), "y": float(y)},
            "uv": rng.uniform(-50, 4000, 2).tolist(),
            "xy": rng.uniform(0, 900, 2).tolist(),
            "zoom": float(np.exp(rng.uniform(-3, 4))),
        }
        for x, y in rng.uniform(-3000, 900, (200, 2))
    ]
    body = """return a.map(({ viewport, uv, xy, zoom }) => ({
        screen: m.toScreen(viewport, uv), back: m.toPixel(viewport, m.toScreen(viewport, uv)),
        before: m.toPixel(viewport, xy), after: m.toPixel(m.zoomedAbout(viewport, xy, zoom), xy) }))"""
    for case, got in zip(cases, run(blank, "panes/viewport", body, cases), strict=True):
        viewport = case["viewport"]
        expected = (np.array(case["uv"]) + 0.5) * viewport["zoom"] + [viewport["x"], viewport["y"]]
        np.testing.assert_allclose(got["screen"], expected, atol=1e-8)
        np.testing.assert_allclose(got["back"], case["uv"], atol=1e-7)
        np.testing.assert_allclose(got["after"], got["before"], atol=1e-7)


def test_some_of_the_picture_always_stays_visible(blank: Page) -> None:
    rng = np.random.default_rng(12)
    drawn = rng.uniform([-3, -9e4, -9e4, 1, 1], [4, 9e4, 9e4, 8000, 8000], (200, 5)).tolist()
    cases = [[{"zoom": np.exp(zoom), "x": x, "y": y}, [500, 300], [int(w), int(h)]] for zoom, x, y, w, h in drawn]
    results = run(blank, "panes/viewport", "return a.map((c) => m.keptInSight(...c))", cases)
    for (before, pane, size), kept in zip(cases, results, strict=True):
        for at, room, length in zip((kept["x"], kept["y"]), pane, size, strict=True):
            extent = length * before["zoom"]
            assert min(at + extent, room) - max(at, 0) >= min(48, extent, room / 2) - 1e-6


def test_rays_agree_with_the_core_and_nothing_behind_the_view_is_drawn(blank: Page) -> None:
    rng = np.random.default_rng(13)
    uv = rng.uniform(-200, 600, (100, 2))
    anywhere = rng.normal(size=(300, 3))
    anywhere /= np.linalg.norm(anywhere, axis=1, keepdims=True)
    body = "return { rays: a.uv.map((p) => m.rayOf(a.lens, p)), pixels: a.rays.map((r) => m.pixelOf(a.lens, r)) }"
    got = run(blank, "panes/projection", body, {"lens": lens(), "uv": uv.tolist(), "rays": anywhere.tolist()})
    np.testing.assert_allclose(got["rays"], rays(uv), atol=1e-12)
    forward = (anywhere @ VIEW_FROM_SCANNER.T)[:, 2]
    shown = np.array([pixel is not None for pixel in got["pixels"]])
    np.testing.assert_array_equal(shown, forward > 0.03)
    np.testing.assert_allclose([p for p in got["pixels"] if p], pixels(anywhere[shown]), rtol=1e-9, atol=1e-7)


def test_a_line_that_ends_behind_the_view_is_drawn_along_the_same_line(blank: Page) -> None:
    rng = np.random.default_rng(14)
    pairs = rng.normal(size=(300, 2, 3))
    pairs /= np.linalg.norm(pairs, axis=2, keepdims=True)
    body = "return a.pairs.map(([p, q]) => m.segmentOf(a.lens, p, q))"
    segments = run(blank, "panes/projection", body, {"lens": lens(), "pairs": pairs.tolist()})
    forward = (pairs @ VIEW_FROM_SCANNER.T)[..., 2]
    for (a, b), ahead, segment in zip(pairs, forward, segments, strict=True):
        assert (segment is None) == bool((ahead <= 0.03).all())
        if segment is None:
            continue
        normal = np.cross(a, b) / np.linalg.norm(np.cross(a, b))
        assert np.abs(rays(segment) @ normal).max() < 1e-9  # in the plane of both rays
        for end, ray, front in zip(segment, (a, b), ahead, strict=True):
            if front > 0.03:
                np.testing.assert_allclose(end, pixels(ray), rtol=1e-9, atol=1e-7)


def test_the_loupe_never_covers_what_it_shows(blank: Page) -> None:
    rng = np.random.default_rng(15)
    cases = [[rng.uniform(0, size).tolist(), size.tolist()] for size in rng.uniform(260, 1500, (200, 2))]
    places = run(blank, "panes/loupe", "return a.map((c) => m.loupePlace(...c))", cases)
    for (xy, size), at in zip(cases, places, strict=True):
        assert np.hypot(*(np.array(at) - xy)) > 66 + 4
        assert (np.array(at) > 60).all()
        assert (np.array(at) < np.array(size) - 60).all()


def test_throttled_calls_never_overlap_and_the_last_one_is_always_made(blank: Page) -> None:
    body = """
        const rest = (ms) => new Promise((done) => setTimeout(done, ms));
        const log = []; let out = 0, most = 0;
        const ask = m.throttled(async (n) => { most = Math.max(most, ++out); await rest(7); log.push(n); out--; }, 20);
        for (let n = 0; n < 60; n++) { ask(n); await rest(2); }
        while (log.at(-1) !== 59) await rest(20);
        return { log, most }"""
    got = run(blank, "ui/throttle", body)
    assert got["most"] == 1
    assert got["log"][-1] == 59
    assert len(got["log"]) < 40
    assert got["log"] == sorted(set(got["log"]))


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
    panes.wait_for_timeout(100)
    u, v = (axis.ravel() for axis in np.meshgrid(np.arange(118, 123), np.arange(79, 83)))
    places = at + (np.stack([u, v], axis=-1) - [120.25, 80.75]) * zoom
    got = panes.evaluate(
        """(places) => { const c = document.querySelector('#photo-pane canvas.pane-picture').getContext('2d');
        return places.map(([x, y]) => [...c.getImageData(x, y, 1, 1).data].slice(0, 3)) }""",
        np.floor(places).tolist(),
    )
    np.testing.assert_array_equal(got, picture(*PHOTO)[v, u])


@pytest.mark.parametrize("how", ["drag", "clicks"])
@pytest.mark.parametrize("first", ["scan", "photo"])
def test_a_line_drawn_in_both_panes_is_one_match_at_the_mouses_own_pixels(panes: Page, first: str, how: str) -> None:
    lines = {"scan": SCAN_LINE, "photo": PHOTO_LINE}
    for side in (first, "photo" if first == "scan" else "scan"):
        assert asked(panes, "add_pick") == []
        if how == "drag":
            drag(panes, side, *lines[side])
        else:
            for end in lines[side]:
                panes.mouse.click(*place(panes, side, end))
    (pick,) = wait_for_picks(panes, 1)
    assert len(asked(panes, "add_pick")) == 1
    assert pick["kind"] == "line"
    np.testing.assert_allclose(pick["photo"], PHOTO_LINE, atol=0.01)
    np.testing.assert_allclose(np.linalg.norm(pick["scan"], axis=1), 1, atol=1e-12)
    np.testing.assert_allclose(pixels(pick["scan"]), SCAN_LINE, atol=0.01)


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
        panes.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
        assert difference(matches_layers(panes)["photo"], whole["photo"]) > 50  # one match that is missing is seen
        show(picks)
    assert panes.evaluate("clipped") >= 24


def test_points_snap_only_to_a_corner_that_is_near_on_the_screen(panes: Page) -> None:
    panes.evaluate("view.set({ snap: true, tool: 'point' })")
    near, far = [101.2, 79.5], [110.0, 90.0]  # the nearest corners stand at (100, 80), and 10 px away
    for side, uv in (("scan", near), ("photo", far)):
        panes.mouse.move(*place(panes, side, uv))
        panes.mouse.down()
        before = len(asked(panes, "snap"))
        panes.mouse.move(*place(panes, side, (uv[0], uv[1] + 0.1)))
        panes.wait_for_function("(n) => asked.filter(([what]) => what === 'snap').length > n", arg=before)
        panes.wait_for_timeout(50)
        panes.mouse.up()
    (pick,) = wait_for_picks(panes, 1)
    np.testing.assert_allclose(pixels(pick["scan"]), [[100, 80]], atol=1e-6)
    np.testing.assert_allclose(pick["photo"], [[110.0, 90.1]], atol=0.01)


def draw_beside_the_edge(page: Page, side: str, *, held: str = "") -> None:
    """Draw a line beside the edge at v = 100; a key may be pressed before the release."""
    a, b = [60.0, 101.5], [160.0, 98.5]
    page.mouse.move(*place(page, side, a))
    page.mouse.down()
    page.mouse.move(*place(page, side, [110, 100]))
    before = len(asked(page, "snap"))
    page.mouse.move(*place(page, side, b))
    page.wait_for_function("(n) => asked.filter(([what]) => what === 'snap').length > n", arg=before)
    page.wait_for_timeout(50)
    if held:
        page.keyboard.down(held)
    page.mouse.up()
    if held:
        page.keyboard.up(held)


def test_a_line_snaps_across_the_edge_under_it_and_shift_suspends_it(panes: Page) -> None:
    panes.evaluate("view.set({ snap: true })")
    draw_beside_the_edge(panes, "scan")
    draw_beside_the_edge(panes, "photo", held="Shift")
    (pick,) = wait_for_picks(panes, 1)
    np.testing.assert_allclose(pixels(pick["scan"]), [[60, 100], [160, 100]], atol=0.01)
    np.testing.assert_allclose(pick["photo"], [[60, 101.5], [160, 98.5]], atol=0.01)


def test_escape_drops_the_open_line_and_a_refusal_keeps_it(panes: Page) -> None:
    drag(panes, "scan", *SCAN_LINE)
    panes.keyboard.press("Escape")
    drag(panes, "photo", *PHOTO_LINE)
    assert asked(panes, "add_pick") == []
    panes.evaluate("refused.add('add_pick')")
    drag(panes, "scan", *SCAN_LINE)
    panes.wait_for_function("notices.length === 1")
    assert "refused" in panes.evaluate("notices[0]")
    panes.evaluate("refused.clear()")
    drag(panes, "scan", [80.0, 60.0], [200.0, 220.0])
    (pick,) = wait_for_picks(panes, 1)
    np.testing.assert_allclose(pick["photo"], PHOTO_LINE, atol=0.01)  # the first side was not lost
    np.testing.assert_allclose(pixels(pick["scan"]), [[80, 60], [200, 220]], atol=0.01)


SECOND_PHOTO = {"id": "p2", "name": "second.png", "width": 300, "height": 200, "camera": {"fx": 250}}


def show_photo(page: Page, photo: str, *, known: str = "p1 p2") -> None:
    """Show a photograph of those that exist."""
    photos = [SECOND_PHOTO | {"id": name, "name": f"{name}.png"} for name in known.split()]
    page.evaluate("([photos, shown]) => store.take({ slices: { photos, shown } })", [photos, photo])


def settled(page: Page) -> None:
    """Wait until every command that was sent is answered."""
    page.evaluate("new Promise((done) => setTimeout(done))")


@pytest.mark.parametrize("first", ["scan", "photo"])
def test_an_unfinished_line_stays_with_its_photograph(panes: Page, first: str) -> None:
    lines = {"scan": SCAN_LINE, "photo": PHOTO_LINE}
    second = "photo" if first == "scan" else "scan"
    drag(panes, first, *lines[first])
    show_photo(panes, "p2")
    assert panes.evaluate("notices") == ["The unfinished match stays with p1.png: show that photograph to complete it."]
    drag(panes, second, *lines[second])
    settled(panes)
    assert asked(panes, "add_pick") == [], "it is not matched with another photograph"
    panes.keyboard.press("Escape")
    show_photo(panes, "p1")
    drag(panes, second, *lines[second])
    (pick,) = wait_for_picks(panes, 1)
    assert [sent["photo"] for sent in asked(panes, "add_pick")] == ["p1"]
    np.testing.assert_allclose(pick["photo"], PHOTO_LINE, atol=0.01)
    np.testing.assert_allclose(pixels(pick["scan"]), SCAN_LINE, atol=0.01)


def test_a_stroke_ends_when_another_photograph_is_shown(panes: Page) -> None:
    panes.mouse.move(*place(panes, "photo", PHOTO_LINE[0]))
    panes.mouse.down()
    panes.mouse.move(*place(panes, "photo", PHOTO_LINE[1]), steps=3)
    show_photo(panes, "p2")
    panes.mouse.up()
    drag(panes, "scan", *SCAN_LINE)
    settled(panes)
    assert asked(panes, "add_pick") == []
    assert panes.evaluate("notices") == ["The unfinished stroke was discarded: another photograph is shown."]


def test_a_drag_of_a_match_ends_when_another_photograph_is_shown(panes: Page) -> None:
    drag(panes, "scan", *SCAN_LINE)
    drag(panes, "photo", *PHOTO_LINE)
    (pick,) = wait_for_picks(panes, 1)
    panes.evaluate("(pick) => store.take({ slices: { 'picks:p2': [pick] } })", pick)  # of the same id
    panes.keyboard.press("v")
    panes.mouse.move(*place(panes, "photo", PHOTO_LINE[1]))
    panes.mouse.down()
    panes.mouse.move(*place(panes, "photo", [200, 100]), steps=3)
    show_photo(panes, "p2")
    assert panes.evaluate("view.get().selected.size") == 0
    panes.mouse.up()
    panes.keyboard.press("Delete")
    settled(panes)
    assert asked(panes, "set_pick") == asked(panes, "remove_picks") == []


def test_an_unfinished_line_is_discarded_with_its_photograph_or_scan(panes: Page) -> None:
    drag(panes, "scan", *SCAN_LINE)
    show_photo(panes, "p2", known="p2")
    assert "its photograph was removed" in panes.evaluate("notices.at(-1)")
    drag(panes, "photo", *PHOTO_LINE)
    panes.evaluate("store.take({ slices: { scan: { ...store.get('scan'), id: 's2' } } })")
    drag(panes, "scan", *SCAN_LINE)  # the photograph's side is still there
    panes.wait_for_function("asked.some(([what]) => what === 'add_pick')")
    assert asked(panes, "add_pick")[0]["photo"] == "p2"
    drag(panes, "scan", *SCAN_LINE)
    panes.evaluate("store.take({ slices: { scan: { ...store.get('scan'), id: 's3' } } })")
    assert "another scan was opened" in panes.evaluate("notices.at(-1)")
    drag(panes, "photo", *PHOTO_LINE)
    settled(panes)
    assert len(asked(panes, "add_pick")) == 1


def test_under_a_pose_the_predicted_partner_is_taken_by_enter_or_by_its_tick(panes: Page) -> None:
    pose = {"shown": "linear", "stages": [{"stage": "linear", "parameters": []}]}
    panes.evaluate("(poses) => store.take({ slices: { 'poses:p1': poses } })", pose)
    line, shift = np.array([[60.0, 60.0], [200.0, 150.0]]), np.array([10, -5])
    for count, accept in ((1, "key"), (2, "tick")):
        drag(panes, "scan", *line)
        panes.wait_for_function("(n) => asked.filter(([what]) => what === 'predict').length === n", arg=count)
        panes.wait_for_function("document.querySelector('#photo-pane .pane-partner').textContent.includes('Enter')")
        if accept == "key":
            panes.keyboard.press("Enter")
        else:
            panes.mouse.click(*place(panes, "photo", line.mean(axis=0) + shift))
        pick = wait_for_picks(panes, count)[-1]
        np.testing.assert_allclose(pick["photo"], line + shift, atol=0.01)


def test_a_selected_end_is_nudged_dragged_switched_off_and_removed(panes: Page) -> None:
    match = {"id": "m1", "number": 1, "kind": "line", "scan": rays(SCAN_LINE).tolist(), "photo": PHOTO_LINE, "on": True}
    panes.evaluate("(pick) => store.take({ slices: { 'picks:p1': [pick] } })", match)
    panes.keyboard.press("v")
    panes.mouse.click(*place(panes, "photo", PHOTO_LINE[1]))
    for key in ("ArrowRight", "ArrowRight", "Shift+ArrowUp"):
        panes.keyboard.press(key)
    panes.wait_for_function("store.picksOf()[0].photo[1][1] < 150")
    panes.wait_for_timeout(50)
    moved = np.array(panes.evaluate("store.picksOf()[0].photo")) - PHOTO_LINE
    np.testing.assert_allclose(moved, [[0, 0], [0.2, -1.0]], atol=1e-9)
    before = len(asked(panes, "set_pick"))
    drag(panes, "scan", SCAN_LINE[0], [150.5, 90.25])
    panes.wait_for_function("(n) => asked.filter(([what]) => what === 'set_pick').length > n", arg=before)
    assert len(asked(panes, "set_pick")) == before + 1  # one edit a drag
    dragged = pixels(panes.evaluate("store.picksOf()[0].scan"))
    np.testing.assert_allclose(dragged, [[150.5, 90.25], SCAN_LINE[1]], atol=0.01)
    panes.keyboard.press("Space")
    panes.wait_for_function("store.picksOf()[0].on === false")
    panes.keyboard.press("Delete")
    wait_for_picks(panes, 0)


def test_a_line_can_be_drawn_without_a_mouse(panes: Page) -> None:
    panes.locator("#scan-pane .pane-body").focus()
    moves = (["ArrowRight"] * 2 + ["Shift+ArrowDown"] * 3, ["Shift+ArrowLeft"] * 5 + ["Control+ArrowUp"] * 5)
    for _ in ("scan", "photo"):
        for keys in moves:
            for key in keys:
                panes.keyboard.press(key)
            panes.keyboard.press("Enter")
    (pick,) = wait_for_picks(panes, 1)
    for drawn, size in ((pixels(pick["scan"]), VIEW), (np.array(pick["photo"]), PHOTO)):
        np.testing.assert_allclose(drawn - (np.array(size) - 1) / 2, [[2, 30], [-48, 29.5]], atol=1e-6)


def test_linked_panes_show_corresponding_points_at_the_same_relative_zoom(panes: Page) -> None:
    pose = {"shown": "linear", "stages": [{"stage": "linear", "parameters": []}]}
    panes.evaluate("(poses) => store.take({ slices: { 'poses:p1': poses } })", pose)
    panes.get_by_role("button", name="Linked").click()
    panes.mouse.move(*place(panes, "scan", [100.0, 100.0]))
    for _ in range(5):
        panes.mouse.wheel(0, -120)
    said = panes.locator("#photo-pane .pane-zoom")
    fit = {side: panes.locator(f"#{side}-pane .pane-body").bounding_box() for side in ("scan", "photo")}
    ratio = min(fit["photo"]["width"] / PHOTO[0], fit["photo"]["height"] / PHOTO[1]) / min(
        fit["scan"]["width"] / VIEW[0], fit["scan"]["height"] / VIEW[1]
    )
    panes.wait_for_timeout(400)
    zoom = float(str(panes.locator("#scan-pane .pane-zoom").text_content()).rstrip(" %"))
    assert float(str(said.text_content()).rstrip(" %")) == pytest.approx(zoom * ratio, rel=0.02)
    at = [panes.locator(f"#{side}-pane .pane-body").bounding_box() for side in ("scan", "photo")]
    shown = []
    for box in at:
        panes.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        panes.wait_for_timeout(100)
        shown.append(panes.evaluate("view.get().readout.uv"))
    np.testing.assert_allclose(np.array(shown[1]) - shown[0], [10, -5], atol=0.6)


def test_each_pane_says_what_to_do_while_it_is_empty(panes: Page) -> None:
    panes.evaluate("store.take({ slices: { scan: null, photos: [], shown: null, 'picks:p1': null } })")
    for side, what in (("scan", "No scan yet"), ("photo", "No photograph yet")):
        assert what in str(panes.locator(f"#{side}-pane .pane-middle").text_content())
        panes.locator(f"#{side}-pane .pane-body").click()
    assert asked(panes, "add_pick") == []


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


KEPT = """async ([told, late]) => {
  sessionStorage.clear();
  const { Store } = await import('/js/net/store.js');
  const { Picking } = await import('/js/panes/picking.js');
  const { keepUnfinished } = await import('/js/panes/unfinished.js');
  const page = () => {
    const store = new Store();
    const picking = new Picking();
    keepUnfinished(picking, store);
    store.watch(['scan', 'shown'], () => picking.turnTo(store.shown()));
    return { store, picking };
  };
  const ours = { project: { id: 'A' }, scan: { id: 's' }, photos: [{ id: 'p' }], shown: 'p' };
  const others = { project: { id: 'B' }, scan: null, photos: [], shown: null };
  const first = page();
  first.store.take({ slices: ours });
  first.picking.open = { side: 'scan', kind: 'point', ends: [[1, 0, 0]] };
  if (told) first.store.take({ event: 'project', id: 'B', name: 'B', by: 'x' });
  first.store.take({ slices: others });
  first.picking.forgetScan();
  dispatchEvent(new Event('pagehide'));
  const elsewhere = page();
  elsewhere.store.take({ slices: others });
  dispatchEvent(new Event('pagehide'));
  const again = page();
  again.store.take({ slices: late ? { ...ours, scan: null } : ours });
  if (late) {
    const before = again.picking.open;
    dispatchEvent(new Event('pagehide'));
    again.store.take({ slices: { scan: ours.scan } });
    if (before) throw new Error('it was open without its scan');
  }
  return [elsewhere.picking.open, again.picking.open?.ends, sessionStorage.length];
}"""


@pytest.mark.parametrize("told", [True, False])
@pytest.mark.parametrize("late", [True, False])
def test_an_unfinished_match_waits_for_its_project(blank: Page, told: bool, late: bool) -> None:
    """Also if slices of the other project arrive before the page has started afresh, or the scan after the project."""
    assert blank.evaluate(KEPT, [told, late]) == [None, [[1, 0, 0]], 0]
