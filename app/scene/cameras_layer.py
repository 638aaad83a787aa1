"""The scanner and the camera, each drawn as a frustum with its picture."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ladarreg_core.export.models.viser_colors import line_colors_for_viewer
from ladarreg_core.foundations.palette import ACCENT, OTHER_CAMERA, REFUSED, SCANNER
from ladarreg_core.inspection.model_textures import small_picture, view_picture
from ladarreg_core.inspection.scene_geometry import camera_outline, dashed, distance_of_picture, for_both_ends, repeated
from ladarreg_core.inspection.viewpoints import field_of_view
from ladarreg_core.surface.texture.registered_texture import intensity_picture

if TYPE_CHECKING:
    import viser

    from ladarreg_core.camera import CameraModel
    from ladarreg_core.foundations.arrays import ByteArray
    from ladarreg_core.foundations.palette import Color
    from ladarreg_core.frames import Rigid

    from .place import Place
    from .subject import CameraShown, Subject

NOT_ACCEPTED = "not accepted"
_DASHES = 9
_JPEG_QUALITY = 88
_PICTURE_PX = 512
_OTHERS_SIZE = 0.7
"""Size of the frusta of other photographs, in depths of the shown one's."""
_SCANNER_SIZE = 0.6
"""Size of the mark of a scanner that looks all around, in depths of a frustum."""


