"""A walk through the states of a project: in each, every figure and verdict on the page is that of the project.

The states are reached by commands, as by another page. In each, the whole page is read and compared with the project on
the disk (testing/workbench/page_truth.py), and with what a person expects of this state.
"""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from PIL import Image, ImageOps

from ladarreg_core.simulate.sample import sample_folder
from testing.scenes.true_matches import true_points
from testing.workbench.operator import Operator, at_work
from testing.workbench.page_truth import facts_of, page_contradictions, server_contradictions
from testing.workbench.pages import ROUND_TRIP, two_frames
from testing.workbench.served import Page as Socket
from testing.workbench.shared import SharedWorkbench

if TYPE_CHECKING:
    from playwright.sync_api import Browser

MIN_STATES = 40
FOCAL_PX = 974.0
LONGEST_S = 30
"""What a page may take to say of a state what is so, on a busy computer."""


class Walk:
    """A walk: states, each by a name, and what was wrong in them."""

    def __init__(self, operator: Operator, workbench: SharedWorkbench) -> None:
        self.operator, self.workbench = operator, workbench
        self.socket, self.page = operator.socket, operator.page
        self.constants: list[str] = []
        self.states: list[str] = []
        self.wrong: list[str] = []

    def reopen(self) -> None:
        """Close the project, and open it again, as after a restart."""
        self.page.goto("about:blank")
        self.socket.socket.close()
        self.workbench.reopen()
        self.operator.socket = self.socket = Socket(self.workbench.server)
        self.operator.open()

    def do(self, do: str, **fields: Any) -> dict[str, Any]:
        """Send a command that must succeed."""
        reply = self.socket.ask(do, **fields)
        assert reply["ok"], reply
        return reply

    def job(self, name: str, photo: str = "p1", **fields: Any) -> None:
        """Run a job to its end."""
        started = self.do("run", photo=photo, job=name, **fields)["job"]
        self.socket.until(
            lambda slices: (
                (slices.get("job") or {}).get("id") == started and slices["job"]["state"] not in ("running", "paused")
            )
        )

    def points(self, count: int, *, shift_px: float = 0, photo: str = "p1") -> list[str]:
        """Draw right points, or ones that are all shifted to the right."""
        found = []
        for point in true_points(count):
            ((u, v),) = point["photo_uv"]
            found.append(str(self.do("add_pick", photo=photo, **{**point, "photo_uv": [[u + shift_px, v]]})["pick"]))
        return found

    def state(self, name: str, light: str | None = None, *, ticks: tuple[str, ...] = ()) -> None:
        """Compare the page with the project; `light` and `ticks` are what a person expects of this state."""
        self.states.append(name)
        end = time.monotonic() + LONGEST_S
        while True:
            said = self.contradictions(light, ticks)
            if not said or time.monotonic() > end:
                break
            self.page.wait_for_timeout(250)
        if said:
            self.operator.keep(re.sub(r"\W+", "-", name))
        self.operator.shot(re.sub(r"\W+", "-", name))
        self.wrong += [f"{name}: {each}" for each in said]

    def contradictions(self, light: str | None, ticks: tuple[str, ...]) -> list[str]:
        self.socket.ask("list_served")
        shown = self.page.evaluate("import('./js/net/store.js').then(({ store }) => store.shown())")
        self.page.evaluate(ROUND_TRIP)
        two_frames(self.page)
        self.socket.ask("list_served")
        slices = {**self.socket.slices, "shown": shown}
        facts = facts_of(self.page)
        found = server_contradictions(self.workbench.folder, slices)
        found += page_contradictions(facts, slices, self.constants, simplex=self.socket.events.get("simplex"))
        photo = next((each for each in slices["photos"] if each["id"] == shown), {})
        if photo.get("light") != light:
            found.append(f"a person expects {light}, and it is {photo.get('light')}")
        done = tuple(name for name in ("match", "solve", "judge", "export") if facts["tabs"][name]["done"])
        if done != ticks:
            found.append(f"a person expects ticks at {ticks}, and they are at {done}")
        return found

    def finish(self, least: int) -> None:
        assert len(self.states) >= least, self.states
        assert not self.wrong, f"{len(self.wrong)} contradictions in {len(self.states)} states:\n" + "\n".join(
            self.wrong
        )


