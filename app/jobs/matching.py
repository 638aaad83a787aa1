"""The thesis's matching, step by step: corners, correlation, culling, the second search, lines between matches."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from ladarreg_core.errors import OptionError
from ladarreg_core.project.edits import switched, with_picks, without_origin
from ladarreg_core.project.results import pose_of

from .inputs import Bench, Inputs
from .runner import JobContext

if TYPE_CHECKING:
    from ladarreg_core.matches import Pick
    from ladarreg_core.matching.thesis.matcher import FoundMatches, ThesisSearch
    from ladarreg_core.project.document import PhotoEntry

CORNER, BETWEEN = "corner", "between corners"
"""Origins of picks."""


@dataclass(slots=True)
class Search:
    """One photograph's search, and which picks came of it."""

    key: object
    search: ThesisSearch
    found: FoundMatches | None = None
    ids: tuple[str, ...] = ()
    culled: list[bool] = field(default_factory=list)


class MatchingJobs:
    """The jobs of the step Match; what they found is kept between them."""

    def __init__(self, bench: Bench) -> None:
        self._bench = bench
        self._searches: dict[str, Search] = {}

    def corners(self, photo_id: str) -> dict[str, list[list[float]]] | None:
        """Return the corners found, rays and pixels; None before they were looked for."""
        found = self._searches.get(photo_id)
        if found is None:
            return None
        search = found.search
        photo = search.photo
        rays = search.scan.view.rays_at(search.scan_uv)
        uv = photo.source.project(photo.cameras[0].unproject(search.photo_uv))
        return {"scan": rays.tolist(), "photo": uv.tolist()}

    def find_corners(self, inputs: Inputs, context: JobContext) -> str:
        """Find corners in both pictures."""
        search = self._search(inputs, context)
        with _timed(context, "corners") as note:
            note.update(scan=len(search.search.scan_uv), photo=len(search.search.photo_uv))
        return f"{len(search.search.scan_uv)} corners in the scan, {len(search.search.photo_uv)} in the photograph."

    def match(self, inputs: Inputs, context: JobContext) -> str:
        """Correlate every corner with every other and keep those that have one clear partner."""
        search = self._search(inputs, context)
        with _timed(context, "unconstrained search") as note:
            found = search.search.unconstrained()
            note.update(matches=len(found))
        context.check()
        self._keep(inputs, search, found, f"Match {len(found)} corners", context)
        return f"{len(found)} matches whose best correlation beats the second by {inputs.settings.t1:g}."

    def cull(self, inputs: Inputs, context: JobContext) -> str:
        """Switch off what moved unlike the others."""
        search = self._searches.get(inputs.entry.id)
        if search is None or search.found is None or search.key != self._key(inputs):
            raise OptionError("there are no corner matches to cull; match corners first")
        with _timed(context, "disparity culling") as note:
            kept = search.search.filtered(search.found)
            pairs = {(*a, *b) for a, b in zip(kept.scan_uv.tolist(), kept.photo_uv.tolist(), strict=True)}
            on = {
                name: (*a, *b) in pairs
                for name, a, b in zip(
                    search.ids, search.found.scan_uv.tolist(), search.found.photo_uv.tolist(), strict=True
                )
            }
            note.update(matches=len(kept), culled=len(on) - len(kept))
        off = len(on) - len(kept)
        self._bench.commit(inputs, f"Cull {off} matches", lambda p: switched(p, on), author=context.job.author)
        return f"{len(kept)} of {len(on)} matches move alike; {off} are switched off."

    def constrained(self, inputs: Inputs, context: JobContext) -> str:
        """Search again where the pose expects each corner."""
        pose = inputs.entry.stage("linear") or inputs.entry.pose
        if pose is None:
            raise OptionError("the second search needs a pose; solve linearly first")
        search = self._search(inputs, context)
        first = pose_of(pose)
        with _timed(context, "constrained search") as note:
            found = search.search.constrained(first)
            note.update(matches=len(found))
        context.check()
        with _timed(context, "disparity culling") as note:
            kept = search.search.filtered(found)
            note.update(matches=len(kept), culled=len(found) - len(kept))
        self._keep(inputs, search, kept, f"Search again: {len(kept)} matches", context)
        return f"{len(found)} corners found where the pose expects them, {len(kept)} of them alike."

    def densify(self, inputs: Inputs, context: JobContext) -> str:
        """Add points along lines between matches that lie on one plane."""
        search = self._searches.get(inputs.entry.id)
        if search is None or search.found is None or search.key != self._key(inputs):
            raise OptionError("there are no corner matches to draw lines between; match corners first")
        pose = inputs.entry.pose
        answer = None if pose is None else pose_of(pose)
        on = {pick.id for pick in inputs.entry.picks if pick.on}
        kept = search.found.subset([k for k, name in enumerate(search.ids) if name in on])
        with _timed(context, "lines between matches") as note:
            more = search.search.densified(kept, answer)
            added = _picks_of(more, BETWEEN)[len(kept) :]
            note.update(matches=len(more), added=len(added))
        if not added:
            return "No two matches lie on one plane, so that nothing was added."
        self._bench.commit(
            inputs,
            f"Add {len(added)} points between matches",
            lambda p: with_picks(without_origin(p, {BETWEEN}), added)[0],
            author=context.job.author,
        )
        return f"{len(added)} points along lines between {len(kept)} matches."

    def _keep(self, inputs: Inputs, search: Search, found: FoundMatches, label: str, context: JobContext) -> None:
        new = _picks_of(found, CORNER)
        ids: tuple[str, ...] = ()

        def replaced(photo: PhotoEntry) -> PhotoEntry:
            nonlocal ids
            photo, ids = with_picks(without_origin(photo, {CORNER, BETWEEN}), new)
            return photo

        self._bench.commit(inputs, label, replaced, author=context.job.author)
        search.found, search.ids = found, ids

    def _key(self, inputs: Inputs) -> object:
        entry = inputs.entry
        return (inputs.document.scan, entry.source, entry.camera, inputs.settings.match_options)

    def _search(self, inputs: Inputs, context: JobContext) -> Search:
        key = self._key(inputs)
        known = self._searches.get(inputs.entry.id)
        if known is not None and known.key == key:
            return known
        from ladarreg_core.matching.thesis.chain import thesis_search

        context.job.said = "looking for corners"
        found = thesis_search(inputs.scan, inputs.photo, inputs.settings.match_options, report=context.step)
        self._searches[inputs.entry.id] = search = Search(key, found)
        return search


def _picks_of(found: FoundMatches, origin: str) -> list[Pick]:
    from ladarreg_core.matches import Pick

    matches = found.matches
    return [
        Pick(str(k), "point", ray[None], uv[None], origin=origin)
        for k, (ray, uv) in enumerate(zip(matches.rays, matches.uv, strict=True))
    ]


class _timed:  # noqa: N801 - used like a function
    """Tell a step with the time it took."""

    def __init__(self, context: JobContext, name: str) -> None:
        self._context, self._name = context, name
        self._note: dict[str, object] = {}

    def __enter__(self) -> dict[str, object]:
        self._begun = time.perf_counter()
        return self._note

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        from ladarreg_core.progress import Step

        if error is None:
            self._context.step(Step(self._name, time.perf_counter() - self._begun, detail=self._note))
