"""The commands on the stations of a project."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from msgspec import Meta

from ladarreg_core.project import station_edits

from .command import Context, Reply, StationId, WorkbenchCommand
from .matches import PhotoCommand, step_reply

if TYPE_CHECKING:
    from ..state.clients import Client


class RegisterStations(WorkbenchCommand, frozen=True):
    """registers all stations to each other; the scan that is shown is fixed; `poses` as
    [`--poses`](stations.md#poses-in-the-files)
    """

    replies: ClassVar[str] = "job"
    poses: Literal["keep", "refine", "search"] = "refine"

    def execute(self, context: Context, client: Client) -> Reply:
        """Start it."""
        return {"job": context.stations.register(self.poses, client.author)}


class CheckAtStations(WorkbenchCommand, frozen=True):
    """verifies the registered photographs, their poses carried over, by the scans of the other stations"""

    replies: ClassVar[str] = "job"

    def execute(self, context: Context, client: Client) -> Reply:
        """Start it."""
        return {"job": context.stations.check_photos(client.author)}


class PlaceStation(WorkbenchCommand, frozen=True):
    """says roughly where a station stands in the frame of the scan that is shown, `{x, y, z, yaw_deg}`, m and degrees;
    null: nobody knows
    """

    station: StationId
    place: Annotated[dict[str, Any], Meta(title="a place is x, y, z and yaw_deg; enter all of them")] | None = None

    def execute(self, context: Context, client: Client) -> Reply:
        """Place it."""
        rough = None if self.place is None else station_edits.rough_pose(self.place)
        context.stations.place(self.station, rough, client.author)
        return {}


class ShowStation(WorkbenchCommand, frozen=True):
    """makes another station's scan the project's, to whose frame all refers from now on; photographs beside the former
    one are matched with it, and their matches and poses beside each station are kept
    """

    station: StationId

    def execute(self, context: Context, client: Client) -> Reply:
        """Show it."""
        context.stations.show(self.station, client.author)
        return {}


class SetStation(PhotoCommand, frozen=True):
    """matches a photograph with the scan of a station (empty: the project's), which is shown beside it from now on; its
    matches and poses beside each scan are kept
    """

    station: Annotated[str, Meta(title="the station is no longer in the project; choose another")] = ""

    def execute(self, context: Context, client: Client) -> Reply:
        """Match it."""
        return step_reply(context.partners.choose(self.photo, self.station, client.author))


class RemoveStation(WorkbenchCommand, frozen=True):
    """removes a station from the project"""

    station: StationId

    def execute(self, context: Context, client: Client) -> Reply:
        """Remove it."""
        context.stations.remove(self.station, client.author)
        return {}