class CamerasLayer:
    """The scanner's frustum and the camera's, and those of all other photographs whose poses are accepted.

    The camera of a pose that is not accepted is a dashed outline without the photograph.
    """

    def __init__(self, place: Place) -> None:
        self._place = place
        self._scanner: list[viser.SceneNodeHandle] = []
        self._camera: list[viser.SceneNodeHandle] = []
        self._others: dict[str, tuple[CameraShown, viser.SceneNodeHandle]] = {}
        self._plain: tuple[tuple[CameraShown, ...], viser.SceneNodeHandle | None] = (), None
        self._drawn: tuple[object, ...] = (None, None, None)
        self._depth_m = 0.0

    def draw(self, subject: Subject | None, others: Sequence[CameraShown] = (), *, visible: bool) -> None:
        """Draw the scanner, the camera, and those of other photographs."""
        requested = (None, None, None) if subject is None else (subject.shown, subject.photo, subject.result)
        if requested != self._drawn:
            self.clear()
            if subject is not None:
                self._draw_scanner(subject)
                self._draw_camera(subject)
            self._drawn = requested
        self._draw_others(subject, others)
        for node in self._nodes():
            node.visible = visible

    def clear(self) -> None:
        """Remove all."""
        for node in self._nodes():
            node.remove()
        self._scanner, self._camera, self._others, self._drawn = [], [], {}, (None, None, None)
        self._plain = (), None

    def _nodes(self) -> list[viser.SceneNodeHandle]:
        plain = [] if self._plain[1] is None else [self._plain[1]]
        return [*self._scanner, *self._camera, *(node for _, node in self._others.values()), *plain]

    def nearest(self, event: viser.SceneClickEvent) -> CameraShown | None:
        """Return the other photograph whose picture a click hits first."""
        plain, node = self._plain
        drawn = [*self._others.values(), *((other, node) for other in plain if node is not None)]
        hits = [
            (distance, other) for other, node in drawn
            if node.visible and (distance := distance_of_picture(
                other.camera, other.camera_from_scanner, event.ray_origin, event.ray_direction, depth_m=self._depth_m,
            )) is not None
        ]  # fmt: skip
        return min(hits, key=lambda hit: hit[0])[1] if hits else None

    def _draw_scanner(self, subject: Subject) -> None:
        if subject.shown.all_around:  # a frustum would show one direction out of all
            self._scanner.append(
                self._place.scene.add_point_cloud(
                    "/scanner",
                    np.zeros((1, 3), dtype=np.float32),
                    np.array([SCANNER], dtype=np.uint8),
                    point_size=_SCANNER_SIZE * subject.shown.frustum_depth_m,
                    point_shape="diamond",
                    precision="float32",
                )
            )
            return
        view = subject.view
        picture = view_picture(view, intensity_picture(subject.scan))
        depth = subject.shown.frustum_depth_m
        self._scanner.append(
            add_camera(self._place, "/scanner", view.camera, view.view_from_scanner, SCANNER, depth, picture=picture)
        )

    def _draw_others(self, subject: Subject | None, others: Sequence[CameraShown]) -> None:
        """Draw those with pictures as nodes of their own, and the outlines of all others as one: each node costs the
        browser two draw calls a frame.
        """
        shown = () if subject is None else others
        if subject is not None:
            self._depth_m = _OTHERS_SIZE * subject.shown.frustum_depth_m
        wanted = {other.photo: other for other in shown if other.picture is not None}
        for photo, (drawn, node) in list(self._others.items()):
            if wanted.get(photo) is not drawn:
                node.remove()
                del self._others[photo]
        for photo, other in wanted.items():
            if photo not in self._others:
                self._others[photo] = other, add_camera(
                    self._place, f"/cameras/{photo}", other.camera, other.camera_from_scanner, OTHER_CAMERA,
                    self._depth_m, picture=other.picture, thickness=1.2,
                )  # fmt: skip
        self._draw_plain(tuple(other for other in shown if other.picture is None))

    def _draw_plain(self, others: tuple[CameraShown, ...]) -> None:
        before, node = self._plain
        if len(before) == len(others) and all(a is b for a, b in zip(before, others, strict=True)):
            return
        if node is not None:
            node.remove()
        self._plain = others, None
        if others:
            lines = np.concatenate(
                [camera_outline(one.camera, one.camera_from_scanner, depth_m=self._depth_m) for one in others]
            )
            colors = line_colors_for_viewer(for_both_ends(repeated(OTHER_CAMERA, len(lines))))
            node = self._place.scene.add_line_segments(
                "/cameras/outlines", points=lines, colors=colors, thickness=1.2, thickness_units="screen"
            )
            self._plain = others, node

    def _draw_camera(self, subject: Subject) -> None:
        result, depth = subject.result, subject.shown.frustum_depth_m
        if result is None:
            return
        pose, camera = result.camera_from_scanner, result.camera
        if result.accepted:
            picture = small_picture(subject.photo.pixels, _PICTURE_PX) if subject.photo is not None else None
            self._camera.append(add_camera(self._place, "/camera", camera, pose, ACCENT, depth, picture=picture))
            return
        lines = dashed(camera_outline(camera, pose, depth_m=depth), dashes=_DASHES)
        colors = line_colors_for_viewer(for_both_ends(repeated(REFUSED, len(lines))))
        scene = self._place.scene
        self._camera.append(
            scene.add_line_segments("/camera", points=lines, colors=colors, thickness=1.5, thickness_units="screen")
        )
        label = f"{subject.name}: {NOT_ACCEPTED}" if subject.name else NOT_ACCEPTED
        self._camera.append(
            scene.add_label("/camera_name", label, position=pose.centre, font_screen_scale=0.9, anchor="top-center")
        )


def add_camera(
    place: Place,
    name: str,
    camera: CameraModel,
    pose: Rigid,
    color: Color,
    depth_m: float,
    *,
    picture: ByteArray | None = None,
    thickness: float = 2.0,
) -> viser.CameraFrustumHandle:
    """Add a frustum whose picture is `depth_m` in front of its centre."""
    _, vertical = field_of_view(camera)
    options: dict[str, Any] = {"cast_shadow": False, "receive_shadow": False}
    frustum = place.scene.add_camera_frustum(
        name,
        fov=vertical,
        aspect=camera.width / camera.height,
        scale=1.0,
        thickness=thickness,
        thickness_units="screen",
        color=tuple(line_colors_for_viewer(color).tolist()),
        image=picture,
        format="jpeg",
        jpeg_quality=_JPEG_QUALITY,
        **viser_pose(pose),
        **options,
    )
    frustum.scale = depth_m / frustum.compute_canonical_frustum_size()[2]
    return frustum


def viser_pose(pose: Rigid) -> dict[str, Any]:
    """Return the position and orientation of a camera as viser takes them."""
    from viser.transforms import SO3

    return {"wxyz": SO3.from_matrix(pose.inverse.rotation).wxyz, "position": pose.centre}
