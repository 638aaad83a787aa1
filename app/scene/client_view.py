"""The 3-D view of one client: the cameras, matches and simplex that it sees, and where it looks from."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ladarreg_core.inspection.viewpoints import from_pose

from .cameras_layer import CamerasLayer
from .draft_layer import DraftLayer
from .measured_layer import MeasuredLayer, MeasuredShown
from .person import Person, ViewpointName
from .picks_layer import PicksLayer
from .simplex_layer import SimplexLayer
from .smoothing_layer import SmoothingLayer
from .stations_layer import StationShown, StationsLayer
from .survey_layer import SurveyLayer, SurveyShown
from .viewer_pose import viewer_pose

if TYPE_CHECKING:
    import viser

    from ladarreg_core.frames import Rigid
    from ladarreg_core.inspection.viewpoints import Viewpoint

    from .picks_layer import Picks
    from .place import Place
    from .simplex_frame import SimplexFrame
    from .subject import CameraShown, Subject
    from .survey_layer import SurveyShown

_NEAR_M, _NEAR_PER_FRUSTUM = 0.01, 1.05
_MOVED_M = 1e-3


@dataclass(frozen=True, slots=True)
class SimplexShown:
    """A simplex that runs or has just ended."""

    photo: str
    """Id of the photograph that it registers."""
    frame: SimplexFrame | None
    """Its newest frame; None before the first."""
    runs: bool
    """Whether it still moves."""


class ClientView:
    """Layers in the scene of a client, and its camera.

    Args:
        place: a client of viser, or the server itself for tests.
        person: id of the workbench's client; empty if it is not known.
        looks: viewpoint from which it starts.
        on_draft: called with the pose of the camera that is placed by hand while it is dragged.
    """

    def __init__(
        self,
        place: Place,
        person: str,
        *,
        looks: ViewpointName = "start",
        on_draft: Callable[[Rigid], None] = lambda _: None,
    ) -> None:
        self.person = person
        self._place = place
        self._cameras, self._matches, self._simplex = CamerasLayer(place), PicksLayer(place), SimplexLayer(place)
        self._stations, self._survey = StationsLayer(place), SurveyLayer(place)
        self._draft, self._measured = DraftLayer(place, on_draft), MeasuredLayer(place)
        self._smoothing = SmoothingLayer(place)
        self._subject: Subject | None = None
        self._looks: ViewpointName = looks
        self._looked_from: Viewpoint | None = None

    def draw(
        self, person: Person, subject: Subject | None, picks: Picks | None, simplex: SimplexShown | None,
        stations: Sequence[StationShown], cameras: Sequence[CameraShown] = (), survey: SurveyShown | None = None,
        measured: MeasuredShown | None = None,
    ) -> None:  # fmt: skip
        """Draw everything that has changed."""
        before, self._subject = self._subject, subject
        others = [camera for camera in cameras if camera.photo != person.photo]
        self._cameras.draw(subject, others, visible=person.model.cameras)
        self._matches.draw(subject, picks, person.model)
        self._matches.highlight(person.highlighted)
        self._stations.draw(stations, hidden=person.model.hidden_stations)
        self._survey.draw(survey, visible=person.model.cameras)
        self._measured.draw(measured, visible=person.model.matches)
        self._smoothing.draw(None if subject is None else person.smoothing)
        self._draft.draw(subject, person.draft)
        self.draw_simplex(person, simplex)
        self._follow(before, subject)

    def draw_simplex(self, person: Person, simplex: SimplexShown | None) -> None:
        """Draw the simplex of the photograph that the person looks at."""
        if simplex is None or simplex.frame is None or simplex.photo != person.photo:
            self._simplex.clear()
        elif simplex.runs:
            self._simplex.draw(self._subject, simplex.frame)
        else:
            self._simplex.end(self._subject, simplex.frame)

    def look(self, name: ViewpointName) -> None:
        """Move the client to a viewpoint, as soon as there is a scan; without an accepted pose the camera has none."""
        subject = self._subject
        if subject is None:
            self._looks = name
            return
        viewpoint = {
            "start": subject.start,
            "overview": subject.overview,
            "scanner": subject.from_scanner,
            "camera": subject.from_camera,
        }[name]()
        if viewpoint is None:
            return
        inside = name in ("scanner", "camera") or (name == "start" and subject.shown.all_around)
        # From inside a frustum its own picture would hide the scene; the near plane lies behind the picture.
        near_m = _NEAR_PER_FRUSTUM * subject.shown.frustum_depth_m if inside else _NEAR_M
        self._looks, self._looked_from = name, viewpoint
        _move(self._place, viewpoint, near_m=near_m)

    def look_at_run(self, viewpoint: Viewpoint) -> None:
        """Move a client that has no scan to look at to the points of a run; once."""
        if self._subject is None and self._looked_from is None:
            self._looked_from = viewpoint
            _move(self._place, viewpoint, near_m=_NEAR_M)

    @property
    def pose(self) -> Rigid | None:
        """Pose of a camera that stands where the client looks from; None while that is not known."""
        camera = getattr(self._place, "camera", None)
        return None if camera is None else viewer_pose(camera)

    def fly_to(self, camera: CameraShown) -> None:
        """Move the client to where a photograph was taken, looking as it did."""
        if self._subject is not None:
            shown = self._subject.shown
            viewpoint = from_pose(shown.scan, camera.camera, camera.camera_from_scanner)
            self._looks, self._looked_from = "camera", viewpoint
            _move(self._place, viewpoint, near_m=_NEAR_PER_FRUSTUM * shown.frustum_depth_m)

    def clicked_camera(self, event: viser.SceneClickEvent) -> CameraShown | None:
        """Return the other photograph whose frustum a click hits."""
        return self._cameras.nearest(event)

    def clicked(self, event: viser.SceneClickEvent) -> str | None:
        """Return the id of the match that a click hits."""
        return self._matches.nearest(event)

    def _follow(self, before: Subject | None, subject: Subject | None) -> None:
        """Move a client to the start of another scan, and with a new pose if it has not moved by itself."""
        if subject is None:
            return
        if before is None or not subject.shown.is_of(before.shown):
            wanted = self._looks if before is None else "start"
            self.look("start")  # the camera has no viewpoint without an accepted pose
            if wanted != "start":
                self.look(wanted)
        elif before.accepted is not subject.accepted and self._looks in ("start", "camera") and not self._has_moved():
            self.look(self._looks)

    def _has_moved(self) -> bool:
        camera = getattr(self._place, "camera", None)
        if camera is None or self._looked_from is None:
            return False
        position, target = np.asarray(camera.position), np.asarray(camera.look_at)
        allowed = _MOVED_M * max(1.0, float(np.linalg.norm(self._looked_from.look_at - self._looked_from.position)))
        return bool(
            np.linalg.norm(position - self._looked_from.position) > allowed
            or np.linalg.norm(target - self._looked_from.look_at) > allowed
        )


def _move(place: Place, viewpoint: Viewpoint, *, near_m: float) -> None:
    camera = getattr(place, "camera", None)
    if camera is None:  # the server has no camera
        return
    try:
        aspect = float(camera.aspect)
    except (AssertionError, RuntimeError):  # the browser has not reported its camera yet
        aspect = 1.0
    with place.atomic():
        camera.near = near_m
        camera.up_direction = viewpoint.up
        camera.position = viewpoint.position
        camera.look_at = viewpoint.look_at
        camera.fov = viewpoint.upright_fov_rad(aspect)
