"""The plan of a run: the devices, the stops and how the scanner is mounted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from ladarreg_core.frames import Rigid

Mode = Literal["sweep", "mosaic"]
"""`sweep`: a line scanner, every pan step is a column; `mosaic`: a scanner with a field of view, pieces overlap."""


@dataclass(frozen=True, slots=True)
class UnitPlan:
    """How the pan/tilt unit is reached."""

    port: str
    """Serial port, pyserial URL, or `twin:NAME?seed=N`."""
    kind: Literal["flir-ptu"] = "flir-ptu"
    baud: int = 9600
    signs: tuple[int, int] = (1, 1)
    """Sign of pan and tilt, -1 for an axis that turns the other way."""


@dataclass(frozen=True, slots=True)
class ScannerPlan:
    """How the scanner is reached: a port for `scip2`, a watched folder for `folder`."""

    kind: Literal["scip2", "folder"]
    port: str = ""
    baud: int = 115_200
    folder: str = ""


@dataclass(frozen=True, slots=True)
class CameraPlan:
    """A camera that takes one photograph a stop."""

    folder: str = ""
    """Watched folder."""
    device: int | None = None
    """Number of a video device."""
    mount: Rigid | None = None
    """`unit_from_camera`, if it is known."""


@dataclass(frozen=True, slots=True)
class Axis:
    """The stops of one axis: from, to and step, deg; a step of 0 where both ends are equal."""

    first_deg: float
    last_deg: float
    step_deg: float


@dataclass(frozen=True, slots=True)
class Plan:
    """A plan, as `plan.json` states it."""

    unit: UnitPlan
    scanner: ScannerPlan
    mode: Mode
    pan: Axis
    tilt: Axis
    mount: Rigid
    """`unit_from_scanner`."""
    camera: CameraPlan | None = None
    settle_s: float = 0.3
    """Rest after each move before measuring."""
    continuous: bool = False
    """Sweep without stopping: the unit turns at a constant speed while lines are measured."""
    passes: int = 1
    """Sweeps at each tilt, in alternating directions."""