@pytest.fixture
def walk(browser: Browser, workbench: SharedWorkbench, request: pytest.FixtureRequest) -> Iterator[Walk]:
    """A walk that begins with nothing open."""
    workbench.open_new()
    with at_work(browser, workbench.server, request, size=(1440, 900)) as operator:
        found = Walk(operator, workbench)
        operator.open()
        operator.page.keyboard.press("Escape")
        found.constants = [text for _, _, text in facts_of(operator.page)["rest"]]
        yield found


def files(walk: Walk, *paths: Path) -> None:
    reply = walk.do("open_files", files=[walk.workbench.server.upload(path) for path in paths])
    assert not reply["refused"] + reply["waiting"], reply


SCAN = sample_folder() / "scan.npz"
PHOTO = next(sample_folder().glob("photo.*"))


def first_steps(walk: Walk) -> list[str]:
    """From nothing to matches that are solved by a button."""
    walk.state("nothing is open")
    files(walk, PHOTO)
    walk.state("a photograph alone")
    files(walk, SCAN)
    walk.page.keyboard.press("Escape")
    walk.state("both, the focal length is unknown")
    walk.do("set_settings", solve_automatically=False)
    walk.do("set_camera", photo="p1", focal_px=FOCAL_PX)
    walk.page.keyboard.press("Escape")
    walk.state("the focal length is entered")
    picks = walk.points(1)
    walk.state("one match")
    picks += [str(walk.do("add_pick", photo="p1", **point)["pick"]) for point in true_points(3)[1:]]
    walk.state("three matches")
    picks += [str(walk.do("add_pick", photo="p1", **point)["pick"]) for point in true_points(16)[3:]]
    walk.state("sixteen matches", ticks=("match",))
    walk.do("switch_picks", photo="p1", picks=picks, on=False)
    walk.state("all matches are disabled")
    walk.do("undo")
    walk.state("enabled again", ticks=("match",))
    return picks


SOLVED = ("match", "solve", "judge")


@pytest.mark.long
def test_a_short_walk(walk: Walk) -> None:
    """Nothing open, matches, solved, out of date, undone, contradicted, corrected."""
    picks = first_steps(walk)
    walk.job("solve")
    walk.state("solved", "verified", ticks=SOLVED)
    walk.do("remove_picks", photo="p1", picks=picks[:1])
    walk.state("a match is removed since", "out_of_date", ticks=("match",))
    walk.do("undo")
    walk.state("and is back", "verified", ticks=SOLVED)
    walk.do("remove_picks", photo="p1", picks=picks)
    walk.points(16, shift_px=30)
    walk.job("solve")
    walk.state("contradicted by the images", "not_accepted", ticks=("match",))
    walk.do("use_stage", photo="p1", stage="refined")
    walk.state("the images' pose is used", "verified", ticks=SOLVED)
    walk.finish(14)


