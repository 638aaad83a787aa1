"""The stops of a plan in the order of a run, and what is known before anything moves."""

from __future__ import annotations

import math
from dataclasses import dataclass

from ladarreg_core.acquisition.interfaces import LineScannerIdentity, PanTilt, UnitIdentity
from ladarreg_core.acquisition.plan import Plan, PlanFault, listed_faults, overlap_faults
from ladarreg_core.errors import OptionError

_USUAL_SPEED_DEG_S = 30.0
_MOVE_OVERHEAD_S = 0.35
_LINE_S = 0.3
_FRAME_S = 60.0
_REVOLUTION_S = 0.5  # about two of a lidar at 10 Hz, and their reading
_READING_S = 0.08
_PARTING_DEG = 0.01


@dataclass(frozen=True, slots=True)
class Stop:
    """One piece of a run: a position, or the two ends of a continuous pass."""

    index: int
    at: PanTilt
    """Where it is measured; of a continuous pass, where it begins."""
    to: PanTilt | None = None
    """Where a continuous pass ends."""
    passed: int = 0
    """Number of the pass at its tilt."""


def stops_of(plan: Plan) -> list[Stop]:
    """Return the stops of a plan, in an order with short moves: back and forth over the pan at each tilt."""
    pans = [math.radians(v) for v in plan.pan.stops_deg]
    tilts = [math.radians(v) for v in plan.tilt.stops_deg]
    stops: list[Stop] = []
    forward = True
    for tilt in tilts:
        for passed in range(plan.passes):
            order = pans if forward else pans[::-1]
            forward = not forward
            if plan.continuous:
                ends = math.radians(plan.pan.first_deg), math.radians(plan.pan.last_deg)
                first, last = ends if not forward else ends[::-1]
                stops.append(Stop(len(stops), PanTilt(first, tilt), PanTilt(last, tilt), passed))
            else:
                stops += [Stop(len(stops) + k, PanTilt(pan, tilt), None, passed) for k, pan in enumerate(order)]
    return stops


def device_faults(plan: Plan, unit: UnitIdentity, line_scanner: LineScannerIdentity | None = None) -> list[PlanFault]:
    """Return what the devices cannot do of a plan, found before anything moves."""
    faults: list[PlanFault] = []
    axes = (
        ("pan_deg", plan.pan, unit.lowest.pan_rad, unit.highest.pan_rad, unit.resolution_rad.pan_rad),
        ("tilt_deg", plan.tilt, unit.lowest.tilt_rad, unit.highest.tilt_rad, unit.resolution_rad.tilt_rad),
    )
    for name, axis, low, high, step in axes:
        least, most = math.degrees(low) - _PARTING_DEG, math.degrees(high) + _PARTING_DEG
        ends = (axis.first_deg, axis.last_deg)
        if min(ends) < least or max(ends) > most:
            text = (
                f"{name!r} goes from {axis.first_deg:g} to {axis.last_deg:g} deg, and the unit's limits are "
                f"{math.degrees(low):.2f} to {math.degrees(high):.2f}; stay within them"
            )
            faults.append(PlanFault(name, text))
        if 0 < abs(axis.step_deg) < math.degrees(step) * 0.999:
            text = (
                f"{name!r} has steps of {axis.step_deg:g} deg, finer than the unit's {math.degrees(step):.4f}; take "
                "larger steps"
            )
            faults.append(PlanFault(name, text))
    if plan.mode == "mosaic" and plan.scanner.fov_deg is not None:
        faults += overlap_faults(plan, plan.scanner.fov_deg)
    if plan.continuous and line_scanner is not None:
        speed = abs(math.radians(plan.pan.step_deg)) / line_scanner.line_period_s
        if speed < 2 * unit.resolution_rad.pan_rad:
            text = "'pan_deg' has steps so fine that the unit cannot turn slowly enough; take larger steps"
            faults.append(PlanFault("pan_deg", text))
    return faults


def require_possible(plan: Plan, unit: UnitIdentity, line_scanner: LineScannerIdentity | None = None) -> None:
    """Raise an error that lists what the devices cannot do of a plan.

    Raises:
        OptionError: if there is anything.
    """
    faults = device_faults(plan, unit, line_scanner)
    if faults:
        raise OptionError(f"the plan cannot be run on these devices; it has {listed_faults(faults)}")


@dataclass(frozen=True, slots=True)
class Forecast:
    """What a run will be, as far as it is known without the devices."""

    stops: int
    pieces: int
    overlap: tuple[float, float] | None
    """Share of a piece that its neighbour repeats, across and down; None if the field of view is not known."""
    cells: int | None
    """Cells of the panorama of a sweep, about; None for a mosaic."""
    seconds: float
    """Duration, about."""


def forecast(plan: Plan, line_scanner: LineScannerIdentity | None = None, *, rays: int = 1081) -> Forecast:
    """Return what a run of a plan will be.

    Args:
        plan: the plan.
        line_scanner: the connected scanner; None: a usual one is assumed.
        rays: rays of a line where no scanner is connected.
    """
    stops = stops_of(plan)
    speed = plan.unit.speed_deg_s or _USUAL_SPEED_DEG_S
    period = line_scanner.line_period_s if line_scanner else 0.025
    rays = len(line_scanner.angles_rad) if line_scanner else rays
    seconds = 0.0
    here = PanTilt(0.0, 0.0)
    for stop in stops:
        way = max(abs(stop.at.pan_rad - here.pan_rad), abs(stop.at.tilt_rad - here.tilt_rad))
        seconds += math.degrees(way) / speed + _MOVE_OVERHEAD_S + plan.settle_s
        here = stop.to or stop.at
        if stop.to is not None:
            seconds += abs(plan.pan.last_deg - plan.pan.first_deg) / max(abs(plan.pan.step_deg), 1e-9) * period
        elif plan.mode == "sweep":
            seconds += _LINE_S + plan.scanner.lines * period
        else:
            seconds += _REVOLUTION_S if plan.scanner.kind == "packets" else _FRAME_S
        if plan.camera is not None:
            seconds += 1.0
    overlap = None
    if plan.mode == "mosaic" and plan.scanner.fov_deg is not None:
        shares = [
            1 - abs(axis.step_deg) / fov if axis.step_deg else 1.0
            for axis, fov in zip((plan.pan, plan.tilt), plan.scanner.fov_deg, strict=True)
        ]
        overlap = shares[0], shares[1]
    columns = len(plan.pan.stops_deg) * len(plan.tilt.stops_deg)
    cells = columns * rays if plan.mode == "sweep" else None
    return Forecast(len(plan.pan.stops_deg) * len(plan.tilt.stops_deg), len(stops), overlap, cells, seconds)
