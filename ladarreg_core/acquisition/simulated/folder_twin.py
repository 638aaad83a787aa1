"""Simulated scanners and cameras with software of their own: they write files into a folder when the unit has come to
rest, as slowly and as clumsily as such software does.

On request a file never comes, stays truncated, is of another kind, or comes with a second one.
"""

from __future__ import annotations

import os
import tempfile
import threading
import zlib
from collections import deque
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from PIL.ExifTags import IFD, Base

from ladarreg_core.acquisition.clock import REAL_CLOCK, Clock
from ladarreg_core.acquisition.interfaces import PanTilt
from ladarreg_core.acquisition.simulated.world import Bench
from ladarreg_core.camera import Camera, CameraModel
from ladarreg_core.errors import DependencyError
from ladarreg_core.formats.scans.npz import write_npz_xyz
from ladarreg_core.foundations.validation import require_choice
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation, ScanGeometry

FileFailure = Literal["never", "truncated", "wrong-format", "two-files"]
"""What goes wrong with the next file."""
ScanFormat = Literal["npz", "e57", "ptx"]
PhotoFormat = Literal["jpg", "png"]
FRAME = AzimuthElevation(rows=175, columns=250, d_azimuth_rad=np.radians(0.22), d_elevation_rad=np.radians(0.22))
"""Rays of the simulated scanner, 55 x 38.5 deg."""
CAMERA = Camera.from_focal(768, 512, 640.0)
"""The simulated camera, 62 x 44 deg: 30 mm on 35 mm film, as its files state."""

_FILM_MM = 36.0
_TICK_S, _IDLE_S = 0.01, 1.0
_CHUNKS = 8
_KEY_STEP_RAD = 1e-5
_WAYS = ("in chunks", "under a temporary name", "a part of it first")


