"""What the targets for cameras share: sentences about a photograph, its picture as a file, and its undistorted form."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.camera import Camera, CameraModel, EquirectangularCamera
from ladarreg_core.errors import ExportError
from ladarreg_core.export.pictures.texture_image import texture_image
from ladarreg_core.export.registered_scan import Registered, RegisteredPhoto
from ladarreg_core.foundations.arrays import ByteArray
from ladarreg_core.foundations.opened_image import opened_image
from ladarreg_core.foundations.progress import Progress, Report
from ladarreg_core.photo import Photo
from ladarreg_core.storage.atomic_write import write_bytes, write_chunks
from ladarreg_core.surface.remap import look_up

_ROWS_AT_ONCE = 256
_LARGEST_FILE_BYTES = 1 << 30
_SEAM_PX = 64
_NOWHERE = np.float32(-10)
_KEPT_AS_THEY_ARE = {b"\xff\xd8\xff": ".jpg", b"\x89PNG\r\n\x1a\n": ".png"}
_EXIF_ORIENTATION = 0x0112


def on_one_line(text: str) -> str:
    """Return a text for a comment: on one line, without control characters."""
    return "".join(letter if letter.isprintable() else " " for letter in text).strip()


def shown_names(photos: Sequence[RegisteredPhoto]) -> str:
    """Return the names of photographs for a message, five at most."""
    names = [on_one_line(one.photo.name)[:60] for one in photos]
    return ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")


def text_writer(text: str) -> Callable[[Path], None]:
    """Return the writer of a text file."""
    return lambda path: write_bytes(path, text.encode("utf-8"))


def words_of(handed: Registered, one: RegisteredPhoto) -> list[str]:
    """Return sentences for the comments of a file: the photograph, its world, and the mark of its pose."""
    lines = [
        f"Photograph: {on_one_line(one.photo.name)} ({one.camera.width} x {one.camera.height} pixels)",
        f"World: {handed.frame.sentence}",
    ]
    return [*lines, f"Pose: {one.registration.standing}"]


class WrittenPhoto:
    """A photograph as a target writes it: as it is, or undistorted.

    Args:
        one: the photograph.
        camera: the camera of the written picture: the photograph's own, or a pinhole without distortion or a panorama
            with the same axes.
        extension: of a picture that is not the photograph's file: `.png`, or `.jpg` where size matters more.
        report: receives the progress; may raise `Cancelled`.
    """

    def __init__(
        self, one: RegisteredPhoto, camera: CameraModel, *, extension: str = ".png", report: Report | None = None
    ) -> None:
        self.one = one
        self.camera = camera
        copied = _copied(one) if camera == one.camera else None
        self._report = report
        self._file = None if copied is None else copied[0]
        mark = f".{one.mark.replace(', ', '-').replace(' ', '-')}" if one.mark else ""
        self.name = f"{one.id}{mark}{extension if copied is None else copied[1]}"
        """File name of the picture; binary files have no other place for the mark of a pose that was not verified."""

    @property
    def is_undistorted(self) -> bool:
        """Whether the picture is not the photograph's own."""
        return self.camera != self.one.camera

    def words(self, handed: Registered) -> list[str]:
        """Return sentences about it for the comments of a file."""
        found = [f"{self.name}: {line}" for line in words_of(handed, self.one)]
        if self.is_undistorted:
            found.append(f"{self.name}: undistorted, since the model of the file has no such lens or none at all")
        return found

    def write(self, path: Path) -> None:
        """Write the picture: the photograph's file where it has just its pixels, otherwise a new one.

        Raises:
            ExportError: if the file cannot be written.
        """
        if self._file is not None:
            write_bytes(path, self._file.read_bytes())
            return
        pixels = self.one.photo.pixels
        if self.is_undistorted:
            target = self.camera.as_pinhole or self.camera.as_panorama
            assert target is not None, "only a lens is taken out"
            pixels = undistorted(self.one.photo, self.one.camera, target, report=self._report)
        if self.name.endswith(".png"):
            write_png_picture(path, pixels)
        else:
            write_bytes(path, texture_image(pixels, lossless=False).data)


