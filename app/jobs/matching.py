"""The matching jobs of the thesis: corners, correlation, disparity filter, guided matching, lines between matches."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

from ladarreg_core.errors import OptionError
from ladarreg_core.project.edits import switched, with_picks, without_origin
from ladarreg_core.project.results import pose_of

from .inputs import Inputs, Workspace
from .runner import JobContext

if TYPE_CHECKING:
    from ladarreg_core.matches import Pick
    from ladarreg_core.project.document import PhotoEntry
    from ladarreg_core.thesis.matching.matcher import FoundMatches, ThesisSearch

    from ..slices.photographs import Corners

CORNER, BETWEEN = "corner", "between corners"
"""Origins of picks."""


@dataclass(slots=True)
class Search:
    """The search of one photograph, and the picks made from it."""

    key: object
    search: ThesisSearch
    found: FoundMatches | None = None
    ids: tuple[str, ...] = ()


class MatchingJobs:
    """The jobs of the step Match, which share their intermediate results."""

    def __init__(self, workspace: Workspace) -> None:
        self._workspace = workspace
        self._searches: dict[str, Search] = {}

    def corners(self, photo_id: str) -> Corners | None:
        """Return the corners, as rays and pixels; None before the search."""
        found = self._searches.get(photo_id)
        if found is None:
            return None
        search = found.search
        photo = search.photo
        rays = search.scan.view.rays_at(search.scan_uv)
        uv = photo.source.project(photo.cameras[0].unproject(search.photo_uv))
        return {"scan": rays.tolist(), "photo": uv.tolist()}

    def find_corners(self, inputs: Inputs, context: JobContext) -> str:
        """Find corners in both images."""
        search = self._search(inputs, context)
        with _timed_step(context, "corners") as detail:
            detail.update(scan=len(search.search.scan_uv), photo=len(search.search.photo_uv))
        return f"{len(search.search.scan_uv)} corners in the scan, {len(search.search.photo_uv)} in the photograph."

    def match(self, inputs: Inputs, context: JobContext) -> str:
        """Correlate all corners and keep the unambiguous pairs, or those that a rough pose predicts."""
        from ladarreg_core.thesis.matching.chain import matched_corners

        search = self._search(inputs, context)
        found = matched_corners(search.search, inputs.photo.pinhole, report=context.step)
        context.check()
        self._commit(inputs, search, found, f"Match {len(found)} corners", context)
        if found.predicted_uv is None:
            return (
                f"{len(found)} matches; their best correlation exceeds the second best by {inputs.settings.t1:g} or "
                "more."
            )
        return (
            f"{len(found)} matches near what a rough pose predicts: too few correlate by {inputs.settings.t1:g} better "
            "than the second best."
        )

    def cull(self, inputs: Inputs, context: JobContext) -> str:
        """Disable matches whose disparity deviates from the median."""
        search = self._searches.get(inputs.entry.id)
        if search is None or search.found is None or search.key != self._key(inputs):
            raise OptionError("there are no corner matches to filter; match corners first")
        with _timed_step(context, "disparity culling") as detail:
            kept = search.search.filtered(search.found)
            pairs = {(*a, *b) for a, b in zip(kept.scan_uv.tolist(), kept.photo_uv.tolist(), strict=True)}
            on = {
                name: (*a, *b) in pairs
                for name, a, b in zip(
                    search.ids, search.found.scan_uv.tolist(), search.found.photo_uv.tolist(), strict=True
                )
            }
            detail.update(matches=len(kept), removed=len(on) - len(kept))
        off = len(on) - len(kept)
        self._workspace.commit(
            inputs, f"Filter out {off} matches", lambda p: switched(p, on), author=context.job.author
        )
        return f"{len(kept)} of {len(on)} matches have consistent disparities; {off} disabled."

    def constrained(self, inputs: Inputs, context: JobContext) -> str:
        """Match again near the positions that the pose predicts."""
        pose = inputs.entry.stage("linear") or inputs.entry.pose
        if pose is None:
            raise OptionError("guided matching needs a pose; compute the linear solution first")
        search = self._search(inputs, context)
        first = pose_of(pose)
        with _timed_step(context, "constrained search") as detail:
            found = search.search.constrained(first)
            detail.update(matches=len(found))
        context.check()
        with _timed_step(context, "disparity culling") as detail:
            kept = search.search.filtered(found)
            detail.update(matches=len(kept), removed=len(found) - len(kept))
        self._commit(inputs, search, kept, f"Guided matching: {len(kept)} matches", context)
        return f"{len(found)} matches near the predicted positions, {len(kept)} with consistent disparities."

    def densify(self, inputs: Inputs, context: JobContext) -> str:
        """Add points along lines between matches on a common plane."""
        search = self._searches.get(inputs.entry.id)
        if search is None or search.found is None or search.key != self._key(inputs):
            raise OptionError("there are no corner matches to connect; match corners first")
        pose = inputs.entry.pose
        known = None if pose is None else pose_of(pose)
        on = {pick.id for pick in inputs.entry.picks if pick.on}
        kept = search.found.subset([k for k, name in enumerate(search.ids) if name in on])
        with _timed_step(context, "lines between matches") as detail:
            more = search.search.densified(kept, known)
            added = _picks_of(more, BETWEEN)[len(kept) :]
            detail.update(matches=len(more), added=len(added))
        if not added:
            return "No two matches lie on a common plane; nothing was added."
        self._workspace.commit(
            inputs,
            f"Add {len(added)} points between matches",
            lambda p: with_picks(without_origin(p, {BETWEEN}), added)[0],
            author=context.job.author,
        )
        return f"Added {len(added)} points along lines between {len(kept)} matches."

    def _commit(self, inputs: Inputs, search: Search, found: FoundMatches, label: str, context: JobContext) -> None:
        new = _picks_of(found, CORNER)
        ids: tuple[str, ...] = ()

        def replaced(photo: PhotoEntry) -> PhotoEntry:
            nonlocal ids
            photo, ids = with_picks(without_origin(photo, {CORNER, BETWEEN}), new)
            return photo

        self._workspace.commit(inputs, label, replaced, author=context.job.author)
        search.found, search.ids = found, ids

    def _key(self, inputs: Inputs) -> object:
        entry = inputs.entry
        return (inputs.document.scan, entry.source, entry.camera, inputs.settings.match_options)

    def _search(self, inputs: Inputs, context: JobContext) -> Search:
        key = self._key(inputs)
        known = self._searches.get(inputs.entry.id)
        if known is not None and known.key == key:
            return known
        from ladarreg_core.thesis.matching.chain import thesis_search

        context.job.message = "finding corners"
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


@contextmanager
def _timed_step(context: JobContext, name: str) -> Iterator[dict[str, object]]:
    """Time a step and report it with the figures that are put into the yielded dict."""
    from ladarreg_core.results.steps import Step

    begun = time.perf_counter()
    detail: dict[str, object] = {}
    yield detail
    context.step(Step(name, time.perf_counter() - begun, detail=detail))
