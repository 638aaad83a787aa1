"""The arithmetic of the two image panes against the core's, without a pane."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tests.page.conftest import VIEW_FROM_SCANNER, lens
from tests.page.two_panes import pixels, rays, run

if TYPE_CHECKING:
    from playwright.sync_api import Page


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
    """On a clock of the test's own: 60 requests, one every 2 ms, of which each call takes 7 ms."""
    body = """
        const due = [], log = [];
        let now = 0, out = 0, most = 0, ended = false;
        const { setTimeout } = globalThis;
        globalThis.setTimeout = (act, ms) => due.push({ at: now + ms, act });
        performance.now = () => now;
        const rest = (ms) => new Promise((done) => globalThis.setTimeout(done, ms));
        const ask = m.throttled(async (n) => { most = Math.max(most, ++out); await rest(7); log.push(n); out--; }, 20);
        const request = async () => {
            for (let n = 0; n < 60; n++) { ask(n); await rest(2); }
            while (log.at(-1) !== 59) await rest(20);
            ended = true;
        };
        request();
        for (let steps = 0; !ended && steps < 1000; steps++) {
            const next = due.splice(due.indexOf(due.reduce((a, b) => (b.at < a.at ? b : a))), 1)[0];
            now = next.at;
            next.act();
            await new Promise((done) => setTimeout(done)); // until all that waited for it has gone on
        }
        globalThis.setTimeout = setTimeout;
        delete performance.now;
        return { log, most, ended }"""
    got = run(blank, "ui/throttle", body)
    assert got["ended"]
    assert got["most"] == 1
    assert got["log"][-1] == 59
    assert len(got["log"]) < 40
    assert got["log"] == sorted(set(got["log"]))


def test_a_pane_is_fitted_before_its_first_frame(blank: Page) -> None:
    """Or the first end of a line, drawn at once, would be at another pixel."""
    body = """
        const element = document.createElement("div");
        element.style.cssText = "position: absolute; width: 400px; height: 300px";
        document.body.append(element);
        const layers = ["picture", "compare", "matches", "live"];
        const pane = new m.Pane(element, "photo", Object.fromEntries(layers.map((layer) => [layer, () => false])));
        pane.setExtent([300, 200]);
        const { fitted } = await import("/js/panes/viewport.js");
        const found = [{ ...pane.viewport }, fitted([400, 300], [300, 200])];
        element.remove();
        return found"""
    at_once, wanted = run(blank, "panes/pane", body)
    assert at_once == wanted
