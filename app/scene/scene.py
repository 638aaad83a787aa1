"""The 3-D scene: the latest state of everything, drawn by one thread."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import TYPE_CHECKING

from ladarreg_core.inspection.model_textures import uniform_picture
from ladarreg_core.inspection.simplex_curves import CURVE_NAMES, SimplexCurves
from ladarreg_core.palette import BACKGROUND

from .cameras_layer import CamerasLayer
from .draw_queue import DrawQueue
from .model_layer import ModelLayer
from .model_view import ModelChoice
from .panel import CAMERA, OVERVIEW, SCANNER, Panel
from .picks_layer import Picks, PicksLayer
from .simplex_folder import SimplexFolder
from .simplex_layer import SimplexLayer
from .subject import RenderChoice, ScanShown, Subject

if TYPE_CHECKING:
    import viser
    from numpy.typing import ArrayLike

    from ladarreg_core.inspection.viewpoints import Viewpoint
    from ladarreg_core.photo import Photo
    from ladarreg_core.results import PoseResult
    from ladarreg_core.scan import Scan

    from .actions import SceneActions
    from .simplex_frame import SimplexFrame

SIMPLEX_EVERY_S = 0.04
FINE_AFTER_SIMPLEX_S = 1.0
"""Delay of the fine model after a simplex, which mostly ends with a new pose and thus a new model."""
FINE_AFTER_DRAFT_S = 0.3
"""A draft is shown first: without a graphics card, a fine model takes seconds to draw."""
_ACTIVE = ("running", "paused")
_NEAR_M, _NEAR_PER_FRUSTUM = 0.01, 1.05


class Scene3D:
    """The 3-D scene, its panel and the live curves in a viser server.

    Every method may be called from any thread and returns at once. One thread draws; if it cannot keep up, only the
    latest state of each layer is drawn. The server keeps all of it, so that clients that connect later see the same.
    """

    def __init__(self, server: viser.ViserServer, actions: SceneActions) -> None:
        self._server = server
        self._lock = threading.RLock()
        self._subject: Subject | None = None
        self._choice = ModelChoice()
        self._picks: Picks | None = None
        self._pick_size = 1.0
        self._highlighted: str | None = None
        self._names: tuple[str, ...] = CURVE_NAMES
        self._curves = SimplexCurves()
        self._frame: SimplexFrame | None = None
        self._state = "done"
        self._keeps_best = False
        scene = server.scene
        scene.set_up_direction("+z")
        scene.world_axes.visible = False
        # Nothing is lit, and shadows would only cost time.
        scene.configure_default_lights(enabled=False, cast_shadow=False)
        scene.set_background_image(uniform_picture(BACKGROUND), format="png")
        self._panel = Panel(server, actions, set_viewpoint=self._set_viewpoint, set_match_size=self._set_match_size)
        self._folder = SimplexFolder(server, actions, self._panel.call_or_notify)
        self._queue = DrawQueue("scene")
        self._model = ModelLayer(server, self._queue)
        self._cameras = CamerasLayer(server)
        self._matches = PicksLayer(server, actions.hover)
        self._simplex = SimplexLayer(server)
        self._viewed_scan: ScanShown | None = None

    def show_scan(self, scan: Scan | None) -> None:
        """Show a scan with its intensity, without a photograph; None: clear the scene."""
        self._show(scan, None, None, "")

    def show_registration(
        self, scan: Scan, photo: Photo | None, registration: PoseResult | None, *, name: str = ""
    ) -> None:
        """Show a scan with a photograph.

        Args:
            scan: the scan.
            photo: the photograph.
            registration: its pose. None, or a pose that is not accepted, colours nothing; the camera of the latter is
                drawn as a dashed outline with a label.
            name: of the photograph.
        """
        self._show(scan, photo, registration, name)

    def show_picks(self, points: ArrayLike, colours: ArrayLike, on: ArrayLike, ids: Sequence[str]) -> None:
        """Show matches in space.

        Args:
            points: (N, 3) m, scanner frame; NaN where a match has no position.
            colours: (N, 3) uint8 RGB.
            on: (N,) bool; matches that are off are dimmed.
            ids: pick id of each point; several points may share one.
        """
        with self._lock:
            self._picks = Picks.of(points, colours, on, ids)
        self._queue.request("matches", self._draw_matches)

    def highlight(self, pick_id: str | None) -> None:
        """Highlight one match, or none."""
        with self._lock:
            self._highlighted = pick_id
        self._queue.request("highlight", self._draw_highlight)

    def set_model(self, **settings: str | bool) -> None:
        """Change settings of `ModelChoice`.

        Raises:
            OptionError: if a setting is unknown, or its value is not of its type.
        """
        with self._lock:
            before = self._choice
            self._choice = before.changed(settings)
            if self._choice == before:
                return
        self._queue.request("model", self._draw_model)
        self._queue.request("cameras", self._draw_cameras)
        if self._choice.matches != before.matches:
            self._queue.request("matches", self._draw_matches)

    def simplex_started(self, labels: Sequence[str] = CURVE_NAMES) -> None:
        """Start a simplex with empty curves.

        Args:
            labels: the names of the six parameters, three lengths (m) and three angles (degrees).
        """
        with self._lock:
            self._names, self._curves, self._frame, self._state = tuple(labels), SimplexCurves(), None, "running"
            self._keeps_best = True
        self._queue.cancel("simplex")
        self._queue.request("simplex start", self._draw_simplex_start)
        self._queue.request("model", self._draw_model)

    def simplex_step(self, frame: SimplexFrame) -> None:
        """Draw a frame of the simplex, at most 25 per second, and always the last."""
        with self._lock:
            self._frame = frame
            self._curves.add(frame.iteration, frame.parameters, frame.cost)
        self._queue.request("simplex", self._draw_simplex, every_s=SIMPLEX_EVERY_S)

    def simplex_paused(self, *, paused: bool) -> None:
        """Show in the controls whether the simplex is paused."""
        with self._lock:
            state = "paused" if paused else "running"
            if self._state == state or self._state not in _ACTIVE:
                return
            self._state = state
        self._queue.request("simplex state", self._draw_simplex_state)

    def simplex_ended(self, best: SimplexFrame | None) -> None:
        """End the simplex.

        Args:
            best: its final frame, which stays until a pose is shown; None: it was stopped without a result.
        """
        with self._lock:
            self._state = "done" if best is not None else "stopped"
            last = self._frame
            if best is not None and (last is None or (best.iteration, best.cost) != (last.iteration, last.cost)):
                self._frame = best
                self._curves.add(best.iteration, best.parameters, best.cost)
        self._queue.cancel("simplex")
        self._queue.request("simplex end", lambda: self._draw_simplex_end(best))
        self._queue.request("model", self._draw_model, after_s=FINE_AFTER_SIMPLEX_S)

    def settle(self, timeout_s: float = 30.0) -> bool:
        """Wait until everything is drawn; return False on timeout."""
        return self._queue.settle(timeout_s)

    def close(self) -> None:
        """End the drawing thread; the scene stays as it is."""
        self._queue.close()

    def _show(self, scan: Scan | None, photo: Photo | None, result: PoseResult | None, name: str) -> None:
        with self._lock:
            before = self._subject
            if scan is None:
                self._subject = None
            else:
                shown = before.shown if before is not None and before.scan is scan else ScanShown(scan)
                self._subject = Subject(shown, photo, result, name)
            scan_changed = before is None or self._subject is None or before.shown is not self._subject.shown
            if self._state not in _ACTIVE:
                self._keeps_best = False  # the pose shown now replaces it
            if scan_changed:
                self._picks, self._highlighted = None, None
        # The model first, because everybody waits for it.
        self._queue.request("model", self._draw_model)
        self._queue.request("cameras", self._draw_cameras)
        self._queue.request("matches", self._draw_matches)

    def _current(self) -> tuple[Subject | None, RenderChoice]:
        with self._lock:
            moving = self._state in _ACTIVE and self._subject is not None and self._subject.camera is not None
            return self._subject, RenderChoice(**asdict(self._choice), draft=moving)

    def _draw_model(self) -> None:
        subject, choice = self._current()
        if subject is not None and subject.shown is not self._viewed_scan:
            self._reset_views(subject)
        if self._model.needs_texture(subject, choice):
            choice = replace(choice, draft=True)
            self._queue.request("model", self._draw_model, after_s=FINE_AFTER_DRAFT_S)
        self._model.draw(subject, choice)
        result = None if subject is None else subject.result
        has_camera = subject is not None and subject.accepted is not None
        self._panel.show(choice, result, self._model.legend, has_camera=has_camera)

    def _draw_cameras(self) -> None:
        subject, choice = self._current()
        if not self._keeps_best:
            self._simplex.clear()
        self._cameras.draw(subject, visible=choice.cameras)

    def _draw_matches(self) -> None:
        subject, choice = self._current()
        with self._lock:
            picks, size = self._picks, self._pick_size
        self._matches.draw(subject, picks, visible=choice.matches, size=size)
        self._draw_highlight()

    def _draw_highlight(self) -> None:
        with self._lock:
            pick_id = self._highlighted
        self._matches.highlight(pick_id)

    def _draw_simplex_start(self) -> None:
        self._simplex.clear()
        with self._lock:
            names = self._names
        self._folder.start(names, SimplexCurves().snapshot())

    def _draw_simplex(self) -> None:
        with self._lock:
            frame = self._frame
        if frame is not None:
            self._simplex.draw(self._current()[0], frame)
            self._draw_curves()

    def _draw_curves(self) -> None:
        with self._lock:
            frame, state, curves = self._frame, self._state, self._curves.snapshot()
        if frame is not None:
            self._folder.draw(curves, frame, state)

    def _draw_simplex_state(self) -> None:
        with self._lock:
            state = self._state
        self._folder.show_state(state)
        self._draw_curves()

    def _draw_simplex_end(self, best: SimplexFrame | None) -> None:
        self._simplex.end(self._current()[0], best if self._keeps_best else None)
        self._draw_simplex_state()

    def _reset_views(self, subject: Subject) -> None:
        """Move all clients to the overview of a new scan; nothing else moves them without being requested."""
        self._viewed_scan = subject.shown
        viewpoint, initial = subject.overview(), self._server.initial_camera
        initial.position, initial.look_at, initial.up = viewpoint.position, viewpoint.look_at, viewpoint.up
        initial.fov = viewpoint.upright_fov_rad(1.0)
        for client in self._server.get_clients().values():
            _move_client(client, viewpoint, near_m=_NEAR_M)

    def _set_viewpoint(self, client: viser.ClientHandle, name: str) -> None:
        subject, _ = self._current()
        if subject is None:
            return
        viewpoint = {OVERVIEW: subject.overview, SCANNER: subject.from_scanner, CAMERA: subject.from_camera}[name]()
        if viewpoint is not None:
            # From inside a frustum its own picture would hide the scene; the near plane lies behind the picture.
            inside = _NEAR_PER_FRUSTUM * subject.shown.frustum_depth_m
            _move_client(client, viewpoint, near_m=_NEAR_M if name == OVERVIEW else inside)

    def _set_match_size(self, size: float) -> None:
        with self._lock:
            self._pick_size = size
        self._queue.request("matches", self._draw_matches)


def _move_client(client: viser.ClientHandle, viewpoint: Viewpoint, *, near_m: float) -> None:
    try:
        aspect = float(client.camera.aspect)
    except (AssertionError, RuntimeError):  # the browser has not reported its camera yet
        aspect = 1.0
    with client.atomic():
        client.camera.near = near_m
        client.camera.up_direction = viewpoint.up
        client.camera.position = viewpoint.position
        client.camera.look_at = viewpoint.look_at
        client.camera.fov = viewpoint.upright_fov_rad(aspect)
