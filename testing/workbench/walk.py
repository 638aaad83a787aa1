"""A walk through the states of a project: in each, what the page says is compared with the project on the disk."""

from __future__ import annotations

import re
import time
from pathlib import Path
from typing import Any

from testing.scenes.true_matches import true_points
from testing.workbench.operator import Operator
from testing.workbench.page_truth import facts_of, page_contradictions, server_contradictions
from testing.workbench.pages import ROUND_TRIP, two_frames
from testing.workbench.served import Page as Socket
from testing.workbench.shared import SharedWorkbench

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

    def files(self, *paths: Path) -> None:
        """Open files that must be accepted."""
        reply = self.do("open_files", files=[self.workbench.server.upload(path) for path in paths])
        assert not reply["refused"] + reply["waiting"], reply

    def station(self, path: Path) -> None:
        """Add a scan as a further station."""
        self.do("open_files", files=[self.workbench.server.upload(path)], scan="stations")

    def stations(self) -> list[str | None]:
        """Return the ids of all stations; that of the scan that is shown is None."""
        self.socket.ask("list_served")
        return [each["id"] for each in self.socket.slices["stations"]["stations"]]

    def job(self, name: str, photo: str = "p1", **fields: Any) -> None:
        """Run a job of a photograph to its end."""
        self.ended(self.do("run", photo=photo, job=name, **fields))

    def ended(self, reply: dict[str, Any]) -> None:
        """Wait until the job that a command started has ended."""
        started = reply["job"]
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
