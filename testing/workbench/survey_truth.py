"""Compares what the page says of all photographs, in the step Survey, with what the workbench sent."""

from __future__ import annotations

from typing import Any

_NEVER_ADJUSTED = "Adjust solves all photographs"
_NO_PHOTOGRAPH = "Add photographs"


def page_survey(
    facts: dict[str, Any], photos: list[dict[str, Any]], survey: dict[str, Any] | None, drawn: int
) -> list[str]:
    """Return where the page says something else of the photographs than the slices; `drawn`: ties and lines."""
    said = facts["survey"]
    accepted = sum(photo["state"] == "accepted" for photo in photos)
    compared = [
        ("ties", said["ties"], f"Ties {drawn}" if drawn else "Ties"),
        ("count", said["count"], f"{accepted} of {len(photos)} accepted" if photos else ""),
        ("rows", said["rows"], [_row(photo, _of(photo, survey)) for photo in photos]),
        ("summary", said["summary"].startswith(_summary(photos, survey)), True),
    ]
    return [f"{what} of the survey: the page says {a!r}, and it is {b!r}" for what, a, b in compared if a != b]


def _of(photo: dict[str, Any], survey: dict[str, Any] | None) -> dict[str, Any] | None:
    """Return what the survey says of a photograph as it is now."""
    found = [] if survey is None else [one for one in survey["photos"] if one["id"] == photo["id"]]
    return found[0] if found and not found[0]["changed"] else None


def _row(photo: dict[str, Any], found: dict[str, Any] | None) -> list[str]:
    refused = found is not None and not found["accepted"] and not photo.get("light")
    if photo.get("error"):
        state = "cannot be read"
    elif not photo["camera"]:
        state = "focal length unknown"
    elif photo["part"] == "out":
        state = "taken out"
    else:
        state = photo.get("light_words") or ("not accepted" if refused else "waiting")
        state += ", held" if photo["part"] == "held" else ""
    position = f"± {photo['position']}" if photo.get("position") else ""
    if found is None:
        return [photo["name"], state, position, "–", "–"]
    out = f" · {found['ties_left_out']} out" if found["ties_left_out"] else ""
    px = "–" if found["median_px"] is None else f"{found['median_px']:.2f}"
    return [photo["name"], state, position, f"{found['ties']}{out}", px]


def _summary(photos: list[dict[str, Any]], survey: dict[str, Any] | None) -> str:
    if not photos:
        return _NO_PHOTOGRAPH
    if survey is None:
        return _NEVER_ADJUSTED
    return str(survey["since"]) or f"Adjusted together: {survey['accepted']} of {len(survey['photos'])} photographs"
