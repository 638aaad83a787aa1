"""Compares what the workbench and its page say of a project's stations with the project, as it lies on the disk."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from ladarreg_core.project.station_edits import is_stale, stated_station

if TYPE_CHECKING:
    from ladarreg_core.project.document import Document

_PLACED = {"fixed", "registered", "kept"}
_STATES = {
    "fixed": "fixed",
    "kept": "as its file states",
    "stated": "as its file states, not verified",
    "out": "not registered",
    "waiting": "waiting",
}


def server_stations(document: Document, told: dict[str, Any] | None) -> list[str]:
    """Return where the slice `stations` says something else than the document."""
    if document.scan is None or not document.stations:
        return [] if told is None else ["stations: the workbench lists some, and the project has one scan"]
    if told is None:
        return ["stations: the workbench lists none, and the project has some"]
    sources = [document.scan, *(station.source for station in document.stations)]
    stated = [stated_station(document.survey, source) for source in sources]
    states = [each["state"] if each else "waiting" for each in stated]
    current = document.survey is not None and not is_stale(document)
    true = {
        "names": [source.name for source in sources],
        "states": states,
        "registered": document.survey is not None,
        "stale": is_stale(document),
        "done": current and set(states) <= _PLACED and len(set(states)) > 1,
        "pairs": [] if document.survey is None else [pair["verdict"] for pair in document.survey.fields["pairs"]],
        "checks": [] if document.survey is None else [check.outcome for check in document.survey.checks],
        "rough": [False, *(station.rough is not None for station in document.stations)],
    }
    said = {
        "names": [each["name"] for each in told["stations"]],
        "states": [each["state"] for each in told["stations"]],
        "registered": told["registered"],
        "stale": told["stale"],
        "done": told["done"],
        "pairs": [each["verdict"] for each in told["pairs"]],
        "checks": [each["outcome"] for each in told["checks"]],
        "rough": [each["rough"] for each in told["stations"]],
    }
    return [
        f"{name} of the stations: the workbench says {said[name]!r}, the project is {true[name]!r}"
        for name in true
        if said[name] != true[name]
    ]


def page_stations(
    facts: dict[str, Any], told: dict[str, Any] | None, survey: dict[str, Any] | None = None
) -> list[str]:
    """Return where the page says something else of the stations than the slice."""
    slice_ = told or {"stations": [], "pairs": [], "loops": [], "checks": [], "done": False}
    tab, step = facts["tabs"]["stations"], facts["stations"]
    compared = [
        ("tick", (tab["done"], tab["ticked"]), (slice_["done"], slice_["done"])),
        ("rows", step["rows"], [_row(each) for each in slice_["stations"]]),
        ("verdicts", step["verdicts"], _verdicts(slice_, survey)),
        ("whole", step["whole"], _whole(slice_)),
    ]
    if told is not None:
        said = f"{'Done. ' if slice_['done'] else ''}{slice_['status']} {slice_['missing']}".strip()
        compared.append(("tab", tab["said"], said))
    return [f"{what} of the stations: the page says {a!r}, and it is {b!r}" for what, a, b in compared if a != b]


def _row(station: dict[str, Any]) -> list[str]:
    name = station["name"] if not station["index"] else f"{station['name']}, scan {station['index'] + 1}"
    if station["id"] is None:
        return [name, "shown", ""]
    state = _STATES.get(station["state"], "registered")
    if station["state"] == "registered":
        state = _sigma(station) or "registered"
    elif station["rough"] and station["state"] in ("waiting", "out"):
        state = "rough place"
    place = station["place"]
    where = "" if place is None else ", ".join(_fixed(place[axis], 3) for axis in "xyz")
    return [name, state, where and f"{where} m, {_fixed(place['yaw_deg'], 2)}°"]


def _verdicts(told: dict[str, Any], survey: dict[str, Any] | None) -> list[str]:
    found = []
    for pair in told["pairs"]:
        sigma = f"{_sigma(pair)}." if pair["verdict"] == "verified" and _sigma(pair) else ""
        found.append(f"{pair['first']} – {pair['second']}: {pair['verdict']}")
        found.append(" ".join(filter(None, [sigma, *pair["reasons"]])))
    for loop in told["loops"]:
        found.append(f"Loop {' → '.join(loop['stations'])}")
        found.append(f"closes within {loop['error_mm']:.1f} mm and {loop['error_deg']:.3f}°.")
    for scan in survey["scans"] if survey and not told["pairs"] and len(survey["scans"]) > 1 else []:
        placed = scan["state"] == "placed"
        found.append(f"{scan['name']}: {'placed by adjusting everything together' if placed else scan['state']}")
        found.append(f"σ {scan['position']}, {scan['angle']}." if placed else "")
    for check in told["checks"]:
        said = "The photograph has another pose by now: check it again." if check["stale"] else check["sentence"]
        found += [f"{check['name']} at {check['station']}: {check['outcome']}", said]
    return [text for text in found if text]


def _whole(told: dict[str, Any]) -> str:
    if not told.get("registered"):
        return ""
    if told["stale"]:
        return "Stations have come or gone since, or got further clouds: register them again."
    return " ".join(told["reasons"])


def _sigma(of: dict[str, Any]) -> str:
    if of["sigma_mm"] is None or of["sigma_deg"] is None:
        return ""
    mm, degrees = (max(math.ceil(of[name] * 10**n) / 10**n, 10**-n) for name, n in (("sigma_mm", 1), ("sigma_deg", 3)))
    return f"σ ≤ {mm:.1f} mm, {degrees:.3f}°"


def _fixed(value: float, decimals: int) -> str:
    text = f"{abs(value):.{decimals}f}"
    return f"−{text}" if value < 0 and float(text) else text
