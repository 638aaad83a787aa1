"""Acquisition from the page: devices connected, jogged, and driven through a plan on a thread of their own.

Stopping never waits for anything here: it goes straight from the client's thread to the devices.
"""

from __future__ import annotations

import hashlib
import io
import logging
import math
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ladarreg_core.errors import Cancelled, LadarregError, OptionError

from ...argument_names import as_fields
from ...gateway.protocol import Picture
from ...messages import internal_error
from ...session.isolated_readers import READERS
from ..state.clients import Client
from .plan_checks import devices_slice, in_degrees, plan_check, require_own_ports, require_within
from .runs import Runs
from .watchable import Watchable

if TYPE_CHECKING:
    from ladarreg_core.acquisition.interfaces import PanTilt
    from ladarreg_core.acquisition.plan import Plan
    from ladarreg_core.acquisition.runs.connected import Connected
    from ladarreg_core.acquisition.runs.preview import RunPreview
    from ladarreg_core.acquisition.runs.run_folder import RunWriter
    from ladarreg_core.acquisition.runs.runner import Run, RunEvent

    from ...scene import Scene3D
    from ...slices.choices import AcquisitionState
    from ...slices.several import Acquisition as AcquisitionSlice

log = logging.getLogger(__name__)
RUNS = "runs"
"""Folder of the runs in a project's folder."""
_POSITION_EVERY_S = 0.25
_PICTURE_EVERY_S = 0.25
_MAX_JOG_DEG = 30.0


@dataclass(slots=True)
class _Progress:
    done: int = 0
    total: int = 0
    seconds_left: float = 0.0
    complete: bool = False
    folder: str = ""
    strays: str = ""


