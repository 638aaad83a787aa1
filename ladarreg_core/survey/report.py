"""The report of a survey, `report.html`: a map, the photographs, cameras and scans, and what disagrees most."""

from __future__ import annotations

import json
from collections.abc import Mapping

import numpy as np

from ladarreg_core.export.report.style import STYLE, SUMMARY_STYLE
from ladarreg_core.foundations.formatting import format_angle, format_length
from ladarreg_core.foundations.markup import Content, DataUri, Html, joined, section, table, tag
from ladarreg_core.storage.checksums import sealed_page
from ladarreg_core.storage.replacement import REPORT_FILE
from ladarreg_core.survey.adjustment import AdjustedLine, AdjustedPhoto, Adjustment
from ladarreg_core.survey.least_squares.problem import Matrix
from ladarreg_core.survey.survey import Survey

_WIDTH, _HEIGHT, _MARGIN = 760.0, 520.0, 40.0
_INK, _FAINT, _IMAGE, _TIES, _STATION = "#39424f", "#d5dae1", "#1c7a4d", "#0b5cad", "#b25d00"
_VISIBLE_PX = 9.0  # half axis that the median ellipse is exaggerated to
_STEPS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000)
_MAX_TIES_SHOWN = 25


def survey_page(adjustment: Adjustment, survey: Survey, pictures: Mapping[str, str]) -> bytes:
    """Return the report as HTML with its checksum; it has no scripts, and refers to nothing but the results beside it.

    Args:
        adjustment: the adjustment.
        survey: the survey.
        pictures: a small JPEG of each photograph in Base64, by its id.
    """
    photos = adjustment.photos
    accepted = sum(one.accepted for one in photos.values())
    title = (
        f"Survey: {len(photos)} photographs on {len(adjustment.scans)} scan{'s' if len(adjustment.scans) > 1 else ''}"
    )
    kind = "ok" if accepted == len(photos) else "bad" if accepted == 0 else "warn"
    badge = tag("span", f"{accepted} of {len(photos)} accepted", class_=f"badge {kind}")
    body = [
        tag("header", tag("h1", title), tag("p", badge)),
        section("map", "Map", *_map(adjustment)),
        section("photographs", "Photographs", _photos(adjustment, survey, pictures)),
        section("cameras", "Cameras", _cameras(adjustment)),
        section("scans", "Scans", _scans(adjustment)),
        section("residuals", "Ties that disagree most", _residuals(adjustment)),
        section("provenance", "Inputs and options", _provenance(adjustment)),
    ]  # fmt: skip
    head = tag(
        "head",
        Html('<meta charset="utf-8">'),
        tag("meta", name="viewport", content="width=device-width, initial-scale=1"),
        tag("meta", name="referrer", content="no-referrer"),
        tag("title", title),
        tag("style", Html(STYLE + SUMMARY_STYLE)),
    )
    page = f"<!DOCTYPE html>\n{tag('html', head, tag('body', tag('main', *body)), lang='en')}\n"
    return sealed_page(page.encode("utf-8"))


def exaggeration(sigmas_px: Matrix) -> int:
    """Return the factor by which ellipses with these half axes, px, are drawn, so that the median one is seen."""
    known = sigmas_px[np.isfinite(sigmas_px) & (sigmas_px > 0)]
    if not len(known):
        return 1
    wanted = _VISIBLE_PX / float(np.median(known))
    return max([step for step in _STEPS if step <= wanted], default=1)


