"""Automatic solving: after an edit of the matches the pose is solved and verified, without being asked.

It is quiet: its results are automatic commits, which undo steps over, and it is no job that clients see. A job that was
asked for goes first, the newest matches win, and a pose that the operator chose otherwise is never replaced.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from ladarreg_core.errors import Cancelled, LadarregError
from ladarreg_core.project.history import NOBODY

from ..argument_names import as_fields
from .inputs import Inputs, Workspace
from .runner import JobRunner
from .solve import SolveJobs

if TYPE_CHECKING:
    from ladarreg_core.matching.image_check import Proposal
    from ladarreg_core.project.document import Document, PhotoEntry
    from ladarreg_core.results.steps import Step

    from ..session.session import Change
    from ..slices.photographs import Solving

log = logging.getLogger(__name__)
PAUSE_S = 0.3
"""From the last edit to the start."""
IDLE: Solving = {"busy": False, "sentence": ""}
"""The state while nothing is solved."""
_MIN_POINTS = 4
_DRAWN = ("manual", "file")
_RETRY_S = 0.1


class AutomaticSolver:
    """Solves photographs whose matches were edited, one at a time, in a thread of its own.

    Args:
        workspace: provides inputs and commits results.
        runner: the runner of the jobs that go first.
        solve: solves.
        on_change: called when it starts and ends.
    """

    def __init__(
        self, workspace: Workspace, runner: JobRunner, solve: SolveJobs, on_change: Callable[[], None]
    ) -> None:
        self._workspace, self._runner, self._solve, self._on_change = workspace, runner, solve, on_change
        self._wanted: dict[str, float] = {}
        self._busy = ""
        self._failed: dict[str, str] = {}
        self._closed = False
        self._changed = threading.Condition()
        self._unsubscribe = workspace.session.subscribe(self._edited)
        self._thread = threading.Thread(target=self._work, name="automatic solver", daemon=True)
        self._thread.start()

    def state(self, photo: str) -> Solving:
        """Return whether a photograph is being solved, and why there is no result, for the slice `solving`."""
        return {"busy": self._busy == photo, "sentence": self._failed.get(photo, "")}

    def close(self) -> None:
        """End the thread; what it is solving is discarded."""
        self._unsubscribe()
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join(60)

    def _edited(self, change: Change) -> None:
        edited = [
            photo.id
            for photo in change.document.photos
            if (before := change.before.photo(photo.id)) is not None
            and before.station == photo.station
            and (
                before.picks is not photo.picks
                or _has_grown(change.before.beside(before), change.document.beside(photo))
            )
        ]
        if not edited:
            return
        with self._changed:
            for photo in edited:
                self._wanted[photo] = time.monotonic() + PAUSE_S
                self._failed.pop(photo, None)
            self._changed.notify_all()

    def _work(self) -> None:
        while photo := self._next():
            try:
                self._solve_photo(photo)
            except Exception:
                log.exception("automatic solving of %s", photo)

    def _next(self) -> str:
        """Wait until a photograph is due and no job runs; return its id, empty when closed."""
        with self._changed:
            while not self._closed:
                due = min(self._wanted.values(), default=None)
                wait_s = None if due is None else due - time.monotonic()
                if wait_s is not None and wait_s <= 0 and not self._runner.is_busy:
                    photo = min(self._wanted, key=self._wanted.__getitem__)
                    del self._wanted[photo]
                    return photo
                self._changed.wait(None if wait_s is None else max(wait_s, _RETRY_S))
            return ""

    def _solve_photo(self, photo: str) -> None:
        try:
            inputs = self._workspace.inputs(photo)
        except LadarregError:  # the page says what is missing
            return
        if not self._is_wanted(inputs.entry):
            return
        self._busy = photo
        self._on_change()
        try:
            found = self._solve.solved(inputs, lambda step: self._check(inputs, step))
            note = self._solve.note_on_start(inputs)
            proposal: Proposal = "drawn" if _chosen_as_drawn(inputs.entry) else "refined"
            solved = self._solve.with_solution(inputs, found, proposal=proposal, note=note)
            self._workspace.commit(
                inputs,
                "Solve automatically",
                lambda now: solved(now) if self._is_wanted(now) else now,
                author=NOBODY,
                of_picks=True,
                automatic=True,
            )
        except Cancelled:
            if self._runner.is_busy:
                with self._changed:
                    self._wanted.setdefault(photo, time.monotonic())
        except LadarregError as error:
            if self._is_current(inputs):
                self._failed[photo] = as_fields(str(error))
        finally:
            self._busy = ""
            self._on_change()

    def _check(self, inputs: Inputs, _: Step) -> None:
        """Stop for newer matches, and for a job."""
        if self._closed or self._runner.is_busy or not self._is_current(inputs):
            raise Cancelled("something newer goes first")

    def _is_current(self, inputs: Inputs) -> bool:
        document = self._workspace.session.document
        now = document.photo(inputs.entry.id)
        same_photo = now is not None and now.picks is inputs.entry.picks and now.camera == inputs.entry.camera
        return same_photo and document.beside(now).scan == inputs.document.scan

    def _is_wanted(self, entry: PhotoEntry) -> bool:
        session, loader = self._workspace.session, self._workspace.loader
        settings, pose = session.document.settings, entry.pose
        enabled = [pick for pick in entry.picks if pick.on]
        points = sum(len(pick.photo) for pick in enabled)
        if not settings.solve_automatically or points < _MIN_POINTS or len(enabled) > settings.solve_up_to:
            return False
        if session.history.redone is not None:
            return False  # its commit would discard what can be redone
        if pose is None or (pose.stage == "auto" and not pose.accepted):
            return any(pick.origin in _DRAWN for pick in enabled)
        return pose.stage in ("robust", "refined") and bool(loader.stale(session.document, entry, pose))


def _has_grown(before: Document, document: Document) -> bool:
    """Return whether the scan has further clouds, or other ranges."""
    return (before.clouds, before.ranges) != (document.clouds, document.ranges)


def _chosen_as_drawn(entry: PhotoEntry) -> bool:
    """Return whether the operator chose the pose as drawn, where the images verify a refined one."""
    pose = entry.pose
    if pose is None or pose.stage != "robust" or entry.stage("refined") is None:
        return False
    return bool(pose.accepted)
