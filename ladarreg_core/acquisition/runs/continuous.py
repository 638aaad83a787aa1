"""One pass of a continuous sweep: lines measured while the unit turns, and its readings on the scanner's clock."""

from __future__ import annotations

import contextlib
import math
import threading

import numpy as np

from ladarreg_core.acquisition.clock import REAL_CLOCK, Clock
from ladarreg_core.acquisition.interfaces import Check, LineScanner, PanTilt, PanTiltUnit
from ladarreg_core.acquisition.line_sweep import LineSweep, UnitTrack
from ladarreg_core.acquisition.plan import Plan
from ladarreg_core.acquisition.runs.stops import Stop
from ladarreg_core.errors import DeviceError

_READ_EVERY_S = 0.03
_SPARE_LINES = 20
_MIN_READINGS = 4
_STILL_S = 0.3
_CLOCKS_APART_S, _DRIFT = 0.1, 1e-3


def measured_pass(
    plan: Plan, stop: Stop, unit: PanTiltUnit, scanner: LineScanner, *, check: Check, clock: Clock = REAL_CLOCK
) -> LineSweep:
    """Measure a pass; the unit stands at its beginning.

    The unit has no clock: its readings are stamped by the host when they arrive, and mapped to the scanner's clock.
    What remains, one constant latency, is found with the mount.

    Raises:
        DeviceError: if a device fails.
        Cancelled: if `check` raises it.
    """
    assert stop.to is not None
    identity = scanner.identity
    speed = abs(math.radians(plan.pan.step_deg)) / identity.line_period_s
    before = unit.identity.speed_rad_s
    unit.set_speed(PanTilt(speed, before.tilt_rad))
    try:
        duration = abs(stop.to.pan_rad - stop.at.pan_rad) / speed
        count = math.ceil(duration / identity.line_period_s) + _SPARE_LINES
        host_minus_scanner = scanner.clock().host_minus_scanner_s
        reader = _Reader(unit, clock)
        unit.start_move(stop.to)
        reader.start()
        try:
            lines = []
            with contextlib.closing(scanner.lines(count, check=check)) as coming:
                for line in coming:
                    lines.append(line)
                    if reader.error is not None:
                        raise reader.error
                    if reader.arrived(stop.to):
                        break
        finally:
            reader.stop()
        if reader.error is not None:
            raise reader.error
    finally:
        unit.set_speed(before)
    after = scanner.clock().host_minus_scanner_s
    if abs(after - host_minus_scanner) > _CLOCKS_APART_S + _DRIFT * duration:
        raise DeviceError(
            f"the scanner's clock moved by {after - host_minus_scanner:+.2f} s against the computer's during a pass; "
            "the scanner was connected anew: resume"
        )
    times, pan, tilt = reader.readings()
    if len(times) < _MIN_READINGS or not lines:
        raise DeviceError(
            f"the unit was read {len(times)} times and the scanner gave {len(lines)} lines during a pass, too few; "
            "sweep more slowly, or use a higher baud rate"
        )
    track = UnitTrack(times - 0.5 * (host_minus_scanner + after), pan, tilt)
    light = [line.intensity for line in lines if line.intensity is not None]
    return LineSweep.moving(
        np.stack([line.ranges_m for line in lines]),
        np.stack(light) if len(light) == len(lines) else None,
        identity.angles_rad,
        time_s=np.array([line.time_s for line in lines]),
        sweep_s=identity.sweep_s,
        track=track,
    )


class _Reader:
    """Reads the unit's position on a thread of its own."""

    def __init__(self, unit: PanTiltUnit, clock: Clock) -> None:
        self.error: DeviceError | None = None
        self._unit, self._clock = unit, clock
        self._found: list[tuple[float, float, float]] = []
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._read, daemon=True, name="unit positions")

    def start(self) -> None:
        self._clock.start(self._thread)

    def stop(self) -> None:
        self._ended.set()
        self._clock.join(self._thread)

    def arrived(self, at: PanTilt) -> bool:
        """Return whether it has stood at the end for a while."""
        step = 1.5 * self._unit.identity.resolution_rad.pan_rad
        recent = [pan for when, pan, _ in self._found if when > self._clock.now() - _STILL_S]
        return len(recent) > 1 and all(abs(pan - at.pan_rad) <= step for pan in recent)

    def readings(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return host times, s, and pan and tilt, rad, of the readings (K,)."""
        times, pan, tilt = np.array(self._found or np.zeros((0, 3)), np.float64).T
        return times, pan, tilt

    def _read(self) -> None:
        while not self._ended.is_set():
            begun = self._clock.now()
            try:
                at = self._unit.position()
            except DeviceError as error:
                self.error = error
                return
            self._found.append((self._clock.now(), at.pan_rad, at.tilt_rad))
            self._clock.wait(self._ended, max(0.0, _READ_EVERY_S - (self._clock.now() - begun)))
