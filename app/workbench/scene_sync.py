"""Synchronises the 3-D scene with the document."""

from __future__ import annotations

import logging
import threading
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from ladarreg_core.errors import LadarregError

from ..scene.model_view import ModelChoice
from ..session.debounce import Debouncer
from ..session.loader import Loader
from ..session.session import Session
from .selection import Selection

if TYPE_CHECKING:
    from ..jobs.runner import Job
    from ..jobs.simplex import Frame
    from ..scene import Scene3D

log = logging.getLogger(__name__)


class SceneSync:
    """Updates the scene in a thread of its own; has no effect before a scene is attached.

    Args:
        session: the session.
        loader: its loader.
        selection: the client whose photograph and model are shown.
    """

    def __init__(self, session: Session, loader: Loader, selection: Selection) -> None:
        self._session = session
        self._loader = loader
        self._selection = selection
        self._scene: Scene3D | None = None
        self._model = ModelChoice()
        self._debouncer = Debouncer()
        self._shown: Any = None
        self._simplex_runs = False
        self._iterations = 0
        self._last_iteration = 0
        self._thread = threading.Thread(target=self._work, name="scene sync", daemon=True)
        self._thread.start()

    def attach(self, scene: Scene3D) -> None:
        """Update this scene from now on."""
        self._scene = scene
        scene.set_model(**asdict(self._model))
        self.refresh()

    def refresh(self) -> None:
        """Update the scene soon."""
        self._debouncer.request()

    def highlight(self, pick_id: str | None) -> None:
        """Highlight a match; None: no match."""
        if self._scene is not None:
            self._scene.highlight(pick_id)

    def watch_simplex(self, frame: Frame) -> None:
        """Show an iteration of the simplex."""
        if self._scene is None:
            return
        from ..scene import SimplexFrame

        if not self._simplex_runs:
            self._simplex_runs, self._iterations, self._last_iteration = True, 0, 0
            self._scene.simplex_started()
        number = frame.step.simplex.iteration
        if number < self._last_iteration:  # another descent has begun
            self._iterations += self._last_iteration
        self._last_iteration = number
        shown = SimplexFrame.of(frame.step, iteration=self._iterations + number)
        if frame.last:
            self._simplex_runs = False
            self._scene.simplex_ended(shown)
        else:
            self._scene.simplex_step(shown)

    def job_changed(self, job: Job) -> None:
        """Show whether the simplex is paused, and end one that failed."""
        if self._scene is None or not self._simplex_runs:
            return
        if job.runs:
            self._scene.simplex_paused(paused=job.state == "paused")
        else:
            self._simplex_runs = False
            self._scene.simplex_ended(None)

    def close(self) -> None:
        """End the thread and close the scene."""
        self._debouncer.close()
        self._thread.join(30)
        if self._scene is not None:
            self._scene.close()

    def _work(self) -> None:
        while self._debouncer.wait():
            try:
                self._update()
            except LadarregError as error:
                log.info("the scene cannot be updated: %s", error)
            except Exception:
                log.exception("the scene cannot be updated")

    def _update(self) -> None:
        scene = self._scene
        if scene is None:
            return

        from ladarreg_core.palette import MATCHES

        active = self._selection.active
        if active is not None and active.model != self._model:
            self._model = active.model
            scene.set_model(**asdict(self._model))
        loader = self._loader
        scan, entry = loader.scan(self._session.document), self._selection.photo
        pose = entry.pose if entry is not None else None
        shown = (id(scan), id(pose), None if entry is None else (entry.id, entry.source, entry.camera))
        if shown != self._shown:
            self._shown = shown
            if scan is None or entry is None:
                scene.show_scan(scan)
            else:
                try:
                    photo = loader.photo(entry)
                except LadarregError:
                    photo = None
                try:
                    registration = None if pose is None or photo is None else loader.registration(pose)
                except LadarregError:  # its matches are missing, which the verdict of its stage states
                    registration = None
                scene.show_registration(scan, photo, registration, name=entry.source.name)
        if scan is None or entry is None:
            return
        from ladarreg_core.inspection.picks import pick_points

        points, ids, on = pick_points(scan, loader.picks(entry))
        numbers = {pick.id: pick.number for pick in entry.picks}
        colours = [MATCHES[(numbers[name] - 1) % len(MATCHES)] for name in ids]
        scene.show_picks(points, colours, on, ids)
