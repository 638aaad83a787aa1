"""A camera that the system knows as a video device: one photograph a stop, as PNG."""

from __future__ import annotations

from pathlib import Path

import cv2

from ladarreg_core.acquisition.interfaces import Arrival, Check
from ladarreg_core.errors import DeviceError
from ladarreg_core.storage.atomic_write import replaced_file, write_bytes

_STALE_FRAMES = 4  # drivers keep frames that were taken while the unit still moved


class VideoCamera:
    """A video device.

    Args:
        device: its number.

    Raises:
        DeviceError: if there is none, or another program uses it.
    """

    def __init__(self, device: int) -> None:
        self._device = device
        self._capture = cv2.VideoCapture(device)
        if not self._capture.isOpened():
            raise DeviceError(
                f"the video device {device} cannot be opened; check that the camera is connected, that no other "
                "program uses it, and its number"
            )

    def arrived(self, stop: Arrival) -> None:
        """Do nothing: the photograph is taken when it is asked for."""

    def next_file(self, folder: Path, *, check: Check) -> Path:
        """Take a photograph and return it as a PNG in `folder`.

        Raises:
            DeviceError: if the camera gives no picture.
            Cancelled: if `check` raises it.
        """
        good, picture = False, None
        for _ in range(_STALE_FRAMES + 1):
            check()
            good, picture = self._capture.read()
        if not good or picture is None:
            raise DeviceError(f"the video device {self._device} gives no picture; check its cable, and resume")
        good, data = cv2.imencode(".png", picture)
        if not good:
            raise DeviceError(f"the picture of the video device {self._device} cannot be stored; check the camera")
        target = folder / "photo.png"
        with replaced_file(target) as new:
            write_bytes(new, data.tobytes())
        return target

    def keep_strays(self, folder: Path) -> list[Path]:
        """Return nothing: there are no photographs that nobody asked for."""
        return []

    def close(self) -> None:
        """Release the device."""
        self._capture.release()
