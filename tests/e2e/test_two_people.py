"""Two people at one workbench, each in a browser of his or her own."""

from __future__ import annotations

import itertools
import re
import socket
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from ladarreg_core.formats import read_scan
from ladarreg_core.formats.scans.npz import write_npz_xyz
from ladarreg_core.simulate.sample import sample_folder
from testing.scenes.thinned_scan import thinned
from testing.workbench.operator import Operator
from testing.workbench.pages import LONGEST_MS, choose_photo, photo_in_list, without_model
from testing.workbench.served import Served, served
from testing.workbench.shared import SharedWorkbench

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

SIZE: Any = {"width": 1366, "height": 768}
PHOTO = next(sample_folder().glob("photo.*")).name
BESIDE = "Scan beside the photograph"
SLICE = "(name) => import('./js/net/store.js').then(({ store }) => store.get(name))"


@pytest.fixture
def server(workbench: SharedWorkbench) -> Served:
    workbench.open("sample")
    return workbench.server


class Person(Operator):
    """A person in a browser of his or her own; without a websocket beside the page, since that would be a third."""

    def __init__(self, browser: Browser, server: Served, name: str, *, token: str = "") -> None:
        self.context = browser.new_context(viewport=SIZE, bypass_csp=True)
        self.context.set_default_timeout(LONGEST_MS)
        self.page, self.server = self.context.new_page(), server
        without_model(self.page)
        self.errors: list[str] = []
        self.pictures, self._shots = Path("artifacts") / "two-people" / name, 0
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.goto(f"{server.address}?token={token or server.token}")
        self.page.get_by_role("button", name="connected").wait_for()
        self.wait(lambda: f"'{name}'" not in str(self.slice("people")), "nobody of an earlier test has the name")
        self.page.locator(".clients-button").click()
        self.page.get_by_label("Your name").fill(name)
        self.page.get_by_role("button", name="Set name").click()
        self.wait(lambda: self.slice("people")["count"] and name in str(self.slice("people")), "the name is known")

    def slice(self, name: str) -> Any:
        return self.page.evaluate(SLICE, name)

    def add_photo(self, path: Path) -> None:
        """Add a photograph with the dialog."""
        self.page.locator(".photo-button").click()
        self.page.get_by_role("button", name="Add photographs").click()
        dialog = self.page.locator("dialog[open]")
        dialog.locator("input[type=file]").first.set_input_files(str(path))
        photo_in_list(self.page, path.name)
        if dialog.count():
            self.page.keyboard.press("Escape")


@pytest.fixture
def ann(browser: Browser, server: Served) -> Iterator[Person]:
    person = Person(browser, server, "Ann")
    yield person
    person.context.close()
    assert not person.errors


@pytest.fixture
def ben(browser: Browser, server: Served) -> Iterator[Person]:
    person = Person(browser, server, "Ben")
    yield person
    person.context.close()
    assert not person.errors


def shown_photo(page: Page) -> str:
    return page.locator(".photo-button .photo-name").inner_text().strip()


@pytest.mark.long
def test_a_colleague_who_adds_a_photograph_does_not_disturb_a_line_that_is_being_drawn(
    ann: Person, ben: Person, tmp_path: Path
) -> None:
    second = tmp_path / "second.png"
    second.write_bytes(next(sample_folder().glob("photo.*")).read_bytes())
    ann.draw("scan", [(420, 180), (760, 260)])
    ann.page.get_by_text(re.compile("Draw the same line in the photograph")).first.wait_for()
    before = len(ann.slice("picks:p1"))
    ben.add_photo(second)
    ben.wait(lambda: ben.slice("shown") == "p2", "the colleague sees the new photograph")
    photo_in_list(ann.page, "second.png")
    assert ann.slice("shown") == "p1"
    ann.draw("photo", [(300, 200), (410, 220)])
    ann.wait(lambda: len(ann.slice("picks:p1")) == before + 1, "the line is saved where it was drawn")
    assert not ann.slice("picks:p2")

    ann.page.reload()
    ann.page.get_by_role("button", name="connected").wait_for()
    assert ann.slice("shown") == "p1"
    assert sorted(each["name"] for each in ann.slice("people")["clients"]) == ["Ann", "Ben"], "the same person"
    ben.page.reload()
    ben.page.get_by_role("button", name="connected").wait_for()
    assert shown_photo(ben.page).startswith("second.png")


