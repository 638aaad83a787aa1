"""The panes fit their pictures until a divider is moved."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.page.two_panes import run

if TYPE_CHECKING:
    from playwright.sync_api import Page

HEADS = 45


@pytest.mark.parametrize("size", [(1440, 826), (1280, 646), (1920, 1006), (1024, 694)])
@pytest.mark.parametrize("aspects", [(1.5, 1.5), (2.0, 0.67), (0.75, 0.75), (1.0, 16 / 9), (4.0, 1.5)])
def test_pictures_fill_their_panes(blank: Page, size: tuple[int, int], aspects: tuple[float, float]) -> None:
    width, height = size
    given = [{"width": width, "height": height}, HEADS, list(aspects)]
    found = run(blank, "layout/dividers", "return m.sharesFor(...a)", given)
    assert 0.33 <= found["dock"] <= 0.46
    assert found["left"] >= 0.2
    assert found["middle"] >= 0.2
    assert found["left"] + found["middle"] <= 0.8
    high = (1 - found["dock"]) * height - HEADS
    filled = []
    for share, aspect in zip((found["left"], found["middle"]), aspects, strict=True):
        wide = share * width
        zoom = min(wide / aspect, high)
        filled.append(aspect * zoom**2 / (wide * high))
    before = (1 - 0.33) * height - HEADS
    usual = [aspect * min(0.325 * width / aspect, before) ** 2 / (0.325 * width * before) for aspect in aspects]
    assert sum(filled) >= sum(usual), "no worse than panes of fixed shares"
    if aspects == (1.5, 1.5):
        assert min(filled) > 0.65
