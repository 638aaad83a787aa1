"""A run: the devices driven through the stops of a plan, and every piece kept as it comes."""

from __future__ import annotations

import contextlib
import logging
import math
import shutil
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ladarreg_core.acquisition.clock import REAL_CLOCK, Clock
from ladarreg_core.acquisition.devices.ports import GuardEndedError
from ladarreg_core.acquisition.interfaces import (
    Arrival,
    FrameSource,
    LineScanner,
    PanTilt,
    PanTiltUnit,
    Read,
    read_here,
)
from ladarreg_core.acquisition.line_sweep import LineSweep
from ladarreg_core.acquisition.plan import Plan
from ladarreg_core.acquisition.run_records import Health, Record
from ladarreg_core.acquisition.runs.closure import SEARCHED_DEG, Closure, closure_of_scans, closure_of_sweep
from ladarreg_core.acquisition.runs.continuous import measured_pass
from ladarreg_core.acquisition.runs.run_folder import PHOTOS, PIECES, STRAYS, RunWriter, ScanPiece, write_sweep
from ladarreg_core.acquisition.runs.stops import Stop, forecast, require_possible, stops_of
from ladarreg_core.errors import Cancelled, DeviceError, DeviceGlitchError, FormatError, OptionError
from ladarreg_core.formats import read_scan
from ladarreg_core.formats.scans.npz import write_npz_xyz
from ladarreg_core.scan import Scan

_LOG = logging.getLogger(__name__)
_T = TypeVar("_T")
_NAP_S = 0.02
_AVERAGED = 0.3  # weight of the latest piece in the time that a piece takes
_MAX_REPEATS = 6  # of a piece after hangs; each of two devices reports the same one
_MAX_GLITCHES = 3  # of a piece, each of which repeats it


@dataclass(frozen=True, slots=True)
class Moved:
    """The unit stands at a stop."""

    stop: Stop
    at: PanTilt


@dataclass(frozen=True, slots=True, eq=False)
class PieceKept:
    """A piece is on disk and will be there after any crash."""

    record: Record
    piece: LineSweep | ScanPiece
    done: int
    """Pieces kept so far, those of an earlier run included."""
    total: int
    seconds_left: float


@dataclass(frozen=True, slots=True)
class Paused:
    """The run waits, with the unit halted and the laser off."""

    reason: str
    fault: bool
    """Whether a device failed; otherwise it was asked for."""


@dataclass(frozen=True, slots=True)
class Repeated:
    """A piece is measured again automatically: an answer was damaged or late, or this program hung for a moment."""

    index: int
    reason: str


@dataclass(frozen=True, slots=True)
class StraysKept:
    """Files that came while the unit was on its way belong to no stop; copies of them lie in the run's folder."""

    index: int
    """The stop before which they came."""
    names: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Compared:
    """The first stop was measured again at the end."""

    closure: Closure


@dataclass(frozen=True, slots=True)
class Resumed:
    """The run goes on."""


@dataclass(frozen=True, slots=True)
class Ended:
    """The run has ended, with the unit halted and the laser off."""

    complete: bool
    """Whether all pieces are there; otherwise it was stopped."""
    done: int
    total: int


RunEvent = Moved | PieceKept | Paused | Repeated | StraysKept | Compared | Resumed | Ended
EventReport = Callable[[RunEvent], None]


_HUNG = "this computer was too busy for a moment, and the devices were stopped; the piece is measured again"


