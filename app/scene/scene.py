"""The 3-D scene: what each client sees in it, drawn by one thread."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from ladarreg_core.export.models.glb import glb_bytes
from ladarreg_core.foundations.palette import BACKGROUND
from ladarreg_core.inspection.model_textures import uniform_picture
from ladarreg_core.inspection.viewpoints import overview_of_points
from ladarreg_core.surface.mesh.grid_mesh import Mesh

from .client_view import ClientView, SimplexShown
from .draw_queue import DrawQueue
from .person import ANYBODY, Person, ViewpointName
from .run_layer import RunLayer

if TYPE_CHECKING:
    import viser
    from numpy.typing import NDArray

    from ladarreg_core.foundations.arrays import ByteArray
    from ladarreg_core.frames import Rigid
    from ladarreg_core.inspection.viewpoints import Viewpoint

    from .measured_layer import MeasuredShown
    from .picks_layer import Picks
    from .place import Place
    from .simplex_frame import SimplexFrame
    from .stations_layer import StationShown
    from .subject import CameraShown, Subject
    from .survey_layer import SurveyShown

MODEL_NODE = "/model"
"""Node of the model. It is empty here: the page, which fetches mesh and textures, fills it in the browser."""
SIMPLEX_EVERY_S = 0.04
RUN_EVERY_S = 1.0
_EMPTY_MESH = Mesh(
    np.eye(3, dtype=np.float32) * np.float32(1e-6),
    np.array([[0, 1, 2]], dtype=np.int32),
    np.zeros((3, 2), dtype=np.int32),
    (2, 2),
)


@dataclass(frozen=True, slots=True)
class Shown:
    """What is shown of a photograph."""

    subject: Subject
    """Scan, photograph and pose."""
    picks: Picks | None = None
    """Its matches."""


class Scene3D:
    """The views of all clients in a viser server.

    Every method may be called from any thread and returns at once. One thread draws; if it cannot keep up, only the
    latest state is drawn.

    Args:
        server: the server.
        on_pick: called with the id of a client and of the match that it has clicked on.
        person_of: returns the id of the workbench's client behind a client of viser.
        on_camera: called with the id of a client and of another photograph whose frustum it has clicked on; the view
            has been moved there.
        on_draft: called with the id of a client and the pose of the camera that it drags.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        on_pick: Callable[[str, str], None],
        *,
        person_of: Callable[[viser.ClientHandle], str] = lambda _: ANYBODY,
        on_camera: Callable[[str, str], None] = lambda _person, _photo: None,
        on_draft: Callable[[str, Rigid], None] = lambda _person, _pose: None,
    ) -> None:
        self._server, self._person_of = server, person_of
        self._on_pick, self._on_camera, self._on_draft = on_pick, on_camera, on_draft
        self._lock = threading.RLock()
        self._photos: Mapping[str | None, Shown] = {}
        self._stations: Sequence[StationShown] = ()
        self._cameras: Sequence[CameraShown] = ()
        self._survey: SurveyShown | None = None
        self._measured: MeasuredShown | None = None
        self._people: Mapping[str, Person] = {}
        self._highlights: dict[str, str | None] = {}
        self._drafts: dict[str, Rigid] = {}
        self._looks: dict[str, ViewpointName] = {}  # of people whose views have yet to connect
        self._simplex: SimplexShown | None = None
        self._views: dict[int, ClientView] = {}
        self._queue = DrawQueue("scene")
        scene = server.scene
        scene.set_up_direction("+z")
        scene.world_axes.visible = False
        # Nothing is lit, and shadows would only cost time.
        scene.configure_default_lights(enabled=False, cast_shadow=False)
        scene.set_background_image(uniform_picture(BACKGROUND), format="png")
        empty = glb_bytes(_EMPTY_MESH, uniform_picture(BACKGROUND), for_viser=True)
        self._model = scene.add_glb(MODEL_NODE, empty, cast_shadow=False, receive_shadow=False)
        self._run = RunLayer(server)
        self._run_view: Viewpoint | None = None
        self._run_points: list[tuple[NDArray[np.float32], ByteArray]] = []
        scene.on_click()(self._clicked)
        server.on_client_connect(self._connected)
        server.on_client_disconnect(lambda client: self.remove_view(client.client_id))

    def show(
        self, photos: Mapping[str | None, Shown], cameras: Sequence[CameraShown] = (), survey: SurveyShown | None = None
    ) -> None:
        """Show a scan with photographs.

        Args:
            photos: by id what is shown to the clients that look at one, None: at none.
            cameras: all photographs whose poses are accepted, of which everybody sees the frusta.
            survey: what is known of all of them together; None: nothing.
        """
        with self._lock:
            self._photos, self._cameras, self._survey = photos, cameras, survey
            if self._simplex is not None and not self._simplex.runs:
                self._simplex = None  # the pose shown now replaces it
        self._request_views()

    def show_stations(self, stations: Sequence[StationShown]) -> None:
        """Show other stations beside the scan."""
        with self._lock:
            self._stations = stations
        self._request_views()

    def show_measured(self, measured: MeasuredShown | None) -> None:
        """Show measurements; None: there are none."""
        with self._lock:
            self._measured = measured
        self._request_views()

    def set_people(self, people: Mapping[str, Person]) -> None:
        """Set what the clients look at, by their ids; `ANYBODY` stands for all others."""
        with self._lock:
            self._people = people
            self._looks = {person: name for person, name in self._looks.items() if person in people}
        self._request_views()

    def highlight(self, person: str, pick_id: str | None) -> None:
        """Highlight one match for a client, or none."""
        with self._lock:
            self._highlights[person] = pick_id
        self._request_views()

    def place_camera(self, person: str, draft: Rigid | None) -> None:
        """Show a client a camera with a handle, which it places by hand, or remove it."""
        with self._lock:
            if draft is None:
                self._drafts.pop(person, None)
            else:
                self._drafts[person] = draft
        self._request_views()

    def look(self, person: str, name: ViewpointName) -> None:
        """Move a client to a viewpoint; one whose view has yet to connect will start there."""

        def move() -> None:
            with self._lock:
                views = self._views_of(person)
                if not views:
                    self._looks[person] = name
            for view in views:
                view.look(name)

        self._queue.request(f"viewpoint {person}", move)

    def pose_of(self, person: str) -> Rigid | None:
        """Return the pose of a camera that stands where a client looks from; None without an open view."""
        return next((pose for view in self._views_of(person) if (pose := view.pose) is not None), None)

    def simplex_started(self, photo: str) -> None:
        """Start a simplex of a photograph."""
        self._set_simplex(SimplexShown(photo, None, runs=True))

    def simplex_step(self, photo: str, frame: SimplexFrame) -> None:
        """Draw a frame of the simplex, at most 25 per second, and always the last."""
        with self._lock:
            self._simplex = SimplexShown(photo, frame, runs=True)
        self._queue.request("simplex", self._draw_simplex, every_s=SIMPLEX_EVERY_S)

    def simplex_ended(self, photo: str, best: SimplexFrame | None) -> None:
        """End the simplex.

        Args:
            photo: id of its photograph.
            best: its final frame, which stays until a pose is shown; None: it was stopped without a result.
        """
        self._set_simplex(None if best is None else SimplexShown(photo, best, runs=False))

    def show_run(self, points: NDArray[np.float32], gray: ByteArray) -> None:
        """Draw more points of a run, (N, 3), m, with gray levels (N,); the model is hidden meanwhile."""
        with self._lock:
            self._run_points.append((points, gray))
        self._queue.request("run", self._draw_run, every_s=RUN_EVERY_S)

    def forget_run(self) -> None:
        """Remove the points of the run, and show the model again."""
        with self._lock:
            self._run_points = []
        self._queue.request("run", self._clear_run)

    def add_view(self, number: int, place: Place, person: str) -> None:
        """Draw a client's view from now on."""
        with self._lock:
            looks = self._looks.pop(person, "start")
            self._views[number] = ClientView(place, person, looks=looks, on_draft=partial(self._dragged, person))
        self._request_views()

    def remove_view(self, number: int) -> None:
        """Stop drawing the view of a client that has gone."""
        with self._lock:
            view = self._views.pop(number, None)
            if view is not None and not self._views_of(view.person):
                self._highlights.pop(view.person, None)
                self._drafts.pop(view.person, None)

    def settle(self, timeout_s: float = 30.0) -> bool:
        """Wait until everything is drawn; return False on timeout."""
        return self._queue.settle(timeout_s)

    def close(self) -> None:
        """End the drawing thread; the scene stays as it is."""
        self._queue.close()

    def _connected(self, client: viser.ClientHandle) -> None:
        self.add_view(client.client_id, client, self._person_of(client))

    def _clicked(self, event: viser.SceneClickEvent) -> None:
        with self._lock:
            view = self._views.get(event.client_id)
        pick = None if view is None else view.clicked(event)
        if view is not None and pick is not None:
            self.highlight(view.person, pick)
            self._on_pick(view.person, pick)
        camera = view.clicked_camera(event) if view is not None and pick is None else None
        if view is not None and camera is not None:
            view.fly_to(camera)
            self._on_camera(view.person, camera.photo)

    def _dragged(self, person: str, draft: Rigid) -> None:
        with self._lock:
            if person not in self._drafts:
                return  # the last message of a handle that has been removed
            self._drafts[person] = draft
        self._on_draft(person, draft)

    def _views_of(self, person: str) -> list[ClientView]:
        with self._lock:
            return [view for view in self._views.values() if view.person == person]

    def _request_views(self) -> None:
        self._queue.request("views", self._draw_views)

    def _draw_views(self) -> None:
        with self._lock:
            views, photos, simplex = list(self._views.values()), self._photos, self._simplex
            stations, cameras, survey, measured = self._stations, self._cameras, self._survey, self._measured
        for view in views:
            person = self._person(view)
            shown = photos.get(person.photo) or photos.get(None)
            subject, picks = (shown.subject, shown.picks) if shown else (None, None)
            view.draw(person, subject, picks, simplex, stations, cameras, survey, measured)
            if self._run_view is not None:
                view.look_at_run(self._run_view)

    def _draw_run(self) -> None:
        with self._lock:
            parts, self._run_points = self._run_points, []
            views = list(self._views.values())
        if not parts:
            return
        points, gray = (np.concatenate(part) for part in zip(*parts, strict=True))
        if self._run_view is None:
            self._run_view = overview_of_points(points)
            self._model.visible = False
        self._run.add(points, gray)
        for view in views:
            view.look_at_run(self._run_view)

    def _clear_run(self) -> None:
        self._run.clear()
        self._run_view = None
        self._model.visible = True

    def _set_simplex(self, simplex: SimplexShown | None) -> None:
        with self._lock:
            self._simplex = simplex
        self._queue.cancel("simplex")
        self._queue.request("simplex state", self._draw_simplex)

    def _draw_simplex(self) -> None:
        with self._lock:
            views, simplex = list(self._views.values()), self._simplex
        for view in views:
            view.draw_simplex(self._person(view), simplex)

    def _person(self, view: ClientView) -> Person:
        with self._lock:
            known = self._people.get(view.person) or self._people.get(ANYBODY) or Person()
            own = self._highlights.get(view.person), self._drafts.get(view.person)
            return Person(known.photo, known.model, *own, known.smoothing)
