"""What a run expects of its devices: the interfaces of pan/tilt units, scanners and cameras, and what they report."""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

Check = Callable[[], None]
"""Called often while a device is awaited; raises `Cancelled` to stop, after which the device is halted."""
Read = Callable[..., Any]
"""Calls a reader with a file, here or in a process of its own, and returns what it returns."""


def read_here(reader: Callable[[Path], Any], path: Path) -> Any:
    """Read a file in this process; a `Read`."""
    return reader(path)


@dataclass(frozen=True, slots=True)
class PanTilt:
    """Position of a pan/tilt unit."""

    pan_rad: float
    """Positive to the left."""
    tilt_rad: float
    """Positive upward."""


@dataclass(frozen=True, slots=True)
class UnitIdentity:
    """What a pan/tilt unit is and can do; angles in the signs of `PanTilt`."""

    model: str
    """Model and firmware as the unit states them."""
    resolution_rad: PanTilt
    """Finest step of each axis."""
    lowest: PanTilt
    """Lower limit of each axis."""
    highest: PanTilt
    """Upper limit of each axis."""
    speed_rad_s: PanTilt
    """Speed of each axis as set."""


class PanTiltUnit(Protocol):
    """A pan/tilt unit that is connected."""

    @property
    def identity(self) -> UnitIdentity:
        """What it is and can do."""

    def position(self) -> PanTilt:
        """Return where it is, as read from its encoders or step counters."""

    def start_move(self, target: PanTilt) -> None:
        """Start to move; a target beyond the limits is refused before anything is sent."""

    def move_to(self, target: PanTilt, *, check: Check) -> PanTilt:
        """Move, await the end of the movement, and return the position read back."""

    def set_speed(self, speed: PanTilt) -> None:
        """Set the speed of both axes, rad/s."""

    def supply(self) -> dict[str, float]:
        """Return what it states about its supply and temperature, `volts` and `celsius`, as far as it does."""

    def require_present(self) -> None:
        """Raise `DeviceError` if its port is lost; without an exchange, so that it can be asked often."""

    def halt(self) -> None:
        """Stop at once, whatever else waits for the unit; may be called from any thread."""

    def close(self) -> None:
        """Halt and disconnect."""


@dataclass(frozen=True, slots=True, eq=False)
class ScanLine:
    """One line of a line scanner."""

    ranges_m: NDArray[np.float32]
    """(N,) m; NaN = no return."""
    intensity: NDArray[np.float32] | None
    """(N,) in the unit of the sensor; None if the scanner has none."""
    time_s: float
    """The scanner's own clock at the line's start, s, without the jumps at which its counter wraps."""


@dataclass(frozen=True, slots=True, eq=False)
class LineScannerIdentity:
    """What a line scanner is."""

    model: str
    """Model, serial number and firmware as the scanner states them."""
    angles_rad: NDArray[np.float64]
    """(N,) angle of each ray in the scanner's plane, 0 ahead, positive to the left."""
    least_range_m: float
    most_range_m: float
    line_period_s: float
    """Time between the starts of two lines."""
    sweep_s: float
    """Time from the first ray of a line to its last."""
    has_intensity: bool


@dataclass(frozen=True, slots=True)
class ClockReading:
    """How the scanner's clock relates to the host's."""

    host_minus_scanner_s: float
    """`time.monotonic` less the scanner's clock as in `ScanLine.time_s`, s."""
    uncertainty_s: float
    """Half of the round trip, and of the clock's step."""


class LineScanner(Protocol):
    """A line scanner that is connected; its frame has X ahead, Y left and Z along the axis of its mirror."""

    @property
    def identity(self) -> LineScannerIdentity:
        """What it is."""

    def lines(self, count: int, *, check: Check) -> Generator[ScanLine]:
        """Switch the laser on, measure a bounded number of lines, and switch it off, whatever happens.

        Who may not take all of them closes the generator, since the laser stays on until then.
        """

    def clock(self) -> ClockReading:
        """Return how the scanner's clock relates to the host's."""

    @property
    def last_clock(self) -> ClockReading | None:
        """How the clocks related when they were compared last; None if that no longer holds."""

    def require_present(self) -> None:
        """Raise `DeviceError` if its port is lost; without an exchange, so that it can be asked often."""

    def laser_off(self) -> None:
        """Switch the laser off at once; may be called from any thread."""

    def close(self) -> None:
        """Switch the laser off and disconnect."""


@dataclass(frozen=True, slots=True)
class Arrival:
    """The unit stands at a stop."""

    index: int
    """Number of the stop."""
    at: PanTilt
    """Position read back."""


class FrameSource(Protocol):
    """A scanner or camera that delivers one whole measurement a stop, in one file or in several."""

    def arrived(self, stop: Arrival) -> None:
        """Take note that the unit stands at a stop: only what is written from now on is measured there."""

    def next_file(self, folder: Path, *, check: Check) -> Path:
        """Await the measurement of the stop and copy its files, under their names, into `folder`; return what to read.

        Raises:
            DeviceError: if none comes.
            Cancelled: if `check` raises it.
        """

    def keep_strays(self, folder: Path) -> list[Path]:
        """Copy what was written, and belongs to no stop, into `folder`; return the copies. Each is given once."""

    def close(self) -> None:
        """Disconnect."""