class FolderTwin:
    """A simulated device that writes a file each time the unit has come to rest; a context manager.

    A movement of no length counts too, one that was halted does not. The way in which a file is written changes from
    file to file, by the seed: in chunks under its name, under a temporary name that is changed in the end, or a part of
    it, and after a pause the whole. A unit that is back at an earlier position gets the same measurement again.

    Args:
        bench: the bench; its unit's motion decides when.
        folder: existing folder.
        stem: of the files' names, which are numbered.
        suffix: of the files' names, with the dot.
        make: writes the measurement at a position of the unit into a new file; the numbers key its noise.
        delay_s: from rest to the measurement.
        writing_s: from a file's first byte to its last.
        clock: what it lives by, as the bench does.
    """

    def __init__(
        self,
        bench: Bench,
        folder: Path,
        *,
        stem: str,
        suffix: str,
        make: Callable[[Path, PanTilt, tuple[int, int]], None],
        delay_s: float = 0.1,
        writing_s: float = 0.2,
        clock: Clock = REAL_CLOCK,
    ) -> None:
        self.folder = folder
        self._on, self._awake = True, threading.Event()
        self._awake.set()
        self.written = 0
        """Files so far that were written as they should be."""
        self._bench, self._stem, self._suffix, self._make = bench, stem, suffix, make
        self._delay_s, self._writing_s, self._clock = delay_s, writing_s, clock
        self._failures: deque[FileFailure] = deque()
        self._rng = np.random.default_rng([zlib.crc32(stem.encode()), bench.seed])
        self._done = bench.arrival()
        self._running = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> FolderTwin:
        self._running.set()
        self._clock.start(self._thread)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._running.clear()
        self._awake.set()
        self._clock.join(self._thread)

    @property
    def on(self) -> bool:
        """Whether it measures; one that is switched on measures from the next arrival of the unit on."""
        return self._on

    @on.setter
    def on(self, on: bool) -> None:
        if on and not self._on:
            self._arrived()  # before it was switched on
        self._on = on
        (self._awake.set if on else self._awake.clear)()

    def fail(self, kind: FileFailure) -> None:
        """Let the next file fail; several calls queue up."""
        require_choice(kind, get_args(FileFailure), "the failure")
        self._failures.append(kind)

    def mend(self) -> None:
        """Forget the failures that were queued."""
        self._failures.clear()

    def _run(self) -> None:
        while self._running.is_set():
            self._clock.sleep(_TICK_S)
            if not self._clock.wait(self._awake, _IDLE_S):
                continue
            if self._arrived() and self._on:
                self._measure()

    def _arrived(self) -> bool:
        """Return whether the unit has arrived since this was asked before, and the delay is over."""
        arrival = self._bench.arrival()
        if arrival is None or arrival == self._done or self._bench.now() < arrival[1] + self._delay_s:
            return False
        self._done = arrival
        return True

    def _measure(self) -> None:
        failure = self._failures.popleft() if self._failures else None
        if failure == "never":
            return
        at = self._bench.pose_at(self._bench.now())
        key = round(at.pan_rad / _KEY_STEP_RAD), round(at.tilt_rad / _KEY_STEP_RAD)
        with tempfile.TemporaryDirectory(prefix="ladarreg-twin-") as aside:
            whole = Path(aside) / f"whole{self._suffix}"
            self._make(whole, at, key)
            content = whole.read_bytes()
        if failure == "wrong-format":
            content = b"The measurement was aborted by the operator.\n" * 40
        if failure == "truncated":
            content = content[: len(content) * 2 // 3]
        self._write(self._next_path(), content, _WAYS[int(self._rng.integers(len(_WAYS)))])
        if failure == "two-files":
            self._write(self._next_path(), content, _WAYS[0])
        if failure is None:
            self.written += 1

    def _next_path(self) -> Path:
        number = 1
        while (path := self.folder / f"{self._stem}_{number:04d}{self._suffix}").exists():
            number += 1
        return path

    def _write(self, path: Path, content: bytes, way: str) -> None:
        if way == "under a temporary name":
            beside = path.with_name(path.name + ".part")
            self._write_chunks(beside, content)
            os.replace(beside, path)
            return
        if way == "a part of it first":
            path.write_bytes(content[: len(content) // 3])
            self._pause(self._writing_s / 2)
        self._write_chunks(path, content)

    def _write_chunks(self, path: Path, content: bytes) -> None:
        size = len(content) // _CHUNKS + 1
        with path.open("wb") as stream:
            for start in range(0, len(content), size):
                stream.write(content[start : start + size])
                stream.flush()
                self._pause(self._writing_s / _CHUNKS)

    def _pause(self, seconds: float) -> None:
        if self._running.is_set():
            self._clock.sleep(seconds)


def scanner_twin(
    bench: Bench,
    folder: Path,
    *,
    geometry: ScanGeometry = FRAME,
    file_format: ScanFormat = "npz",
    delay_s: float = 0.1,
    writing_s: float = 0.2,
    clock: Clock = REAL_CLOCK,
) -> FolderTwin:
    """Return a scanner with a field of view that writes scans.

    Args:
        bench: the bench.
        folder: existing folder.
        geometry: its rays.
        file_format: of the files; `e57` needs the package `pye57`.
        delay_s: from rest to the measurement.
        writing_s: from a file's first byte to its last.
        clock: what it lives by, as the bench does.
    """
    require_choice(file_format, get_args(ScanFormat), "the format of the scans")
    write = {"npz": write_npz_xyz, "ptx": _write_ptx, "e57": _write_e57}[file_format]

    def make(path: Path, at: PanTilt, key: tuple[int, int]) -> None:
        write(path, bench.scan_frame(at, geometry, noise_key=key))

    return FolderTwin(
        bench,
        folder,
        stem="scan",
        suffix=f".{file_format}",
        make=make,
        delay_s=delay_s,
        writing_s=writing_s,
        clock=clock,
    )


def camera_twin(
    bench: Bench,
    folder: Path,
    *,
    camera: CameraModel = CAMERA,
    file_format: PhotoFormat = "jpg",
    delay_s: float = 0.1,
    writing_s: float = 0.2,
    clock: Clock = REAL_CLOCK,
) -> FolderTwin:
    """Return a camera that writes photographs; arguments as of `scanner_twin`."""
    require_choice(file_format, get_args(PhotoFormat), "the format of the photographs")

    def make(path: Path, at: PanTilt, key: tuple[int, int]) -> None:
        picture = Image.fromarray(bench.photograph(at, camera, noise_key=key))
        exif = Image.Exif()
        exif[Base.Make], exif[Base.Model] = "ladarreg", "simulated camera"
        if (pinhole := camera.as_pinhole) is not None:
            exif.get_ifd(IFD.Exif)[Base.FocalLengthIn35mmFilm] = round(_FILM_MM * pinhole.fx / pinhole.width)
        picture.save(path, exif=exif, quality=95)

    return FolderTwin(
        bench,
        folder,
        stem="photo",
        suffix=f".{file_format}",
        make=make,
        delay_s=delay_s,
        writing_s=writing_s,
        clock=clock,
    )


def _write_ptx(path: Path, scan: Scan) -> None:
    """Write a PTX in the scanner's own frame: a column at a time from the left, each from below."""
    rows, columns = scan.shape
    axes = ["0 0 0", "1 0 0", "0 1 0", "0 0 1"]
    header = [str(columns), str(rows), *axes, "1 0 0 0", "0 1 0 0", "0 0 1 0", "0 0 0 1"]
    points = np.nan_to_num(np.asarray(scan.points, np.float64), nan=0.0)
    light = np.clip(scan.intensity / 4.0, 0, 1)
    cells = np.concatenate([points, light[..., None]], axis=-1)[::-1].transpose(1, 0, 2).reshape(-1, 4)
    with path.open("w", encoding="ascii", newline="\r\n") as stream:
        stream.write("\n".join(header) + "\n")
        np.savetxt(stream, cells, fmt="%.5f")


def _write_e57(path: Path, scan: Scan) -> None:
    try:
        import pye57
    except ImportError:
        raise DependencyError(
            "the simulated scanner writes E57 by the package pye57, which is not installed: pip install pye57"
        ) from None
    points = np.asarray(scan.points, np.float64).reshape(-1, 3)
    missing: NDArray[np.bool_] = ~np.isfinite(scan.ranges).reshape(-1)
    row, column = np.indices(scan.shape)
    points = np.where(missing[:, None], 0.0, points)
    data: dict[str, NDArray[Any]] = {
        f"cartesian{axis}": np.ascontiguousarray(points[:, k]) for k, axis in enumerate("XYZ")
    }
    data |= {
        "intensity": scan.intensity.reshape(-1).astype(np.float32),
        "rowIndex": row.reshape(-1).astype(np.uint32),
        "columnIndex": column.reshape(-1).astype(np.uint32),
        "cartesianInvalidState": missing.astype(np.int8) * 2,
    }
    file = pye57.E57(str(path), mode="w")
    try:
        file.write_scan_raw(data, name="scan")
    finally:
        file.close()
