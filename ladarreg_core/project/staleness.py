"""Whether a pose still belongs to the matches of its photograph, or these have changed since it was solved."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ladarreg_core.project.document import PhotoEntry, PickEntry, PoseEntry

_FROM_IMAGES = ("auto", "carried")
"""Stages whose poses rest on the images or on another pose; their matches only illustrate them."""


def changed_since(photo: PhotoEntry, solved_on: Sequence[PickEntry] | None) -> frozenset[str]:
    """Return the ids of the picks that were added, removed, moved, weighted or switched since a pose was solved.

    Args:
        photo: the photograph.
        solved_on: the enabled picks at that time; None if they are not known, which counts as no change.
    """
    if solved_on is None:
        return frozenset()
    then = {pick.id: pick for pick in solved_on}
    now = {pick.id: pick for pick in photo.picks if pick.on}
    appeared_or_gone = then.keys() ^ now.keys()
    changed = {name for name in then.keys() & now.keys() if _substance(then[name]) != _substance(now[name])}
    return frozenset(appeared_or_gone | changed)


def stale(photo: PhotoEntry, pose: PoseEntry, solved_on: Sequence[PickEntry] | None) -> str:
    """Return why a pose is out of date, as a sentence without its full stop; empty if it is current.

    A change of the camera or of the scan is not stated: it removes the poses. A pose that was found in the images does
    not rest on the matches, so that it stays current.

    Args:
        photo: the photograph.
        pose: one of its poses.
        solved_on: the enabled picks that it was solved on, see `results.solved_on`.
    """
    count = 0 if pose.stage in _FROM_IMAGES else len(changed_since(photo, solved_on))
    if not count:
        return ""
    return f"{_matches(count)} changed since: solve again"


def rests_on(photo: PhotoEntry, pose: PoseEntry, solved_on: Sequence[PickEntry]) -> dict[str, Any]:
    """Return on which matches a pose rests, for `registration.json`: their ids, and whether they are still the same.

    Args:
        photo: the photograph.
        pose: one of its poses.
        solved_on: the enabled picks that it was solved on.
    """
    since = stale(photo, pose, solved_on)
    what = "the images" if pose.stage in _FROM_IMAGES else f"{_matches(len(solved_on))} in matches.json"
    sentence = f"The pose rests on {what}."
    if since:
        sentence += (
            f" It is the last solved state: {_matches(len(changed_since(photo, solved_on)))} of the project changed"
            " afterwards, and matches.json contains them as they were when the pose was solved."
        )
    return {"matches": [pick.id for pick in solved_on], "current": not since, "sentence": sentence}


def _matches(count: int) -> str:
    return "1 match" if count == 1 else f"{count} matches"


def _substance(pick: PickEntry) -> tuple[object, ...]:
    """Return what solvers use of a pick."""
    return pick.kind, pick.scan, pick.photo, pick.weight, pick.lengths_m
