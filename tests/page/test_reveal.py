"""A match of the table is offered to be shown, and the former view is given back."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from tests.page.two_panes import place, rays, run

if TYPE_CHECKING:
    from playwright.sync_api import Page

MATCHES = [
    {"id": f"m{k}", "number": k, "kind": "point", "scan": rays([uv]).tolist(), "photo": [at], "on": True}
    for k, uv, at in ((1, [350.0, 30.0], [280.0, 20.0]), (2, [60.0, 220.0], [40.0, 180.0]))
]


def zoom(page: Page, side: str) -> str:
    return page.locator(f"#{side}-pane .pane-zoom").inner_text()


def offer(page: Page, name: str) -> None:
    """Select a match as its row of the table does."""
    page.evaluate("(id) => view.set({ selected: new Set([id]), offer: id })", name)


@pytest.fixture
def narrow(panes: Page) -> Page:
    """Panes in which the pictures are small."""
    panes.emulate_media(reduced_motion="reduce")
    panes.set_viewport_size({"width": 500, "height": 400})
    panes.evaluate("(picks) => store.take({ slices: { 'picks:p1': picks } })", MATCHES)
    return panes


def test_a_row_offers_a_view_and_back_gives_the_old_one(narrow: Page) -> None:
    fitted = zoom(narrow, "photo"), zoom(narrow, "scan")
    offer(narrow, "m1")
    assert (zoom(narrow, "photo"), zoom(narrow, "scan")) == fitted, "nothing moves of itself"
    narrow.get_by_role("button", name="Show match 1").first.click()
    narrow.wait_for_function("document.querySelector('#photo-pane .pane-zoom').textContent === '100 %'")
    offer(narrow, "m2")  # while matches are shown, the next one is shown at once
    assert narrow.get_by_role("button", name="Show match 2").count() == 0
    narrow.get_by_role("button", name="Back to the former view").first.click()
    assert (zoom(narrow, "photo"), zoom(narrow, "scan")) == fitted
    assert narrow.get_by_role("button", name="Back to the former view").count() == 0
    offer(narrow, "m1")
    assert (zoom(narrow, "photo"), zoom(narrow, "scan")) == fitted
    assert narrow.get_by_role("button", name="Show match 1").count() > 0


def test_a_picture_that_was_moved_by_hand_is_not_moved_back(narrow: Page) -> None:
    narrow.evaluate("view.set({ reveal: 'm1' })")
    narrow.get_by_role("button", name="Back to the former view").first.wait_for()
    narrow.mouse.move(*place(narrow, "photo", (150, 100)))
    narrow.mouse.wheel(0, -200)
    narrow.wait_for_function("!document.querySelector('.pane-offer:not([hidden])')")


def test_a_shown_match_leaves_no_border_where_the_picture_is_larger(blank: Page) -> None:
    rng = np.random.default_rng(4)
    for _ in range(200):
        size = rng.integers(50, 4000, 2)
        x, y = (4000 * rng.normal(size=2)).tolist()
        before = {"zoom": float(np.exp(rng.uniform(-2, 3))), "x": x, "y": y}
        pane = [500, 300]
        after: dict[str, Any] = run(blank, "panes/viewport", "return m.filling(...a)", [before, pane, size.tolist()])
        for at, room, length in zip((after["x"], after["y"]), pane, size * before["zoom"], strict=True):
            if length >= room:
                assert at <= 1e-9
                assert at + length >= room - 1e-6
            else:
                assert at == pytest.approx((room - length) / 2)