class Run:
    """Drives the devices through a plan; `go` blocks, the others may be called from any thread.

    Args:
        plan: the plan.
        folder: where the pieces are kept; with those of an earlier run, if it is resumed.
        unit: the pan/tilt unit.
        line_scanner: for a sweep.
        frames: the scanner with software of its own, for a mosaic.
        camera: takes a photograph at each stop.
        report: receives the events, on the thread of `go`.
        clock: the one that the devices live by.
        read: reads the files of a watched folder.

    Raises:
        OptionError: if the devices cannot run the plan; nothing has moved then.
    """

    def __init__(
        self, plan: Plan, folder: RunWriter, *, unit: PanTiltUnit, line_scanner: LineScanner | None = None,
        frames: FrameSource | None = None, camera: FrameSource | None = None, report: EventReport,
        clock: Clock = REAL_CLOCK, read: Read = read_here,
    ) -> None:  # fmt: skip
        self._read = read
        if (plan.mode == "sweep") != (line_scanner is not None) or (plan.mode == "mosaic") != (frames is not None):
            raise OptionError(f"a {plan.mode} needs {'a line scanner' if plan.mode == 'sweep' else 'a watched folder'}")
        identity = None if line_scanner is None else line_scanner.identity
        require_possible(plan, unit.identity, identity)
        self.plan, self.folder = plan, folder
        self._unit, self._lines, self._frames, self._camera = unit, line_scanner, frames, camera
        self._devices = [device for device in (unit, line_scanner) if device is not None]
        self._sources = {
            name: source for name, source in (("scanner", frames), ("camera", camera)) if source is not None
        }
        self._in_doubt = False
        self._report, self._clock = report, clock
        self._stops = stops_of(plan)
        self._stopped, self._paused = threading.Event(), threading.Event()
        self._seconds_a_piece = forecast(plan, identity).seconds / max(1, len(self._stops))

    @property
    def total(self) -> int:
        """Number of pieces."""
        return len(self._stops)

    def go(self) -> bool:
        """Measure all pieces that are missing; return whether all are there, or the run was stopped.

        In the end the first stop is measured again, which shows whether the unit has lost steps.

        A device that fails pauses the run until `resume` or `stop`. Devices that were stopped because this program hung
        for a moment have not failed: their piece is begun again, a few times. So is that of a device that restarted, or
        whose answer was damaged, late or missing even when it was asked again.

        Raises:
            ExportError: if a piece cannot be written; the devices are at rest then, as after every other end.
        """
        try:
            for stop in self._stops:
                if stop.index not in self.folder.records:
                    self._measure_until_kept(stop)
            if self.total > 1 and not self.folder.closed:
                self._report(Compared(self._until_done(self._stops[0], self._close)))
        except Cancelled:
            pass
        finally:
            self._rest()
        complete = len(self.folder.records) >= self.total
        self._report(Ended(complete, len(self.folder.records), self.total))
        return complete

    def pause(self) -> None:
        """Have the run wait after the piece that is being measured."""
        self._paused.set()

    def resume(self) -> None:
        """Have a run that waits go on."""
        self._paused.clear()

    def stop(self) -> None:
        """Halt the unit and switch the laser off at once, and end the run; the pieces so far are kept."""
        self._stopped.set()
        self._rest()

    def _measure_until_kept(self, stop: Stop) -> None:
        begun = self._clock.now()
        record, piece = self._until_done(stop, self._measure)
        taken = self._clock.now() - begun
        self._seconds_a_piece += _AVERAGED * (taken - self._seconds_a_piece)
        done = len(self.folder.records)
        left = (self.total - done) * self._seconds_a_piece
        self._report(PieceKept(record, piece, done, self.total, left))

    def _until_done(self, stop: Stop, work: Callable[[Stop], _T]) -> _T:
        """Return what comes of some work at a stop, which is begun again after each pause for a fault."""
        repeats = glitches = 0
        while True:
            if self._paused.is_set():
                self._wait("paused", fault=False)
            try:
                if self._in_doubt:
                    self._find_devices()
                    self._in_doubt = False
                return work(stop)
            except (DeviceError, FormatError) as error:
                if self._stopped.is_set():
                    raise Cancelled from None
                self._rest()
                self._in_doubt = True
                if isinstance(error, GuardEndedError) and error.hung and repeats < _MAX_REPEATS:
                    repeats += 1
                    self._report(Repeated(stop.index, _HUNG))
                    continue
                if isinstance(error, DeviceGlitchError) and glitches < _MAX_GLITCHES:
                    glitches += 1
                    again = f"the piece is measured again ({glitches} of {_MAX_GLITCHES})"
                    _LOG.warning("piece %d: %s; %s", stop.index, error, again)
                    self._report(Repeated(stop.index, f"{error}; {again}"))
                    continue
                self._paused.set()
                self._wait(str(error), fault=True)
                repeats = glitches = 0

    def _wait(self, reason: str, *, fault: bool) -> None:
        self._report(Paused(reason, fault))
        while self._paused.is_set():
            self._require_wanted()
            self._clock.sleep(_NAP_S)
        self._require_wanted()
        self._report(Resumed())

    def _arrive(self, stop: Stop) -> PanTilt:
        """Move to a stop and let the unit settle; return the position read back."""
        read = self._unit.move_to(stop.at, check=self._check)
        for source in self._sources.values():
            source.arrived(Arrival(stop.index, read))
        self._report(Moved(stop, read))
        self._rest_for(self.plan.settle_s)
        return read

    def _measure(self, stop: Stop) -> tuple[Record, LineSweep | ScanPiece]:
        read = self._arrive(stop)
        if self.plan.mode == "mosaic":
            return self._measure_frame(stop, read)
        assert self._lines is not None
        if stop.to is not None:
            sweep = measured_pass(self.plan, stop, self._unit, self._lines, check=self._check, clock=self._clock)
        else:
            sweep = self._measure_lines(read)
        photo = self._photograph(stop)
        return self._keep(stop, read, lambda path: write_sweep(path, sweep), photo), sweep

    def _health(self) -> Health:
        """Return what the devices state about themselves."""
        reading = None if self._lines is None else self._lines.last_clock
        clock = {}
        if reading is not None:
            now = self._clock.now()
            clock = {
                "scanner_s": now - reading.host_minus_scanner_s, "host_minus_scanner_s": reading.host_minus_scanner_s,
                "uncertainty_s": reading.uncertainty_s,
            }  # fmt: skip
        return Health(self._unit.supply(), clock)

    def _measure_lines(self, read: PanTilt) -> LineSweep:
        assert self._lines is not None
        with contextlib.closing(self._lines.lines(self.plan.scanner.lines, check=self._check)) as coming:
            lines = list(coming)
        ranges: NDArray[np.float32] = np.stack([line.ranges_m for line in lines])
        light = [line.intensity for line in lines if line.intensity is not None]
        return LineSweep(
            ranges, np.stack(light) if len(light) == len(lines) else None, self._lines.identity.angles_rad,
            np.full(len(lines), read.pan_rad), np.full(len(lines), read.tilt_rad),
        )  # fmt: skip

    def _measure_frame(self, stop: Stop, read: PanTilt) -> tuple[Record, ScanPiece]:
        scan = self._frame(stop)
        photo = self._photograph(stop)
        return self._keep(stop, read, lambda path: write_npz_xyz(path, scan), photo), ScanPiece(scan, read)

    def _frame(self, stop: Stop) -> Scan:
        assert self._frames is not None
        with self._landing(PIECES, stop) as landing:
            scan: Scan = self._read(read_scan, self._frames.next_file(landing, check=self._check))
            return scan

    def _close(self, stop: Stop) -> Closure:
        """Measure the first stop again and compare it with its piece."""
        read = self._arrive(stop)
        first = self.folder.piece(stop.index)
        if isinstance(first, ScanPiece):
            scan = self._frame(stop)
            closure = closure_of_scans(first.scan, scan)
            self.folder.keep_closure(closure, lambda path: write_npz_xyz(path, scan))
            return closure
        again = self._measure_lines(read)
        closure = closure_of_sweep(first, again, self._lines_near(stop), read)
        self.folder.keep_closure(closure, lambda path: write_sweep(path, again))
        return closure

    def _lines_near(self, first: Stop) -> Iterator[LineSweep]:
        """Yield the pieces beside the first stop that show where the unit may have been instead."""
        for stop in self._stops[1:]:
            beside = abs(stop.at.pan_rad - first.at.pan_rad) <= math.radians(SEARCHED_DEG)
            if first.to is None and beside and stop.at.tilt_rad == first.at.tilt_rad:
                piece = self.folder.piece(stop.index)
                assert isinstance(piece, LineSweep)
                yield piece

    def _photograph(self, stop: Stop) -> Path | None:
        if self._camera is None:
            return None
        with self._landing(PHOTOS, stop) as landing:
            came = self._camera.next_file(landing, check=self._check)
            return came.replace(landing.parent / f"{stop.index:03d}{came.suffix}")

    @contextlib.contextmanager
    def _landing(self, kind: str, stop: Stop) -> Iterator[Path]:
        """Give an empty folder for the files of a stop as they come, and remove it."""
        landing = self.folder.path / kind / f".{stop.index:03d}-as-it-came"
        shutil.rmtree(landing, ignore_errors=True)  # of a run that was killed
        landing.mkdir(parents=True)
        try:
            yield landing
        finally:
            shutil.rmtree(landing, ignore_errors=True)

    def _keep(self, stop: Stop, read: PanTilt, write: Callable[[Path], None], photo: Path | None) -> Record:
        stamp = datetime.now(UTC).isoformat(timespec="milliseconds")
        above = self.folder.path / STRAYS / f"{stop.index:03d}"
        strays = [path for name, source in self._sources.items() for path in source.keep_strays(above / name)]
        record = self.folder.keep(
            stop.index,
            write,
            asked=stop.at,
            read=read,
            time=stamp,
            passed=stop.passed,
            photo=photo,
            strays=strays,
            health=self._health(),
        )
        if strays:
            self._report(StraysKept(stop.index, tuple(path.name for path in strays)))
        return record

    def _rest_for(self, seconds: float) -> None:
        until = self._clock.now() + seconds
        while (left := until - self._clock.now()) > 0:
            self._check()
            self._clock.sleep(min(left, _NAP_S))

    def _check(self) -> None:
        """Raise if the run is to be stopped, or a device has been lost: the others must not go on without it."""
        self._require_wanted()
        for device in self._devices:
            device.require_present()

    def _require_wanted(self) -> None:
        if self._stopped.is_set():
            raise Cancelled

    def _find_devices(self) -> None:
        """Exchange something with each device, which opens a port that was lost again."""
        self._unit.position()
        if self._lines is not None:
            self._lines.clock()

    def _rest(self) -> None:
        """Halt the unit and switch the laser off."""
        self._unit.halt()
        if self._lines is not None:
            self._lines.laser_off()
