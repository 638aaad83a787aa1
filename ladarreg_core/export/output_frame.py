"""Coordinates of the clouds and models that are written: the scanner's, or the world's less an offset.

Models and clouds are written in single precision, which resolves half a metre in coordinates of millions of metres.
In the world a rounded offset is therefore subtracted in double precision first. It is the same for all files of an
export, so that they fit together, and is stated in `offset.json`, in the PLY's comments and in the GLB's extras.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.errors import OptionError
from ladarreg_core.export.json import write_document
from ladarreg_core.foundations.arrays import FloatArray
from ladarreg_core.foundations.validation import require_choice
from ladarreg_core.frames import Rigid
from ladarreg_core.scan import Scan

FrameName = Literal["scanner", "world"]
_LARGE_M = 1000.0  # single precision resolves .06 mm there
_ROUNDED_TO_M = 100.0


@dataclass(frozen=True, slots=True, eq=False)
class OutputFrame:
    """The frame of written points."""

    name: FrameName = "scanner"
    """`scanner`: X forward, Y left, Z up at the scanner; `world`: that of the survey."""
    world_from_scanner: Rigid = field(default_factory=Rigid.identity)
    """The scanner's pose in the world; the identity where points are written in the scanner's frame."""
    offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """What was subtracted from coordinates in the world, m; zero where these are small."""

    @staticmethod
    def of(scan: Scan, name: object = "scanner") -> OutputFrame:
        """Return the frame of the clouds and models of a scan.

        Raises:
            OptionError: if the name is unknown, or it is `world` and the scan's file does not state where the scanner
                stands.
        """
        require_choice(name, get_args(FrameName), "the frame")
        if name == "scanner":
            return OutputFrame()
        pose = scan.world_from_scanner
        if pose is None:
            raise OptionError(
                "the frame 'world' needs the scanner's pose, which this scan's file does not state; write in the "
                "scanner's frame, or give a scan with its pose (E57, PTX, NPZ with world_from_scanner)"
            )
        large = np.abs(pose.translation).max() > _LARGE_M
        rounded = np.round(pose.translation / _ROUNDED_TO_M) * _ROUNDED_TO_M + 0.0
        x, y, z = rounded.tolist() if large else (0.0, 0.0, 0.0)
        return OutputFrame("world", pose, (x, y, z))

    def place(self, points: FloatArray) -> NDArray[np.float64]:
        """Return points (..., 3) of the scanner's frame as they are written, in double precision."""
        if self.name == "scanner":
            return np.asarray(points, dtype=np.float64)
        pose = self.written_from_scanner
        return np.asarray(points.astype(np.float64) @ pose.rotation.T + pose.translation)

    @property
    def written_from_scanner(self) -> Rigid:
        """The scanner's pose among the written points: in the world less the offset."""
        moved = self.world_from_scanner.translation - np.array(self.offset_m)  # small, and exact
        return Rigid(self.world_from_scanner.rotation, moved)

    @property
    def sentence(self) -> str:
        """What the coordinates are, in words."""
        if self.name == "scanner":
            return "scanner frame, X forward, Y left, Z up; metres"
        if not any(self.offset_m):
            return "world frame, as the scan's file states it; metres"
        x, y, z = self.offset_m
        return f"world frame less an offset, metres; add {x:.0f} {y:.0f} {z:.0f} to X Y Z"

    def as_dict(self) -> dict[str, Any]:
        """Return the frame, JSON-ready."""
        return {"frame": self.name, "offset_m": list(self.offset_m)}

    def write(self, path: str | Path) -> None:
        """Write `offset.json`.

        Raises:
            ExportError: if the file cannot be written.
        """
        document = {
            **self.as_dict(),
            "offset_is": "what was subtracted from the world's X, Y, Z (m) in the clouds, models and poses beside "
            "this file; add it to their coordinates in double precision",
            "world_from_scanner": self.world_from_scanner.matrix,
        }
        write_document(path, document)
