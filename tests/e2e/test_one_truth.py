"""The page never contradicts the facts: verdict, ticks, status bar, tabs, table and export agree after an edit."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import pytest

from testing.workbench.operator import Operator, at_work
from testing.workbench.shared import SharedWorkbench

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

TICK = ".sign.ok"


@pytest.fixture
def operator(browser: Browser, workbench: SharedWorkbench, request: pytest.FixtureRequest) -> Iterator[Operator]:
    """An operator whose photograph was solved from 16 right points."""
    workbench.open("solved")
    with at_work(browser, workbench.server, request) as found:
        assert found.socket.ask("run", photo="p1", job="robust")["ok"]  # the page tells of the last job
        found.wait(lambda: (found.slice("job") or {}).get("state") == "done", "solved")
        found.open()
        yield found


def verdict(page: Page) -> Any:
    return page.get_by_role("region", name="Verdict").get_by_role("status")


@pytest.mark.slow
def test_an_edit_puts_the_whole_verdict_out_of_date(operator: Operator) -> None:
    page = operator.page
    judge = page.get_by_role("tab", name="Judge", exact=True)
    photo = page.locator(".photo-button")
    status = page.get_by_role("group", name="Job")
    verdict(page).filter(has_text="verified against the image").wait_for()
    page.locator("#step-judge.done").wait_for()

    page.locator(".row-line[data-pick]").first.locator(".col-kind").click()
    page.keyboard.press("Delete")
    said = re.compile("1 match changed since: solve again")
    verdict(page).filter(has_text="Out of date: 1 match changed since.").wait_for()
    status.filter(has_text=said).wait_for()
    page.wait_for_selector("#step-judge:not(.done)")
    page.wait_for_selector("#step-solve:not(.done)")
    assert "solve again" in (judge.get_attribute("title") or "")
    assert "out of date" in photo.inner_text()
    assert photo.locator(TICK).count() == 0
    assert page.get_by_role("region", name="Verdict").locator(TICK).count() == 0
    operator.shot("out-of-date")

    operator.step("Export")
    zip_button = operator.button("Download zip")
    assert zip_button.is_disabled()
    last = page.get_by_role("checkbox", name="export the last solved state")
    last.check()
    with page.expect_download(timeout=120_000):
        zip_button.click()
    operator.shot("export-of-the-last-state")
    assert page.locator("#step-export.done").count() == 0

    operator.step("Match")
    page.locator("#scan-pane .pane-body").focus()
    page.keyboard.press("Control+z")
    verdict(page).filter(has_text="Accepted").wait_for()
    page.locator("#step-judge.done").wait_for()
    assert photo.locator(TICK).count() == 1


@pytest.mark.slow
def test_solving_is_one_button_with_one_verdict(operator: Operator) -> None:
    """Matches that agree with each other and not with the images: solved, verified and refused by one click."""
    page = operator.page
    for pick in operator.slice("picks:p1"):
        ((u, v),) = pick["photo"]
        operator.socket.ask("set_pick", photo="p1", pick=pick["id"], photo_uv=[[u + 30, v]])
    verdict(page).filter(has_text="Out of date").wait_for()
    page.get_by_role("region", name="Methods").get_by_role("button", name="Solve from matches").click()
    contradicted = re.compile("Not accepted: contradicted by the images", re.IGNORECASE)
    verdict(page).filter(has_text=contradicted).wait_for(timeout=90_000)
    notices = page.locator(".notice").filter(has_text=contradicted)
    notices.first.wait_for()
    assert notices.count() == 1
    page.get_by_role("group", name="Job").filter(has_text=contradicted).wait_for()
    assert "not accepted" in page.locator(".photo-button").inner_text()
    for step in ("solve", "judge", "export"):
        assert page.locator(f"#step-{step}.done").count() == 0
    assert page.get_by_role("group", name="Job").locator(".icon-tick").count() == 0
    operator.step("Solve")
    row = page.locator(".pipeline-step").filter(has=page.get_by_role("button", name="Run: Verify"))
    assert row.filter(visible=True).get_attribute("data-state") == "failed"
    operator.shot("contradicted")


@pytest.mark.long
def test_drawn_matches_are_solved_by_themselves(operator: Operator) -> None:
    """The verdict follows an edit without a click, a notice or a step of its own, and undo takes it back."""
    page = operator.page
    assert operator.socket.ask("set_settings", solve_automatically=True)["ok"]
    page.locator(".row-line[data-pick]").first.locator(".col-kind").click()
    page.keyboard.press("Delete")
    page.get_by_role("button", name="Undo: Remove a match").wait_for()  # until then, the verdict is that of before
    operator.wait(lambda: operator.slice("photos")[0]["state"] == "accepted", "solved")
    verdict(page).filter(has_text="verified against the image").wait_for()
    page.locator("#step-judge.done").wait_for()
    assert page.locator(".notice").count() == 0
    page.keyboard.press("Control+z")
    operator.wait(lambda: len(operator.slice("picks:p1")) == 16, "undone")
    operator.wait(lambda: operator.slice("photos")[0]["state"] == "accepted", "solved again")
    verdict(page).filter(has_text="verified against the image").wait_for()
    assert page.locator(".notice").count() == 0
