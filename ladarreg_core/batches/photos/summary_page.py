"""The summary page of a run, `index.html`: one self-contained file; what was not accepted comes first."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ladarreg_core.export.report.style import STYLE, SUMMARY_STYLE
from ladarreg_core.foundations.formatting import format_angle, format_length
from ladarreg_core.foundations.markup import Content, DataUri, Html, joined, section, table, tag
from ladarreg_core.storage.atomic_write import write_bytes
from ladarreg_core.storage.checksums import sealed_page
from ladarreg_core.storage.replacement import REPORT_FILE

_MAX_REASONS = 4
_BADGES = (("bad", "failed"), ("bad", "not accepted"), ("warn", "accepted, coarse"), ("ok", "accepted"))
"""By `_rank`."""


def write_summary_page(path: Path, document: Mapping[str, Any], results: Mapping[str, Mapping[str, Any]]) -> None:
    """Write the page with its checksum, see `sealed_page`; the arguments are those of `summary_page`.

    Raises:
        ExportError: if it cannot be written.
    """
    write_bytes(path, sealed_page(summary_page(document, results).encode("utf-8")))


def summary_page(document: Mapping[str, Any], results: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the page as HTML without scripts, that refers to nothing but the reports beside it.

    Args:
        document: the contents of `adjustment.json`.
        results: what is known of each photograph, by its id, with its `thumbnail`.
    """
    scan = next(iter(document["scans"].values()))
    photos = document["photos"]
    accepted = sum(one["accepted"] for one in photos.values())
    title = f"{len(photos)} photographs on {scan['name']}"
    kind = "ok" if accepted == len(photos) else "bad" if accepted == 0 else "warn"
    badge = tag("span", f"{accepted} of {len(photos)} accepted", class_=f"badge {kind}")
    files = [tag("li", f"{one['name']}, SHA-256 {one['sha256']}") for one in scan["inputs"]]
    body = [
        tag("header", tag("h1", title), tag("p", badge)),
        section("photographs", "Photographs", _photos(photos, results)),
        section("cameras", "Cameras", _cameras(document["cameras"])),
        section("scan", "Scan", tag("ul", files), tag("ul", [tag("li", note) for note in scan["notes"]])),
    ]
    return whole_page(title, body)


def whole_page(title: str, body: Sequence[Html], *, style: str = "", script: str = "") -> str:
    """Return a self-contained page as HTML.

    Args:
        title: its title.
        body: its header and sections.
        style: what its style sheet has besides that of all summaries.
        script: of the page; it must not be needed to read it.
    """
    head = tag(
        "head",
        Html('<meta charset="utf-8">'),
        tag("meta", name="viewport", content="width=device-width, initial-scale=1"),
        tag("meta", name="referrer", content="no-referrer"),
        tag("title", title),
        tag("style", Html(STYLE + SUMMARY_STYLE + style)),
    )
    scripts = [tag("script", Html(script))] if script else []
    return f"<!DOCTYPE html>\n{tag('html', head, tag('body', tag('main', *body), *scripts), lang='en')}\n"


def summary_row(
    name: str, badge: tuple[str, str], text: Sequence[Content], *, thumbnail: str, link: str | None, note: str,
    **data: str | float | None,
) -> Html:  # fmt: skip
    """Return a row of the table of a summary: picture, name with its badge, what there is to say, and a note.

    Args:
        name: of the photograph or job.
        badge: class and words of its verdict.
        text: paragraphs and lists.
        thumbnail: JPEG in Base64; empty: none.
        link: to its report; None: it has none.
        note: last cell.
        data: further attributes of the row.
    """
    kind, words = badge
    uri = DataUri(f"data:image/jpeg;base64,{thumbnail}") if thumbnail else None
    picture: Content = tag("img", src=uri, alt=name, loading="lazy") if uri else ""
    cell: list[Content] = [tag("p", tag("b", name), " ", tag("span", words, class_=f"badge {kind}")), *text]
    if link is not None:
        cell.append(tag("p", tag("a", "Report", href=link)))
    return tag("tr", tag("td", picture), tag("td", *cell), tag("td", note, class_="dim"), **data)


def sigma_words(sigma: Mapping[str, float]) -> str:
    """Return the standard deviations of a pose."""
    return f"Sigma {_length(sigma['position_m'])}, {_angle(sigma['angle_rad'])}"


def _photos(photos: Mapping[str, Mapping[str, Any]], results: Mapping[str, Mapping[str, Any]]) -> Html:
    """Return the table of the photographs: failed, refused, accepted coarsely, accepted; each in their order."""
    rows = sorted(photos.items(), key=lambda item: _rank(item[1]))
    return tag("table", tag("tbody", [_row(one, results[name]) for name, one in rows]), class_="photos")


def _rank(photo: Mapping[str, Any]) -> int:
    if photo["accepted"]:
        return 2 if photo["precision"] == "coarse" else 3
    return 1 if photo["folder"] else 0


def _row(photo: Mapping[str, Any], result: Mapping[str, Any]) -> Html:
    text: list[Content] = [tag("p", str(photo["verdict"]))]
    if photo["sigma"] is not None and photo["accepted"]:
        text.append(tag("p", sigma_words(photo["sigma"])))
    text.append(tag("ul", [tag("li", reason) for reason in photo["reasons"][-_MAX_REASONS:]]))
    return summary_row(
        str(photo["input"]["name"]), _BADGES[_rank(photo)], text, thumbnail=str(result.get("thumbnail") or ""),
        link=f"{photo['folder']}/{REPORT_FILE}" if photo["folder"] else None, note=str(photo["camera"] or ""),
    )  # fmt: skip


def _cameras(cameras: Mapping[str, Mapping[str, Any]]) -> Html:
    rows = []
    for name, one in cameras.items():
        fields, sigmas = one["camera"], one["sigmas"]
        focal = "not determined" if fields is None else f"{fields.get('fx', float('nan')):.1f}"
        sigma = f"+- {sigmas['focal_px']:.1f}" if "focal_px" in sigmas else ""
        rows.append((name, one["is"], focal, sigma, _pooled_words(one)))
    heads = ("camera", "body, lens, focal length, size", "focal length, px", "sigma, px", "pooled over")
    return joined(
        table(heads, rows, numbers=(2, 3)),
        tag("p", "Photographs of one body, lens, focal length and size share one camera.", class_="dim"),
    )


def _pooled_words(camera: Mapping[str, Any]) -> str:
    if not camera["pooled"]:
        return f"not pooled, of {len(camera['photos'])}"
    words = f"{len(camera['pooled'])} of {len(camera['photos'])} photographs"
    return words + (f"; disagreeing: {', '.join(camera['disagreeing'])}" if camera["disagreeing"] else "")


def _length(metres: float) -> str:
    return format_length(metres) if math.isfinite(metres) else "unknown"


def _angle(radians: float) -> str:
    return format_angle(radians) if math.isfinite(radians) else "unknown"
