"""The sections of a report that state what its document records: quality, files, method, options and software."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ladarreg_core.foundations.markup import Content, Html, definitions, section, table, tag

Document = Mapping[str, Any]
_MAX_ADVICE = 3
_MAX_LENGTHS = 100
_GROUPS: Mapping[str, tuple[str, ...]] = {"auto": ("auto",), "manual": ("pose",), "thesis": ("thesis",)}
"""The groups of `RegisterOptions` that the methods use; other methods may use all."""
_LEVELS = {"good": "ok", "fair": "warn", "poor": "bad"}
_ORDER = ("poor", "fair", "good")


def quality_section(document: Document, *, pose_known: bool) -> Html:
    """Return the findings, the positions where another match would help, and what could not be assessed.

    Args:
        document: the document of the registration.
        pose_known: whether its pose, or the rejected guess, is known well enough for findings on it to mean anything.
    """
    parts: list[Content] = []
    findings = list(document.get("findings") or ())
    if not pose_known:
        findings = []  # of a pose that was not found nothing is good or poor
    if findings:
        rows = [
            tag(
                "tr",
                tag("td", tag("span", str(f["level"]), class_=f"badge {_LEVELS.get(str(f['level']), 'warn')}")),
                tag("td", str(f["sentence"]), " ", tag("em", str(f.get("what_to_do") or ""))),
            )
            for f in sorted(findings, key=lambda f: _ORDER.index(f["level"]) if f["level"] in _ORDER else 0)
        ]
        parts.append(tag("table", tag("tbody", rows), class_="findings"))
    parts += _lengths(document)
    advice = list(document.get("advice") or ())[:_MAX_ADVICE]
    if advice and pose_known:
        parts += [
            tag("h3", "Where another match would help most"),
            tag("ul", [tag("li", str(a["sentence"])) for a in advice]),
        ]
    absent = dict(document.get("not_assessed") or {})
    if absent:
        parts += [
            tag("h3", "Not assessed"),
            tag("ul", [tag("li", f"{name}: {why}") for name, why in absent.items()]),
        ]
    smoothing = document.get("smoothing")
    if smoothing:
        parts.append(tag("p", f"Range spikes: {smoothing.get('sentence', '')}"))
    return section("quality", "Quality", *(parts or [tag("p", "Nothing was assessed.")]))


def _lengths(document: Document) -> list[Content]:
    """Return the lengths that came with matches beside the scan's own ranges, the largest differences first."""
    found = (document.get("diagnostics") or {}).get("lengths") or {}
    listed = sorted(found.get("matches") or (), key=lambda one: -abs(one["difference_m"] or 0))
    if not listed:
        return []
    rows = [
        (
            str(one["name"]),
            f"{one['length_m']:.3f}",
            "none" if one["scan_range_m"] is None else f"{one['scan_range_m']:.3f}",
            "" if one["difference_m"] is None else f"{one['difference_m']:+.3f}",
            f"{one['tolerance_m']:.3f}",
            "beyond" if one["beyond"] else "" if one["state"] == "compared" else str(one["state"]),
        )
        for one in listed[:_MAX_LENGTHS]
    ]
    heads = ("match", "length m", "scan m", "difference m", "tolerance m", "")
    parts: list[Content] = [tag("h3", "Lengths of the matches and the scan's own ranges")]
    parts.append(table(heads, rows, numbers=(1, 2, 3, 4)))
    if len(listed) > len(rows):
        parts.append(tag("p", f"The {len(rows)} largest differences of {len(listed)}.", class_="dim"))
    return parts


def files_section(document: Document) -> Html:
    """Return the input files with their sizes and hashes."""
    inputs = list(document.get("inputs") or ())
    if not inputs:
        return section("files", "Files", tag("p", "The input files were not recorded."))
    rows = [(str(f["name"]), f"{int(f['size']):,}", str(f["sha256"])) for f in inputs]
    return section("files", "Files", table(("file", "bytes", "SHA-256"), rows, numbers=(1,), code=(2,)))


def method_section(document: Document) -> Html:
    """Return the method, its steps, and the options that it uses."""
    steps = _summed_steps(document)
    options = _flat(_options_of(str(document.get("method")), document.get("options") or {}))
    parts: list[Content] = [definitions([("Method", str(document.get("method"))), ("Seed", str(document.get("seed")))])]
    if steps:
        timed = any(step.get("seconds") is not None for step in document.get("steps") or ())
        listed_steps = (
            table(("step", "times", "seconds", "matches"), steps, numbers=(1, 2, 3)) if timed else
            table(("step", "times", "matches"), [(name, n, count) for name, n, _, count in steps], numbers=(1, 2))
        )  # fmt: skip
        parts += [tag("h3", "Steps"), tag("div", listed_steps, class_="steps")]
    if options:
        listed = [tag("div", tag("code", name), " ", tag("span", value)) for name, value in options]
        parts += [
            tag("h3", "Options"),
            tag("p", "Those of this method; registration.json has all.", class_="dim"),
            tag("div", listed, class_="options"),
        ]
    return section("options", "Method and options", *parts)


def _summed_steps(document: Document) -> list[tuple[str, str, str, str]]:
    """Return name, count, seconds and last number of matches of the steps, those of one name in one row."""
    found: dict[str, tuple[int, float, str]] = {}
    for step in document.get("steps") or ():
        times, seconds, matches = found.get(str(step["name"]), (0, 0.0, ""))
        if step.get("matches") is not None:
            matches = str(step["matches"])
        found[str(step["name"])] = times + 1, seconds + float(step["seconds"] or 0.0), matches
    return [(name, str(n), f"{seconds:.2f}", matches) for name, (n, seconds, matches) in found.items()]


def _options_of(method: str, options: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the options without the groups of other methods."""
    used = _GROUPS.get(method)
    if used is None:
        return options
    others = {group for groups in _GROUPS.values() for group in groups} - set(used)
    return {name: value for name, value in options.items() if name not in others}


def software_section(document: Document) -> Html:
    """Return the versions of the software."""
    rows = [(str(name), str(version)) for name, version in (document.get("software") or {}).items()]
    return section("software", "Software", definitions(rows))


def _flat(value: Any, name: str = "") -> list[tuple[str, str]]:
    """Return nested options as pairs of a dotted name and a value."""
    if isinstance(value, Mapping):
        return [pair for key, item in value.items() for pair in _flat(item, f"{name}.{key}" if name else str(key))]
    return [(name, plain_text(value))]


def plain_text(value: Any) -> str:
    """Return a value of the document as text."""
    if value is None:
        return "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(plain_text(item) for item in value) + "]"
    return str(value)
