"""The report of a registration: one self-contained HTML file to read, to file and to print on A4."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ladarreg_core.export.json import CAMERA_FROM_SCANNER_IS
from ladarreg_core.export.report.match_crops import WorstMatch, crop_legend, match_crops, worst_matches
from ladarreg_core.export.report.pictures import ReportPictures, legend_html
from ladarreg_core.export.report.plots import legend_of_points, residual_plots
from ladarreg_core.export.report.provenance import (
    files_section,
    method_section,
    plain_text,
    quality_section,
    software_section,
)
from ladarreg_core.export.report.style import STYLE
from ladarreg_core.foundations.formatting import format_angle, format_length, format_number
from ladarreg_core.foundations.markup import Content, Html, definitions, figure, joined, section, table, tag
from ladarreg_core.inspection.figures import figures, parameters
from ladarreg_core.photo import Photo
from ladarreg_core.picks.lengths import lengths_by_end
from ladarreg_core.results.registration import Registration
from ladarreg_core.results.verdict_words import verdict_words
from ladarreg_core.scan import Scan
from ladarreg_core.storage.atomic_write import write_bytes
from ladarreg_core.storage.checksums import sealed_page
from ladarreg_core.surface.texture.registered_texture import RegisteredTexture

_MAX_WORST = 6
_MAX_DRAWN_CELLS = 4_000_000
_MAX_SIGMA_RAD = 0.5
_COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4")
_UNITS = {"fx": "px", "fy": "px", "cx": "px", "cy": "px", "width": "px", "height": "px"}


def write_report(
    path: str | Path,
    registration: Registration,
    scan: Scan,
    photo: Photo,
    document: Mapping[str, Any],
    *,
    texture: RegisteredTexture | None = None,
) -> None:
    """Write the report with its checksum, see `sealed_page`; the arguments are those of `report_html`.

    Raises:
        ExportError: if the file cannot be written.
    """
    page = report_html(registration, scan, photo, document, texture=texture)
    write_bytes(path, sealed_page(page.encode("utf-8")))


def report_html(
    registration: Registration,
    scan: Scan,
    photo: Photo,
    document: Mapping[str, Any],
    *,
    texture: RegisteredTexture | None = None,
) -> str:
    """Return the report as HTML without scripts and without references to anything outside of it.

    It depends on its arguments only: the same registration gives the same report, byte for byte.

    Args:
        registration: the result, with its matches.
        scan: the scan.
        photo: the photograph.
        document: `registration_document` of the result, or a `registration.json` that was read.
        texture: the photograph on the scan's grid for this pose, if already computed.

    Raises:
        ShapeError: if the texture is not on the scan's grid.
    """
    report = _Report(registration, scan, photo, document, texture)
    title = f"Registration of {photo.name} with {scan.name}"
    head = tag(
        "head",
        Html('<meta charset="utf-8">'),
        tag("meta", name="viewport", content="width=device-width, initial-scale=1"),
        tag("meta", name="referrer", content="no-referrer"),
        tag("title", title),
        tag("style", Html(STYLE)),
    )
    body = tag("body", tag("main", report.header(), *report.sections()))
    return f"<!DOCTYPE html>\n{tag('html', head, body, lang='en')}\n"


class _Report:
    def __init__(
        self,
        registration: Registration,
        scan: Scan,
        photo: Photo,
        document: Mapping[str, Any],
        texture: RegisteredTexture | None,
    ) -> None:
        self._r = registration
        self._scan, self._photo, self._document = scan, photo, document
        # What is drawn of a large scan is reduced to the size of a page anyway.
        self._drawn, stride = scan.thinned(_MAX_DRAWN_CELLS)
        if texture is not None and stride > 1:
            texture = RegisteredTexture(texture.image[::stride, ::stride], texture.labels[::stride, ::stride])
        self._given = registration.evidence == "given"
        rests_on = document.get("rests_on") or {}
        self._rests_on = str(rests_on.get("sentence") or "")
        self._stale = rests_on.get("current") is False
        self._shown = registration.is_shown
        mark = registration.mark or ("out of date" if self._stale else None)
        self._pictures = ReportPictures(
            self._drawn, photo, registration, texture=texture, mark=mark if self._shown else "rejected guess"
        )

    @property
    def _has_guess(self) -> bool:
        """Whether a refused pose is known well enough for its figures to mean anything."""
        r = self._r
        if not r.inliers.any() or not np.isfinite(r.covariance).all():
            return False
        return bool(
            r.sigma_angle_rad < _MAX_SIGMA_RAD
            and r.sigma_position_m < float(np.median(self._scan.ranges[self._scan.valid]))
        )

    def header(self) -> Html:
        kind, words = self._badge()
        sizes = (
            f"scan {self._scan.shape[1]} x {self._scan.shape[0]} cells, photograph {self._photo.camera.width} x "
            f"{self._photo.camera.height} px, method {self._document.get('method') or self._r.method}"
        )
        return tag(
            "header",
            tag("h1", f"{self._photo.name} {self._words()}"),
            tag("p", tag("span", words, class_=f"badge {kind}"), " ", tag("span", sizes, class_="dim")),
        )  # fmt: skip

    def _words(self) -> str:
        if self._given:
            return f"on {self._scan.name}: pose given, not verified"
        return f"registered with {self._scan.name}" if self._shown else f"with {self._scan.name}: not registered"

    def _badge(self) -> tuple[str, str]:
        if self._given:
            return "warn", "given, not verified"
        if not self._r.accepted:
            return "bad", "not accepted"
        return ("warn", "out of date") if self._stale else ("ok", "accepted")

    def sections(self) -> list[Html]:
        found = [self._verdict()]
        if self._shown:
            found += [self._before_and_after(), self._overlay(), self._pose("Pose", "pose")]
        else:
            found.append(self._refused_guess())
        if len(self._r.matches) and (self._shown or self._has_guess):
            found.append(self._matches())
        found.append(quality_section(self._document, pose_known=self._shown or self._has_guess))
        if self._shown:
            found.append(self._maps())
        found += [build(self._document) for build in (files_section, method_section, software_section)]
        return found

    def _verdict(self) -> Html:
        r = self._r
        words = verdict_words(r.accepted, r.evidence, r.diagnostics, coarse=r.is_coarse)
        parts: list[Content] = [tag("p", words, class_="note warn lead" if self._given else "lead")]
        if self._stale:
            parts.append(tag("p", f"Out of date. {self._rests_on}", class_="note warn"))
        elif self._rests_on:
            parts.append(tag("p", self._rests_on))
        if r.reasons:
            parts.append(tag("ul", [tag("li", reason) for reason in r.reasons]))
        if self._shown:
            parts.append(definitions(self._key_figures()))
        return section("verdict", "Verdict", *parts)

    def _key_figures(self) -> list[tuple[str, str]]:
        r, found = self._r, figures(self._r)
        rows = []
        if len(r.matches):
            rms = f", {format_number(found.rms_px)} px rms" if np.isfinite(found.rms_px) else ""
            rows.append(("Matches", f"{found.inliers} of {found.matches} agree{rms}"))
        rows.append(
            (
                "Position",
                f"{r.thesis_parameters.describe_position()}, sigma {_sigma(format_length, r.sigma_position_m)}",
            )
        )
        rows.append(
            (
                "Orientation",
                f"{r.thesis_parameters.describe_orientation()}, sigma {_sigma(format_angle, r.sigma_angle_rad)}",
            )
        )
        if r.in_world is not None:
            rows.append(("In the world", r.in_world))
        uncertainty = self._document.get("uncertainty")
        if uncertainty:
            rows.append(
                (
                    "In the photograph",
                    f"median {_px(uncertainty.get('median_px'))}, 95 % within {_px(uncertainty.get('p95_px'))}, "
                    f"largest {_px(uncertainty.get('worst_px'))} (1 sigma)",
                )
            )
        return rows

    def _before_and_after(self) -> Html:
        p = self._pictures
        figures_ = [
            figure(
                p.scan(), "Before: the scan's intensity. Gray frame: the part shown beside; blue frame: the detail."
            ),
            figure(p.photograph(), "The photograph."),
            figure(
                p.registered(), "After: the photograph on the scan's grid; what it does not show is dimmed intensity."
            ),
        ]
        parts: list[Content] = [tag("div", figures_, class_="pictures three")]
        detail = p.detail()
        if detail is not None:
            names = (
                "Detail, before: the scan's intensity.",
                "Detail, after. Thin lines: edges of the scan's intensity.",
            )
            parts.append(
                tag("div", [figure(one, name) for one, name in zip(detail, names, strict=True)], class_="pictures")
            )
        return section("before-after", "Before and after", *parts)

    def _overlay(self) -> Html:
        words = "Edges of the scan, in blue, on the photograph: at a good pose they follow its edges everywhere."
        return section("overlay", "Overlay", figure(self._pictures.overlay(), words, wide=True))

    def _pose(self, title: str, name: str) -> Html:
        r = self._r
        rows = [(p.name, p.value, p.sigma, p.unit) for p in parameters(r)]
        parts: list[Content] = [
            tag("p", "Tx is left, Ty up, Tz forward of the scanner; alpha pans right, beta tilts down, gamma rolls "
                "clockwise as seen from behind the camera (one standard deviation each)."),
            tag("div",
                tag("div", tag("h3", "Six parameters"),
                    table(("parameter", "value", "sigma", "unit"), rows, numbers=(1, 2))),
                tag("div", tag("h3", "Camera"), self._camera()), class_="tables"),
            tag("h3", "Matrix"), self._matrix(),
        ]  # fmt: skip
        return section(name, title, *parts)

    def _camera(self) -> Html:
        joint = self._r.camera_uncertainty
        sigmas = {**({} if joint is None else joint.sigmas), **self._r.camera_sigmas}
        fields = dict(self._r.camera.as_fields())
        coefficients = fields.pop("distortion", None) or ()
        fields |= dict(zip(_COEFFICIENTS, coefficients, strict=False))
        rows = []
        for name, value in fields.items():
            sigma = sigmas.get(name, sigmas.get("focal_px") if name in ("fx", "fy") else None)
            stated = "as given" if sigma is None else f"{sigma:.3g}"
            rows.append((name, plain_text(value), stated, _UNITS.get(name, "")))
        return table(("intrinsics", "value", "sigma", "unit"), rows, numbers=(1, 2))

    def _matrix(self) -> Html:
        shown = [(CAMERA_FROM_SCANNER_IS, self._r.camera_from_scanner, ".9g")]
        for words, pose in (
            ("camera_from_world: the same from the world's coordinates", self._r.camera_from_world),
            ("world_from_scanner: the scanner's pose as the scan's file states it", self._r.world_from_scanner),
        ):
            if pose is not None:  # its coordinates may be millions of metres
                shown.append((words, pose, ".15g"))
        return joined(
            *(
                joined(
                    tag("p", words, class_="dim"),
                    table((), [tuple(f"{v:{digits}}" for v in row) for row in pose.matrix], numbers=(0, 1, 2, 3)),
                )
                for words, pose, digits in shown
            )
        )

    def _refused_guess(self) -> Html:
        command = self._document.get("open_in_workbench")
        opens = [tag("p", "To draw matches by hand, open it in the workbench: ", tag("code", str(command)))]
        if not self._has_guess:
            words = "No pose was found that is worth showing: the candidates are not determined by the data."
            return section("guess", "Rejected guess", tag("p", words), *(opens if command else ()))
        rows = [(p.name, p.value, p.unit) for p in parameters(self._r)]
        return section(
            "guess",
            "Rejected guess",
            tag(
                "p",
                "The best candidate, which was refused. It is no registration: do not use it as one.",
                class_="note bad",
            ),
            figure(self._pictures.overlay(), "Edges of the scan at the rejected guess, on the photograph.", wide=True),
            table(("parameter", "guess", "unit"), rows, numbers=(1,)),
            *(opens if command else ()),
        )

    def _matches(self) -> Html:
        picture, enlargement = self._pictures.matches()
        times = "" if enlargement == 1 else f", enlarged {enlargement} times"
        parts: list[Content] = [
            figure(picture, f"Green: inliers; red: outliers; lines: their residuals{times}.", wide=True),
            tag(
                "div",
                [tag("figure", plot, tag("figcaption", words)) for plot, words in residual_plots(self._r)],
                class_="plots",
            ),
            legend_of_points(),
        ]
        worst = worst_matches(self._r, most=_MAX_WORST)
        if worst:
            crops = match_crops(self._drawn, self._photo, self._r, worst)
            parts += [
                tag("h3", "The worst matches, enlarged"),
                crop_legend(),
                tag("div", [self._worst(*pair) for pair in zip(worst, crops, strict=True)], class_="worst"),
            ]
        return section("matches", "Matches and residuals", *parts)

    def _worst(self, match: WorstMatch, crops: tuple[Html, Html]) -> Html:
        r, k = self._r, match.end
        rows = [f"{np.linalg.norm(r.residuals_px[k]):.2f} px", "inlier" if r.inliers[k] else "outlier"]
        if np.isfinite(r.stereo_depth_error_m[k]):
            rows.append(f"depth error {1000 * r.stereo_depth_error_m[k]:+.0f} mm")
        rows.append(f"at {r.matches.ranges[k]:.2f} m")
        influence = self._influence(k)
        if influence is not None and r.inliers[k]:
            rows.append(f"without it the picture shifts by {format_number(influence)} px")
        return tag(
            "figure",
            tag("div", crops, class_="pair"),
            tag("figcaption", tag("strong", self._name(match)), f": {', '.join(rows)}"),
        )

    def _name(self, match: WorstMatch) -> str:
        """Return what a match is called: by its name, its number or its id in the file, never by an internal id."""
        named = lengths_by_end(self._document.get("diagnostics") or {}).get((match.pick_id, 0))
        if named is not None:
            return f"Match {named['name']}"
        drawn = self._r.method in ("manual", "thesis") and match.pick_id.strip()
        kind = "Line" if match.others else "Match"
        return f"{kind} {match.pick_id}" if drawn else f"Match {match.end + 1}"

    def _influence(self, k: int) -> float | None:
        listed = self._document.get("matches") or []
        found = listed[k].get("influence") if k < len(listed) else None
        value = None if found is None else found.get("pixels")
        return float(value) if isinstance(value, int | float) else None

    def _maps(self) -> Html:
        maps = [
            tag(
                "figure",
                tag("img", src=uri, alt=legend.title, class_="map"),
                legend_html(legend, shares),
                tag("figcaption", words),
            )
            for uri, legend, shares, words in self._pictures.maps()
        ]
        return section("maps", "Uncertainty and visibility", tag("div", maps, class_="pictures"))


def _sigma(format_: Callable[[float], str], value: float) -> str:
    return format_(value) if np.isfinite(value) else "unknown"


def _px(value: Any) -> str:
    return f"{format_number(float(value))} px" if isinstance(value, int | float) else "unknown"
