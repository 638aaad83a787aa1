"""A camera that a client places by hand: its frustum with a handle that moves and turns it."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from ladarreg_core.foundations.palette import ACCENT
from ladarreg_core.frames import Rigid
from ladarreg_core.inspection.model_textures import small_picture

from .cameras_layer import add_camera, viser_pose

if TYPE_CHECKING:
    import viser

    from .place import Place
    from .subject import Subject

_HANDLE, _CAMERA = "/draft", "/draft/camera"
_PICTURE_PX = 256
_HANDLE_SIZE = 0.8
"""Size of the handle in depths of the frustum."""


class DraftLayer:
    """The camera that is being placed.

    Args:
        place: where it is drawn.
        moved: called with its pose while it is dragged.
    """

    def __init__(self, place: Place, moved: Callable[[Rigid], None]) -> None:
        self._place, self._moved = place, moved
        self._handle: viser.TransformControlsHandle | None = None
        self._photo: object = None

    def draw(self, subject: Subject | None, draft: Rigid | None) -> None:
        """Draw it, move it, or remove it."""
        photo = None if subject is None else subject.photo
        if self._handle is not None and (draft is None or photo is not self._photo):
            self._handle.remove()
            self._handle = None
        if draft is None or photo is None or subject is None:
            return
        if self._handle is None:
            self._photo, self._handle = photo, self._added(subject, draft)
            return
        now = viser_pose(draft)
        if not np.allclose(self._handle.position, now["position"], atol=1e-9):
            self._handle.position = now["position"]
        if not np.allclose(self._handle.wxyz, now["wxyz"], atol=1e-9):
            self._handle.wxyz = now["wxyz"]

    def _added(self, subject: Subject, draft: Rigid) -> viser.TransformControlsHandle:
        depth = subject.shown.frustum_depth_m
        handle = self._place.scene.add_transform_controls(
            _HANDLE, scale=_HANDLE_SIZE * depth, depth_test=False, disable_sliders=True, **viser_pose(draft)
        )
        assert subject.photo is not None, "a draft is drawn of a photograph"
        picture = small_picture(subject.photo.pixels, _PICTURE_PX)
        add_camera(self._place, _CAMERA, subject.photo.pinhole, Rigid.identity(), ACCENT, depth, picture=picture)
        handle.on_update(lambda _: self._moved(self._pose_of(handle)))
        return handle

    @staticmethod
    def _pose_of(handle: viser.TransformControlsHandle) -> Rigid:
        from viser.transforms import SO3

        scanner_from_camera = np.asarray(SO3(np.asarray(handle.wxyz, dtype=np.float64)).as_matrix())
        return Rigid.from_centre(scanner_from_camera.T, np.asarray(handle.position, dtype=np.float64))
