"""The commands on matches, and the queries about them."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from msgspec import Meta

from ladarreg_core.errors import OptionError
from ladarreg_core.project import edits

from .command import Context, PhotoId, Picks, Pixels, Positive, Ray, Rays, Reply, Side, ViewIndex, WorkbenchCommand

if TYPE_CHECKING:
    from ladarreg_core.project.document import PhotoEntry

    from ..state.clients import Client

PickId = Annotated[str, Meta(title="no match is selected; select one")]
Enabled = Annotated[bool, Meta(title="a match is enabled with true and disabled with false")]


class PhotoCommand(WorkbenchCommand, frozen=True):
    """A command on a photograph."""

    photo: PhotoId

    def entry(self, context: Context) -> PhotoEntry:
        """Return the photograph; raises `OptionError` if it is gone."""
        return edits.require_photo(context.session.document, self.photo)

    def edit(
        self,
        context: Context,
        client: Client,
        label: str,
        edit: Callable[[PhotoEntry], PhotoEntry],
        *,
        merge_key: str = "",
    ) -> Reply:
        """Edit the photograph, as a step of the history, and return the step's number."""
        photo = self.entry(context).id
        change = partial(edits.edited_photo, photo_id=photo, edit=edit)
        return step_reply(context.session.commit(label, change, author=client.author, merge_key=merge_key))


def step_reply(number: int | None) -> Reply:
    """Return the reply to an edit: the number of its step, by which it can be undone; none if nothing changed."""
    return {} if number is None else {"n": number}


class AddPick(PhotoCommand, frozen=True):
    """adds a point or line: one coordinate on each side, or two; `station` is that whose scan it was drawn in"""

    replies: ClassVar[str] = "pick"
    kind: Annotated[Literal["point", "line"], Meta(title="a match is a 'point' or a 'line'")]
    scan: Rays
    photo_uv: Pixels
    station: str | None = None

    def execute(self, context: Context, client: Client) -> Reply:
        """Add it."""
        from ladarreg_core.matches import Pick

        pick = Pick("new", self.kind, edits.rays(self.scan), edits.pixels(self.photo_uv))  # type: ignore[arg-type]
        made: tuple[str, ...] = ()

        def edit(photo: PhotoEntry) -> PhotoEntry:
            nonlocal made
            if self.station is not None and self.station != photo.station:
                raise OptionError(f"{photo.source.name} is beside another scan by now; draw the match again")
            photo, made = edits.with_picks(photo, [pick])
            return photo

        number = self.entry(context).numbered + 1
        step = self.edit(context, client, f"Draw {self.kind} {number}", edit)
        return {"pick": made[0], **step}


class SetPick(PhotoCommand, frozen=True):
    """moves, enables, disables or weights a match; quick successive moves of one end become one step"""

    pick: PickId
    scan: Rays | None = None
    photo_uv: Pixels | None = None
    on: Enabled | None = None
    weight: float | None = None

    def execute(self, context: Context, client: Client) -> Reply:
        """Change it."""
        changed: dict[str, Any] = {}
        if self.scan is not None:
            changed["scan"] = edits.rays(self.scan)
        if self.photo_uv is not None:
            changed["photo"] = edits.pixels(self.photo_uv)
        if self.on is not None:
            changed["on"] = self.on
        if self.weight is not None:
            changed["weight"] = edits.weight(self.weight)
        entry = self.entry(context)
        pick = entry.pick(self.pick)
        number = pick.number if pick else "?"
        if set(changed) == {"on"}:
            label = f"{_enable(changed['on'])} match {number}"
        else:
            label = f"{'Weight' if set(changed) == {'weight'} else 'Move'} match {number}"
        moves = "scan" in changed or "photo" in changed
        merge_key = f"{entry.id} {self.pick} {sorted(changed)}" if moves else ""
        change = partial(edits.changed_pick, pick_id=self.pick, fields=changed)
        return self.edit(context, client, label, change, merge_key=merge_key)


class RemovePicks(PhotoCommand, frozen=True):
    """removes matches"""

    picks: Picks

    def execute(self, context: Context, client: Client) -> Reply:
        """Remove them."""
        ids = _existing(self.entry(context), self.picks)
        return self.edit(context, client, f"Remove {_count(ids)}", lambda p: edits.without_picks(p, ids))


class SwitchPicks(PhotoCommand, frozen=True):
    """enables or disables matches"""

    picks: Picks
    on: Enabled

    def execute(self, context: Context, client: Client) -> Reply:
        """Enable or disable them."""
        there = _existing(self.entry(context), self.picks)
        label = f"{_enable(self.on)} {_count(there)}"
        return self.edit(context, client, label, lambda p: edits.switched(p, dict.fromkeys(there, self.on)))


