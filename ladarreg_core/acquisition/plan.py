"""The plan of a run: the devices, the stops and how the scanner is mounted; as a file, `plan.json`."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NotRequired, TypedDict

from ladarreg_core.acquisition.mount_fields import (
    base_as_value,
    is_upright,
    mount_as_fields,
    mount_from_fields,
)
from ladarreg_core.acquisition.trigger import TriggerPlan
from ladarreg_core.errors import OptionError
from ladarreg_core.frames import Rigid
from ladarreg_core.storage.atomic_write import replaced_file, write_bytes

Mode = Literal["sweep", "mosaic"]
"""`sweep`: a line scanner, every pan step is a column; `mosaic`: a scanner with a field of view, pieces overlap."""
UnitKind = Literal["flir-ptu", "pelco-d", "onvif"]
"""Protocol of a pan/tilt unit."""
ScannerKind = Literal["scip2", "folder", "packets"]

VERSION = 1
MAX_STOPS = 100_000
UPRIGHT = Rigid.identity()
"""`level_from_unit` of a unit that stands upright."""


class UnitFields(TypedDict):
    """The unit of a plan, as `plan.json` states it."""

    kind: UnitKind
    port: str
    baud: NotRequired[int]
    signs: list[int]
    address: NotRequired[int]
    user: NotRequired[str]
    range_deg: NotRequired[list[list[float]]]
    speed_deg_s: NotRequired[float]


class ScannerFields(TypedDict):
    """The scanner of a plan, as `plan.json` states it."""

    kind: ScannerKind
    port: NotRequired[str]
    baud: NotRequired[int]
    lines: NotRequired[int]
    udp_port: NotRequired[int]
    host: NotRequired[str]
    sensor_file: NotRequired[str]
    folder: NotRequired[str]
    timeout_s: NotRequired[float]
    fov_deg: NotRequired[list[float]]
    trigger: NotRequired[dict[str, Any]]


class CameraFields(TypedDict):
    """The camera of a plan, as `plan.json` states it."""

    folder: NotRequired[str]
    device: NotRequired[int | None]
    mount: list[list[float]] | None
    trigger: NotRequired[dict[str, Any]]


class MountFields(TypedDict):
    """How the scanner is mounted, as `plan.json` states it."""

    xyz_m: list[float]
    rpy_deg: list[float]
    base: NotRequired[str | list[float]]
    base_sigma_deg: NotRequired[list[float]]


class PlanFields(TypedDict):
    """The content of `plan.json`."""

    version: int
    unit: UnitFields
    scanner: ScannerFields
    camera: CameraFields | None
    mode: Mode
    pan_deg: list[float]
    tilt_deg: list[float]
    settle_s: float
    continuous: bool
    passes: int
    mount: MountFields


@dataclass(frozen=True, slots=True)
class UnitPlan:
    """How the pan/tilt unit is reached."""

    port: str
    """Serial port, pyserial URL, or `twin:NAME?seed=N`; of `onvif`, the URL of the device service."""
    kind: UnitKind = "flir-ptu"
    baud: int = 9600
    signs: tuple[int, int] = (1, 1)
    """Sign of pan and tilt, -1 for an axis that turns the other way."""
    speed_deg_s: float | None = None
    """Speed of both axes; None: as the unit is set."""
    address: int = 1
    """Of a `pelco-d` head on its line."""
    user: str = ""
    """Name at an `onvif` head, whose password is in the environment; empty: it asks for none."""
    range_deg: tuple[tuple[float, float], tuple[float, float]] | None = None
    """Lowest and highest pan and tilt as the unit counts them, left and up positive, where it does not state them."""


@dataclass(frozen=True, slots=True)
class ScannerPlan:
    """How the scanner is reached: a port for `scip2`, a watched folder for `folder`, a UDP port for `packets`."""

    kind: ScannerKind
    port: str = ""
    baud: int = 115_200
    folder: str = ""
    fov_deg: tuple[float, float] | None = None
    """Field of view of a scanner that makes pieces, across and down; None: learnt from its first file."""
    lines: int = 1
    """Lines that a line scanner measures at each stop of a sweep."""
    timeout_s: float = 600.0
    """Longest wait for the next file of a folder, or for a whole revolution of a spinning lidar."""
    trigger: TriggerPlan | None = None
    """What starts a shot of a scanner with a folder; None: a person, or its software."""
    udp_port: int = 0
    """Where a spinning lidar sends its packets; of a simulated one, it is not needed."""
    host: str = ""
    """Its address, or `twin:velodyne?seed=N`; empty: whatever sends there, if it is only one."""
    sensor_file: str = ""
    """Description of the lidar that its packets are read by, for an Ouster its metadata JSON; empty: none is needed."""


@dataclass(frozen=True, slots=True)
class CameraPlan:
    """A camera that takes one photograph a stop: a watched folder, or a video device."""

    folder: str = ""
    device: int | None = None
    mount: Rigid | None = None
    """`unit_from_camera`, if it is known."""
    trigger: TriggerPlan | None = None
    """What starts a photograph of a camera with a folder; None: its software."""


@dataclass(frozen=True, slots=True)
class Axis:
    """The stops of one axis: from, to and step, deg; a step of 0 where both ends are equal."""

    first_deg: float
    last_deg: float
    step_deg: float

    @property
    def stops_deg(self) -> tuple[float, ...]:
        """The stops; the last one is where the axis ends, if a step does not lead beyond it."""
        if self.step_deg == 0:
            return (self.first_deg,)
        count = math.floor((self.last_deg - self.first_deg) / self.step_deg + 1e-6) + 1
        return tuple(self.first_deg + k * self.step_deg for k in range(count))


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
    base: Rigid = UPRIGHT
    """`level_from_unit`, a rotation: how the unit itself stands or hangs."""
    base_sigma_deg: tuple[float, float] | None = None
    """Standard deviations of its roll and pitch, deg; None: not known."""

    def as_fields(self) -> PlanFields:
        """Return the content of `plan.json`."""
        mount = mount_as_fields(self.mount)
        mounted: MountFields = {"xyz_m": mount["xyz_m"], "rpy_deg": mount["rpy_deg"]}
        if not is_upright(self.base):
            mounted["base"] = base_as_value(self.base)
        if self.base_sigma_deg is not None:
            mounted["base_sigma_deg"] = list(self.base_sigma_deg)
        return {
            "version": VERSION,
            "unit": self._unit_fields(),
            "scanner": self._scanner_fields(),
            "camera": self._camera_fields(),
            "mode": self.mode,
            "pan_deg": [self.pan.first_deg, self.pan.last_deg, self.pan.step_deg],
            "tilt_deg": [self.tilt.first_deg, self.tilt.last_deg, self.tilt.step_deg],
            "settle_s": self.settle_s,
            "continuous": self.continuous,
            "passes": self.passes,
            "mount": mounted,
        }

    def _scanner_fields(self) -> ScannerFields:
        scanner = self.scanner
        found: ScannerFields = {"kind": scanner.kind}
        if scanner.kind == "scip2":
            found.update({"port": scanner.port, "baud": scanner.baud, "lines": scanner.lines})
        elif scanner.kind == "packets":
            found.update({"udp_port": scanner.udp_port, "timeout_s": scanner.timeout_s})
            if scanner.host:
                found["host"] = scanner.host
            if scanner.sensor_file:
                found["sensor_file"] = scanner.sensor_file
        else:
            found.update({"folder": scanner.folder, "timeout_s": scanner.timeout_s})
        if scanner.fov_deg is not None:
            found["fov_deg"] = list(scanner.fov_deg)
        if scanner.trigger is not None:
            found["trigger"] = scanner.trigger.as_fields()
        return found

    def _unit_fields(self) -> UnitFields:
        unit = self.unit
        found: UnitFields = {"kind": unit.kind, "port": unit.port, "baud": unit.baud, "signs": list(unit.signs)}
        if unit.kind == "pelco-d":
            found["address"] = unit.address
        elif unit.kind == "onvif":
            del found["baud"]
            if unit.user:
                found["user"] = unit.user
        if unit.range_deg is not None:
            found["range_deg"] = [list(axis) for axis in unit.range_deg]
        if unit.speed_deg_s is not None:
            found["speed_deg_s"] = unit.speed_deg_s
        return found

    def _camera_fields(self) -> CameraFields | None:
        camera = self.camera
        if camera is None:
            return None
        mount = None if camera.mount is None else camera.mount.matrix.tolist()
        found: CameraFields = (
            {"folder": camera.folder, "mount": mount} if camera.folder else {"device": camera.device, "mount": mount}
        )
        if camera.trigger is not None:
            found["trigger"] = camera.trigger.as_fields()
        return found


def example_plan() -> Plan:
    """Return a plan to edit: a sweep over half a turn with simulated devices."""
    return Plan(
        UnitPlan("twin:flir-ptu?seed=1", baud=115_200),
        ScannerPlan("scip2", "twin:scip2?seed=1"),
        "sweep",
        Axis(-90.0, 90.0, 2.0),
        Axis(0.0, 0.0, 0.0),
        mount_from_fields({"xyz_m": [0.06, 0.0, 0.08], "rpy_deg": [90.0, 0.0, 0.0]}),
        settle_s=0.1,
    )


def write_plan(path: str | Path, plan: Plan) -> None:
    """Write a plan.

    Raises:
        ExportError: if the file cannot be written.
    """
    with replaced_file(path) as new:
        write_bytes(new, (json.dumps(plan.as_fields(), indent=1) + "\n").encode())


@dataclass(frozen=True, slots=True)
class PlanFault:
    """A fault of a plan."""

    field: str
    """Where it is, such as `pan_deg` or `scanner.folder`; a part's name, or empty, if it is no single field."""
    text: str


