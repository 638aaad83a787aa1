"""The 3-D scene of one registration, in viser: model, cameras with their pictures, matches."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from ladarreg_core.blend import blended_picture, intensity_picture
from ladarreg_core.export.glb import glb_bytes
from ladarreg_core.export.true_colours import texture_for_viewer
from ladarreg_core.frames import Rigid
from ladarreg_core.mesh import Mesh, scan_mesh
from ladarreg_core.perspective import View, perspective_view
from ladarreg_core.texture import RegisteredTexture, texture_scan

if TYPE_CHECKING:
    import viser

    from ladarreg_core.camera import Camera
    from ladarreg_core.photo import Photo
    from ladarreg_core.results import Registration
    from ladarreg_core.scan import Scan

MATCH_COLORS = ((255, 211, 77), (92, 200, 255), (255, 143, 171), (126, 226, 168), (201, 167, 255), (255, 166, 92))
"""As in `static/tokens.css`, repeating."""
BACKGROUND = (15, 17, 21)
SCANNER_COLOR, CAMERA_COLOR = (255, 211, 77), (92, 200, 255)
_SCREEN_VERTICES = 250_000
_MATCH_LINES = 24
_FRUSTUM_SIZE = 0.1
_REPLACED_AFTER_S = 1.5
_LEAST_INTERVAL_S = 0.15


@dataclass(frozen=True)
class Standpoint:
    """From where to look, and where to."""

    position: np.ndarray
    """(3,) m, scanner frame."""
    look_at: np.ndarray
    """(3,) m."""
    up: np.ndarray
    """(3,)."""
    fov_rad: float
    """Vertical."""


@dataclass(frozen=True)
class Stage:
    """What stands in the scene: computed once, drawn as often as needed. Nothing is coloured before it is accepted."""

    scan: Scan
    photo: Photo
    registration: Registration

    @cached_property
    def mesh(self) -> Mesh:
        """The model, coarse enough for any browser."""
        return scan_mesh(self.scan, max_vertices=_SCREEN_VERTICES)

    @cached_property
    def texture(self) -> RegisteredTexture | None:
        """The photo on the scan; None where the registration is not accepted."""
        r = self.registration
        if not r.accepted:
            return None
        return texture_scan(
            self.scan, self.photo, r.camera_from_scanner, camera=r.camera, covariance=np.asarray(r.covariance)
        )

    @cached_property
    def view(self) -> View:
        """The scan's intensity as the scanner's own frustum shows it."""
        return perspective_view(self.scan, self.photo.camera.without_distortion())

    def glb(self, share: float) -> bytes:
        """Return the model with a share of colour, 0 to 1, as viser shows it in true colours."""
        if self.texture is None:
            picture = intensity_picture(self.scan)
        else:
            picture = blended_picture(self.scan, self.texture, share=share)
        return glb_bytes(self.mesh, picture, for_viser=True)

    @property
    def typical_range_m(self) -> float:
        """The median range."""
        return float(np.median(self.scan.ranges[self.scan.valid]))

    def from_scanner(self) -> Standpoint:
        """Return the scanner's own view."""
        direction = self.scan.mean_direction
        return Standpoint(
            np.zeros(3), direction * self.typical_range_m, np.array([0.0, 0, 1]), vertical_fov(self.view.camera)
        )

    def from_camera(self) -> Standpoint:
        """Return the photo's own view."""
        pose, camera = self.registration.camera_from_scanner, self.registration.camera
        _, down, forward = pose.rotation
        return Standpoint(pose.centre, pose.centre + forward * self.typical_range_m, -down, vertical_fov(camera))

    def overview(self) -> Standpoint:
        """Return a view from behind and above both cameras, that holds them and the model."""
        forward = self.scan.mean_direction * np.array([1.0, 1, 0])
        left = np.array([-forward[1], forward[0], 0.0])
        reach = self.typical_range_m
        between = self.registration.camera_from_scanner.centre / 2 if self.registration.accepted else np.zeros(3)
        # From the side away from the camera, so that neither frustum hides the other.
        aside = -left if between @ left > 0 else left
        # A little to the right of the model's middle, since the panel covers that side.
        centre = np.median(self.scan.points[self.scan.valid], axis=0) - 0.04 * reach * left
        position = between + reach * (-0.3 * forward + 0.2 * aside + np.array([0, 0, 0.22]))
        return Standpoint(position, centre - np.array([0, 0, 0.12 * reach]), np.array([0.0, 0, 1]), np.deg2rad(47.0))


def vertical_fov(camera: Camera) -> float:
    """Return a camera's vertical field of view, rad."""
    return 2 * float(np.arctan2(camera.height, 2 * camera.fy))


def true_line_colors(colors: np.ndarray) -> np.ndarray:
    """Return what to ask of viser for lines of these RGB colours: it tone maps lines, though not points."""
    return texture_for_viewer(colors, base_colour=1.0)


