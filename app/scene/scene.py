"""The 3-D stage: what the session tells it is drawn by one thread, the newest of everything."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import TYPE_CHECKING

from ladarreg_core.inspection.model_textures import uniform_picture
from ladarreg_core.inspection.simplex_curves import CURVE_NAMES, SimplexCurves

from .cameras_layer import CamerasLayer
from .colours import BACKGROUND
from .draw_queue import Wishes
from .model_layer import ModelLayer
from .model_view import ModelChoice
from .panel import CAMERA, OVERVIEW, SCANNER, Panel
from .picks_layer import Picks, PicksLayer
from .simplex_folder import SimplexFolder
from .simplex_layer import SimplexLayer
from .subject import ModelNow, ScanShown, Subject

if TYPE_CHECKING:
    import viser
    from numpy.typing import ArrayLike

    from ladarreg_core.inspection.viewpoints import Viewpoint
    from ladarreg_core.photo import Photo
    from ladarreg_core.results import PoseResult
    from ladarreg_core.scan import Scan

    from .actions import StageActions
    from .simplex_frame import SimplexFrame

SIMPLEX_EVERY_S = 0.04
FINE_AGAIN_S = 1.0
"""After a walk; most end with a new pose, and with it a new model."""
FINE_AFTER_COARSE_S = 0.3
"""What is new is shown coarsely first: where no graphics card draws, a fine model needs seconds."""
_WALKING = ("running", "paused")
_NEAR_M, _BEYOND_PICTURE = 0.01, 1.05


class Stage3D:
    """The 3-D scene, its panel and the live curves in a viser server.

    Every method may be called from any thread and returns at once; one thread draws, and where it cannot follow only
    the newest of each thing is drawn. All of it stays in the server, so that whoever comes later sees the same.
    """

    def __init__(self, server: viser.ViserServer, actions: StageActions) -> None:
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
        self._best_stays = False
        scene = server.scene
        scene.set_up_direction("+z")
        scene.world_axes.visible = False
        # Nothing here is lit, and shadows would be drawn for nothing.
        scene.configure_default_lights(enabled=False, cast_shadow=False)
        scene.set_background_image(uniform_picture(BACKGROUND), format="png")
        self._panel = Panel(server, actions, look=self._look, resize=self._resize)
        self._folder = SimplexFolder(server, actions, self._panel.guarded)
        self._wishes = Wishes("stage3d")
        self._model = ModelLayer(server, self._wishes)
        self._cameras = CamerasLayer(server)
        self._matches = PicksLayer(server, actions.hover)
        self._simplex = SimplexLayer(server)
        self._placed: ScanShown | None = None

    def show_scan(self, scan: Scan | None) -> None:
        """Show a scan with its own intensity, and no photograph; None: nothing at all."""
        self._show(scan, None, None, "")

    def show_registration(
        self, scan: Scan, photo: Photo | None, registration: PoseResult | None, *, name: str = ""
    ) -> None:
        """Show a scan with a photograph.

        Args:
            scan: the scan.
            photo: the photograph.
            registration: its pose; None, or one that is not accepted, colours nothing: the latter's camera is drawn as
                a dashed outline that says so.
            name: what to call the photograph.
        """
        self._show(scan, photo, registration, name)

    def show_picks(self, points: ArrayLike, colours: ArrayLike, on: ArrayLike, ids: Sequence[str]) -> None:
        """Show matches in space.

        Args:
            points: (N, 3) m, scanner frame; NaN where a match has no place.
            colours: (N, 3) uint8 RGB.
            on: (N,) bool; those that are off are dimmed.
            ids: the pick that each point belongs to; several may belong to one.
        """
        with self._lock:
            self._picks = Picks.of(points, colours, on, ids)
        self._wishes.wish("matches", self._draw_matches)

    def highlight(self, pick_id: str | None) -> None:
        """Mark one match, or none."""
        with self._lock:
            self._highlighted = pick_id
        self._wishes.wish("highlight", self._draw_highlight)

    def set_model(self, **wanted: str | bool) -> None:
        """Change what of `ModelChoice` is named.

        Raises:
            OptionError: if there is no such thing to choose.
        """
        with self._lock:
            before = self._choice
            self._choice = before.changed(wanted)
            if self._choice == before:
                return
        self._wishes.wish("model", self._draw_model)
        self._wishes.wish("cameras", self._draw_cameras)
        if self._choice.matches != before.matches:
            self._wishes.wish("matches", self._draw_matches)

    def simplex_started(self, labels: Sequence[str] = CURVE_NAMES) -> None:
        """Begin a walk with empty curves.

        Args:
            labels: the names of the six parameters, three lengths (m) and three angles (degrees).
        """
        with self._lock:
            self._names, self._curves, self._frame, self._state = tuple(labels), SimplexCurves(), None, "running"
            self._best_stays = True
        self._wishes.forget("simplex")
        self._wishes.wish("simplex start", self._draw_simplex_start)
        self._wishes.wish("model", self._draw_model)

    def simplex_step(self, frame: SimplexFrame) -> None:
        """Draw a moment of the walk, at most 25 a second, and always the last."""
        with self._lock:
            self._frame = frame
            self._curves.add(frame.iteration, frame.parameters, frame.cost)
        self._wishes.wish("simplex", self._draw_simplex, every_s=SIMPLEX_EVERY_S)

    def simplex_paused(self, *, paused: bool) -> None:
        """Let the controls say whether the walk waits."""
        with self._lock:
            state = "paused" if paused else "running"
            if self._state == state or self._state not in _WALKING:
                return
            self._state = state
        self._wishes.wish("simplex state", self._draw_simplex_state)

    def simplex_ended(self, best: SimplexFrame | None) -> None:
        """End the walk.

        Args:
            best: where it ended, which stays until a pose is shown; None: it came to nothing.
        """
        with self._lock:
            self._state = "done" if best is not None else "stopped"
            last = self._frame
            if best is not None and (last is None or (best.iteration, best.cost) != (last.iteration, last.cost)):
                self._frame = best
                self._curves.add(best.iteration, best.parameters, best.cost)
        self._wishes.forget("simplex")
        self._wishes.wish("simplex end", lambda: self._draw_simplex_end(best))
        self._wishes.wish("model", self._draw_model, after_s=FINE_AGAIN_S)

    def settle(self, timeout_s: float = 30.0) -> bool:
        """Wait until all is drawn; return whether that was so in time."""
        return self._wishes.settle(timeout_s)

    def close(self) -> None:
        """End the thread; the scene stays as it is."""
        self._wishes.close()

    def _show(self, scan: Scan | None, photo: Photo | None, result: PoseResult | None, name: str) -> None:
        with self._lock:
            before = self._subject
            if scan is None:
                self._subject = None
            else:
                shown = before.shown if before is not None and before.scan is scan else ScanShown(scan)
                self._subject = Subject(shown, photo, result, name)
            other_scan = before is None or self._subject is None or before.shown is not self._subject.shown
            if self._state not in _WALKING:
                self._best_stays = False  # the pose that is shown now says it better
            if other_scan:
                self._picks, self._highlighted = None, None
        # The model first, in any case: it is what everybody waits for.
        self._wishes.wish("model", self._draw_model)
        self._wishes.wish("cameras", self._draw_cameras)
        self._wishes.wish("matches", self._draw_matches)

    def _now(self) -> tuple[Subject | None, ModelNow]:
        with self._lock:
            moving = self._state in _WALKING and self._subject is not None and self._subject.camera is not None
            return self._subject, ModelNow(**asdict(self._choice), coarse=moving)

    def _draw_model(self) -> None:
        subject, choice = self._now()
        if subject is not None and subject.shown is not self._placed:
            self._place_everybody(subject)
        if self._model.is_news(subject, choice):
            choice = replace(choice, coarse=True)
            self._wishes.wish("model", self._draw_model, after_s=FINE_AFTER_COARSE_S)
        self._model.draw(subject, choice)
        result = None if subject is None else subject.result
        has_camera = subject is not None and subject.accepted is not None
        self._panel.mirror(choice, result, self._model.legend, has_camera=has_camera)

    def _draw_cameras(self) -> None:
        subject, choice = self._now()
        if not self._best_stays:
            self._simplex.clear()
        self._cameras.draw(subject, visible=choice.cameras)

    def _draw_matches(self) -> None:
        subject, choice = self._now()
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
            self._simplex.draw(self._now()[0], frame)
            self._draw_curves()

    def _draw_curves(self) -> None:
        with self._lock:
            frame, state, curves = self._frame, self._state, self._curves.snapshot()
        if frame is not None:
            self._folder.draw(curves, frame, state)

    def _draw_simplex_state(self) -> None:
        with self._lock:
            state = self._state
        self._folder.state(state)
        self._draw_curves()

    def _draw_simplex_end(self, best: SimplexFrame | None) -> None:
        self._simplex.end(self._now()[0], best if self._best_stays else None)
        self._draw_simplex_state()

    def _place_everybody(self, subject: Subject) -> None:
        """Let all look at a new scan from aside: what they were looking at is gone. Nothing else ever moves them."""
        self._placed = subject.shown
        there, initial = subject.overview(), self._server.initial_camera
        initial.position, initial.look_at, initial.up = there.position, there.look_at, there.up
        initial.fov = there.upright_fov_rad(1.0)
        for client in self._server.get_clients().values():
            _stand(client, there, near_m=_NEAR_M)

    def _look(self, client: viser.ClientHandle, name: str) -> None:
        subject, _ = self._now()
        if subject is None:
            return
        there = {OVERVIEW: subject.overview, SCANNER: subject.from_scanner, CAMERA: subject.from_camera}[name]()
        if there is not None:
            # From inside, the camera's own picture would hide the scene: it lies before the near plane.
            inside = _BEYOND_PICTURE * subject.shown.frustum_depth_m
            _stand(client, there, near_m=_NEAR_M if name == OVERVIEW else inside)

    def _resize(self, size: float) -> None:
        with self._lock:
            self._pick_size = size
        self._wishes.wish("matches", self._draw_matches)


def _stand(client: viser.ClientHandle, there: Viewpoint, *, near_m: float) -> None:
    try:
        aspect = float(client.camera.aspect)
    except (AssertionError, RuntimeError):  # it has not told where it looks yet
        aspect = 1.0
    with client.atomic():
        client.camera.near = near_m
        client.camera.up_direction = there.up
        client.camera.position = there.position
        client.camera.look_at = there.look_at
        client.camera.fov = there.upright_fov_rad(aspect)