class Acquisition:
    """The acquisition of a workbench; safe for several threads.

    One client drives; everybody who may edit can stop, and take over.

    Args:
        folder: the project's folder.
        publish: publishes the state.
        open_scan: opens a finished panorama as the project's scan.
        present: whether a client is still connected, by its id.
        scene: returns the 3-D scene, which shows the points of a run; None where there is none.
        watchable: what plans may watch.
    """

    def __init__(
        self, folder: Path, publish: Callable[[], None], open_scan: Callable[[Path, Client], None],
        present: Callable[[str], bool], scene: Callable[[], Scene3D | None], watchable: Watchable,
    ) -> None:  # fmt: skip
        self._watchable = watchable
        self._publish, self._open_scan, self._present = publish, open_scan, present
        self._runs = Runs(folder / RUNS)
        self._scene = scene
        self._lock = threading.RLock()
        self._state: AcquisitionState = "off"
        self._said = ""
        self._driver: tuple[str, str] | None = None
        self._plan: Plan | None = None
        self._devices: Connected | None = None
        self._stack = ExitStack()
        self._run: Run | None = None
        self._thread: threading.Thread | None = None
        self._stopping = threading.Event()
        self._at: PanTilt | None = None
        self._progress = _Progress()
        self._preview: RunPreview | None = None
        self._picture: Picture | None = None
        self._pictured_s = 0.0
        self._points = 0
        self.offered = False
        """Whether pages open the acquisition by themselves in an empty project."""

    # -- what clients ask for ----------------------------------------------------------------------------------

    def ports(self) -> dict[str, Any]:
        """Return the serial ports of the server, and an example of a plan, with simulated devices."""
        from ladarreg_core.acquisition.plan import example_plan
        from ladarreg_core.acquisition.serial_port import described_ports

        ports = [{"port": port, "said": said} for port, said in described_ports()]
        return {"ports": ports, "example": example_plan().as_fields(), "draft": self._runs.draft}

    def keep(self, fields: Mapping[str, Any]) -> None:
        """Keep a plan that is being edited, right or not, in the project's folder.

        Raises:
            OptionError: if it is too large for a plan.
            ExportError: if it cannot be written.
        """
        self._runs.keep_draft(fields)

    def check(self, fields: Mapping[str, Any]) -> dict[str, Any]:
        """Return the faults of a plan, each with its field, as far as they are known, and what its run will be."""
        return plan_check(fields, self._watchable.faults(fields), self._devices)

    def connect(self, client: Client, fields: Mapping[str, Any]) -> None:
        """Connect to the devices of a plan.

        Raises:
            OptionError: if the plan has faults, or devices are connected.
        """
        plan = self._allowed(fields)
        with self._lock:
            if self._state == "disconnecting":
                raise OptionError("devices are still being disconnected; wait for it")
            if self._state != "off":
                raise OptionError("devices are connected already; disconnect them first")
            self._state, self._said, self._plan = "connecting", "", plan
            self._driver = client.id, client.name
            self._begin(self._connect, "connecting devices")
        self._publish()

    def disconnect(self, client: Client) -> None:
        """Stop everything at once, and disconnect as soon as what was asked of the devices has ended.

        Raises:
            OptionError: if another client drives.
        """
        self._require_driver(client)
        self.stop()
        with self._lock:
            if self._state == "disconnecting":
                return
            self._state = "disconnecting"
        self._publish()
        threading.Thread(target=self._leave, name="disconnecting devices", daemon=True).start()

    def jog(self, client: Client, pan_deg: float, tilt_deg: float) -> None:
        """Move the unit by some degrees.

        Raises:
            OptionError: if another client drives, something moves already, or it would leave the limits.
        """
        from ladarreg_core.acquisition.interfaces import PanTilt

        self._require_driver(client)
        if max(abs(pan_deg), abs(tilt_deg)) > _MAX_JOG_DEG:
            raise OptionError(
                f"a step of more than {_MAX_JOG_DEG:g} deg is too far to move at once; take a smaller one"
            )
        with self._lock:
            devices = self._require_ready()
            at = self._at or devices.unit.position()
            target = PanTilt(at.pan_rad + math.radians(pan_deg), at.tilt_rad + math.radians(tilt_deg))
            require_within(devices, target)
            self._state = "jogging"
            self._begin(lambda: self._jog(devices, target), "jog")
        self._publish()

    def start(self, client: Client, fields: Mapping[str, Any], *, resume: str | None = None) -> None:
        """Begin a run of a plan in a new folder of the project, or go on with one.

        Args:
            client: who drives.
            fields: the plan of a new run.
            resume: name of the run to go on with, by its own plan.

        Raises:
            OptionError: if another client drives, the plan has faults, or the devices cannot run it.
        """
        from ladarreg_core.acquisition.runs.preview import RunPreview
        from ladarreg_core.acquisition.runs.run_folder import RunWriter

        self._require_driver(client)
        plan = self._allowed(fields if resume is None else self._runs.plan(resume).as_fields())
        with self._lock:
            devices = self._require_ready()
            name = resume or self._runs.new_name()
            folder = RunWriter.begin(self._runs.path(name), plan, resume=resume is not None)
            try:
                run = devices.run(plan, folder, self._see)
            except BaseException:
                folder.close()
                raise
            preview = RunPreview(
                plan.mount, plan.base, pieces=run.total, step_deg=plan.pan.step_deg if plan.mode == "sweep" else 0.0
            )
            self._forget_points()
            self._run, self._plan, self._preview = (
                run,
                plan,
                preview,
            )  # the earlier picture stays until there is another
            self._progress = _Progress(len(folder.records), run.total, 0.0, False, name)
            self._state, self._said = "running", ""
            self._begin(lambda: self._go(run, folder), "run")
        self._publish()

    def pause(self, client: Client) -> None:
        """Have the run wait after the piece that is being measured."""
        self._require_driver(client)
        if self._run is not None:
            self._run.pause()

    def resume(self, client: Client) -> None:
        """Have a run that waits go on."""
        self._require_driver(client)
        if self._run is not None:
            self._run.resume()

    def stop(self) -> None:
        """Halt the unit and switch the laser off at once; for everybody who may edit, and without waiting."""
        self._stopping.set()
        run, devices = self._run, self._devices
        if run is not None:
            run.stop()
        elif devices is not None:
            devices.unit.halt()

    def take_over(self, client: Client) -> None:
        """Drive from now on."""
        with self._lock:
            self._driver = client.id, client.name
        self._publish()

    def open_panorama(self, client: Client, name: str | None = None) -> None:
        """Open the panorama of a finished run as the project's scan; by default of the latest.

        Raises:
            OptionError: if the run has not been finished.
        """
        name = name or self._progress.folder
        if not name:
            raise OptionError("no run has finished; run a plan to its end first")
        self._open_scan(self._runs.panorama(name), client)
        self._forget_points()
        self._publish()

    def photos(self, name: str) -> list[tuple[Path, str]]:
        """Return the photographs of a run, with names for display.

        Raises:
            LadarregError: if there is no such run, or it has none.
        """
        return self._runs.photos(name)

    def left(self, client: Client) -> None:
        """A client is gone: a jog of its is halted, a run goes on and may be taken over."""
        with self._lock:
            if self._driver is not None and self._driver[0] == client.id and self._state == "jogging":
                self.stop()

    def close(self) -> None:
        """Stop everything and disconnect."""
        self.stop()
        self._join()
        with self._lock:
            self._disconnect()

    # -- what they see -----------------------------------------------------------------------------------------

    def slice(self) -> AcquisitionSlice:
        """Return the slice `acquisition`."""
        with self._lock:
            at, progress = self._at, self._progress
            return {
                "state": self._state,
                "offered": self.offered,
                "said": self._said,
                "driver": None if self._driver is None else {"id": self._driver[0], "name": self._driver[1]},
                "devices": None if self._devices is None else devices_slice(self._devices, self._plan),
                "plan": None if self._plan is None else self._plan.as_fields(),
                "at_deg": None if at is None else [in_degrees(at.pan_rad), in_degrees(at.tilt_rad)],
                "done": progress.done,
                "total": progress.total,
                "seconds_left": round(progress.seconds_left),
                "complete": progress.complete,
                "run": progress.folder,
                "picture": None if self._picture is None else self._picture.etag,
                "points": self._points,
                "runs": self._runs.slice,
            }

    def picture(self) -> Picture:
        """Return what the run has seen so far.

        Raises:
            OptionError: if there is nothing yet.
        """
        picture = self._picture
        if picture is None:
            raise OptionError("no run has measured anything yet")
        return picture

    # -- on the thread of the devices --------------------------------------------------------------------------

    def _connect(self) -> None:
        from ladarreg_core.acquisition.runs.connected import connected

        assert self._plan is not None
        devices = self._stack.enter_context(connected(self._plan, read=READERS.run))
        self._check()  # whoever stopped it meanwhile does not expect devices that are ready to move
        with self._lock:
            self._devices = devices
        self._at = devices.unit.position()

    def _jog(self, devices: Connected, target: PanTilt) -> None:
        self._at = devices.unit.move_to(target, check=self._check)

    def _go(self, run: Run, folder: RunWriter) -> None:
        from ladarreg_core.acquisition.composition.panorama import add_to_run, compose

        try:
            assert self._preview is not None
            for index in sorted(folder.records):
                self._preview.add(folder.piece(index))
            complete = run.go()
        finally:
            folder.close()
            self._run = None
            self._draw(now=True)
        refused: tuple[str, ...] = ()
        if complete:
            self._said = "All pieces are kept; the panorama is being composed."
            self._publish()
            try:
                made = compose(folder.path, report=lambda progress: self._check())
                add_to_run(folder.path, made)
                refused = made.reasons
            except Cancelled:
                with self._lock:
                    self._said = "Composing was stopped: all pieces are kept. Go on with the run to compose them."
                return
        with self._lock:
            self._progress.complete = complete
            self._said = (
                " ".join(("The run is complete.", *(f"Not accepted: {reason}." for reason in refused))) if complete
                else f"Stopped: {self._progress.done} of {self._progress.total} pieces are kept."
            )  # fmt: skip

    def _see(self, event: RunEvent) -> None:
        from ladarreg_core.acquisition.runs.runner import Moved, Paused, PieceKept, Repeated, Resumed, StraysKept

        if isinstance(event, Moved):
            self._at = event.at
        elif isinstance(event, PieceKept):
            self._progress.done, self._progress.seconds_left = event.done, event.seconds_left
            self._said = self._progress.strays
            if self._preview is not None:
                self._preview.add(event.piece)
                self._draw()
        elif isinstance(event, Paused):
            self._state, self._said = ("fault" if event.fault else "paused"), as_fields(event.reason)
        elif isinstance(event, Repeated):
            self._said = event.reason
        elif isinstance(event, StraysKept):
            names = ", ".join(event.names)
            self._progress.strays = f"Before stop {event.index}: {names} came on the way, and counts for no stop."
        elif isinstance(event, Resumed):
            self._state, self._said = "running", ""
        self._publish()

    def _draw(self, *, now: bool = False) -> None:
        """Draw the picture again, not too often."""
        if self._preview is None or self._preview.is_empty:
            return
        if not (now or time.monotonic() - self._pictured_s > _PICTURE_EVERY_S):
            return
        from PIL import Image

        buffer = io.BytesIO()
        Image.fromarray(self._preview.picture()).save(buffer, "PNG", compress_level=1)
        data = buffer.getvalue()
        self._picture = Picture(data, "image/png", hashlib.sha256(data).hexdigest()[:16])
        self._pictured_s = time.monotonic()
        points, gray = self._preview.take_points()
        scene = self._scene()
        if scene is not None and len(points):
            scene.show_run(points, gray)
            self._points += len(points)

    def _forget_points(self) -> None:
        self._points = 0
        scene = self._scene()
        if scene is not None:
            scene.forget_run()

    def _begin(self, work: Callable[[], None], name: str) -> None:
        self._stopping.clear()

        def guarded() -> None:
            said = ""
            try:
                work()
            except Cancelled:
                said = "Stopped while connecting: connect again." if self._devices is None else "Stopped."
            except LadarregError as error:
                said = as_fields(str(error))
            except Exception as error:
                log.exception("%s failed", name)
                said = internal_error(error, go_on="the pieces so far are kept, connect again and resume")
            with self._lock:
                self._runs.refresh()
                if self._state == "disconnecting":
                    pass  # the thread that disconnects waits for this one
                elif self._devices is None:
                    self._disconnect()
                else:
                    self._state = "ready"
                self._said = said or self._said
            self._publish()

        self._thread = threading.Thread(target=guarded, name=name, daemon=True)
        self._thread.start()

    def _leave(self) -> None:
        self._join()
        with self._lock:
            self._disconnect()
        self._publish()

    def _check(self) -> None:
        if self._stopping.is_set():
            raise Cancelled

    def _join(self) -> None:
        thread = self._thread
        if thread is not None and thread is not threading.current_thread():
            thread.join(20)

    def _disconnect(self) -> None:
        self._stack.close()
        self._stack = ExitStack()
        self._devices = None
        self._run = None
        self._at = None
        self._driver = None
        self._forget_points()
        self._state = "off"

    def _require_driver(self, client: Client) -> None:
        with self._lock:
            if self._driver is None:
                raise OptionError("no devices are connected; connect them first")
            if self._driver[0] != client.id:
                if self._present(self._driver[0]):
                    raise OptionError(f"{self._driver[1]} drives the devices; take over first")
                self._driver = client.id, client.name

    def _allowed(self, fields: Mapping[str, Any]) -> Plan:
        """Return a plan that may be run from a page.

        Raises:
            OptionError: if it has faults, or names what the computer does not have or the operator did not name.
        """
        from ladarreg_core.acquisition.plan import PlanError
        from ladarreg_core.acquisition.plan_reading import plan_from_fields

        if refused := self._watchable.faults(fields):
            raise PlanError(refused)
        plan = plan_from_fields(fields)
        require_own_ports(plan)
        return plan

    def _require_ready(self) -> Connected:
        if self._devices is None:
            raise OptionError("no devices are connected; connect them first")
        if self._state != "ready":
            raise OptionError("the unit is busy; wait for it, or stop it")
        return self._devices