@pytest.mark.slow
def test_each_sees_the_scan_of_the_station_beside_his_or_her_photograph(
    ann: Person, ben: Person, tmp_path: Path
) -> None:
    folder = sample_folder()
    station, second = tmp_path / "window.npz", tmp_path / "second.png"
    write_npz_xyz(station, thinned(read_scan(folder / "scan.npz"), 2))
    second.write_bytes(next(folder.glob("photo.*")).read_bytes())
    assert not ann.page.get_by_label(BESIDE).is_visible(), "there is one scan only"
    ann.step("Survey")
    ann.page.get_by_role("region", name="Stations", exact=True).locator("input[type=file]").set_input_files(
        str(station)
    )
    ben.add_photo(second)
    ann.page.get_by_label(BESIDE).select_option(label="window.npz")
    ann.wait(lambda: (ann.slice("beside") or {}).get("name") == "window.npz", "the station's scan is beside it")
    assert ben.slice("beside") is None
    assert ben.page.get_by_label(BESIDE).input_value() == ""
    ann.step("Match")
    drawn = {}
    for person, photo in ((ann, "p1"), (ben, "p2")):
        person.draw("scan", [(420, 200), (760, 280)] if person is ben else [(210, 100), (380, 140)])
        person.draw("photo", [(300, 200), (410, 220)])
        person.wait(lambda: person.slice(f"picks:{photo}"), "the line is drawn")  # noqa: B023
        drawn[photo] = person.slice(f"picks:{photo}")
        person.shot("beside")
    # A person who looks at both photographs sees each beside its own scan; what was drawn returns with the scan.
    choose_photo(ben.page, PHOTO)
    ben.wait(lambda: (ben.slice("beside") or {}).get("name") == "window.npz", "its scan comes with the photograph")
    ann.page.get_by_label(BESIDE).select_option(index=0)
    ann.wait(lambda: ann.slice("beside") is None and not ann.slice("picks:p1"), "the line belongs to the other scan")
    ben.wait(lambda: ben.slice("beside") is None, "who looks at the same photograph sees the same scan")
    ann.page.keyboard.press("Control+z")
    ann.wait(lambda: ann.slice("picks:p1") == drawn["p1"], "it returns with the other scan")
    assert ben.slice("picks:p2") == drawn["p2"]


@pytest.mark.slow
def test_undo_takes_back_ones_own_edit_and_a_conflict_says_whose(ann: Person, ben: Person) -> None:
    choose_photo(ann.page, PHOTO)
    choose_photo(ben.page, PHOTO)
    before = {pick["number"] for pick in ann.slice("picks:p1")}

    def drawn(person: Person, v: float) -> int:
        there = {pick["number"] for pick in person.slice("picks:p1")}
        person.draw("scan", [(420, v), (760, v + 80)])
        person.draw("photo", [(300, v), (410, v + 20)])
        return person.wait(lambda: {pick["number"] for pick in person.slice("picks:p1")} - there, "a line").pop()

    mine = drawn(ann, 200)
    ben.wait(lambda: mine in {pick["number"] for pick in ben.slice("picks:p1")}, "the colleague sees it")
    theirs = drawn(ben, 300)
    ann.wait(lambda: theirs in {pick["number"] for pick in ann.slice("picks:p1")}, "the colleague's line")
    ann.page.keyboard.press("Control+z")
    ann.wait(lambda: {pick["number"] for pick in ann.slice("picks:p1")} == before | {theirs}, "one's own is undone")
    ann.page.keyboard.press("Control+Shift+z")
    ann.wait(lambda: {pick["number"] for pick in ann.slice("picks:p1")} == before | {mine, theirs}, "and redone")

    ben.wait(lambda: mine in {pick["number"] for pick in ben.slice("picks:p1")}, "the colleague sees it again")
    # By its number, not by its place: a slice is known a frame before the table shows it.
    ben.page.get_by_role("checkbox", name=f"Match {mine} enabled", exact=True).click()
    ann.wait(lambda: [p["number"] for p in ann.slice("picks:p1") if not p["on"]] == [mine], "it is disabled")
    ann.page.keyboard.press("Control+z")
    ann.page.get_by_text(f"Ben changed match {mine} since", exact=False).wait_for()

    ann.page.keyboard.press("h")
    ann.page.get_by_role("button", name="Begin").click()
    question = ann.page.get_by_role("dialog", name="Go to this state for everybody?")
    question.get_by_text("also for Ben").wait_for()
    question.get_by_role("button", name="Cancel").click()
    assert mine in {pick["number"] for pick in ben.slice("picks:p1")}
    ann.page.locator(".history-button").click()
    ann.page.get_by_role("button", name=f"Draw line {theirs}").first.click()
    question.get_by_role("button", name="Go to this state").click()
    ben.page.get_by_text(f"Ann went to 'Draw line {theirs}'", exact=False).wait_for()


POINTER_SEEN = """() => {
  const canvas = document.querySelector('#photo-pane canvas.pane-live');
  if (canvas.hidden) return 0;
  const { data } = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
  let count = 0;
  for (let k = 3; k < data.length; k += 4) count += data[k] > 200;
  return count;
}"""


