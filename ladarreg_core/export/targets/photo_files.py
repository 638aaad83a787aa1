"""What the targets for cameras share: sentences about a photograph, its picture as a file, and its undistorted form."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.arrays import ByteArray
from ladarreg_core.camera import Camera, CameraModel
from ladarreg_core.errors import ExportError
from ladarreg_core.export.atomic_write import write_bytes, write_chunks
from ladarreg_core.export.targets.registered_scan import RegisteredPhoto, RegisteredScan
from ladarreg_core.photo import Photo
from ladarreg_core.progress import Progress, Report
from ladarreg_core.surface.remap import look_up

_PIXELS_AT_ONCE = 1_000_000
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


def words_of(handed: RegisteredScan, one: RegisteredPhoto) -> list[str]:
    """Return sentences for the comments of a file: the photograph, its world, and the mark of its pose."""
    lines = [
        f"Photograph: {on_one_line(one.photo.name)} ({one.camera.width} x {one.camera.height} pixels)",
        f"World: {handed.frame.sentence}",
    ]
    return [*lines, *([f"Pose: {one.mark}"] if one.mark else [])]


class WrittenPhoto:
    """A photograph as a target writes it: as it is, or undistorted.

    Args:
        one: the photograph.
        camera: the camera of the written picture: the photograph's own, or a pinhole without distortion with the same
            axes.
        report: receives the progress; may raise `Cancelled`.
    """

    def __init__(self, one: RegisteredPhoto, camera: CameraModel, *, report: Report | None = None) -> None:
        self.one = one
        self.camera = camera
        copied = _copied(one) if camera == one.camera else None
        self._report = report
        self._file = None if copied is None else copied[0]
        mark = f".{one.mark.replace(', ', '-').replace(' ', '-')}" if one.mark else ""
        self.name = f"{one.id}{mark}{'.png' if copied is None else copied[1]}"
        """File name of the picture; binary files have no other place for the mark of a pose that was not verified."""

    @property
    def is_undistorted(self) -> bool:
        """Whether the picture is not the photograph's own."""
        return self.camera != self.one.camera

    def words(self, handed: RegisteredScan) -> list[str]:
        """Return sentences about it for the comments of a file."""
        found = [f"{self.name}: {line}" for line in words_of(handed, self.one)]
        if self.is_undistorted:
            found.append(f"{self.name}: undistorted, since the model of the file has no such lens or none at all")
        return found

    def write(self, path: Path) -> None:
        """Write the picture: the photograph's file where it has just its pixels, otherwise a PNG.

        Raises:
            ExportError: if the file cannot be written.
        """
        if self._file is not None:
            write_bytes(path, self._file.read_bytes())
        elif self.is_undistorted:
            assert isinstance(self.camera, Camera)
            write_png_picture(path, undistorted(self.one.photo, self.one.camera, self.camera, report=self._report))
        else:
            write_png_picture(path, self.one.photo.pixels)


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
    from PIL import Image

    file = one.file
    if file is None or not file.is_file():
        return None
    try:
        with open(file, "rb") as stream:
            head = stream.read(8)
        extension = next((found for magic, found in _KEPT_AS_THEY_ARE.items() if head.startswith(magic)), None)
        if extension is None:
            return None
        with Image.open(file) as image:
            plain = image.mode == "RGB" and image.getexif().get(_EXIF_ORIENTATION, 1) == 1
            if not plain or image.size != one.camera.size or not np.array_equal(np.asarray(image), one.photo.pixels):
                return None
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        return None
    return file, extension


def undistorted(photo: Photo, camera: CameraModel, ideal: Camera, *, report: Report | None = None) -> NDArray[np.uint8]:
    """Return the picture that an ideal camera at the same place would have taken; black where the photograph ends.

    Args:
        photo: the photograph.
        camera: its camera.
        ideal: a pinhole without distortion, with the same axes.
        report: receives the progress; may raise `Cancelled`.

    Returns:
        (height, width, 3) RGB.
    """
    result = np.empty((ideal.height, ideal.width, 3), np.uint8)
    at_once = max(1, _PIXELS_AT_ONCE // ideal.width)
    for first in range(0, ideal.height, at_once):
        if report is not None:
            report(Progress(first, ideal.height, f"undistorting {on_one_line(photo.name)}"))
        rows = np.arange(first, min(first + at_once, ideal.height))
        uv = camera.project(ideal.unproject(np.stack(np.meshgrid(np.arange(ideal.width), rows), axis=-1)))
        u, v = np.moveaxis(np.where(np.isfinite(uv), uv, -10.0), -1, 0)
        result[rows] = look_up(photo.pixels, u, v, outside=(0, 0, 0))
    return result
