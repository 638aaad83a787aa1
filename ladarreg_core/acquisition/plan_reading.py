"""Reads plans of runs: all faults of a plan are found and listed."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast, get_args
from urllib.parse import urlsplit

import numpy as np

from ladarreg_core.acquisition.mount_fields import base_from_value, base_sigma_from_value, mount_from_fields
from ladarreg_core.acquisition.plan import (
    MAX_STOPS,
    UPRIGHT,
    VERSION,
    Axis,
    CameraPlan,
    Mode,
    Plan,
    PlanError,
    ScannerKind,
    ScannerPlan,
    UnitKind,
    UnitPlan,
    overlap_faults,
)
from ladarreg_core.acquisition.plan_fields import FieldReader, are_numbers, shown
from ladarreg_core.acquisition.trigger import TriggerPlan
from ladarreg_core.acquisition.twin_address import is_twin
from ladarreg_core.errors import FormatError, LadarregError, OptionError
from ladarreg_core.formats.parsing.json_file import read_json_object
from ladarreg_core.formats.parsing.untrusted import shown_name
from ladarreg_core.frames import Rigid

_MAX_LINES = 99
_LONGEST_SETTLE_S = 60.0
_LARGEST_LEVER_M = 5.0
_BAUDS = (300, 4_000_000)
_SAME_DEG = 1e-9
_OF_UNIT = {
    "flir-ptu": ("baud",), "pelco-d": ("baud", "address", "range_deg"), "onvif": ("user", "range_deg"),
}  # fmt: skip
_PORTS = {
    "flir-ptu": "a serial port such as /dev/ttyUSB0 or COM3", "pelco-d": "a serial port such as /dev/ttyUSB0 or COM3",
    "onvif": "the URL of its device service, such as http://192.168.1.64/onvif/device_service",
}  # fmt: skip


def read_plan(path: str | Path) -> Plan:
    """Read a plan.

    Raises:
        FormatError: if the file is not JSON, or the plan has faults, all of which are listed.
    """
    file = Path(path)
    if not file.is_file():
        raise FormatError(f"{shown_name(file)}: there is no such file; give a plan")
    try:
        return plan_from_fields(read_json_object(file, "a plan"))
    except LadarregError as error:
        raise FormatError(f"{shown_name(file)}: {error}") from None


def plan_from_fields(fields: Mapping[str, Any], *, folders_exist: bool = True) -> Plan:
    """Return the plan of the content of `plan.json`.

    Args:
        fields: the content.
        folders_exist: whether the watched folders must be there; not for a run that is only read.

    Raises:
        PlanError: if it has faults, all of them.
    """
    reader = _Reader(folders_exist=folders_exist)
    plan = reader.plan(fields)
    if plan is None or reader.faults:
        raise PlanError(reader.faults)
    return plan


class _Reader(FieldReader):
    """Reads a plan and collects its faults."""

    def plan(self, fields: Mapping[str, Any]) -> Plan | None:
        known = ("version", "unit", "scanner", "camera", "mode", "pan_deg", "tilt_deg", "settle_s", "continuous",
                 "passes", "mount")  # fmt: skip
        self._refuse_unknown(fields, known, "the plan")
        if fields.get("version") != VERSION:
            self._fault("version", f"'version' is {shown(fields.get('version'))}; it must be {VERSION}")
        mode = self._choice(fields, "mode", get_args(Mode), None, "the plan")
        continuous = self._flag(fields, "continuous")
        unit, scanner = self._unit(fields.get("unit")), self._scanner(fields.get("scanner"))
        camera = self._camera(fields.get("camera"))
        pan, tilt = self._axis(fields, "pan_deg", 360.0), self._axis(fields, "tilt_deg", 90.0)
        settle = self._number(fields, "settle_s", 0.3, 0.0, _LONGEST_SETTLE_S, "the plan")
        passes = self._whole(fields, "passes", 2 if continuous else 1, 1, 20, "the plan")
        mount, base = self._mount(fields.get("mount")), self._base(fields.get("mount"))
        base_sigma_deg = self._base_sigma(fields.get("mount"))
        if None in (mode, unit, scanner, pan, tilt, mount, base) or settle is None or passes is None:
            return None
        plan = Plan(
            cast(UnitPlan, unit), cast(ScannerPlan, scanner), cast(Mode, mode), cast(Axis, pan), cast(Axis, tilt),
            cast(Rigid, mount), camera, settle, continuous, passes, cast(Rigid, base),
            base_sigma_deg,
        )  # fmt: skip
        self._check_whole(plan)
        return plan

    def _check_whole(self, plan: Plan) -> None:
        """Note what is wrong with parts that are right by themselves."""
        if plan.mode == "sweep" and plan.scanner.kind != "scip2":
            self._fault(
                "scanner.kind", "'mode' is 'sweep', which needs a scanner of kind 'scip2'; use 'mosaic' for others"
            )
        if plan.mode == "mosaic" and plan.scanner.kind == "scip2":
            self._fault(
                "scanner.kind",
                "'mode' is 'mosaic', which needs a scanner of kind 'folder' or 'packets'; use 'sweep' for this one",
            )
        if plan.mode == "mosaic" and plan.continuous:
            self._fault("continuous", "'continuous' is for sweeps; leave it out of a mosaic")
        if plan.continuous and plan.camera is not None:
            self._fault("camera", "'camera' takes photographs at stops, and a continuous sweep has none; leave it out")
        if plan.continuous and plan.pan.step_deg == 0:
            self._fault("pan_deg", "'continuous' needs a range of pan angles; 'pan_deg' has one")
        if plan.continuous and plan.unit.kind != "flir-ptu":
            self._fault(
                "continuous",
                f"'continuous' reads positions while the unit turns, for which one of kind {plan.unit.kind!r} is too "
                "slow; leave it out, and the unit stops at each column",
            )
        if plan.scanner.kind == "scip2" and plan.scanner.port == plan.unit.port:
            self._fault("scanner.port", f"unit and scanner have the same port {plan.unit.port!r}; each needs its own")
        if plan.camera is not None and plan.camera.folder and plan.camera.folder == plan.scanner.folder:
            self._fault("camera.folder", "scanner and camera have the same folder; each needs its own")
        stops = len(plan.pan.stops_deg) * len(plan.tilt.stops_deg) * plan.passes
        if stops > MAX_STOPS:
            self._fault("pan_deg", f"the plan has {stops:,} stops; at most {MAX_STOPS:,} are made: take larger steps")
        if plan.mode == "mosaic" and plan.scanner.fov_deg is not None:
            self.faults += overlap_faults(plan, plan.scanner.fov_deg)

    def _unit(self, value: Any) -> UnitPlan | None:
        fields = self._object(value, "unit")
        if fields is None:
            return None
        kind = cast(UnitKind | None, self._choice(fields, "kind", get_args(UnitKind), "flir-ptu", "'unit'"))
        if kind is None:
            return None
        known = ("kind", "port", "signs", "speed_deg_s", *_OF_UNIT[kind])
        self._refuse_unknown(fields, known, "'unit'" if kind == "flir-ptu" else f"'unit' of kind {kind!r}")
        port = self._text(fields, "port", "'unit'", _PORTS[kind])
        if port is not None and is_twin(port):
            self._check_twin(fields, "port", "'unit'")
        elif port is not None and kind == "onvif" and urlsplit(port).scheme not in ("http", "https"):
            self._fault("unit.port", f"'port' of 'unit' is {shown(port)}; it must be {_PORTS[kind]}")
        baud = self._whole(fields, "baud", 9600, *_BAUDS, "'unit'")
        signs = fields.get("signs", [1, 1])
        if not (isinstance(signs, list) and len(signs) == 2 and all(type(s) is int and s in (-1, 1) for s in signs)):
            self._fault(
                "unit.signs", f"'signs' of 'unit' is {shown(signs)}; it must be two of 1 and -1, for pan and tilt"
            )
            signs = None
        speed = self._number(fields, "speed_deg_s", math.nan, 1e-3, 1000.0, "'unit'")
        if kind == "pelco-d" and fields.get("speed_deg_s") is not None:
            self._fault("unit.speed_deg_s", "'speed_deg_s' cannot be set at a head with Pelco-D; leave it out")
        address = self._whole(fields, "address", 1, 0, 255, "'unit'")
        user = self._text(fields, "user", "'unit'", "a name, or leave it out") if fields.get("user") else ""
        ranges = self._range(fields)
        if None in (port, baud, signs, speed, address, user):
            return None
        return UnitPlan(
            cast(str, port), kind, cast(int, baud), (signs[0], signs[1]),
            None if math.isnan(cast(float, speed)) else speed, cast(int, address), cast(str, user), ranges,
        )  # fmt: skip

    def _range(self, fields: Mapping[str, Any]) -> tuple[tuple[float, float], tuple[float, float]] | None:
        value = fields.get("range_deg")
        if value is None:
            return None
        if (
            isinstance(value, list | tuple)
            and len(value) == 2
            and all(are_numbers(axis, 2, -360.0, 360.0) and axis[0] < axis[1] for axis in value)
        ):
            pan, tilt = ((float(low), float(high)) for low, high in value)
            return pan, tilt
        self._fault(
            "unit.range_deg",
            f"'range_deg' of 'unit' is {shown(value)}; it must be the lowest and highest pan, and the lowest and "
            "highest tilt, such as [[-180, 180], [-30, 90]]",
        )
        return None

    def _scanner(self, value: Any) -> ScannerPlan | None:
        fields = self._object(value, "scanner")
        if fields is None:
            return None
        kind = self._choice(fields, "kind", get_args(ScannerKind), None, "'scanner'")
        if kind is None:
            return None
        if kind == "scip2":
            self._refuse_unknown(fields, ("kind", "port", "baud", "lines"), "'scanner' of kind 'scip2'")
            port = self._text(fields, "port", "'scanner'", "a serial port such as /dev/ttyACM0 or COM4")
            baud = self._whole(fields, "baud", 115_200, *_BAUDS, "'scanner'")
            lines = self._whole(fields, "lines", 1, 1, _MAX_LINES, "'scanner'")
            return None if port is None or baud is None or lines is None else ScannerPlan(
                "scip2", port=port, baud=baud, lines=lines
            )  # fmt: skip
        if kind == "packets":
            return self._packets(fields)
        self._refuse_unknown(
            fields, ("kind", "folder", "fov_deg", "timeout_s", "trigger"), "'scanner' of kind 'folder'"
        )
        folder = self._folder(fields, "'scanner'")
        timeout = self._number(fields, "timeout_s", 600.0, 1.0, 1e5, "'scanner'")
        fov = self._field_of_view(fields)
        if folder is None or timeout is None:
            return None
        return ScannerPlan(
            "folder", folder=folder, fov_deg=fov, timeout_s=timeout, trigger=self._trigger(fields, "scanner")
        )

    def _packets(self, fields: Mapping[str, Any]) -> ScannerPlan | None:
        known = ("kind", "udp_port", "host", "sensor_file", "fov_deg", "timeout_s")
        self._refuse_unknown(fields, known, "'scanner' of kind 'packets'")
        is_simulated = isinstance(fields.get("host"), str) and is_twin(fields["host"])
        port = self._whole(fields, "udp_port", 0, 0 if is_simulated else 1, 65_535, "'scanner'")
        timeout = self._number(fields, "timeout_s", 10.0, 1.0, 1e5, "'scanner'")
        fov = self._field_of_view(fields)
        example = "a text, or leave it out"
        host = self._text(fields, "host", "'scanner'", example) if fields.get("host") else ""
        if is_simulated:
            self._check_twin(fields, "host", "'scanner'")
        file = self._text(fields, "sensor_file", "'scanner'", example) if fields.get("sensor_file") else ""
        if file and self._folders_exist and not Path(file).expanduser().is_file():
            self._fault(
                "scanner.sensor_file", f"'sensor_file' of 'scanner' is {shown(file)}, which does not exist; correct it"
            )
        if port is None or timeout is None or host is None or file is None:
            return None
        return ScannerPlan("packets", fov_deg=fov, timeout_s=timeout, udp_port=port, host=host, sensor_file=file)

    def _field_of_view(self, fields: Mapping[str, Any]) -> tuple[float, float] | None:
        fov = fields.get("fov_deg")
        if fov is None:
            return None
        if not are_numbers(fov, 2, 0.1, 360.0):
            self._fault(
                "scanner.fov_deg", f"'fov_deg' of 'scanner' is {shown(fov)}; it must be two angles, across and down"
            )
            return None
        return float(fov[0]), float(fov[1])

    def _camera(self, value: Any) -> CameraPlan | None:
        if value is None:
            return None
        fields = self._object(value, "camera")
        if fields is None:
            return None
        self._refuse_unknown(fields, ("folder", "device", "mount", "trigger"), "'camera'")
        if ("folder" in fields) == ("device" in fields):
            self._fault("camera", "'camera' needs either 'folder' or 'device', the number of a video device")
            return None
        mount = None
        if fields.get("mount") is not None:
            mount = self._matrix(fields["mount"])
        if "folder" in fields:
            folder = self._folder(fields, "'camera'")
            trigger = self._trigger(fields, "camera")
            return None if folder is None else CameraPlan(folder=folder, mount=mount, trigger=trigger)
        if "trigger" in fields:
            self._fault("camera.trigger", "'trigger' is for a camera with a folder; a video device needs none")
        device = self._whole(fields, "device", 0, 0, 99, "'camera'")
        return None if device is None else CameraPlan(device=device, mount=mount)

    def _trigger(self, fields: Mapping[str, Any], part: str) -> TriggerPlan | None:
        if fields.get("trigger") is None:
            return None
        try:
            return TriggerPlan.from_fields(fields["trigger"])
        except OptionError as error:
            self._fault(f"{part}.trigger", f"'trigger' of {part!r} is {shown(fields['trigger'])}: {error}")
            return None

    def _axis(self, fields: Mapping[str, Any], name: str, most: float) -> Axis | None:
        value = fields.get(name, [0.0, 0.0, 0.0] if name == "tilt_deg" else None)
        if not are_numbers(value, 3, -3 * most, 3 * most):
            self._fault(name, f"{name!r} is {shown(value)}; it must be three angles: from, to and step")
            return None
        first, last, step = (float(v) for v in value)
        if abs(first) > most or abs(last) > most:
            self._fault(name, f"{name!r} goes from {first:g} to {last:g} deg; angles lie within {most:g} to both sides")
            return None
        if abs(last - first) < _SAME_DEG:
            return Axis(first, first, 0.0)
        if step == 0:
            self._fault(name, f"{name!r} goes from {first:g} to {last:g} deg by steps of 0; give a step")
            return None
        if (last - first) * step < 0:
            self._fault(
                name,
                f"{name!r} goes from {first:g} to {last:g} deg by steps of {step:g}, which lead away; change the sign",
            )
            return None
        if abs(step) > abs(last - first) + _SAME_DEG:
            self._fault(name, f"{name!r} goes from {first:g} to {last:g} deg by steps of {step:g}, beyond its end")
            return None
        return Axis(first, last, step)

    def _mount(self, value: Any) -> Rigid | None:
        fields = self._object(value, "mount")
        if fields is None:
            return None
        self._refuse_unknown(fields, ("xyz_m", "rpy_deg", "base", "base_sigma_deg"), "'mount'")
        xyz, rpy = fields.get("xyz_m"), fields.get("rpy_deg")
        good = True
        if not are_numbers(xyz, 3, -_LARGEST_LEVER_M, _LARGEST_LEVER_M):
            self._fault("mount.xyz_m", f"'xyz_m' of 'mount' is {shown(xyz)}; it must be three lengths within 5 m")
            good = False
        if not are_numbers(rpy, 3, -360.0, 360.0):
            self._fault(
                "mount.rpy_deg", f"'rpy_deg' of 'mount' is {shown(rpy)}; it must be roll, pitch and yaw in degrees"
            )
            good = False
        if not good:
            return None
        return mount_from_fields(fields)

    def _base(self, mount: Any) -> Rigid | None:
        value = mount.get("base") if isinstance(mount, Mapping) else None
        try:
            return UPRIGHT if value is None else base_from_value(value)
        except FormatError as error:
            self._fault("mount.base", f"'base' of 'mount': {error}")
            return None

    def _base_sigma(self, mount: Any) -> tuple[float, float] | None:
        value = mount.get("base_sigma_deg") if isinstance(mount, Mapping) else None
        try:
            return None if value is None else base_sigma_from_value(value)
        except FormatError as error:
            self._fault("mount.base_sigma_deg", f"'base_sigma_deg' of 'mount': {error}")
            return None

    def _matrix(self, value: Any) -> Rigid | None:
        try:
            return Rigid.from_matrix(np.array(value, np.float64))
        except (LadarregError, ValueError, TypeError) as error:
            self._fault(
                "camera.mount", f"'mount' of 'camera' is no pose ({str(error)[:120]}); it must be 4 x 4, or null"
            )
            return None
