"""Keys act where the pointer is, and snapping shows what it will do."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from testing.workbench.operator import Operator
from testing.workbench.pages import ROUND_TRIP, two_frames

AFTER_THROTTLE = "new Promise((done) => setTimeout(done, 200))"
"""Timers of a page end in the order of their times: this one ends after that of any question about snapping."""


def beside_an_edge(operator: Operator) -> tuple[list[list[float]], list[list[float]]]:
    """Return a line in the scan and where it snaps to, between 0.8 and 4 pixels away."""
    view: dict[str, Any] = operator.slice("scan")["views"][0]
    size = np.array([view["width"], view["height"]])
    rng = np.random.default_rng(5)
    for _ in range(400):
        middle = rng.uniform(0.25, 0.75, 2) * size
        angle = rng.choice([0.0, np.pi / 2])
        drawn = (middle + np.array([[-60.0], [60.0]]) * [np.cos(angle), np.sin(angle)]).round(1).tolist()
        answer = operator.socket.ask("snap", side="scan", view=0, ends=drawn, px_per_screen=1.0)
        jump = np.abs(np.array(answer["ends"]) - drawn).max()
        if answer["found"] and 0.8 < jump < 4:
            return drawn, answer["ends"]
    raise AssertionError("the sample has no edge to snap to")


@pytest.mark.slow
def test_a_line_shows_its_ghost_before_the_release_and_shift_suspends_it(operator: Operator) -> None:
    page = operator.page
    drawn, snapped = beside_an_edge(operator)
    in_photo = [[200.0, 150.0], [320.0, 260.0]]
    start = len(operator.slice("picks:p1"))
    for held in (False, True):
        if held:  # an end of the line drawn before, which is selected, would be dragged
            page.locator(".row-line[aria-selected=true]").wait_for()
            page.keyboard.press("Escape")
        (x0, y0), (x1, y1) = (operator.place("scan", uv) for uv in drawn)
        page.mouse.move(x0, y0)
        page.mouse.down()
        page.mouse.move((x0 + x1) / 2, (y0 + y1) / 2, steps=3)
        page.mouse.move(x1, y1, steps=3)
        page.locator("#scan-pane .loupe-caption", has_text="edge").wait_for()
        for _ in range(2):  # until the question about the last ends is answered, not only one about earlier ones
            page.evaluate(AFTER_THROTTLE)
            page.evaluate(ROUND_TRIP)
        if held:
            page.keyboard.down("Shift")
            page.locator("#scan-pane .loupe-caption", has_not_text="edge").wait_for()
        else:
            operator.shot("ghost")
        page.mouse.up()
        page.keyboard.up("Shift")
        page.keyboard.press("n")
        operator.draw("photo", in_photo)  # type: ignore[arg-type]
        page.keyboard.press("n")
        count = start + 1 + held
        pick = operator.wait(
            lambda n=count: p[-1] if len(p := operator.slice("picks:p1")) == n else None, "a line in the document"
        )
        view = operator.slice("scan")["views"][0]
        rays = np.array(pick["scan"]) @ np.array(view["rotation"]).reshape(3, 3).T
        uv = view["f"] * rays[:, :2] / rays[:, 2:] + [view["cx"], view["cy"]]
        np.testing.assert_allclose(uv, drawn if held else snapped, atol=0.1 if held else 0.6)


@pytest.mark.slow
def test_keys_act_on_what_is_selected_and_under_the_pointer(operator: Operator) -> None:
    page = operator.page
    for k in range(2):
        reply = operator.socket.ask(
            "add_pick", photo="p1", kind="point", scan=[[1, 0.05 * k, 0.0]], photo_uv=[[300 + 20 * k, 200]]
        )
        assert reply["ok"]
    operator.wait(lambda: page.locator(".row-line[data-pick]").count() >= 2, "rows of the matches")
    rows = page.locator(".row-line[data-pick]")
    for focus in (".step[aria-selected=true]", "#photo-pane .pane-body"):
        page.locator(focus).focus()
        page.keyboard.press("Control+a")
        operator.wait(lambda: page.locator(".row-line[aria-selected=true]").count() == rows.count(), "all are selected")
        assert page.evaluate("getSelection().toString()") == ""

    rows.last.locator(".col-kind").click()
    page.mouse.move(*operator.place("photo", (300, 200)))
    before = operator.slice("picks:p1")[-1]
    page.keyboard.press("Shift+ArrowRight")
    moved = operator.wait(lambda: p if (p := operator.slice("picks:p1")[-1]) != before else None, "a nudge")
    np.testing.assert_allclose(moved["photo"][0][0], before["photo"][0][0] + 1, atol=1e-6)
    assert moved["scan"] == before["scan"], "only the side under the pointer moves"
    page.keyboard.press("l")
    page.keyboard.press("ArrowRight")
    two_frames(page)
    page.evaluate(ROUND_TRIP)  # a nudge would have been sent before
    assert operator.slice("picks:p1")[-1] == moved, "a match drawn before is forgotten by the line tool"