class PlanError(OptionError):
    """A plan that cannot be used; its text lists all faults."""

    def __init__(self, faults: Sequence[PlanFault]) -> None:
        super().__init__(f"the plan has {listed_faults(faults)}")
        self.faults = tuple(faults)


def listed_faults(faults: Sequence[PlanFault]) -> str:
    """Return faults as one text: `a fault: ...`, or `2 faults: (1) ...; (2) ...`."""
    if len(faults) == 1:
        return f"a fault: {faults[0].text}"
    return f"{len(faults)} faults: " + "; ".join(f"({k}) {fault.text}" for k, fault in enumerate(faults, 1))


def overlap_faults(plan: Plan, fov_deg: tuple[float, float]) -> list[PlanFault]:
    """Return what is wrong with the steps of a mosaic, given the field of view of its pieces, across and down."""
    faults = []
    for name, axis, fov in (("pan_deg", plan.pan, fov_deg[0]), ("tilt_deg", plan.tilt, fov_deg[1])):
        if abs(axis.step_deg) >= fov:
            text = (
                f"{name!r} has steps of {abs(axis.step_deg):g} deg, and a piece is {fov:.3g} deg wide: pieces do not "
                f"overlap; take steps of {0.85 * fov:.3g} deg or less"
            )
            faults.append(PlanFault(name, text))
    return faults
