"""Plans from the page: what is wrong with them, what they may not do, and the devices that they name."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from ladarreg_core.errors import OptionError

from ...argument_names import as_fields

if TYPE_CHECKING:
    from ladarreg_core.acquisition.interfaces import PanTilt
    from ladarreg_core.acquisition.plan import Plan, PlanFault
    from ladarreg_core.acquisition.runs.connected import Connected

    from ...slices.several import Devices


def devices_slice(devices: Connected, plan: Plan | None) -> Devices:
    """Return connected devices for the slice `acquisition`; those of a plan may be simulated."""
    from ladarreg_core.acquisition.twin_address import is_twin

    unit, scanner = devices.unit.identity, devices.line_scanner
    unit_is_twin = plan is not None and is_twin(plan.unit.port)
    scanner_is_twin = plan is not None and is_twin(plan.scanner.port or "")
    return {
        "unit": f"{unit.model} (simulated)" if unit_is_twin else unit.model,
        "simulated": unit_is_twin,
        "lowest_deg": [in_degrees(unit.lowest.pan_rad), in_degrees(unit.lowest.tilt_rad)],
        "highest_deg": [in_degrees(unit.highest.pan_rad), in_degrees(unit.highest.tilt_rad)],
        "step_deg": [in_degrees(unit.resolution_rad.pan_rad), in_degrees(unit.resolution_rad.tilt_rad)],
        "scanner": None
        if scanner is None
        else f"{scanner.identity.model} (simulated)"
        if scanner_is_twin
        else scanner.identity.model,
        "has_intensity": scanner is None or scanner.identity.has_intensity,
    }


def plan_check(fields: Mapping[str, Any], refused: Sequence[PlanFault], devices: Connected | None) -> dict[str, Any]:
    """Return the faults of a plan, each with its field, as far as they are known, and what its run will be.

    Args:
        fields: the plan, as the page sends it.
        refused: faults found before: folders that may not be watched.
        devices: those that are connected; None: none are.
    """
    from ladarreg_core.acquisition.plan import PlanError
    from ladarreg_core.acquisition.plan_reading import plan_from_fields
    from ladarreg_core.acquisition.runs.stops import device_faults, forecast

    try:
        plan = plan_from_fields(fields, folders_exist=not refused)
    except PlanError as error:
        return {"faults": _faults([*refused, *error.faults]), "forecast": None}
    if refused:
        return {"faults": _faults(refused), "forecast": None}
    scanner = None if devices is None or devices.line_scanner is None else devices.line_scanner.identity
    faults = [] if devices is None else device_faults(plan, devices.unit.identity, scanner)
    ahead = forecast(plan, scanner)
    said = {
        "stops": ahead.stops, "pieces": ahead.pieces, "cells": ahead.cells, "seconds": round(ahead.seconds),
        "overlap": None if ahead.overlap is None else list(ahead.overlap),
    }  # fmt: skip
    return {"faults": _faults(faults), "forecast": said}


def _faults(faults: Sequence[PlanFault]) -> list[dict[str, str]]:
    return [{"field": fault.field, "said": as_fields(fault.text)} for fault in faults]


def require_own_ports(plan: Plan) -> None:
    """Refuse ports that the server does not have: an address would let clients reach into its network.

    Raises:
        OptionError: if the plan has one, or triggers shots by a command.
    """
    from ladarreg_core.acquisition.serial_port import port_names
    from ladarreg_core.acquisition.twin_address import is_twin

    found = plan.scanner.trigger, None if plan.camera is None else plan.camera.trigger
    triggers = [trigger for trigger in found if trigger is not None]
    if any(trigger.command for trigger in triggers):
        raise OptionError(
            "the plan triggers shots by a command, which nobody may have this computer run from a page; run it by "
            "`ladarreg acquire`, or trigger by 'file' or 'port'"
        )
    own = port_names()
    for port in filter(None, (plan.unit.port, plan.scanner.port, *(trigger.port for trigger in triggers))):
        if port not in own and not is_twin(port):
            there = f"its ports are {', '.join(own)}" if own else "it has none"
            raise OptionError(
                f"the computer of the workbench has no port {port[:80]}; {there}, or use a simulated device"
            )


def require_within(devices: Connected, target: PanTilt) -> None:
    """Refuse a position that the unit cannot take.

    Raises:
        OptionError: if it is beyond the unit's limits.
    """
    low, high = devices.unit.identity.lowest, devices.unit.identity.highest
    if not (low.pan_rad <= target.pan_rad <= high.pan_rad and low.tilt_rad <= target.tilt_rad <= high.tilt_rad):
        raise OptionError(
            f"pan {math.degrees(target.pan_rad):.1f}, tilt {math.degrees(target.tilt_rad):.1f} deg is beyond the "
            "unit's limits; take a smaller step"
        )


def in_degrees(angle: float) -> float:
    """Return an angle in degrees, as the page shows it."""
    return round(math.degrees(angle), 4)
