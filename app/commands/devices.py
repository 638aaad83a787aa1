"""`ladarreg devices`."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from ..exit_codes import ExitCode
from ..messages import one_line

if TYPE_CHECKING:
    from ladarreg_core.acquisition.runs.connected import FoundDevice

EXAMPLES = (
    "ladarreg devices",
    "ladarreg devices /dev/ttyUSB0 /dev/ttyACM0",
    "ladarreg devices twin:flir-ptu?seed=1 twin:scip2?seed=1",
)


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Arguments of `devices`."""

    port: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="[PORT ...]")] = ()
    """Ask what stands at these ports, or at the URL of a head with ONVIF: a unit is halted and a laser switched off by
    it, nothing moves."""
    json: bool = False
    """Print one JSON object, and nothing else, on stdout; errors, too."""
    debug: bool = False
    """Print a log, and a traceback on failure."""


def run(arguments: Arguments) -> ExitCode:
    """List the serial ports, or ask what stands at some."""
    if arguments.port:
        from ladarreg_core.acquisition.runs.connected import identified

        found = [(port, identified(port)) for port in arguments.port]
        if arguments.json:
            print(json.dumps({"devices": [_fields(port, device) for port, device in found]}))
        else:
            for port, device in found:
                print("\n".join(_lines(port, device)))
        return ExitCode.ACCEPTED
    from ladarreg_core.acquisition.serial_port import described_ports, why_shut
    from ladarreg_core.foundations.shell_command import shell_command

    ports = [(port, said, why_shut(port)) for port, said in described_ports()]
    if arguments.json:
        print(json.dumps({"ports": [{"port": port, "is": said, "shut": shut or None} for port, said, shut in ports]}))
        return ExitCode.ACCEPTED
    for port, said, shut in ports:
        print(f"{port}  {one_line(said)}")
        if shut:
            print(f"  {one_line(shut)}")
    if not ports:
        print("No serial port is connected. Without devices, try simulated ones:")
        print(f"  {shell_command(['ladarreg', 'devices', 'twin:flir-ptu?seed=1', 'twin:scip2?seed=1'])}")
    else:
        print(f"What stands there: {shell_command(['ladarreg', 'devices', ports[0][0]])}")
    return ExitCode.ACCEPTED


def _fields(port: str, device: FoundDevice) -> dict[str, Any]:
    return {"port": port, "kind": device.kind, "baud": device.baud, "is": dict(_facts(device))}


def _lines(port: str, device: FoundDevice) -> list[str]:
    part, kind = ("scanner", "line scanner") if device.kind == "scip2" else ("unit", "pan/tilt unit")
    plan = json.dumps({"kind": device.kind, "port": port} | ({} if device.baud is None else {"baud": device.baud}))
    facts = [f"  {name}: {one_line(value)}" for name, value in _facts(device)]
    return [f"{port}: a {kind}", *facts, f'  in a plan: "{part}": {plan}']


def _facts(device: FoundDevice) -> list[tuple[str, str]]:
    from ladarreg_core.acquisition.interfaces import LineScannerIdentity, UnitIdentity

    found = device.identity
    if isinstance(found, UnitIdentity):
        return [
            ("model", found.model),
            ("pan", _span(found.lowest.pan_rad, found.highest.pan_rad, found.resolution_rad.pan_rad)),
            ("tilt", _span(found.lowest.tilt_rad, found.highest.tilt_rad, found.resolution_rad.tilt_rad)),
        ]
    assert isinstance(found, LineScannerIdentity)
    angles = [math.degrees(angle) for angle in (found.angles_rad[0], found.angles_rad[-1])]
    step = (angles[1] - angles[0]) / max(1, len(found.angles_rad) - 1)
    return [
        ("model", found.model),
        ("line", f"{len(found.angles_rad)} rays, {angles[0]:.1f} to {angles[1]:.1f} deg by {step:.3f}"),
        ("range", f"{found.least_range_m:g} to {found.most_range_m:g} m"),
        ("lines a second", f"{1 / found.line_period_s:.0f}"),
        ("intensity", "yes" if found.has_intensity else "no intensity: geometry only"),
    ]


def _span(low: float, high: float, step: float) -> str:
    return f"{math.degrees(low):.1f} to {math.degrees(high):.1f} deg, finest step {math.degrees(step):.4f}"
