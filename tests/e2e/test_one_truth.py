"""The page never contradicts the facts: verdict, ticks, status bar, tabs, table and export agree after an edit."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from ladarreg_core.simulate.sample import sample_folder
from testing.scenes.true_matches import true_points
from testing.workbench.operator import Operator
from testing.workbench.pages import without_model
from testing.workbench.served import Served, served

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform == "win32", reason="needs the served sample")]
SIZE: Any = {"width": 1600, "height": 900}
TICK = ".sign.ok"


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """A running workbench on the sample, with its camera set."""
    with served(tmp_path_factory.mktemp("truth") / "project") as (found, _):
        yield found


@pytest.fixture
def operator(browser: Browser, server: Served, checkout: Path, request: pytest.FixtureRequest) -> Iterator[Operator]:
    """An operator whose photograph was solved from 16 right points."""
    context = browser.new_context(viewport=SIZE, bypass_csp=True, color_scheme="dark", accept_downloads=True)
    page = context.new_page()
    without_model(page)
    faults: list[str] = []
    page.on("pageerror", lambda error: faults.append(str(error)))
    found = Operator(page, server, checkout / "artifacts" / request.node.name)
    camera = json.loads((sample_folder() / "camera.json").read_text())
    found.socket.ask("set_camera", photo="p1", focal_px=camera["fx"])
    assert found.socket.ask("set_settings", solve_automatically=False)["ok"]
    left = [pick["id"] for pick in found.slice("picks:p1")]
    if left:
        found.socket.ask("remove_picks", photo="p1", picks=left)
    for point in true_points(16):
        assert found.socket.ask("add_pick", photo="p1", **point)["ok"]
    assert found.socket.ask("run", photo="p1", job="robust")["ok"]
    found.wait(lambda: found.slice("photos")[0]["state"] == "accepted", "solved")
    found.open()
    yield found
    found.shot("end")
    found.slice("photos")  # unread messages would delay the end of the connection
    found.socket.socket.close()
    context.close()
    assert not faults


def verdict(page: Page) -> Any:
    return page.get_by_role("region", name="Verdict").get_by_role("status")


def test_an_edit_puts_the_whole_verdict_out_of_date(operator: Operator) -> None:
    page = operator.page
    judge = page.get_by_role("tab", name="Judge", exact=True)
    photo = page.locator(".photo-tab")
    status = page.get_by_role("group", name="Job")
    page.get_by_text("Accepted on match statistics only").first.wait_for()
    page.locator("#step-judge.done").wait_for()

    page.locator(".row-line[data-pick]").first.locator(".col-kind").click()
    page.keyboard.press("Delete")
    said = re.compile("1 match changed since: solve again")
    verdict(page).filter(has_text="Out of date").filter(has_text=said).wait_for()
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


def test_solving_is_one_button_with_one_verdict(operator: Operator) -> None:
    """Matches that agree with each other and not with the images: solved, verified and refused by one click."""
    page = operator.page
    for pick in operator.slice("picks:p1"):
        ((u, v),) = pick["photo"]
        operator.socket.ask("set_pick", photo="p1", pick=pick["id"], photo_uv=[[u + 30, v]])
    verdict(page).filter(has_text="Out of date").wait_for()
    page.get_by_role("region", name="Find matches").get_by_role("button", name="Solve from matches").click()
    contradicted = re.compile("Not accepted: contradicted by the images", re.IGNORECASE)
    verdict(page).filter(has_text=contradicted).wait_for(timeout=90_000)
    notices = page.locator(".notice").filter(has_text=contradicted)
    notices.first.wait_for()
    assert notices.count() == 1
    page.get_by_role("group", name="Job").filter(has_text=contradicted).wait_for()
    assert "not accepted" in page.locator(".photo-tab").inner_text()
    for step in ("solve", "judge", "export"):
        assert page.locator(f"#step-{step}.done").count() == 0
    assert page.get_by_role("group", name="Job").locator(".icon-tick").count() == 0
    operator.step("Solve")
    row = page.locator(".pipeline-step").filter(has=page.get_by_role("button", name="Run: Verify"))
    assert row.filter(visible=True).get_attribute("data-state") == "failed"
    operator.shot("contradicted")


def test_drawn_matches_are_solved_by_themselves(operator: Operator) -> None:
    """The verdict follows an edit without a click, a notice or a step of its own, and undo takes it back."""
    page = operator.page
    assert operator.socket.ask("set_settings", solve_automatically=True)["ok"]
    page.locator(".row-line[data-pick]").first.locator(".col-kind").click()
    page.keyboard.press("Delete")
    verdict(page).filter(has_text="verified against the image").wait_for(timeout=60_000)
    page.locator("#step-judge.done").wait_for()
    assert page.locator(".notice").count() == 0
    assert page.get_by_role("button", name="Undo: Remove a match").count() == 1
    page.keyboard.press("Control+z")
    operator.wait(lambda: len(operator.slice("picks:p1")) == 16, "undone")
    operator.wait(lambda: operator.slice("photos")[0]["state"] == "accepted", "solved again")
    verdict(page).filter(has_text="verified against the image").wait_for()
    assert page.locator(".notice").count() == 0