def _map(adjustment: Adjustment) -> list[Html]:
    """Return the map from above with its legend: scanners, cameras with their directions, and error ellipses."""
    stations = {name: one.world_from_scanner for name, one in adjustment.scans.items() if one.world_from_scanner}
    cameras = {name: one for name, one in adjustment.photos.items() if one.camera_from_world is not None}
    if not stations and not cameras:
        return [tag("p", "Nothing has a place.")]
    centres = np.array([
        *(pose.translation[:2] for pose in stations.values()),
        *(one.camera_from_world.centre[:2] for one in cameras.values() if one.camera_from_world is not None),
    ])  # fmt: skip
    low, high = centres.min(axis=0) - 0.5, centres.max(axis=0) + 0.5
    scale = float(min((_WIDTH - 2 * _MARGIN) / (high[0] - low[0]), (_HEIGHT - 2 * _MARGIN) / (high[1] - low[1])))
    middle = (low + high) / 2

    def at(xy: Matrix) -> tuple[float, float]:
        x, y = (xy[:2] - middle) * scale
        return _WIDTH / 2 + float(x), _HEIGHT / 2 - float(y)

    axes = {name: _ellipse(one.covariance[3:5, 3:5]) for name, one in cameras.items()}
    factor = exaggeration(np.array([max(half) * scale for half, _ in axes.values()]))
    marks: list[Html] = []
    for name, one in cameras.items():
        assert one.camera_from_world is not None
        pose, color = one.camera_from_world, _IMAGE if one.evidence == "image" else _TIES
        x, y = at(pose.centre)
        ahead = pose.rotation[2, :2] / max(float(np.linalg.norm(pose.rotation[2, :2])), 1e-9) * 16
        (long, short), turn = axes[name]
        marks += [
            tag("ellipse", cx=x, cy=y, rx=max(long * scale * factor, 0.5), ry=max(short * scale * factor, 0.5),
                transform=f"rotate({-np.degrees(turn):.2f} {x:.2f} {y:.2f})", fill=color, fill_opacity=0.22,
                stroke=color),
            tag("line", x1=x, y1=y, x2=x + float(ahead[0]), y2=y - float(ahead[1]), stroke=color, stroke_width=2),
            tag("circle", tag("title", name), cx=x, cy=y, r=3, fill=color),
            tag("text", name, x=x + 6, y=y - 6, font_size=10, fill=_INK),
        ]  # fmt: skip
    for name, pose in stations.items():
        x, y = at(pose.translation)
        marks += [
            tag("path", d=f"M{x:.1f} {y - 8:.1f}l7 13h-14z", fill=_STATION),
            tag("text", name, x=x + 9, y=y + 4, font_size=11, font_weight="bold", fill=_INK),
        ]
    bar = _round_length((high[0] - low[0]) / 4)
    marks += [
        tag(
            "line", x1=_MARGIN, y1=_HEIGHT - 14, x2=_MARGIN + bar * scale, y2=_HEIGHT - 14, stroke=_INK, stroke_width=2
        ),
        tag("text", format_length(bar), x=_MARGIN, y=_HEIGHT - 20, font_size=11, fill=_INK),
    ]
    svg = tag(
        "svg", *marks, viewBox=f"0 0 {_WIDTH:g} {_HEIGHT:g}", role="img", aria_label="Map from above", class_="map",
        style="width:100%;max-width:60rem;border:1px solid #d5dae1",
    )  # fmt: skip
    words = (
        f"From above, X of the world to the right. Triangles: scanners; green: photographs verified by a scan's image; "
        f"blue: by ties; lines: where they look. Ellipses: one standard deviation, {factor} times enlarged."
    )
    return [svg, tag("p", words, class_="dim")]


def _ellipse(covariance: Matrix) -> tuple[tuple[float, float], float]:
    """Return the half axes, m, long one first, and the direction of the long one, rad."""
    values, vectors = np.linalg.eigh(covariance)
    half = np.sqrt(np.maximum(values, 0))
    return (float(half[1]), float(half[0])), float(np.arctan2(vectors[1, 1], vectors[0, 1]))


def _photos(adjustment: Adjustment, survey: Survey, pictures: Mapping[str, str]) -> Html:
    """Return the table of the photographs: those that are not accepted first, then by their standard deviation."""
    rows = sorted(adjustment.photos.items(), key=lambda item: (item[1].accepted, -_size(item[1])))
    cameras = {one.id: one.camera for one in survey.photos}
    found = [_row(name, one, pictures.get(name, ""), cameras[name]) for name, one in rows]
    return tag("table", tag("tbody", found), class_="photos")


def _size(one: AdjustedPhoto) -> float:
    return one.sigma_position_m if one.accepted else 0.0


def _row(name: str, one: AdjustedPhoto, picture: str, camera: str) -> Html:
    kind, words = ("bad", "not accepted")
    if one.accepted:
        kind, words = ("warn", f"{one.evidence}, coarse") if one.is_coarse else ("ok", one.evidence)
    image: Content = tag("img", src=DataUri(f"data:image/jpeg;base64,{picture}"), alt=name) if picture else ""
    text: list[Content] = [
        tag("p", tag("b", name), " ", tag("span", words, class_=f"badge {kind}")),
        tag("p", one.verdict),
    ]
    if one.accepted:
        tied = f"{one.ties} ties agree, {one.ties_left_out} do not" + (
            f"; median residual {one.median_px:.2f} px" if np.isfinite(one.median_px) else ""
        )
        sigma = f"{format_length(one.sigma_position_m)}, {format_angle(one.sigma_angle_rad)}, {one.sigma_px:.1f} px"
        text.append(tag("p", f"Sigma {sigma}. {tied}."))
        text.append(tag("p", tag("a", "Results", href=f"photos/{name}/{REPORT_FILE}")))
    text.append(tag("ul", [tag("li", reason) for reason in one.reasons]))
    return tag("tr", tag("td", image), tag("td", *text), tag("td", camera, class_="dim"))


