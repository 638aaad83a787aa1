"""The arithmetic of the overview strip, and a stroke that survives turning."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from ladarreg_core.frames import look_along

if TYPE_CHECKING:
    from playwright.sync_api import Page

EXTENT = {"low": -1.0, "high": 1.5}
SIZE = [600, 250]


def run(page: Page, module: str, body: str, given: Any = None) -> Any:
    return page.evaluate(f"async (a) => {{ const m = await import('/js/panes/{module}.js'); {body} }}", given)


def view(azimuth_deg: float) -> dict[str, Any]:
    angle = math.radians(azimuth_deg)
    rotation = look_along([math.cos(angle), math.sin(angle), 0.0]).ravel().tolist()
    return {"width": 400, "height": 400, "f": 200.0, "cx": 199.5, "cy": 199.5, "rotation": rotation}


def test_positions_and_directions_agree_and_wrap(blank: Page) -> None:
    for x, y in ((0, 0), (150, 100), (300, 249), (599, 10)):
        body = "return m.positionOf(a[0], a[1], m.anglesOf(m.rayAt(...m.anglesAt(a[0], a[1], a[2]))))"
        found = run(blank, "strip_geometry", body, [EXTENT, SIZE, [x, y]])
        assert found[0] % 600 == pytest.approx(x, abs=1e-6)
        assert found[1] == pytest.approx(y, abs=1e-6)
    beyond = run(
        blank,
        "strip_geometry",
        "return [m.anglesAt(a[0], a[1], [-150, 50]), m.anglesAt(a[0], a[1], [450, 50])]",
        [EXTENT, SIZE],
    )
    assert beyond[0] == pytest.approx(beyond[1]), "a drag beyond the left border goes on from the right"


def test_an_outline_across_the_seam_has_no_jump_and_one_around_a_pole_reaches_it(blank: Page) -> None:
    ring = [[math.cos(t), math.sin(t)] for t in np.linspace(0, 2 * math.pi, 40, endpoint=False)]
    behind = [[-1.0, 0.3 * y, 0.3 * x] for x, y in ring]
    above = [[0.2 * x, 0.2 * y, 1.0] for x, y in ring]
    body = "return m.outlineIn(a[0], a[1], a[2])"
    found = run(blank, "strip_geometry", body, [behind, EXTENT, SIZE])
    points = np.array(found["points"])
    assert not found["turns"]
    assert np.ptp(points[:, 0]) < 80
    found = run(blank, "strip_geometry", body, [above, EXTENT, SIZE])
    points = np.array(found["points"])
    assert found["turns"]
    assert np.ptp(points[:, 0]) == pytest.approx(600)
    assert points[:, 1].min() < 0


def test_the_most_central_view_is_shown_but_not_changed_for_little(blank: Page) -> None:
    views = [view(degrees) for degrees in (0, 60, 120, 180, -120, -60)]
    body = "return m.viewTowards(a[0], m.rayAt(a[1] * Math.PI / 180, 0), a[2])"
    assert run(blank, "strip_geometry", body, [views, 170, 0]) == 3
    assert run(blank, "strip_geometry", body, [views, 31, 0]) == 0
    assert run(blank, "strip_geometry", body, [views, 31, 1]) == 1
    assert run(blank, "strip_geometry", body, [views, -175, 4]) == 3


def test_a_stroke_goes_on_from_the_same_direction_in_another_view(blank: Page) -> None:
    body = """
      const { pixelOf, rayOf } = await import('/js/panes/projection.js');
      const [before, after] = a;
      const at = (lens, uv, time_ms) => ({ world: rayOf(lens, uv), uv, zoom: 1, time_ms });
      const picking = new m.Picking();
      picking.subject = "p1";
      picking.press("scan", "line", at(before, [60, 200], 0));
      const first = picking.release("scan", at(before, [60, 200], 10));
      picking.turned("scan", (ray) => pixelOf(after, ray));
      picking.press("scan", "line", at(after, [330, 120], 2000));
      const second = picking.release("scan", at(after, [330, 120], 2010));
      return [first, second, picking.open, [rayOf(before, [60, 200]), rayOf(after, [330, 120])]];
    """
    for turned_deg in (40, 120):  # the first end is inside the other view, or behind it
        first, second, drawn, rays = run(blank, "picking", body, [view(0), view(turned_deg)])
        assert (first, second) == ("drawing", "open")
        assert drawn["ends"] == rays


def test_of_names_that_cover_each_other_the_first_are_written(blank: Page) -> None:
    boxes = np.random.default_rng(2).uniform(0, [560, 230], (80, 2))
    boxes = np.concatenate([boxes, boxes + np.array([60, 14])], axis=1)
    body = "const taken = []; return a.map((box) => m.takesRoom(taken, box))"
    written = run(blank, "strip_geometry", body, boxes.tolist())
    kept: list[Any] = []
    for box, shown in zip(boxes, written, strict=True):
        free = not any(box[0] < k[2] and k[0] < box[2] and box[1] < k[3] and k[1] < box[3] for k in kept)
        assert shown == free
        kept += [box] if free else []
    assert 20 < len(kept) < 80
