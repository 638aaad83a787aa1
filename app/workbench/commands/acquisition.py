"""The commands by which clients drive a pan/tilt unit and a scanner."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, ClassVar

from msgspec import Meta

from .command import Context, Plan, Reply, WorkbenchCommand

if TYPE_CHECKING:
    from ..state.clients import Client

_DEGREES = "give the degrees to move, of pan and of tilt"
Degrees = Annotated[float, Meta(ge=-1e6, le=1e6, title=_DEGREES)]


class AcquirePorts(WorkbenchCommand, frozen=True):
    """the server's serial ports `{port, said}`, a plan with simulated devices, and the plan that was being edited last,
    or null
    """

    replies: ClassVar[str] = "ports, example, draft"

    def execute(self, context: Context, client: Client) -> Reply:
        """Return them."""
        return context.acquisition.ports()


class AcquireCheck(WorkbenchCommand, frozen=True):
    """all faults of a plan, `{field, said}` with the field as in plan.json, such as `scanner.folder`, and `{stops,
    pieces, cells, seconds, overlap}`
    """

    replies: ClassVar[str] = "faults, forecast"
    plan: Plan

    def execute(self, context: Context, client: Client) -> Reply:
        """Return them."""
        return context.acquisition.check(self.plan)


class AcquireKeep(WorkbenchCommand, frozen=True):
    """keeps a plan that is being edited, right or not, in the project's folder `runs`"""

    plan: Plan

    def execute(self, context: Context, client: Client) -> Reply:
        """Keep it."""
        context.acquisition.keep(self.plan)
        return {}


class AcquireConnect(WorkbenchCommand, frozen=True):
    """connects to the devices of a plan; only ports that the server has, or simulated devices"""

    plan: Plan

    def execute(self, context: Context, client: Client) -> Reply:
        """Connect."""
        context.acquisition.connect(client, self.plan)
        return {}


class AcquireDisconnect(WorkbenchCommand, frozen=True):
    """stops everything at once, and disconnects when what was asked of the devices has ended"""

    def execute(self, context: Context, client: Client) -> Reply:
        """Disconnect."""
        context.acquisition.disconnect(client)
        return {}


class AcquireJog(WorkbenchCommand, frozen=True):
    """moves the unit by some degrees, at most 30; halted if the client disconnects"""

    pan_deg: Degrees
    tilt_deg: Degrees

    def execute(self, context: Context, client: Client) -> Reply:
        """Move it."""
        context.acquisition.jog(client, self.pan_deg, self.tilt_deg)
        return {}


class AcquireStart(WorkbenchCommand, frozen=True):
    """begins a run in the project's folder `runs`, or resumes the one that `resume` names, by its own plan"""

    plan: Plan | None = None
    resume: Annotated[str, Meta(title="a run to resume is given by its name")] | None = None

    def execute(self, context: Context, client: Client) -> Reply:
        """Begin it."""
        context.acquisition.start(client, {} if self.resume is not None else self.plan or {}, resume=self.resume)
        return {}


class AcquirePause(WorkbenchCommand, frozen=True):
    """pauses the run after the piece that is being measured"""

    def execute(self, context: Context, client: Client) -> Reply:
        """Pause it."""
        context.acquisition.pause(client)
        return {}


class AcquireResume(WorkbenchCommand, frozen=True):
    """resumes a paused run, also after a fault"""

    def execute(self, context: Context, client: Client) -> Reply:
        """Resume it."""
        context.acquisition.resume(client)
        return {}


class AcquireStop(WorkbenchCommand, frozen=True):
    """halts the unit and switches the laser off at once, from the client's own thread"""

    urgent: ClassVar[bool] = True

    def execute(self, context: Context, client: Client) -> Reply:
        """Halt it."""
        context.acquisition.stop()
        return {}


class AcquireTakeOver(WorkbenchCommand, frozen=True):
    """this client drives from now on"""

    def execute(self, context: Context, client: Client) -> Reply:
        """Take over."""
        context.acquisition.take_over(client)
        return {}


class AcquireOpen(WorkbenchCommand, frozen=True):
    """opens the panorama of a finished run as the project's scan; of the latest without a name"""

    run: str | None = None

    def execute(self, context: Context, client: Client) -> Reply:
        """Open it."""
        context.acquisition.open_panorama(client, self.run)
        return {}


class AcquirePhotos(WorkbenchCommand, frozen=True):
    """adds the photographs of a run to the project; their number"""

    replies: ClassVar[str] = "photos"
    run: Annotated[str, Meta(title="no run is given; specify one by its name")]

    def execute(self, context: Context, client: Client) -> Reply:
        """Add them."""
        found = context.acquisition.photos(self.run)
        for path, name in found:
            context.files.open(path, name, "photo", None, client)
        return {"photos": len(found)}
