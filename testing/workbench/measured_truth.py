"""Compares what the page says of measurements, in the step Judge, with what the workbench sent."""

from __future__ import annotations

from typing import Any


def page_measurements(
    facts: dict[str, Any],
    measurements: list[dict[str, Any]],
    measured: list[dict[str, Any]],
    stations: dict[str, Any] | None,
) -> list[str]:
    """Return where the page says something else of the measurements than the slices."""
    values = {one["id"]: one for one in measured}
    scans = {one["id"] or "": one["name"] for one in (stations or {"stations": []})["stations"]}
    wanted = [_row(one["name"], values.get(one["id"]), scans.get(one["station"], "")) for one in measurements]
    if facts["measurements"] == wanted:
        return []
    return [f"the page says of the measurements {facts['measurements']!r}, and it is {wanted!r}"]


def _row(name: str, found: dict[str, Any] | None, scan: str) -> list[str]:
    on = [f"on {scan}"] if scan else []
    if found is None:
        return [name, "…", *(on or [""])]
    interval = [f"95 %: {found['interval']}"] if found["interval"] else []
    notes = [found["refusal"]] if found["refusal"] else found["notes"]
    return [name, found["value"] or "Not measured", " · ".join([*interval, *on]), *notes]


def page_smoothing(facts: dict[str, Any], smoothing: dict[str, Any]) -> list[str]:
    """Return where the page says something else of smoothed ranges than the slice; of what it shows at the moment."""
    shown = facts["smoothing"]
    if shown["hidden"]:
        return []
    preview = smoothing["preview"]
    rows = [
        [
            one["id"], "Depth edge" if one["edge"] else "Spike", f"{one['before_m']:.3f}", f"{one['after_m']:.3f}",
            f"{one['after_m'] - one['before_m']:+.3f}".replace("-", "\N{MINUS SIGN}"), f"{one['sigma_m']:.3f}",
        ]
        for one in (preview["ranges"] if preview else ())
    ]  # fmt: skip
    applied = f"{smoothing['sentence']} Restore" if smoothing["replaced"] else ""
    wanted = {"hidden": False, "applied": applied, "rows": rows}
    return [] if shown == wanted else [f"the page says of smoothed ranges {shown!r}, and it is {wanted!r}"]
