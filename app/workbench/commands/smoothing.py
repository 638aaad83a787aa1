"""The commands on the ranges of the scan: previewed, applied, discarded and restored."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Annotated, Literal

from msgspec import Meta

from ladarreg_core.project.smoothing_edits import without_smoothings

from .command import Context, PhotoId, Reply, WorkbenchCommand
from .matches import step_reply

if TYPE_CHECKING:
    from ..state.clients import Client

Show = Annotated[
    Literal["before", "after", "difference"], Meta(title="a preview shows 'before', 'after' or 'difference'")
]


class PreviewSmoothing(WorkbenchCommand, frozen=True):
    """shows this client which ranges of the scan beside a photograph its accepted pose would replace, in the slice
    `smoothing`, in the scan and in the 3-D view; nothing is changed
    """

    photo: PhotoId
    show: Show = "difference"

    def execute(self, context: Context, client: Client) -> Reply:
        """Show them."""
        client.smoothing = context.smoothing.preview(self.photo, self.show)
        context.show_smoothing()
        return {}


class DiscardSmoothing(WorkbenchCommand, frozen=True):
    """ends the preview of this client; nothing was changed"""

    def execute(self, context: Context, client: Client) -> Reply:
        """End it."""
        client.smoothing = None
        context.show_smoothing()
        return {}


class ApplySmoothing(WorkbenchCommand, frozen=True):
    """replaces the ranges of a preview, `rev` as in the slice `smoothing`, at spikes, and with `edges` at depth edges,
    too, in one step; refused if scan or pose have changed since the preview
    """

    photo: PhotoId
    rev: Annotated[str, Meta(title="there is no such preview; preview the ranges first")]
    edges: bool = False

    def execute(self, context: Context, client: Client) -> Reply:
        """Replace them."""
        number = context.smoothing.apply(client, self.photo, self.rev, edges=self.edges)
        context.show_smoothing()
        return step_reply(number)


class RestoreRanges(WorkbenchCommand, frozen=True):
    """restores all ranges of the scan of a station (empty: the project's) as they were measured"""

    station: Annotated[str, Meta(title="the station is no longer in the project; choose another")] = ""

    def execute(self, context: Context, client: Client) -> Reply:
        """Restore them."""
        change = partial(without_smoothings, station_id=self.station)
        return step_reply(context.session.commit("Restore the measured ranges", change, author=client.author))
