"""The suggested threshold of the depth-error plot never rejects what the robust estimator accepts."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from playwright.sync_api import Page

GOOD = [0.31, -0.42, 0.38, 0.0127, -0.44, 0.4351, 0.29, -0.33, 0.27]
WRONG = [0.12, -0.9]
"""Errors under a pose that two wrong matches have pulled towards them."""


def test_the_suggestion_rests_on_the_robust_inliers(page: Page, modules: str) -> None:
    page.goto(f"{modules}/blank.html")
    errors = [(value, True) for value in GOOD] + [(value, False) for value in WRONG]
    stems = [
        {"id": f"{k}", "number": k, "on": True, "inlier": None, "agrees": agrees, "value": value}
        for k, (value, agrees) in enumerate(errors)
    ]
    above = page.evaluate(
        """async ([stems, sigmas]) => {
             const { suggestedThreshold } = await import('/js/panels/pose/depth_scale.js');
             return sigmas.map((each) => suggestedThreshold(stems, each));
           }""",
        [stems, [0.5, 1, 3]],
    )
    assert all(max(map(abs, GOOD)) <= value for value in above)
    assert above[0] == 0.44  # rounded up to two figures: not one correct match is beyond
    assert (
        page.evaluate("""async () => (await import('/js/panels/pose/depth_scale.js')).suggestedThreshold([], 3)""")
        is None
    )