class Reject(PhotoCommand, frozen=True):
    """disables the matches whose error under the shown pose exceeds `above`, and enables the others; `by` is `depth` by
    default
    """

    replies: ClassVar[str] = "off"
    above: Positive
    by: Annotated[Literal["depth", "px"], Meta(title="the threshold applies to 'depth' or to 'px'")] = "depth"

    def execute(self, context: Context, client: Client) -> Reply:
        """Disable and enable them."""
        errors = context.queries.pick_errors(self.entry(context).id)
        unit = "m" if self.by == "depth" else "px"
        sizes = {pick: error["depth_m"] if self.by == "depth" else error["px"] for pick, error in errors.items()}
        on = {pick: abs(size) <= self.above for pick, size in sizes.items() if size is not None}
        if not on:
            raise OptionError("no match has an error yet; solve first")
        off = sum(not value for value in on.values())
        label = f"Disable {off} above {self.above:.3g} {unit}"
        return {"off": off, **self.edit(context, client, label, lambda p: edits.switched(p, on))}


class HoverPick(WorkbenchCommand, frozen=True):
    """highlights a match in the 3-D scene; null: none"""

    looks: ClassVar[bool] = True
    pick: str | None = None

    def execute(self, context: Context, client: Client) -> Reply:
        """Highlight it."""
        if context.scene is not None:
            context.scene.highlight(client.id, self.pick)
        return {}


class Predict(PhotoCommand, frozen=True):
    """the other side of a match under the shown pose, of `scan` or of `photo_uv`; null where undefined"""

    looks: ClassVar[bool] = True
    replies: ClassVar[str] = "photo_uv | scan"
    side: Side
    scan: Rays | None = None
    photo_uv: Pixels | None = None

    def execute(self, context: Context, client: Client) -> Reply:
        """Return it."""
        partners = context.queries.partners(self.entry(context))
        if self.side == "scan":
            return {"photo_uv": _finite_rows(partners.in_photo(edits.rays(self.scan)).tolist())}
        return {"scan": _finite_rows(partners.on_scan(edits.pixels(self.photo_uv)).tolist())}


class Where(PhotoCommand, frozen=True):
    """a ray projected into the photograph"""

    looks: ClassVar[bool] = True
    replies: ClassVar[str] = "photo_uv"
    scan: Ray

    def execute(self, context: Context, client: Client) -> Reply:
        """Return its pixel."""
        rows = context.queries.partners(self.entry(context)).in_photo(edits.rays([self.scan]))
        return {"photo_uv": _finite_rows(rows.tolist())[0]}


class Snap(WorkbenchCommand, frozen=True):
    """one end: the corner within 4 pixels of the screen; two: both ends moved onto the straight edge under the line,
    across it, by at most 6 pixels of the screen; sub-pixel, unchanged where nothing is `found`
    """

    looks: ClassVar[bool] = True
    replies: ClassVar[str] = "ends, found"
    side: Side
    ends: Pixels
    photo: str | None = None
    view: ViewIndex = 0
    px_per_screen: Annotated[float, Meta(ge=1e-3, le=1e3, title="px_per_screen is a number from 0.001 to 1000")] = 1.0

    def execute(self, context: Context, client: Client) -> Reply:
        """Return where they snap to."""
        ends = edits.pixels(self.ends)
        shown = context.selection.photo_of(client)
        found = context.queries.snapped(
            self.side, self.view, self.photo, ends, shown=shown, px_per_screen=self.px_per_screen
        )
        return {"ends": [list(end) for end in ends] if found is None else found, "found": found is not None}


class SampleLine(WorkbenchCommand, frozen=True):
    """samples of a line, as under `judged`"""

    looks: ClassVar[bool] = True
    replies: ClassVar[str] = "scan_samples, sampled, used"
    scan: Rays

    def execute(self, context: Context, client: Client) -> Reply:
        """Return them."""
        return {**context.queries.sample_line(edits.rays(self.scan), context.selection.photo_of(client))}


class Probe(WorkbenchCommand, frozen=True):
    """the measurement along a ray; the range is null without a return; `edge`: the surfaces of a depth edge within two
    cells, `{near_m, far_m, near: ray, far: ray}`, or null
    """

    looks: ClassVar[bool] = True
    replies: ClassVar[str] = "range_m, intensity, cell, edge"
    scan: Ray

    def execute(self, context: Context, client: Client) -> Reply:
        """Return it."""
        return context.queries.probe(edits.rays([self.scan])[0], context.selection.photo_of(client))


def _existing(entry: PhotoEntry, ids: list[str]) -> list[str]:
    """Return those ids that are matches of the photograph, without duplicates."""
    wanted = frozenset(ids)
    return [pick.id for pick in entry.picks if pick.id in wanted]


def _enable(on: bool) -> str:
    return "Enable" if on else "Disable"


def _count(ids: list[str]) -> str:
    return "a match" if len(ids) == 1 else f"{len(ids)} matches"


def _finite_rows(rows: list[list[float]]) -> list[list[float] | None]:
    return [row if all(map(math.isfinite, row)) else None for row in rows]
