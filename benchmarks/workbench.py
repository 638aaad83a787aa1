"""Responsiveness of the workbench on the embedded sample: python -m benchmarks.workbench [--minutes M] [--json F].

Starts `ladarreg serve`, drives it as pages do, and opens the page in Chromium where one is found.
"""

from __future__ import annotations

import argparse
import json
import random
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.page.model_drawn import model_drawn
from testing.workbench.served import Page, Served, many_clients, random_pick, served, with_camera_and_picks

_MANY = 500
_WATCH_MOVES = """
window.moves = [];
new PerformanceObserver((list) => {
  for (const entry of list.getEntries()) if (entry.name === 'pane move') window.moves.push(entry.duration);
}).observe({ entryTypes: ['measure'] });
"""
_EDIT_IN_PAGE = """
async ([photo, times]) => {
  const module = (name) => import(new URL(`js/net/${name}.js`, location.href).href);
  const [{ ask }, { store }] = await Promise.all([module('connection'), module('store')]);
  const answered = [];
  const drawn = [];
  for (let k = 0; k < times; k += 1) {
    const picks = store.picksOf(photo);
    const { id } = picks[(7 * k) % picks.length];
    const uv = [100 + k, 50.5];
    await new Promise((done) => requestAnimationFrame(() => setTimeout(done, 100)));
    const begun = performance.now();
    await ask('set_pick', { photo, pick: id, photo_uv: [uv] });
    const now = store.picksOf(photo).find((pick) => pick.id === id).photo[0];
    if (now.join() !== uv.join()) throw new Error('the answer came before what it changed');
    answered.push(performance.now() - begun);
    await new Promise((done) => requestAnimationFrame(() => setTimeout(done)));
    drawn.push(performance.now() - begun);
  }
  return { answered, drawn };
}
"""
ASKED = {
    "first picture, s": 3.0,
    "document round trip, ms": 10.0,
    "document round trip in a browser, ms": 10.0,
    "edit at another page, ms": 500.0,
    "memory, MB": 700.0,
    "pointer move, ms": 16.0,
    "model drawn after its pose, s": 3.0,
    "growth in the second half, MB": 20.0,
}


def round_trips(page: Page, other: Page, times: int = 200) -> tuple[list[float], list[float]]:
    """Return the latencies of edits, ms: until the reply, and until another page has received it."""
    rng = random.Random(1)
    picks = [pick["id"] for pick in page.slices["picks:p1"]]
    answered, seen = [], []
    for _ in range(times):
        name, (_, uv) = rng.choice(picks), random_pick(rng)

        def has_it(slices: dict[str, Any], name: str = name, wanted: list[float] = uv) -> bool:
            pick = next((p for p in slices["picks:p1"] if p["id"] == name), None)
            return pick is not None and pick["photo"][0] == wanted

        begun = time.perf_counter()
        page.ask("set_pick", photo="p1", pick=name, photo_uv=[uv])
        answered.append(1e3 * (time.perf_counter() - begun))
        assert has_it(page.slices), "the answer comes after what it changed"
        other.until(has_it, 30)
        seen.append(1e3 * (time.perf_counter() - begun))
    return answered, seen


def in_browser(found: Served) -> dict[str, float]:
    """Return the figures measured in a real page."""
    from testing.workbench.browser import FLAGS, find_chromium

    path = find_chromium()
    if path is None:
        print("no Chromium: the figures of the page are left out")
        return {}
    from playwright.sync_api import sync_playwright

    figures: dict[str, float] = {}
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=path, args=list(FLAGS))
        # The driver evaluates scripts, which the page's policy forbids; the model, rendered in software, is omitted.
        tab = chromium.new_context(bypass_csp=True, viewport={"width": 1600, "height": 900}).new_page()
        tab.route("**/viser/**", lambda route: route.fulfill(body="<!doctype html>", content_type="text/html"))
        tab.add_init_script(_WATCH_MOVES)
        tab.goto(f"{found.address}?token={found.token}")
        tab.get_by_role("button", name="connected").wait_for()
        body = tab.locator("#photo-pane .pane-body")
        tab.locator("#photo-pane canvas").first.wait_for(state="attached")
        tab.wait_for_timeout(3000)
        box = body.bounding_box()
        assert box is not None
        tab.mouse.move(box["x"] + 80, box["y"] + 120)
        tab.mouse.down()
        for k in range(60):
            tab.mouse.move(box["x"] + 80 + 4 * k, box["y"] + 120 + 2 * k)
        tab.keyboard.press("Escape")
        tab.mouse.up()
        spent = tab.evaluate("window.moves")
        if spent:
            figures["pointer move, ms"] = float(np.median(spent))
            figures["pointer move, worst, ms"] = float(max(spent))
        edits = tab.evaluate(_EDIT_IN_PAGE, ["p1", 100])
        answered = edits["answered"]
        figures["document round trip in a browser, ms"] = float(np.median(answered))
        figures["document round trip in a browser, p95, ms"] = float(np.percentile(answered, 95))
        figures["edit drawn in a browser, ms"] = float(np.median(edits["drawn"]))
        chromium.close()
    return figures


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=1.0, help="minutes of random edits by ten clients")
    parser.add_argument("--json", type=Path, help="write the figures here")
    arguments = parser.parse_args()
    figures: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as folder, served(Path(folder) / "project") as (found, first):
        figures["first picture, s"] = first
        page = Page(found)
        with_camera_and_picks(page, _MANY)
        other = Page(found)
        answered, seen = round_trips(page, other)
        figures["document round trip, ms"] = float(np.median(answered))
        figures["document round trip, p95, ms"] = float(np.percentile(answered, 95))
        figures["edit at another page, ms"] = float(np.median(seen))
        figures.update(in_browser(found))
        page.ask("remove_picks", photo="p1", picks=[pick["id"] for pick in page.slices["picks:p1"]])
        figures.update(model_drawn(found, page))
        if "poses:p1" not in page.slices or not page.slices["poses:p1"]["stages"]:
            page.ask("run", photo="p1", job="auto")
        page.until(lambda slices: slices["job"] and slices["job"]["state"] not in ("running", "paused"))
        time.sleep(5)
        figures["memory, MB"] = found.memory_mb()
        page.socket.close()
        other.socket.close()
        memory, edits = many_clients(found, arguments.minutes)
        half = [mb for seconds, mb in memory if seconds > memory[-1][0] / 2]
        figures["random edits"] = float(edits)
        figures["memory after them, MB"] = memory[-1][1]
        figures["growth in the second half, MB"] = half[-1] - half[0]
    for name, value in figures.items():
        asked = ASKED.get(name)
        verdict = "" if asked is None else f"   required <= {asked:g}: {'met' if value <= asked else 'MISSED'}"
        print(f"{name:42} {value:10.2f}{verdict}")
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