def write_png_picture(path: Path, pixels: ByteArray) -> None:
    """Write pixels (H, W, 3) RGB losslessly.

    Raises:
        ExportError: if the picture is too large for a PNG or the file cannot be written.
    """
    done, encoded = cv2.imencode(".png", cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR))
    if not done:
        raise ExportError(
            f"a picture of {pixels.shape[1]} x {pixels.shape[0]} pixels cannot be written as PNG; give a smaller one"
        )
    write_chunks(path, (encoded.data,))


def _copied(one: RegisteredPhoto) -> tuple[Path, str] | None:
    """Return the file that has a photograph's pixels for every reader, and its extension; None if there is none."""
    file = one.file
    if file is None or not has_pixels(file, one.photo.pixels):
        return None
    with open(file, "rb") as stream:
        head = stream.read(8)
    extension = next((found for magic, found in _KEPT_AS_THEY_ARE.items() if head.startswith(magic)), None)
    return None if extension is None else (file, extension)


def has_pixels(path: Path, pixels: ByteArray, *, modes: Collection[str] = ("RGB",)) -> bool:
    """Return whether a file is a JPEG or PNG that shows pixels (H, W, 3) as it stands: not turned, not converted.

    Args:
        path: the file; it need not exist.
        pixels: what it must show.
        modes: modes of Pillow that it may have.
    """
    from PIL import Image

    try:
        if path.stat().st_size > _LARGEST_FILE_BYTES:
            return False
        with opened_image(path, ("JPEG", "PNG")) as image:
            width, height = image.size
            if (height, width) != pixels.shape[:2] or image.mode not in modes:
                return False
            if image.getexif().get(_EXIF_ORIENTATION, 1) != 1:
                return False
            image.load()
            for first in range(0, height, _ROWS_AT_ONCE):
                part = image.crop((0, first, width, min(first + _ROWS_AT_ONCE, height))).convert("RGB")
                if not np.array_equal(np.asarray(part), pixels[first : first + _ROWS_AT_ONCE]):
                    return False
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        return False
    return True


def undistorted(
    photo: Photo, camera: CameraModel, ideal: Camera | EquirectangularCamera, *, report: Report | None = None
) -> NDArray[np.uint8]:
    """Return the picture that an ideal camera at the same place would have taken; black where the photograph ends.

    Args:
        photo: the photograph.
        camera: its camera.
        ideal: a pinhole without distortion or a panorama, with the same axes.
        report: receives the progress; may raise `Cancelled`.

    Returns:
        (height, width, 3) RGB.
    """
    done = 0

    def progress() -> None:
        nonlocal done
        if report is not None:
            report(Progress(min(done, ideal.height), ideal.height, f"undistorting {on_one_line(photo.name)}"))
        done += _ROWS_AT_ONCE

    return resampled(photo.pixels, camera, ideal, np.eye(3), progress)


def resampled(
    pixels: ByteArray,
    camera: CameraModel,
    target: Camera | EquirectangularCamera,
    photo_from_target: NDArray[np.float64],
    report: Callable[[], None],
) -> NDArray[np.uint8]:
    """Return a photograph as another camera at the same place would have taken it; black beyond its borders.

    Args:
        pixels: (h, w, 3) uint8.
        camera: the camera that took them.
        target: the other camera.
        photo_from_target: (3, 3) rotation from its axes.
        report: called for every few rows; may raise `Cancelled`.
    """
    seam = min(_SEAM_PX, camera.width) if camera.turn_px else 0
    if seam:
        pixels = np.concatenate([pixels[:, -seam:], pixels, pixels[:, :seam]], axis=1)
    made = np.empty((target.height, target.width, 3), np.uint8)
    for first in range(0, target.height, _ROWS_AT_ONCE):
        report()
        rows = np.arange(first, min(first + _ROWS_AT_ONCE, target.height))
        uv = np.stack(np.meshgrid(np.arange(target.width), rows), axis=-1)
        at = camera.project(target.unproject(uv) @ photo_from_target.T)
        seen = camera.contains(at, border=-0.5)
        u, v = (np.where(seen, at[..., k] + (seam if k == 0 else 0), _NOWHERE).astype(np.float32) for k in (0, 1))
        drawn = look_up(pixels, u, v)  # within half a pixel of the border, its pixels go on
        drawn[~seen] = 0
        made[rows] = drawn
    return made