@pytest.mark.slow
def test_one_sees_the_others_pointer_and_follows_the_others_view(ann: Person, ben: Person) -> None:
    for person in (ann, ben):
        choose_photo(person.page, PHOTO)
        person.wait(lambda p=person: p.slice("shown") == "p1", "the same photograph")
    assert ben.page.evaluate(POINTER_SEEN) == 0
    path = itertools.cycle([ann.place("photo", (200 + 4 * k, 150 + 3 * k)) for k in range(10)])

    def seen() -> bool:
        ann.page.mouse.move(*next(path))
        return bool(ben.page.evaluate(POINTER_SEEN) > 100)

    ben.wait(seen, "a pointer with a name")
    ben.shot("pointer")
    ben.wait(lambda: ben.page.evaluate(POINTER_SEEN) == 0, "it fades")

    ben.page.locator(".clients-button").click()
    ben.page.get_by_role("button", name="Follow Ann").click()
    ben.page.get_by_text("Following Ann").wait_for()
    ben.shot("following")
    ben.page.keyboard.press("Escape")
    zoom = "() => document.querySelector('#photo-pane .pane-zoom, #photo-pane [class*=zoom]')?.textContent"
    ann.page.mouse.wheel(0, -600)
    ben.wait(lambda: ben.page.evaluate(zoom) == ann.page.evaluate(zoom) != None, "the same zoom")  # noqa: E711
    ben.page.mouse.move(*ben.place("photo", (240, 180)))
    ben.page.mouse.wheel(0, 300)
    ben.page.get_by_text("You no longer follow Ann.").wait_for()
    ben.wait(lambda: not ben.page.get_by_text("Following Ann").is_visible(), "the mark is gone")


@pytest.mark.slow
def test_a_read_only_page_looks_and_changes_nothing(browser: Browser, workbench: SharedWorkbench, ann: Person) -> None:
    server, token = workbench.server, workbench.look_token
    eve = Person(browser, server, "Eve", token=token)
    try:
        page = eve.page
        page.get_by_text("Read only", exact=True).first.wait_for()
        for name in ("Undo", "Redo", "Register automatically", "Draw a line"):
            assert page.get_by_role("button", name=name).count() == 0, name
        before, at = eve.slice("picks:p1"), eve.slice("history")["at"]
        eve.draw("scan", [(420, 180), (760, 260)])
        eve.draw("photo", [(300, 200), (410, 220)])
        page.keyboard.press("Control+z")
        box = page.locator(".row-line[data-pick] input[type=checkbox]").first
        if box.count():
            box.dispatch_event("click")
        name = page.get_by_label("Project name")
        name.click()
        page.keyboard.type("changed")
        said = page.evaluate("import('./js/net/connection.js').then((m) => m.ask('undo').catch((e) => e.message))")
        assert said.startswith("This page is read-only")
        status = page.evaluate("fetch('upload?what=scan', { method: 'POST', body: 'x' }).then((r) => r.status)")
        assert status == 403
        ann.page.get_by_text("2 clients").wait_for()
        assert (eve.slice("picks:p1"), eve.slice("history")["at"]) == (before, at)
        ann.page.locator(".clients-button").click()
        ann.page.get_by_text("· read only").wait_for()
        ann.page.context.grant_permissions(["clipboard-read", "clipboard-write"])
        ann.page.get_by_role("button", name="Copy read-only link").click()
        ann.page.get_by_text("The read-only link was copied", exact=False).wait_for()
        link = ann.page.evaluate("navigator.clipboard.readText()")
        assert link == f"{server.address}?token={token}"
    finally:
        eve.context.close()


@pytest.mark.long
@pytest.mark.skipif(sys.platform == "win32", reason="the server is ended by a signal")
def test_a_page_outlives_a_restart_of_the_workbench(browser: Browser, tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    with served(tmp_path / "project", port=port) as (first, _):
        person = Person(browser, first, "Ann")
        person.draw("scan", [(420, 180), (760, 260)])
        person.draw("photo", [(300, 200), (410, 220)])
        person.wait(lambda: len(person.slice("picks:p1")) == 1, "a line")
    try:
        person.page.get_by_role("button", name=re.compile("connect", re.IGNORECASE)).filter(
            has_not_text=re.compile("^connected")
        ).first.wait_for()
        with served(tmp_path / "project", port=port) as (again, _):
            assert (again.port, again.token) == (port, first.token)
            person.page.get_by_text("Reconnected.").wait_for()
            assert len(person.slice("picks:p1")) == 1
            assert [each["name"] for each in person.slice("people")["clients"]] == ["Ann"]
            person.page.keyboard.press("Control+z")
            person.wait(lambda: person.slice("picks:p1") == [], "the line of before the restart is undone")
    finally:
        person.context.close()
    assert not person.errors
