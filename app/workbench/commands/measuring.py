"""The commands on measurements."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from msgspec import Meta

from ladarreg_core.errors import OptionError
from ladarreg_core.project import measurement_edits
from ladarreg_core.project.document import MeasuredPlace, MeasurementKind
from ladarreg_core.project.edits import require_photo
from ladarreg_core.project.measurement_edits import MAX_PLACES

from ...session.measured import Picked
from .command import Context, Reply, WorkbenchCommand
from .matches import step_reply

if TYPE_CHECKING:
    from ladarreg_core.project.document import Document

    from ..state.clients import Client

Kind = Annotated[MeasurementKind, Meta(title="a measurement is a point, distance, polyline, angle, area or height")]
Places = Annotated[
    list[dict[str, Any]],
    Meta(
        min_length=1, max_length=MAX_PLACES,
        title=f"the points are a list of 1 to {MAX_PLACES}, each with a ray, or a photo and uv",
    ),
]  # fmt: skip
MeasurementId = Annotated[str, Meta(title="no measurement is selected; select one")]
MeasurementIds = Annotated[list[str], Meta(min_length=1, title="no measurements are selected; select some")]


class OfPlaces(WorkbenchCommand, frozen=True):
    """A command on picked points."""

    kind: Kind
    places: Places
    station: Annotated[str, Meta(title="the station is no longer in the project; choose another")] = ""

    def picked(self) -> Picked:
        """Return what is measured; raises `OptionError` if a point is neither a ray nor a pixel."""
        return Picked(self.station, self.kind, tuple(_place(one) for one in self.places))


class Measure(OfPlaces, frozen=True):
    """measures points on the scan of a station (empty: the project's), each `{ray}` in that scan or `{photo, uv}`, with
    the standard deviation of the pick along each axis, `sigma_rad` or `sigma_px`, where the picture was shown too small
    for the usual half a cell or pixel; and changes nothing: value with standard deviation, 95 % interval and notes as
    in the slice `measured`, or why it is refused
    """

    looks: ClassVar[bool] = True
    replies: ClassVar[str] = "value, interval, notes, refusal"

    def execute(self, context: Context, client: Client) -> Reply:
        """Measure them."""
        return {**context.measured.preview(self.picked())}


class AddMeasurement(OfPlaces, frozen=True):
    """keeps a measurement on the scan of a station (empty: the project's); one that is refused is not kept"""

    replies: ClassVar[str] = "measurement"

    def execute(self, context: Context, client: Client) -> Reply:
        """Keep it."""
        picked = self.picked()
        for one in picked.places:
            if one.photo:
                require_photo(context.session.document, one.photo)
        context.measured.check(picked)
        made = ""

        def edit(document: Document) -> Document:
            nonlocal made
            found, entry = measurement_edits.with_measurement(document, picked.kind, picked.places, picked.station)
            made = entry.id
            return found

        number = context.session.commit(f"Measure {_with_article(self.kind)}", edit, author=client.author)
        return {"measurement": made, **step_reply(number)}


class RenameMeasurement(WorkbenchCommand, frozen=True):
    """renames a measurement; without a name it is called by kind and number"""

    measurement: MeasurementId
    name: Annotated[str, Meta(title="give a name")]

    def execute(self, context: Context, client: Client) -> Reply:
        """Rename it."""
        change = partial(measurement_edits.with_measurement_name, measurement_id=self.measurement, name=self.name)
        return step_reply(context.session.commit("Rename a measurement", change, author=client.author))


class RemoveMeasurements(WorkbenchCommand, frozen=True):
    """removes measurements"""

    measurements: MeasurementIds

    def execute(self, context: Context, client: Client) -> Reply:
        """Remove them."""
        wanted = frozenset(self.measurements)
        there = [entry for entry in context.session.document.measurements if entry.id in wanted]
        label = f"Remove {there[0].title}" if len(there) == 1 else f"Remove {len(there)} measurements"
        ids = [entry.id for entry in there]
        change = partial(measurement_edits.without_measurements, ids=ids)
        return step_reply(context.session.commit(label, change, author=client.author))


def _place(fields: dict[str, Any]) -> MeasuredPlace:
    photo = fields.get("photo") or ""
    at = fields.get("uv" if photo else "ray")
    if not isinstance(photo, str) or not isinstance(at, list):
        raise OptionError("a point has a ray [x, y, z] of the scan, or a photo and its pixel uv; give one of them")
    return measurement_edits.place(at, photo, fields.get("sigma_px" if photo else "sigma_rad", 0.0))


def _with_article(kind: str) -> str:
    return f"{'an' if kind[0] in 'aeiou' else 'a'} {kind}"
