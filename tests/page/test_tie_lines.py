"""Lines that are drawn in several photographs: what the page says of each, and what it asks for next."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from playwright.sync_api import Page

LINE: dict[str, Any] = {
    "id": "l4", "photos": ["p1", "p2", "p3"], "uv": [], "in_scan": False, "agrees": None, "residuals_px": {},
    "reason": "",
}  # fmt: skip
SAID = """async ([line, names]) => {
  const { lineSaid, lineShownIn } = await import('/js/panes/tie_lines.js');
  return [lineSaid(line), lineShownIn(line, new Map(names))];
}"""
HINT = """async (now) => (await import('/js/panes/tie_lines.js')).lineHint(now)"""


@pytest.mark.parametrize(
    ("changes", "said", "shown"),
    [
        ({}, "not adjusted yet", "a.jpg – b.jpg – p3"),
        ({"photos": ["p1"]}, "in one photograph: draw it in two more", "a.jpg"),
        (
            {"photos": ["p1", "p2"]},
            "in two photographs, which do not constrain their poses: draw it in a third",
            "a.jpg – b.jpg",
        ),
        ({"photos": ["p1"], "in_scan": True}, "not adjusted yet", "a.jpg – the scan"),
        (
            {"agrees": False, "reason": "Left out in b.jpg.", "residuals_px": {"p1": 0.25, "p2": 12.04}},
            "Left out in b.jpg.",
            "a.jpg 0.3 px – b.jpg 12.0 px – p3",
        ),
    ],
)
def test_a_line_says_what_it_needs_or_what_the_last_adjustment_found(
    blank: Page, changes: dict[str, Any], said: str, shown: str
) -> None:
    assert blank.evaluate(SAID, [LINE | changes, [["p1", "a.jpg"], ["p2", "b.jpg"]]]) == [said, shown]


@pytest.mark.parametrize(
    ("now", "start"),
    [
        ({"readOnly": True}, "Lines are shown only"),
        ({"photos": 2}, "A line needs 3 photographs, and the project has 2"),
        ({}, "Click two places of a straight edge in one photograph"),
        ({"begun": "third"}, "Now click another place of the same edge in the third photograph"),
        (
            {"line": LINE | {"photos": ["p1"]}},
            "Line 4 is drawn in 1 photograph: click two places of the same edge in two",
        ),
        (
            {"line": LINE | {"photos": ["p1", "p2"]}},
            "Line 4 is drawn in 2 photographs, which do not constrain their poses",
        ),
        ({"line": LINE}, "Line 4 is drawn in 3 photographs: draw it in a further one, or begin another"),
    ],
)
def test_the_next_click_is_said(blank: Page, now: dict[str, Any], start: str) -> None:
    before = {"readOnly": False, "photos": 5, "begun": None, "line": None, "number": "4"}
    assert blank.evaluate(HINT, before | now).startswith(start)
