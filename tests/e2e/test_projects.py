"""The start page, and the change from one project to another with two people at the workbench."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

import pytest

from ladarreg_core.simulate.sample import sample_folder
from testing.workbench.audits import hard_to_read
from testing.workbench.operator import SLICE, TOKEN, draw, drop, opened, shot
from testing.workbench.pages import wait_for_store, without_model
from testing.workbench.served import Served

if TYPE_CHECKING:
    from playwright.sync_api import Browser

SIZE = {"width": 1024, "height": 720}
pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform == "win32", reason="started as a process group")]


@contextmanager
def started_without_a_project(home: Path) -> Iterator[Served]:
    """A workbench that opens its start page."""
    process = subprocess.Popen(
        [sys.executable, "-m", "ladarreg", "serve", "--port", "0", "--no-browser", "--token", TOKEN],
        stdout=subprocess.PIPE, text=True, env={**os.environ, "LADARREG_HOME": str(home), "OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    try:
        assert process.stdout is not None
        address = next(word for word in process.stdout.readline().split() if "://" in word)
        parts = urlsplit(address)
        yield Served(process, parts.hostname or "", parts.port or 0, TOKEN)
    finally:
        process.terminate()
        process.wait(60)


@pytest.mark.long
def test_from_the_start_page_to_a_second_project_and_back(browser: Browser, tmp_path: Path) -> None:
    """Files on the start page begin a project; a colleague's page follows the change; the first project comes back."""
    photo, scan = next(sample_folder().glob("photo.*")).read_bytes(), (sample_folder() / "scan.npz").read_bytes()
    mine, others = (browser.new_context(viewport=SIZE, bypass_csp=True) for _ in range(2))
    without_model(others)
    faults: list[str] = []
    with started_without_a_project(tmp_path / "home") as server:
        page = opened(mine, server)
        page.on("pageerror", lambda error: faults.append(str(error)))
        projects = page.get_by_role("dialog", name="Projects")
        projects.get_by_text("No projects yet").wait_for()
        for _ in range(3):
            page.keyboard.press("Escape")
        projects.get_by_role("button", name="Open the sample").wait_for()  # there is nothing behind it yet
        page.wait_for_function("document.querySelector('.start-page').matches(':modal')")
        drop(page, ".start-page", {"office.npz": scan, "desk.jpg": photo})
        projects.wait_for(state="hidden")
        wait_for_store(page, "store.photo()")
        page.get_by_role("dialog", name="Camera of the photograph").wait_for()
        page.keyboard.press("Escape")

        draw(page, "scan")
        page.locator("#photo-pane .awaits-partner").wait_for()

        colleague = opened(others, server)
        colleague.get_by_role("textbox", name="Project name").wait_for()
        page.get_by_role("button", name="Projects").click()
        entry = projects.get_by_role("list", name="Recent projects").get_by_role("listitem")
        entry.get_by_text("1 photograph, not solved").wait_for()
        entry.locator("img").wait_for()
        entry.get_by_role("button", name="Duplicate office").click()
        entry.nth(1).wait_for()
        shot(page, "projects")
        for theme in ("dark", "light"):
            page.emulate_media(color_scheme=theme)  # type: ignore[arg-type]
            assert hard_to_read(page) == []
            shot(page, f"projects-{theme}")

        projects.get_by_role("textbox", name="New project").fill("Second")
        page.keyboard.press("Enter")
        question = projects.get_by_role("alertdialog", name="Open another project?")
        question.get_by_text("would see the other project as well").wait_for()
        shot(page, "projects-question")
        question.get_by_role("button", name="Open it all the same").click()
        for tab in (page, colleague):
            tab.wait_for_function("document.title.startsWith('Second')")
            wait_for_store(tab, "store.get('scan') === null")  # the page loads anew
        colleague.get_by_text("opened the project Second.").wait_for()
        page.get_by_role("dialog", name="Open files").wait_for()
        assert page.locator(".notice.bad").count() == 0
        assert page.locator(".awaits-partner").count() == 0

        page.keyboard.press("Escape")
        page.get_by_role("button", name="Projects").click()
        entry.filter(has_text="not solved").filter(has_not_text="copy").locator(".project-card-open").click()
        for tab in (page, colleague):
            tab.wait_for_function("document.title.startsWith('office')")
            assert [each["name"] for each in tab.evaluate(SLICE, "photos")] == ["desk.jpg"]
        page.locator("#photo-pane .awaits-partner").wait_for()  # the line that was half drawn
        mine.close()
        others.close()
    assert not faults
    folders = sorted(path.name.rpartition("-")[0] or path.name for path in (tmp_path / "home/projects").iterdir())
    assert folders == ["Second", "office-copy", "untitled"], "every project keeps its folder"
