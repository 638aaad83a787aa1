"""Time from a pose to the coloured model, in a real browser: the page keeps the mesh and fetches another texture.

Every large draw call of the 3-D page is followed by a look at the middle of its canvas; gray pixels become coloured
ones when the new model is on the screen. Looking costs some time itself, most where no graphics card draws.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

from testing.workbench.browser import FLAGS, find_chromium

if TYPE_CHECKING:
    from testing.workbench.served import Page, Served

_FINE_INDICES = 100_000
_COLORFUL = 5.0
_PATIENCE_S, _SETTLING_S = 40.0, 12.0
_WATCH_DRAWING = """
window.drawn = [];
const get = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind, options) {
  const gl = get.call(this, kind, options);
  if (kind !== "webgl2" || !gl || gl.watched) return gl;
  gl.watched = true;
  const draw = gl.drawElements.bind(gl);
  gl.drawElements = (mode, count, ...rest) => {
    draw(mode, count, ...rest);
    if (count < 10000) return;
    const pixels = new Uint8Array(4 * 32 * 32);
    gl.readPixels(this.width / 2 - 16, this.height / 2 - 16, 32, 32, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
    let colour = 0;
    for (let k = 0; k < pixels.length; k += 4) {
      const [r, g, b] = pixels.subarray(k, k + 3);
      colour += Math.max(r, g, b) - Math.min(r, g, b);
    }
    window.drawn.push([Date.now() / 1000, count, colour / 1024]);
  };
  return gl;
};
"""


def model_drawn(found: Served, page: Page) -> dict[str, float]:
    """Register the photograph, and return how long after its pose the model is seen in colour.

    Args:
        found: the server, with a scan and a photograph that has no pose yet.
        page: who asks for it.
    """
    path = find_chromium()
    if path is None:
        print("no Chromium: the model is not looked at")
        return {}
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=path, args=list(FLAGS))
        tab = chromium.new_context(bypass_csp=True, viewport={"width": 1366, "height": 768}).new_page()
        tab.add_init_script(_WATCH_DRAWING)
        tab.goto(f"{found.address}?token={found.token}")
        tab.get_by_role("button", name="connected").wait_for()
        tab.wait_for_timeout(1000 * _SETTLING_S)
        tab.keyboard.press("m")  # nothing but the model
        page.ask("run", photo="p1", job="auto")
        page.until(lambda slices: slices.get("poses:p1", {}).get("stages"))
        posed = time.time()
        frame = next(frame for frame in tab.frames if "viser" in frame.url)
        figures: dict[str, float] = {}
        while len(figures) < len(_SEEN) and time.time() < posed + _PATIENCE_S:
            tab.wait_for_timeout(1000)
            figures = _first_seen(frame.evaluate("window.drawn"), posed)
        chromium.close()
    return figures


_SEEN = {"model drawn after its pose, s": _FINE_INDICES}


def _first_seen(drawn: list[Any], posed: float) -> dict[str, float]:
    gray = max((color for when, _, color in drawn if when < posed), default=0.0)
    colored = [(when, count) for when, count, color in drawn if when > posed and color > gray + _COLORFUL]
    found = {name: [when for when, count in colored if count >= least] for name, least in _SEEN.items()}
    return {name: whens[0] - posed for name, whens in found.items() if whens}