class Scene:
    """Draws a `Stage` into a viser server and keeps the model's blend up to date."""

    def __init__(self, server: viser.ViserServer, stage: Stage) -> None:
        self._server = server
        self._stage = stage
        self._model = ModelLayer(server, stage)
        self._frusta: list[viser.CameraFrustumHandle] = []
        self._lines: list[viser.SceneNodeHandle] = []

    def draw(self, *, share: float) -> None:
        """Put everything into the scene."""
        self._server.scene.set_up_direction("+z")
        self._server.scene.world_axes.visible = False
        self._server.scene.set_background_image(np.full((2, 2, 3), BACKGROUND, np.uint8), format="png")
        self._model.show(share)
        self._draw_frusta()
        self._draw_matches()
        start = self._stage.overview()
        camera = self._server.initial_camera
        camera.position, camera.look_at, camera.up, camera.fov = start.position, start.look_at, start.up, start.fov_rad

    def blend(self, share: float) -> None:
        """Ask for another share of colour; the newest wish wins."""
        self._model.wish(share)

    def show_cameras(self, *, visible: bool) -> None:
        """Show or hide both frusta."""
        for frustum in self._frusta:
            frustum.visible = visible

    def show_matches(self, *, visible: bool) -> None:
        """Show or hide the match lines."""
        for node in self._lines:
            node.visible = visible

    def close(self) -> None:
        """Stop the background work."""
        self._model.close()

    def _draw_frusta(self) -> None:
        stage = self._stage
        size = _FRUSTUM_SIZE * stage.typical_range_m**0.5
        view = stage.view
        gray = view.resample(intensity_picture(stage.scan)[..., 0].astype(np.float32))
        picture = np.repeat(gray.astype(np.uint8)[..., None], 3, axis=-1)
        self._add_frustum("/scanner", view.camera, view.view_from_scanner, picture, SCANNER_COLOR, size)
        if stage.registration.accepted:
            pose = stage.registration.camera_from_scanner
            self._add_frustum("/camera", stage.registration.camera, pose, stage.photo.pixels, CAMERA_COLOR, size)

    def _add_frustum(
        self, name: str, camera: Camera, pose: Rigid, picture: np.ndarray, color: tuple[int, int, int], size: float
    ) -> None:
        from viser.transforms import SO3

        step = max(1, max(picture.shape[:2]) // 512)
        self._frusta.append(
            self._server.scene.add_camera_frustum(
                name,
                fov=vertical_fov(camera),
                aspect=camera.width / camera.height,
                scale=size,
                thickness=2.0,
                thickness_units="screen",
                color=true_line_colors(np.array(color)),
                image=np.ascontiguousarray(picture[::step, ::step]),
                format="jpeg",
                jpeg_quality=88,
                wxyz=SO3.from_matrix(pose.inverse.rotation).wxyz,
                position=pose.centre,
                cast_shadow=False,
                receive_shadow=False,
            )
        )

    def _draw_matches(self) -> None:
        result = self._stage.registration
        if not result.accepted:
            return
        points = np.asarray(result.matches.points)[np.asarray(result.inliers)]
        points = points[np.isfinite(points).all(axis=-1)]
        if not len(points):
            return
        chosen = points[np.linspace(0, len(points) - 1, min(len(points), _MATCH_LINES)).round().astype(int)]
        colors = np.array([MATCH_COLORS[k % len(MATCH_COLORS)] for k in range(len(chosen))], np.uint8)
        deep = true_line_colors(colors)
        for name, origin in (("scanner", np.zeros(3)), ("camera", result.camera_from_scanner.centre)):
            segments = np.stack([np.broadcast_to(origin, chosen.shape), chosen], axis=1)
            self._lines.append(
                self._server.scene.add_line_segments(
                    f"/matches/{name}",
                    points=segments.astype(np.float32),
                    colors=np.repeat(deep[:, None], 2, axis=1),
                    thickness=1.2,
                    thickness_units="screen",
                )
            )
        self._lines.append(
            self._server.scene.add_point_cloud(
                "/matches/points",
                points=chosen.astype(np.float32),
                colors=colors,
                point_size=0.006 * self._stage.typical_range_m,
                point_shape="circle",
            )
        )


class ModelLayer:
    """The textured model, sent anew for every blend by one thread of its own.

    viser cannot exchange a texture alone, and a model disappears while its successor is parsed: so the next one is
    added under another name and the last one taken away a little later. Lying in the same place, the newer is drawn.
    """

    def __init__(self, server: viser.ViserServer, stage: Stage) -> None:
        self._server = server
        self._stage = stage
        self._shown: list[tuple[float, viser.GlbHandle]] = []
        self._share = -1.0
        self._wish: float | None = None
        self._closed = False
        self._count = 0
        self._changed = threading.Condition()
        self._worker = threading.Thread(target=self._work, name="model", daemon=True)
        self._worker.start()

    def show(self, share: float) -> None:
        """Draw the model now."""
        data = self._stage.glb(share)
        self._count += 1
        handle = self._server.scene.add_glb(f"/model/{self._count}", data, cast_shadow=False, receive_shadow=False)
        self._share = share
        self._shown.append((time.monotonic(), handle))

    def wish(self, share: float) -> None:
        """Draw the model soon; wishes that come faster than they can be met are dropped."""
        with self._changed:
            self._wish = share
            self._changed.notify()

    def close(self) -> None:
        """End the thread."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._worker.join(timeout=5)

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closed or self._wish is not None, timeout=_REPLACED_AFTER_S / 2)
                if self._closed:
                    return
                share, self._wish = self._wish, None
            if share is not None and share != self._share:
                self.show(share)
                time.sleep(_LEAST_INTERVAL_S)
            self._remove_replaced()

    def _remove_replaced(self) -> None:
        """Take away every model whose successor has had time to be drawn."""
        now = time.monotonic()
        while len(self._shown) > 1 and now - self._shown[1][0] > _REPLACED_AFTER_S:
            self._shown.pop(0)[1].remove()
