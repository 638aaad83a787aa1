"""The devices of a plan, connected; and what stands at a port, asked without moving or lighting anything."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from ladarreg_core.acquisition.clock import REAL_CLOCK, Clock
from ladarreg_core.acquisition.devices.flir_unit import FlirUnit
from ladarreg_core.acquisition.devices.folder_source import FolderSource
from ladarreg_core.acquisition.devices.onvif_unit import OnvifUnit
from ladarreg_core.acquisition.devices.packet_stream import PacketStream
from ladarreg_core.acquisition.devices.pelco_unit import PelcoUnit
from ladarreg_core.acquisition.devices.ports import GuardEndedError, Ports, PortSource
from ladarreg_core.acquisition.devices.scip_scanner import ScipScanner
from ladarreg_core.acquisition.devices.video_camera import VideoCamera
from ladarreg_core.acquisition.interfaces import FrameSource, Read, read_here
from ladarreg_core.acquisition.plan import CameraPlan, Plan, ScannerPlan, UnitPlan
from ladarreg_core.acquisition.runs.run_folder import RunWriter
from ladarreg_core.acquisition.runs.runner import EventReport, Run
from ladarreg_core.acquisition.twin_address import is_twin, packet_source, resolved_twin, watched_folder
from ladarreg_core.errors import DeviceError
from ladarreg_core.formats import read_scan
from ladarreg_core.formats.photos.image_file import require_image
from ladarreg_core.formats.scans.scan_files import scan_files

_PHOTO_S = 60.0
_UNIT_BAUDS = (9600, 115_200, 19_200, 38_400)
_SCANNER_BAUDS = (115_200, 19_200)
_HEAD_BAUDS = (2400, 9600, 4800)
_TO_TRY = (("flir-ptu", _UNIT_BAUDS), ("scip2", _SCANNER_BAUDS), ("pelco-d", _HEAD_BAUDS))

OpenPorts = Callable[[], AbstractContextManager[PortSource]]
"""Gives the ports of a run, and closes them at its end."""


Unit = FlirUnit | PelcoUnit | OnvifUnit
"""A pan/tilt unit, by the protocol that the plan names."""


@dataclass(frozen=True, slots=True)
class Connected:
    """The devices of a plan."""

    unit: Unit
    line_scanner: ScipScanner | None
    frames: FrameSource | None
    camera: FrameSource | None
    clock: Clock = REAL_CLOCK
    """The one that they live by."""
    read: Read = read_here
    """Reads the files of a watched folder."""

    def run(self, plan: Plan, folder: RunWriter, report: EventReport) -> Run:
        """Return a run of a plan on these devices.

        Raises:
            OptionError: if they cannot run it.
        """
        for device in (self.unit, self.line_scanner):
            if device is not None:
                device.link.log_to(folder.exchanges.add)
        return Run(
            plan, folder, unit=self.unit, line_scanner=self.line_scanner, frames=self.frames, camera=self.camera,
            report=report, clock=self.clock, read=self.read,
        )  # fmt: skip


@contextmanager
def connected(plan: Plan, *, ports: OpenPorts = Ports, read: Read = read_here) -> Iterator[Connected]:
    """Connect to the devices of a plan, halted and dark, and disconnect at the end.

    Args:
        plan: the plan.
        ports: opens the ports; by default real ones, which a guard holds.
        read: reads the files of a watched folder; by default in this process.

    Raises:
        DeviceError: if one cannot be reached.
    """
    with ExitStack() as stack:
        yield _connect(plan, stack, ports=ports, read=read)


def _connect(plan: Plan, stack: ExitStack, *, ports: OpenPorts, read: Read) -> Connected:
    """Return the devices, disconnected by `stack`; once more if this program hung for a moment meanwhile."""
    for last in (False, False, True):
        try:
            with ExitStack() as attempt:
                devices = _connect_once(plan, attempt, ports=ports, read=read)
                stack.push(attempt.pop_all())
                return devices
        except GuardEndedError as error:
            if last or not error.hung:
                raise
    raise AssertionError("the last attempt returns or raises")


def _connect_once(plan: Plan, stack: ExitStack, *, ports: OpenPorts, read: Read) -> Connected:
    opened = stack.enter_context(ports())
    unit = _unit(opened, plan.unit)
    stack.callback(unit.close)
    line_scanner: ScipScanner | None = None
    frames: FrameSource | None = None
    if plan.scanner.kind == "scip2":
        line_scanner = ScipScanner.connect(opened, plan.scanner)
        stack.callback(line_scanner.close)
    else:
        frames = _frames(plan.scanner, opened.clock, read)
        stack.callback(frames.close)
    camera = None if plan.camera is None else _camera(plan.camera, opened.clock, read)
    if camera is not None:
        stack.callback(camera.close)
    return Connected(unit, line_scanner, frames, camera, opened.clock, read)


def _unit(ports: PortSource, plan: UnitPlan) -> Unit:
    match plan.kind:
        case "flir-ptu":
            return FlirUnit.connect(ports, plan)
        case "pelco-d":
            return PelcoUnit.connect(ports, plan)
        case "onvif":
            return OnvifUnit.connect(plan, clock=ports.clock)


@dataclass(frozen=True, slots=True)
class FoundDevice:
    """What stands at a port."""

    kind: str
    """As in a plan: of a unit `flir-ptu`, `pelco-d` or `onvif`, of a line scanner `scip2`."""
    baud: int | None
    """Of its port; None: it is reached by the network."""
    identity: object
    """`UnitIdentity` or `LineScannerIdentity`."""


def identified(address: str) -> FoundDevice:
    """Return what stands at a port; the unit is halted and the laser switched off by asking, nothing else is done.

    Args:
        address: a port, or the URL of the device service of a head with ONVIF.

    Raises:
        DeviceError: if the port cannot be opened, or nothing known answers.
    """
    found_at = resolved_twin(address) if is_twin(address) else address
    if found_at.startswith(("http://", "https://")):
        head = OnvifUnit.connect(UnitPlan(found_at, "onvif"))
        head.close()
        return FoundDevice("onvif", None, head.identity)
    tried = []
    with Ports() as ports:  # one guard for all attempts
        for kind, bauds in _TO_TRY:
            for baud in bauds if "://" not in address and ":" not in address else bauds[:1]:
                try:
                    device: FlirUnit | PelcoUnit | ScipScanner
                    if kind == "flir-ptu":
                        device = FlirUnit.connect(ports, UnitPlan(address, baud=baud), patience_s=0.0)
                    elif kind == "pelco-d":
                        device = PelcoUnit.connect(ports, UnitPlan(address, "pelco-d", baud))
                    else:
                        device = ScipScanner.connect(ports, ScannerPlan("scip2", address, baud=baud))
                except DeviceError as error:
                    tried.append(str(error))
                    ports.release(address)
                    if not tried[0].startswith("the pan/tilt unit"):
                        raise  # the port itself cannot be used
                    continue
                found = FoundDevice(kind, baud, device.identity)
                device.close()
                return found
    raise DeviceError(
        f"neither a pan/tilt unit nor a line scanner answers on {address}; check that it is switched on, and "
        "that the port is its"
    )


def _frames(plan: ScannerPlan, clock: Clock, read: Read) -> FrameSource:
    if plan.kind == "packets":
        host, port = packet_source(plan.host, plan.udp_port)
        return PacketStream(
            port,
            host=host,
            sensor_file=Path(plan.sensor_file).expanduser() if plan.sensor_file else None,
            is_readable=partial(read, read_scan),
            timeout_s=plan.timeout_s,
            clock=clock,
        )
    return FolderSource(
        watched_folder(plan.folder),
        is_readable=partial(read, read_scan),
        timeout_s=plan.timeout_s,
        device="the scanner",
        files_of=scan_files,
        trigger=plan.trigger,
        clock=clock,
    )


def _camera(plan: CameraPlan, clock: Clock, read: Read) -> FrameSource:
    if plan.folder:
        return FolderSource(
            watched_folder(plan.folder),
            is_readable=partial(read, require_image),  # its focal length may be known later
            timeout_s=_PHOTO_S,
            device="the camera",
            trigger=plan.trigger,
            clock=clock,
        )
    return VideoCamera(plan.device or 0)
