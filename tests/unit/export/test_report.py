"""The report: every section for every verdict, nothing fetched from elsewhere, and no text that becomes markup."""

from __future__ import annotations

import base64
import re
from dataclasses import replace
from html.parser import HTMLParser
from typing import Any

import cv2
import numpy as np
import pytest

from ladarreg_core.export.json import registration_document
from ladarreg_core.export.report.match_crops import worst_matches
from ladarreg_core.export.report.page import report_html
from ladarreg_core.export.report.plots import residual_plots
from ladarreg_core.foundations.markup import joined, tag
from ladarreg_core.matches import Matches
from ladarreg_core.photo import Photo
from ladarreg_core.quality.assessment import assess
from ladarreg_core.results.registration import Registration
from ladarreg_core.scan import Scan
from testing.scenes.small_registration import CAMERA, POSE, sample_registration

ALWAYS = {"verdict", "quality", "files", "options", "software"}
SHOWN = {"before-after", "overlay", "pose", "matches", "maps"}
HOSTILE = "<script>alert(1)</script> & \"x\" 'y' \u202e.png"
VOID = {"meta", "img", "br", "link"}
EVERYTHING_ELSE = {"href", "src", "xlink:href", "action", "srcset", "data", "poster"}


class Parsed(HTMLParser):
    """A document: its sections with their texts, its elements, and the addresses that it refers to."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.elements: list[str] = []
        self.addresses: list[str] = []
        self.sections: dict[str, str] = {}
        self.handlers: list[str] = []
        self._section = ""
        self.feed(text)
        self.close()
        assert self.open == [], f"not closed: {self.open}"

    def handle_starttag(self, name: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append(name)
        self.addresses += [value or "" for key, value in attrs if key in EVERYTHING_ELSE]
        self.handlers += [key for key, _ in attrs if key.startswith("on")]
        if name == "section":
            self._section = dict(attrs)["id"] or ""
            self.sections[self._section] = ""
        if name not in VOID:
            self.open.append(name)

    def handle_endtag(self, name: str) -> None:
        assert self.open, f"</{name}> closes nothing"
        assert self.open.pop() == name
        if name == "section":
            self._section = ""

    def handle_data(self, data: str) -> None:
        if self._section:
            self.sections[self._section] += data


def solved(scan: Scan, *, count: int = 24, **changes: Any) -> Registration:
    """Return a registration whose matches lie on the scan, two ends of a line first."""
    rng = np.random.default_rng(3)
    uv = CAMERA.project(POSE @ np.where(scan.valid[..., None], scan.points, np.nan))
    cells = np.flatnonzero(CAMERA.contains(uv).reshape(-1))
    chosen = rng.choice(cells, count, replace=False)
    residuals = rng.normal(size=(count, 2)) * 0.4
    residuals[5] = (6.0, -2.0)
    matches = Matches(
        scan.rays.reshape(-1, 3)[chosen],
        scan.ranges.reshape(-1)[chosen],
        uv.reshape(-1, 2)[chosen] + residuals,
        tuple(str(1 + max(k - 1, 0)) for k in range(count)),
    )
    fields = {
        "matches": matches,
        "inliers": np.arange(count) != 5,
        "residuals_px": residuals,
        "residuals_m": rng.normal(size=count) * 0.01,
        "stereo_depth_error_m": rng.normal(size=count) * 0.03,
        "method": "manual",
        "evidence": "statistics",
        "accepted": True,
    }
    return replace(sample_registration(), **{**fields, **changes})


def report_of(registration: Registration, scan: Scan, photo: Photo, **more: Any) -> str:
    document = registration_document(registration, assessment=assess(scan, registration))
    return report_html(registration, scan, photo, {**document, **more})


@pytest.mark.parametrize("method", ["auto", "manual"])
def test_an_accepted_registration_has_every_section(scan: Scan, photo: Photo, method: str) -> None:
    registration = solved(scan, method=method, evidence="image" if method == "auto" else "statistics")
    text = report_of(registration, scan, photo)
    parsed = Parsed(text)
    assert set(parsed.sections) == ALWAYS | SHOWN
    assert "Accepted" in parsed.sections["verdict"]
    for reason in registration.reasons:
        assert reason in parsed.sections["verdict"]
    for name in ("Tx", "Ty", "Tz", "alpha", "beta", "gamma"):
        assert name in parsed.sections["pose"]
    for words in ("Standard deviation of the photo position, px", "Visibility class", "Residual of the nearby"):
        assert words in parsed.sections["maps"], "every map has its legend"
    assert "seen by the camera (" in parsed.sections["maps"]
    assert len(text) < 6e6


def test_the_same_registration_gives_the_same_report(scan: Scan, photo: Photo) -> None:
    assert report_of(solved(scan), scan, photo) == report_of(solved(scan), scan, photo)


def test_nothing_is_fetched_and_nothing_runs(scan: Scan, photo: Photo) -> None:
    text = report_of(solved(scan), scan, photo)
    parsed = Parsed(text)
    assert len(parsed.addresses) > 10
    assert all(re.match(r"data:image/(png|jpeg);base64,", address) for address in parsed.addresses)
    assert not {"script", "link", "iframe", "object", "base", "form"} & set(parsed.elements)
    assert parsed.handlers == []
    assert "url(" not in text
    assert "@import" not in text
    for address in parsed.addresses:
        data = np.frombuffer(base64.b64decode(address.partition(",")[2]), np.uint8)
        assert cv2.imdecode(data, cv2.IMREAD_COLOR) is not None


def test_a_refused_pose_is_shown_as_a_rejected_guess_only(scan: Scan, photo: Photo) -> None:
    refused = solved(scan, accepted=False, evidence="none", reasons=("Only 3 matches agree.",))
    parsed = Parsed(report_of(refused, scan, photo))
    assert set(parsed.sections) == ALWAYS | {"guess", "matches"}
    assert "Not accepted" in parsed.sections["verdict"]
    assert "Only 3 matches agree." in parsed.sections["verdict"]
    assert "do not use it" in parsed.sections["guess"]
    assert "Tx" not in parsed.sections["verdict"] + parsed.sections["quality"]


def test_a_refusal_without_a_usable_candidate_shows_no_figures(scan: Scan, photo: Photo) -> None:
    unknown = np.diag([np.pi**2] * 3 + [100.0**2] * 3)
    for changes in (
        {"covariance": unknown},
        {"inliers": np.zeros(24, bool)},
        {"matches": Matches.none(), "inliers": np.zeros(0, bool), "residuals_px": np.zeros((0, 2)),
         "residuals_m": np.zeros(0), "stereo_depth_error_m": np.zeros(0)},
    ):  # fmt: skip
        refused = solved(scan, accepted=False, evidence="none", **changes)
        parsed = Parsed(report_of(refused, scan, photo))
        assert set(parsed.sections) == ALWAYS | {"guess"}
        assert "No pose was found" in parsed.sections["guess"]
        assert not re.search(r"\d", parsed.sections["guess"])


@pytest.mark.slow
def test_a_given_pose_says_that_it_was_not_verified(scan: Scan, photo: Photo) -> None:
    given = solved(scan, accepted=False, evidence="given", method="carried")
    text = report_of(given, scan, photo)
    parsed = Parsed(text)
    assert set(parsed.sections) == ALWAYS | SHOWN
    assert "Given, not verified" in parsed.sections["verdict"]
    assert "accepted</span>" not in text
    marked = set(parsed.addresses) - set(
        Parsed(report_of(replace(given, accepted=True, evidence="image"), scan, photo)).addresses
    )
    assert len(marked) >= 4, "the pictures that rest on the pose bear a mark"


def test_a_pose_that_is_out_of_date_says_on_which_matches_it_rests(scan: Scan, photo: Photo) -> None:
    rests_on = {"matches": ["1"], "current": False, "sentence": "It is the last solved state: 2 matches changed."}
    text = report_of(solved(scan), scan, photo, rests_on=rests_on)
    assert "Out of date. It is the last solved state: 2 matches changed." in Parsed(text).sections["verdict"]
    assert "out of date</span>" in text
    assert "accepted</span>" not in text


def test_names_and_sentences_are_never_markup(scan: Scan, photo: Photo) -> None:
    registration = solved(scan, reasons=(HOSTILE,), options={HOSTILE: HOSTILE}, method="manual")
    ids = tuple(HOSTILE for _ in registration.matches.pick_ids)
    m = registration.matches
    registration = replace(registration, matches=Matches(m.rays, m.ranges, m.uv, ids))
    document = registration_document(registration, assessment=assess(scan, registration))
    files = [{"name": HOSTILE, "size": 12, "sha256": "ab" * 32}]
    finding = [{"name": "matches", "level": "poor", "sentence": HOSTILE, "what_to_do": HOSTILE, "values": {}}]
    text = report_html(
        registration,
        replace(scan, name=HOSTILE),
        replace(photo, name=HOSTILE),
        {**document, "inputs": files, "findings": finding, "not_assessed": {HOSTILE: HOSTILE}},
    )
    parsed = Parsed(text)
    assert "script" not in parsed.elements
    assert "\u202e" not in text, "a direction mark could disguise a file name"
    for name in ("verdict", "files", "quality", "options", "matches"):
        assert "<script>alert(1)</script> & \"x\" 'y'" in parsed.sections[name], name


def test_steps_of_one_name_are_summed_and_only_used_options_listed(scan: Scan, photo: Photo) -> None:
    steps = [{"name": "hypothesis", "seconds": 0.25, "matches": m, "detail": {}} for m in (None, 7, None)]
    options = {"seed": 1, "auto": {"gate": {"many": 45}}, "pose": {"gate_chi2": 9.21}, "thesis": {"t1": 0.2}}
    for method, used in (("auto", "auto.gate.many 45"), ("manual", "pose.gate_chi2 9.21"), ("thesis", "thesis.t1 0.2")):
        text = report_of(solved(scan, method=method), scan, photo, steps=steps, options=options)
        words = Parsed(text).sections["options"]
        assert "hypothesis30.757" in words
        assert used in words
        assert "seed 1" in words
        assert sum(name in words for name in ("auto.gate", "pose.gate", "thesis.t1")) == 1


def test_attributes_are_escaped() -> None:
    assert tag("a", "<", title='"><b>') == '<a title="&quot;&gt;&lt;b&gt;">&lt;</a>'
    assert joined("a<", [tag("i", "b"), "&"]) == "a&lt;<i>b</i>&amp;"


def test_the_worst_matches_come_once_each_with_few_outliers(scan: Scan) -> None:
    registration = solved(scan)
    worst = worst_matches(registration, most=6)
    length = np.linalg.norm(registration.residuals_px, axis=1)
    assert worst[0].end == 5
    assert not registration.inliers[worst[0].end]
    assert len({match.pick_id for match in worst}) == len(worst) == 6
    assert sorted((length[m.end] for m in worst[1:]), reverse=True) == [length[m.end] for m in worst[1:]]
    assert all(registration.inliers[match.end] for match in worst[1:])
    nearly_all = solved(scan, inliers=np.zeros(24, bool))
    assert len(worst_matches(nearly_all, most=6)) == 3


def test_plots_of_few_or_undefined_residuals(scan: Scan) -> None:
    assert residual_plots(solved(scan, residuals_px=np.full((24, 2), np.nan))) == []
    exact = solved(scan, residuals_px=np.zeros((24, 2)), stereo_depth_error_m=np.full(24, np.nan))
    plots = residual_plots(exact)
    assert [words.split(",")[0] for _, words in plots][2].startswith("Range residual")
    for plot, _ in plots:
        assert "nan" not in plot
        assert "inf" not in plot
