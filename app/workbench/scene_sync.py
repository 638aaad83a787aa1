"""Between the session and the 3-D stage: what is shown there follows the document."""

from __future__ import annotations

import logging
import threading
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from ladarreg_core.errors import LadarregError

from ..session.debounce import Quiet

if TYPE_CHECKING:
    from ..jobs.runner import Job
    from ..jobs.simplex import Frame
    from ..scene import Stage3D
    from ..scene.model_view import ModelChoice
    from .workbench import Workbench

log = logging.getLogger(__name__)


class StageLink:
    """Refreshes the stage in a thread of its own; without a stage it does nothing."""

    def __init__(self, workbench: Workbench) -> None:
        self._workbench = workbench
        self._stage: Stage3D | None = None
        self._quiet = Quiet()
        self._drawn: Any = None
        self._walks = False
        self._iterations = 0
        self._last_iteration = 0
        self._thread = threading.Thread(target=self._work, name="stage link", daemon=True)
        self._thread.start()

    def attach(self, stage: Stage3D) -> None:
        """Draw into this stage from now on."""
        self._stage = stage
        self.set_model(self._workbench.model)
        self.refresh()

    def refresh(self) -> None:
        """Have the stage follow the document."""
        self._quiet.ask()

    def set_model(self, model: ModelChoice) -> None:
        """Show the model in another way."""
        if self._stage is not None:
            self._stage.set_model(**asdict(model))

    def highlight(self, pick_id: str | None) -> None:
        """Mark a match."""
        if self._stage is not None:
            self._stage.highlight(pick_id)

    def watch_simplex(self, frame: Frame) -> None:
        """Draw a moment of the simplex."""
        if self._stage is None:
            return
        from ..scene import SimplexFrame

        if not self._walks:
            self._walks, self._iterations, self._last_iteration = True, 0, 0
            self._stage.simplex_started()
        number = frame.step.simplex.iteration
        if number < self._last_iteration:  # another descent began
            self._iterations += self._last_iteration
        self._last_iteration = number
        moment = SimplexFrame.of(frame.step, iteration=self._iterations + number)
        if frame.last:
            self._walks = False
            self._stage.simplex_ended(moment)
        else:
            self._stage.simplex_step(moment)

    def job_changed(self, job: Job) -> None:
        """Let the stage's controls say whether the walk waits, and end a walk that came to nothing."""
        if self._stage is None or not self._walks:
            return
        if job.runs:
            self._stage.simplex_paused(paused=job.state == "paused")
        else:
            self._walks = False
            self._stage.simplex_ended(None)

    def close(self) -> None:
        """End the thread."""
        self._quiet.close()
        self._thread.join(30)
        if self._stage is not None:
            self._stage.close()

    def _work(self) -> None:
        while self._quiet.wait():
            try:
                self._follow()
            except LadarregError as error:
                log.info("the stage cannot follow: %s", error)
            except Exception:
                log.exception("the stage cannot follow")

    def _follow(self) -> None:
        stage, workbench = self._stage, self._workbench
        if stage is None:
            return
        from ladarreg_core.inspection.picks import pick_points

        from ..scene.colours import MATCH_COLOURS

        room, document = workbench.room, workbench.session.document
        scan, entry = room.scan(document), workbench.shown
        pose = entry.pose if entry is not None else None
        shown = (id(scan), id(pose), None if entry is None else (entry.id, entry.source, entry.camera))
        if shown != self._drawn:
            self._drawn = shown
            if scan is None or entry is None:
                stage.show_scan(scan)
            else:
                try:
                    photo = room.photo(entry)
                except LadarregError:
                    photo = None
                try:
                    answer = None if pose is None or photo is None else room.answer(pose)
                except LadarregError:  # its matches are missing, which its stage says in its verdict
                    answer = None
                stage.show_registration(scan, photo, answer, name=entry.source.name)
        if scan is None or entry is None:
            return
        points, ids, on = pick_points(scan, room.picks(entry))
        numbers = {pick.id: pick.number for pick in entry.picks}
        colours = [MATCH_COLOURS[(numbers[name] - 1) % len(MATCH_COLOURS)] for name in ids]
        stage.show_picks(points, colours, on, ids)
