"""Whether a pose still belongs to the matches of its photograph, or these have changed since it was solved."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ladarreg_core.project.document import PhotoEntry, PickEntry, PoseEntry

_FROM_IMAGES = ("auto", "survey", "carried")


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


def stale(
    photo: PhotoEntry, pose: PoseEntry, solved_on: Sequence[PickEntry] | None, clouds: int, ranges: str = ""
) -> str:
    """Return why a pose is out of date, as a sentence without its full stop; empty if it is current.

    A change of the camera, or another scan, is not stated: it removes the poses. A pose that was found in the images
    does not rest on the matches, so that it stays current whatever becomes of them; every pose rests on the scan, which
    further clouds and smoothed ranges change.

    Args:
        photo: the photograph.
        pose: one of its poses.
        solved_on: the enabled picks that it was solved on, see `results.solved_on`.
        clouds: number of clouds that the scan consists of now.
        ranges: name of its ranges now, see `Source.ranges`.
    """
    causes = []
    if pose.clouds != clouds:
        causes.append(f"solved on {'fewer' if pose.clouds < clouds else 'more'} clouds")
    if pose.ranges != ranges:
        causes.append("solved on other ranges of the scan")
    if count := _changed_matches(photo, pose, solved_on):
        causes.append(f"{_matches(count)} changed since")
    what = "register" if is_from_images(pose) else "solve"
    return f"{', '.join(causes)}: {what} again" if causes else ""


def is_from_images(pose: PoseEntry) -> bool:
    """Return whether a pose rests on the images or on another pose, so that its matches only illustrate it."""
    return pose.stage in _FROM_IMAGES


def rests_on(
    photo: PhotoEntry, pose: PoseEntry, solved_on: Sequence[PickEntry] | None, clouds: int, ranges: str = ""
) -> dict[str, Any] | None:
    """Return what a pose rests on, for `registration.json`: ids of matches, and whether it is still the same.

    Args:
        photo: the photograph.
        pose: one of its poses.
        solved_on: the enabled picks that it was solved on; None: not known, or it was not solved on any.
        clouds: number of clouds that the scan consists of now.
        ranges: name of its ranges now, see `Source.ranges`.

    Returns:
        `matches`, `current` and `sentence`; None if it is not known, and the scan is the same.
    """
    since = stale(photo, pose, solved_on, clouds, ranges)
    if solved_on is None and not since:
        return None
    from_images = solved_on is None or is_from_images(pose)
    what = "the images" if from_images else f"{_matches(len(solved_on or ()))} in matches.json"
    sentence = f"The pose rests on {what}."
    if since:
        sentence += " It is the last solved state:"
    if pose.clouds != clouds:
        sentence += f" the scan had {_clouds(pose.clouds)} then, and has {_clouds(clouds)} now."
    if pose.ranges != ranges:
        sentence += " ranges of the scan were replaced, or measured ones restored, since."
    if count := _changed_matches(photo, pose, solved_on):
        sentence += (
            f" {_matches(count)} of the project changed afterwards, and matches.json contains them as they were when "
            "the pose was solved."
        )
    return {"matches": [pick.id for pick in solved_on or ()], "current": not since, "sentence": sentence}


def _changed_matches(photo: PhotoEntry, pose: PoseEntry, solved_on: Sequence[PickEntry] | None) -> int:
    return 0 if is_from_images(pose) else len(changed_since(photo, solved_on))


def _clouds(count: int) -> str:
    return "1 cloud" if count == 1 else f"{count} clouds"


def _matches(count: int) -> str:
    return "1 match" if count == 1 else f"{count} matches"


def _substance(pick: PickEntry) -> tuple[object, ...]:
    """Return what solvers use of a pick."""
    return pick.kind, pick.scan, pick.photo, pick.weight, pick.lengths_m