@pytest.mark.long
@pytest.mark.timeout(1200)
def test_a_long_walk(walk: Walk, tmp_path: Path) -> None:
    """More than forty states, among them each of those that have contradicted themselves before."""
    picks = first_steps(walk)
    walk.job("robust")
    walk.state("solved as drawn", "verified", ticks=SOLVED)
    walk.job("solve")
    walk.state("solved and refined", "verified", ticks=SOLVED)
    walk.do("use_stage", photo="p1", stage="robust")
    walk.state("the drawn pose is used", "verified", ticks=SOLVED)
    walk.job("verify")
    walk.state("verified again", "verified", ticks=SOLVED)
    walk.do("set_pick", photo="p1", pick=picks[0], photo_uv=[[100.0, 100.0]])
    walk.state("a match is moved", "out_of_date", ticks=("match",))
    walk.do("set_pick", photo="p1", pick=picks[1], weight=2)
    walk.state("another is weighted", "out_of_date", ticks=("match",))
    walk.job("robust")
    walk.state("solved with an outlier", "verified", ticks=SOLVED)
    walk.do("switch_picks", photo="p1", picks=picks[:1], on=False)
    walk.state("the outlier is disabled", "out_of_date", ticks=("match",))
    walk.job("solve")
    walk.state("and solved again", "verified", ticks=SOLVED)
    walk.job("linear")
    walk.state("linear", light_of(walk), ticks=ticks_of(walk))
    walk.job("simplex")
    walk.state("simplex", light_of(walk), ticks=ticks_of(walk))
    walk.job("reject_outliers")
    walk.state("outliers are removed", light_of(walk), ticks=ticks_of(walk))
    walk.job("compare")
    walk.state("all methods are compared", light_of(walk), ticks=ticks_of(walk))
    walk.do("reject", photo="p1", by="px", above=0.3)
    walk.state("matches are disabled by the threshold", "out_of_date", ticks=("match",))
    walk.do("undo")
    walk.state("and enabled again", light_of(walk), ticks=ticks_of(walk))
    walk.job("auto")
    walk.state("registered automatically", "verified", ticks=SOLVED)
    walk.do("remove_picks", photo="p1", picks=picks[2:5])
    walk.state("a pose from the images outlives its matches", "verified", ticks=SOLVED)
    walk.job("export")
    exported = (*SOLVED, "export")
    walk.state("exported", "verified", ticks=exported)
    other = Socket(walk.workbench.server)
    assert other.ask("call_me", name="Ada")["ok"]
    assert other.ask("use_stage", photo="p1", stage="robust")["ok"]
    walk.state("another person shows another pose", "out_of_date", ticks=("match",))
    assert other.ask("undo")["ok"]
    walk.state("and undoes it", "verified", ticks=exported)
    assert other.ask("set_pick", photo="p1", pick=picks[6], on=False)["ok"]
    walk.state("another person disables a match", "verified", ticks=exported)
    other.socket.close()

    walk.reopen()
    walk.state("reopened", "verified", ticks=exported)
    walk.do("undo")
    walk.state("undone after reopening", "verified", ticks=exported)

    mirrored = tmp_path / "mirrored.png"
    with Image.open(PHOTO) as image:
        ImageOps.mirror(image).save(mirrored)
    files(walk, mirrored)
    walk.operator.page.evaluate(
        "import('./js/net/requests.js').then(({ request }) => request('show_photo', { photo: 'p2' }))"
    )
    walk.page.keyboard.press("Escape")
    walk.state("a second photograph")
    walk.do("set_camera", photo="p2", focal_px=FOCAL_PX)
    walk.state("its focal length is entered")
    walk.job("auto", photo="p2")
    walk.state("it is of something else: refused", "not_accepted")
    walk.points(3, photo="p2")
    walk.state("a refused one with matches", "not_accepted")
    walk.points(6, shift_px=40, photo="p2")
    walk.state("a refused one with enough matches", "not_accepted", ticks=("match",))
    walk.job("solve", photo="p2")
    walk.state("wrong matches of it are solved", "not_accepted", ticks=("match",))
    walk.page.evaluate("import('./js/net/requests.js').then(({ request }) => request('show_photo', { photo: 'p1' }))")
    walk.state("the first photograph again", "verified", ticks=exported)
    walk.do("remove_photo", photo="p2")
    walk.state("the second is removed", "verified", ticks=exported)
    walk.do("undo")
    walk.state("and is back", "verified", ticks=exported)
    walk.do("set_camera", photo="p1", focal_px=900.0)
    walk.state("another focal length removes the poses", ticks=("match",))
    walk.do("undo")
    walk.state("which are back", "verified", ticks=exported)
    walk.job("find_corners")
    walk.state("corners are found", "verified", ticks=exported)
    walk.job("match")
    walk.state("corners are matched", "verified", ticks=exported)
    walk.do("undo")
    walk.state("corner matches are undone", "verified", ticks=exported)
    walk.do("rename", name="Seven of nine")
    walk.state("renamed", "verified", ticks=exported)
    walk.finish(MIN_STATES)


def light_of(walk: Walk) -> str | None:
    """What the workbench says of the first photograph, where a person would not know."""
    walk.socket.ask("list_served")
    light = walk.socket.slices["photos"][0].get("light")
    return str(light) if light else None


def ticks_of(walk: Walk) -> tuple[str, ...]:
    return SOLVED if light_of(walk) in ("verified", "matches_only") else ("match",)
