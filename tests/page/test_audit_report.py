"""The audit of a pose in the page: its outcome, and the curves of the errors that would be found."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

if TYPE_CHECKING:
    from playwright.sync_api import Page

SIZES_MM, FOUND = [1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0], [0.05, 0.06, 0.12, 0.4, 0.9, 1.0, 1.0, 1.0]
SIZES_DEG = [0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0]
AUDIT: dict[str, Any] = {
    "judged": "rig.json", "outcome": "right", "sentence": "The images agree with this pose.",
    "power": {
        "position_m": [[size / 1000, p] for size, p in zip(SIZES_MM, FOUND, strict=True)],
        "rotation_rad": [[float(np.radians(size)), p / 2] for size, p in zip(SIZES_DEG, FOUND, strict=True)],
        "seen_with_probability": 0.9, "smallest_position_m": 0.02, "smallest_rotation_rad": None,
    },
}  # fmt: skip
MOUNTED = """async (found) => {
  const { auditReport } = await import('/js/panels/pose/audit.js');
  document.body.replaceChildren(auditReport(found));
}"""
CENTRES = """(figure) =>
  [...figure.querySelectorAll('circle')].map(({ cx, cy }) => [cx.baseVal.value, cy.baseVal.value])"""


@pytest.fixture
def report(page: Page, modules: str) -> Page:
    page.goto(f"{modules}/blank.html")
    for sheet in ("tokens.css", "css/base.css", "css/results.css"):
        page.add_style_tag(url=f"{modules}/{sheet}")
    page.evaluate(MOUNTED, AUDIT)
    return page


@pytest.mark.parametrize(("nth", "sizes", "share"), [(0, SIZES_MM, 1.0), (1, SIZES_DEG, 0.5)])
def test_the_curves_show_the_probabilities_over_the_logarithm_of_the_size(
    report: Page, nth: int, sizes: list[float], share: float
) -> None:
    x, y = np.array(report.locator(".power").nth(nth).evaluate(CENTRES)).T
    assert np.corrcoef(x, np.log(sizes))[0, 1] == pytest.approx(1, abs=1e-5)
    assert np.ptp(x) > 150
    found = share * np.array(FOUND)
    slope, offset = np.polyfit(found, y, 1)
    assert slope < -60, "likelier is higher"
    assert y == pytest.approx(slope * found + offset, abs=0.1)


def test_axes_have_units_and_the_same_is_said_in_words(report: Page) -> None:
    shifts, turns = report.locator(".power").nth(0), report.locator(".power").nth(1)
    assert "size of the error, mm" in (shifts.locator("svg").text_content() or "")
    assert "size of the error, deg" in (turns.locator("svg").text_content() or "")
    name = shifts.locator("svg").get_attribute("aria-label") or ""
    assert name.endswith("20 mm would be found with a probability of 90 %."), name
    assert "No error of up to 2 deg" in (turns.text_content() or "")
    shifts.get_by_text("As a table").click()
    assert shifts.locator("tbody tr").nth(3).locator("td").all_text_contents() == ["10 mm", "40 %"]


def test_a_pose_that_cannot_be_judged_has_no_curves(report: Page) -> None:
    unknown = AUDIT | {"outcome": "undecidable", "power": AUDIT["power"] | {"position_m": [], "rotation_rad": []}}
    report.evaluate(MOUNTED, unknown)
    report.get_by_text("Undecidable").wait_for()
    assert report.locator(".power").count() == 0
