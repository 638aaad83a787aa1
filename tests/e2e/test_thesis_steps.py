"""From the demo, a newcomer sees corners, the simplex, what it rejects, and an export, in six actions."""

from __future__ import annotations

from typing import Any

import pytest

from testing.workbench.operator import Operator
from testing.workbench.pages import wait_for_store

MAX_ACTIONS = 6


class Newcomer:
    """Clicks, counted."""

    def __init__(self, operator: Operator) -> None:
        self.page, self.operator, self.actions = operator.page, operator, 0

    def step(self, name: str) -> None:
        self.actions += 1
        self.operator.step(name)

    def run(self, label: str) -> dict[str, Any]:
        """Run a step, and return the job once it has ended."""
        self.actions += 1
        part = self.page.get_by_role("region", name="Methods")
        part.get_by_role("button", name=f"Run: {label}", exact=True).click()
        name = {"Match corners": "match", "Simplex": "simplex", "Remove outliers": "reject_outliers"}[label]
        wait_for_store(self.page, f"store.get('job')?.kind === '{name}' && store.get('job').state !== 'running'")
        return dict(self.operator.slice("job"))


@pytest.mark.slow
def test_corners_simplex_outliers_and_an_export_in_six_actions(operator: Operator) -> None:
    page, hand = operator.page, Newcomer(operator)
    hand.step("Solve")
    assert hand.run("Match corners")["state"] == "done"
    corners = operator.slice("corners:p1")
    assert min(len(corners["scan"]), len(corners["photo"])) > 50, "corners are found and shown"
    found = len(operator.slice("picks:p1"))
    assert found >= 20

    job = hand.run("Simplex")
    assert job["state"] == "done", job
    frames = "import('./js/state/simplex_run.js').then(({ simplexRun }) => simplexRun.frames.length)"
    assert page.evaluate(frames) > 5, "the simplex is seen live"
    page.get_by_text("matches agree").first.wait_for()

    job = hand.run("Remove outliers")
    assert job["state"] == "done", job
    poses = operator.slice("poses:p1")
    assert poses["shown"] == "simplex_outliers_removed"
    stage = next(each for each in poses["stages"] if each["stage"] == poses["shown"])
    assert stage["matches"] == found
    assert stage["accepted"], stage["verdict"]
    assert 0.7 * found < stage["inliers"] < found, "the simplex converges, and some matches are outliers"

    def outliers() -> int:
        judged = (operator.slice("judged:p1") or {}).get("by_pick") or {}
        return sum(each["inlier"] is False for each in judged.values())

    operator.wait(lambda: outliers() == found - stage["inliers"], "the table marks what was rejected")
    operator.shot("outliers-removed")

    hand.step("Export")
    hand.actions += 1
    with page.expect_download(timeout=120_000) as download:
        page.get_by_role("region", name="Export", exact=True).get_by_role("button", name="Download zip").click()
    assert download.value.path().stat().st_size > 10_000
    assert hand.actions <= MAX_ACTIONS
