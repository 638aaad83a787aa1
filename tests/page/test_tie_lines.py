"""Lines that are drawn in several photographs: what the page says of each, and what it asks for next."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from playwright.sync_api import Page

LINE: dict[str, Any] = {
    "id": "l4", "photos": ["p1", "p2", "p3"], "uv": [], "in_scan": None, "agrees": None, "residuals_px": {},
    "scan_residual": None, "reason": "",
}  # fmt: skip
SCAN: dict[str, Any] = {"station": "", "name": "hall.npz", "xyz": [[1, 0, 0], [1, 1, 0]], "sigma": "3 mm"}
SAID = """async ([line, names]) => {
  const { lineSaid, lineShownIn } = await import('/js/panes/tie_lines.js');
  return [lineSaid(line), lineShownIn(line, new Map(names))];
}"""
HINT = """async (now) => (await import('/js/panes/tie_lines.js')).lineHint(now)"""


@pytest.mark.parametrize(
    ("changes", "said", "shown"),
    [
        ({}, "not adjusted yet", "a.jpg – b.jpg – p3"),
        ({"photos": ["p1"]}, "in one photograph: draw it in two more, or in the scan", "a.jpg"),
        (
            {"photos": ["p1", "p2"]},
            "in two photographs, which do not constrain their poses: draw it in a third, or in the scan",
            "a.jpg – b.jpg",
        ),
        ({"photos": ["p1"], "in_scan": SCAN}, "not adjusted yet", "a.jpg – hall.npz ± 3 mm"),
        ({"photos": [], "in_scan": SCAN}, "in the scan alone: draw it in a photograph", "hall.npz ± 3 mm"),
        (
            {"photos": [], "in_scan": SCAN | {"station": None}},
            "its scan is no longer in the project: draw it again, or remove it",
            "hall.npz (no longer in the project)",
        ),
        (
            {
                "photos": ["p1"],
                "in_scan": SCAN,
                "agrees": True,
                "reason": "It agrees.",
                "scan_residual": "2 mm",
                "residuals_px": {"p1": 0.25},
            },
            "It agrees.",
            "a.jpg 0.3 px – hall.npz 2 mm",
        ),
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
        ({"photos": 0, "hasScan": True}, "A line needs a photograph, and the project has none"),
        ({"photos": 1, "hasScan": True, "begun": "scan"}, "Now click another place of the same edge in the scan, far"),
        (
            {"hasScan": True, "line": LINE | {"photos": ["p1"]}},
            "Line 4 is drawn in 1 photograph: click two places of the same edge in two others, or in the scan.",
        ),
        (
            {"hasScan": True, "line": LINE | {"photos": [], "in_scan": SCAN}},
            "Line 4 is drawn in the scan: click two places of the same edge in a photograph.",
        ),
        (
            {"hasScan": True, "line": LINE | {"photos": ["p1"], "in_scan": SCAN}},
            "Line 4 is drawn in 1 photograph and the scan: draw it in a further one",
        ),
        ({}, "Click two places of a straight edge in one photograph"),
        ({"begun": "third photograph"}, "Now click another place of the same edge in the third photograph"),
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
    before = {"readOnly": False, "photos": 5, "hasScan": False, "begun": None, "line": None, "number": "4"}
    assert blank.evaluate(HINT, before | now).startswith(start)
