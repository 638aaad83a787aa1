"""Photographs as images of an E57: pictures that its pinhole and spherical representations can describe.

A pinhole image looks along -Z with Y up, and the middle of a spherical one lies along X with Z up, its azimuth growing
to the left. The pixels of both are counted from the outer corner of the first one, half a pixel from ours; faces of
cubes by other programs (4096 pixels, principal point 2048, focal length .5, pixels of 1/4096) say so.

No representation has a lens: a distorted photograph is resampled to the ideal pinhole of the same focal lengths, a
fisheye to the faces of a cube, and the original goes along as a visual reference, in an image of its own, because
programs show only one representation of an image.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.camera import (
    Camera,
    EquirectangularCamera,
    axial_pinhole,
    cube_faces,
)
from ladarreg_core.export.photo_files import has_pixels, resampled
from ladarreg_core.export.registered_scan import RegisteredPhoto
from ladarreg_core.foundations.arrays import ByteArray
from ladarreg_core.frames import CAMERA_AXES_FROM_SCANNER

_QUALITY = 95
_LONGEST_JPEG_SIDE = 65_500
_SYMMETRIC_DEG = 1e-6
_FACE_NAMES = ("front", "right", "left", "back", "down", "up")
# Columns: the axes of an image in the axes of its camera (x right, y down, z forward).
CAMERA_FROM_PINHOLE = np.diag([1.0, -1.0, -1.0])
CAMERA_FROM_SPHERICAL = CAMERA_AXES_FROM_SCANNER


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """An image of an E57."""

    name: str
    """Its name."""
    camera: Camera | EquirectangularCamera | None
    """An ideal pinhole, or a window of the sphere around azimuth and elevation 0; None for a visual reference."""
    size: tuple[int, int]
    """(width, height), px."""
    photo_from_image: NDArray[np.float64]
    """(3, 3) rotation from the axes of the image to those of the photograph's camera."""
    data: bytes
    """The JPEG or PNG."""

    @property
    def is_jpeg(self) -> bool:
        """Whether it is a JPEG; a PNG otherwise."""
        return self.data.startswith(b"\xff\xd8")


def pictures(one: RegisteredPhoto, report: Callable[[], None]) -> Iterator[Picture]:
    """Yield the images of a photograph, one at a time; several if it needs them.

    Args:
        one: the photograph.
        report: called at least every second; may raise `Cancelled`.
    """
    camera, name = one.camera, f"{one.photo.name} ({one.caveat})" if one.caveat else one.photo.name
    pinhole = CAMERA_FROM_PINHOLE
    flat, panorama = camera.as_pinhole, camera.as_panorama
    if flat is not None and not any(flat.distortion):
        yield Picture(name, flat, flat.size, pinhole, _original(one))
        return
    if panorama is not None:
        centred, turn = _centred(panorama)
        axes = turn @ CAMERA_FROM_SPHERICAL
        if centred.size == camera.size:
            yield Picture(name, centred, centred.size, axes, _original(one))
            return
        data = _encoded(resampled(one.photo.pixels, camera, centred, turn, report))
        yield Picture(name, centred, centred.size, axes, data)
    elif flat is None:
        for face in cube_faces(camera, margin_px=0):
            turn = face.face_from_camera.T
            data = _encoded(resampled(one.photo.pixels, camera, face.camera, turn, report))
            yield Picture(
                f"{name}, {_face_name(face.face_from_camera)}", face.camera, face.camera.size, turn @ pinhole, data
            )
    else:
        ideal = axial_pinhole(camera)
        data = _encoded(resampled(one.photo.pixels, camera, ideal, np.eye(3), report))
        yield Picture(f"{name}, undistorted", ideal, ideal.size, pinhole, data)
    yield Picture(f"{name}, original", None, camera.size, pinhole, _original(one))


def _original(one: RegisteredPhoto) -> bytes:
    """Return the photograph's file where it is a JPEG or PNG of exactly these pixels; else a new one."""
    if one.file is not None and has_pixels(one.file, one.photo.pixels, modes=("RGB", "L")):
        return one.file.read_bytes()
    return _encoded(one.photo.pixels)


def _encoded(pixels: ByteArray) -> bytes:
    from PIL import Image

    stream = io.BytesIO()
    image = Image.fromarray(np.asarray(pixels))
    if max(image.size) <= _LONGEST_JPEG_SIDE:
        image.save(stream, "JPEG", quality=_QUALITY, subsampling=0)
    else:
        image.save(stream, "PNG")
    return stream.getvalue()


def _centred(camera: EquirectangularCamera) -> tuple[EquirectangularCamera, NDArray[np.float64]]:
    """Return the same pixels as a window around longitude and latitude 0, and the rotation from it to the camera.

    A spherical representation states only the size of its pixels: the window is turned to its middle longitude, and
    reaches as far above the equator as below.
    """
    left, top, right, bottom = camera.window or (-180.0, 90.0, 180.0, -90.0)
    middle, half = np.radians((left + right) / 2), (right - left) / 2
    turn = np.array([[np.cos(middle), 0, np.sin(middle)], [0, 1, 0], [-np.sin(middle), 0, np.cos(middle)]])
    highest, height = max(abs(top), abs(bottom)), camera.height
    if abs(top + bottom) > _SYMMETRIC_DEG:
        step = (top - bottom) / camera.height
        height = int(np.ceil(2 * highest / step - 1e-9))
        highest = min(90.0, height * step / 2)
    window = (-half, highest, half, -highest)
    whole = abs(half - 180) < _SYMMETRIC_DEG and abs(highest - 90) < _SYMMETRIC_DEG
    return EquirectangularCamera(camera.width, height, None if whole else window), turn


def _face_name(face_from_camera: NDArray[np.float64]) -> str:
    x, y, z = face_from_camera[2]  # where it looks
    return _FACE_NAMES[int(np.argmax([z, x, -x, -z, y, -y]))]
