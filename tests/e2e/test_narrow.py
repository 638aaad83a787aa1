"""Narrow screens: labels are whole, and on a phone there is one part at a time, everything within reach."""

from __future__ import annotations

import itertools

import pytest

from testing.workbench.operator import Operator

CLIPPED = """
() => [...document.querySelectorAll("button, h2, h3, label, th, select, [role=tab]")]
  .filter((each) => each.checkVisibility({visibilityProperty: true}) && each.innerText.trim())
  .filter((each) => getComputedStyle(each).overflowX !== "visible" && each.scrollWidth > each.clientWidth + 1)
  .map((each) => `${each.tagName}: ${each.innerText.trim()}`)
"""


@pytest.mark.slow
def test_no_label_is_clipped(onlooker: Operator) -> None:
    page = onlooker.page
    for width, step in itertools.product((1024, 1280, 1440), ("Match", "Solve", "Judge", "Export")):
        page.set_viewport_size({"width": width, "height": 800})
        onlooker.step(step)
        onlooker.shot(f"{width}-{step.lower()}")
        assert page.evaluate(CLIPPED) == [], (width, step)


@pytest.mark.slow
def test_one_part_at_a_time_on_a_narrow_screen(operator: Operator) -> None:
    page = operator.page
    page.set_viewport_size({"width": 390, "height": 844})
    bar = page.get_by_role("navigation", name="Shown part")
    parts = {"Scan": "#scan-pane", "Photograph": "#photo-pane", "Model": "#model-pane", "Matches": "#dock"}
    for name, shown in parts.items():
        bar.get_by_role("button", name=name, exact=True).click()
        for part in parts.values():
            page.locator(part).wait_for(state="visible" if part == shown else "hidden")
        box = page.locator(shown).bounding_box()
        assert box is not None
        assert box["width"] > 380
        assert box["height"] > 400
        operator.shot(name.lower())
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    start = len(operator.slice("picks:p1"))
    page.keyboard.press("n")
    for name, side in (("Scan", "scan"), ("Photograph", "photo")):
        bar.get_by_role("button", name=name, exact=True).click()
        operator.draw(side, [(200.0, 150.0), (420.0, 260.0)])
    operator.wait(lambda: len(operator.slice("picks:p1")) == start + 1, "a line in the document")