def _cameras(adjustment: Adjustment) -> Html:
    rows = []
    for name, one in adjustment.cameras.items():
        pinhole, sigmas = one.camera.as_pinhole, one.sigmas
        values = (
            {} if pinhole is None else
            {"focal_px": pinhole.focal_px, "k1": pinhole.distortion[0] if pinhole.distortion else 0.0, "cx": pinhole.cx,
             "cy": pinhole.cy}
        )  # fmt: skip
        shown = ", ".join(
            f"{key} {value:.4g} +- {sigmas[key]:.2g}" if key in sigmas else f"{key} {value:.5g}"
            for key, value in values.items()
        )
        size = f"{one.camera.width} x {one.camera.height}"
        rows.append((name, size, shown or "as given", str(len(one.photos))))
    return table(("camera", "size, px", "intrinsics with standard deviations", "photographs"), rows, numbers=(3,))


def _scans(adjustment: Adjustment) -> Html:
    rows = []
    for name, one in adjustment.scans.items():
        known = one.accepted and not one.fixed and np.isfinite(one.covariance).all()
        sigma = (
            f"{format_length(float(np.sqrt(np.trace(one.covariance[3:, 3:]))))}, "
            f"{format_angle(float(np.sqrt(np.trace(one.covariance[:3, :3]))))}"
            if known else "fixed" if one.fixed else "not placed"
        )  # fmt: skip
        rows.append((name, sigma, " ".join(one.reasons)))
    return table(("scan", "sigma", "where it stands"), rows)


def _residuals(adjustment: Adjustment) -> Html:
    if not adjustment.residuals:
        return tag("p", "There are no ties.")
    rows = []
    for one in adjustment.residuals[:_MAX_TIES_SHOWN]:
        length = np.linalg.norm(one.residual_px, axis=1)
        worst = int(np.nanargmax(length))
        rows.append((
            one.photos[worst], f"{one.uv[worst, 0]:.0f}, {one.uv[worst, 1]:.0f}", f"{length[worst]:.1f}",
            ", ".join(name for k, name in enumerate(one.photos) if k != worst),
        ))  # fmt: skip
    words = (
        f"The noise of the ties is {adjustment.sigma_px:.2f} px; chi squared per degree of freedom of what was kept "
        f"is {adjustment.chi2_per_dof:.2f}."
    )
    found = joined(tag("p", words), table(("photograph", "pixel", "residual, px", "also seen in"), rows, numbers=(2,)))
    if adjustment.ties:
        ties = [(one.id, " and ".join(one.photos), one.reason) for one in adjustment.ties]
        found = joined(found, tag("p", "Drawn by hand:"), table(("tie", "photographs", "verdict"), ties))
    if adjustment.lines:
        lines = [(one.id, _line_residuals(one), one.reason) for one in adjustment.lines]
        found = joined(found, tag("p", "Lines drawn by hand:"), table(("line", "residuals", "verdict"), lines))
    return found


def _line_residuals(line: AdjustedLine) -> str:
    found = [
        f"{name} {px:.1f} px" if np.isfinite(px) else f"{name} -"
        for name, px in zip(line.photos, line.residuals_px, strict=True)
    ]
    if np.isfinite(line.scan_residual_m):
        found.append(f"scan {format_length(line.scan_residual_m)}")
    return ", ".join(found)


def _provenance(adjustment: Adjustment) -> Html:
    files = [tag("li", f"{what}: {one['name']}, SHA-256 {one['sha256']}") for what, one in adjustment.inputs.items()]
    options = json.dumps(adjustment.options, indent=1, sort_keys=True)
    return joined(tag("ul", files), tag("details", tag("summary", "Options"), tag("pre", options)) if options else "")


def _round_length(length: float) -> float:
    power = 10.0 ** np.floor(np.log10(max(length, 1e-6)))
    return float(max(step * power for step in (1, 2, 5) if step * power <= length))
