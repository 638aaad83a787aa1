"""Pictures of registrations for notebooks and scripts."""

from __future__ import annotations

import builtins
from dataclasses import replace
from html.parser import HTMLParser

import cv2
import numpy as np
import pytest

import ladarreg_core as lr
from ladarreg_core.simulate import SimulatedCase
from testing.scenes.simulated import simulated


@pytest.fixture(scope="module")
def case() -> SimulatedCase:
    return simulated("boxes", seed=3)


@pytest.fixture(scope="module")
def accepted(case: SimulatedCase) -> lr.Registration:
    return lr.register(case.scan, case.photo)


class Parsed(HTMLParser):
    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.text = ""
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)

    def handle_data(self, data: str) -> None:
        self.text += data + " "


@pytest.mark.slow
def test_edges_lie_on_the_photograph_at_the_pose_only(case: SimulatedCase, accepted: lr.Registration) -> None:
    assert accepted.accepted
    turned = lr.Rigid.from_rotvec([0.0, 0.03, 0.0], (0.0, 0.0, 0.0)) @ accepted.camera_from_scanner
    gray = cv2.cvtColor(case.photo.pixels, cv2.COLOR_RGB2GRAY)
    slope = cv2.magnitude(cv2.Sobel(gray, cv2.CV_32F, 1, 0), cv2.Sobel(gray, cv2.CV_32F, 0, 1))
    slopes = []
    for result in (accepted, replace(accepted, camera_from_scanner=turned)):
        picture = lr.views.overlay(result, case.scan, case.photo)
        assert picture.shape == case.photo.pixels.shape
        assert picture.dtype == np.uint8
        drawn = np.abs(picture.astype(int) - case.photo.pixels).max(axis=2)
        slopes.append(float((slope * drawn).sum() / drawn.sum()))
    assert slopes[0] > 1.2 * slopes[1]
    ranges = lr.views.overlay(accepted, case.scan, case.photo, show="range")
    assert (ranges != case.photo.pixels).any(axis=2).mean() > 0.5
    with pytest.raises(lr.LadarregError, match="overlay"):
        lr.views.overlay(accepted, case.scan, case.photo, show="nothing")


@pytest.mark.slow
def test_a_registered_picture_has_the_colors_of_the_texture(case: SimulatedCase, accepted: lr.Registration) -> None:
    picture = lr.views.registered(accepted, case.scan, case.photo)
    texture = lr.texture_scan(case.scan, case.photo, accepted.camera_from_scanner, covariance=accepted.joint_covariance)
    seen = texture.labels == lr.Label.SEEN
    assert seen.any()
    assert (picture[seen] == texture.image[seen]).all()


def test_what_was_refused_or_given_says_so(case: SimulatedCase, accepted: lr.Registration) -> None:
    refused = replace(accepted, accepted=False, evidence="none", reasons=("too little",))
    with pytest.raises(lr.LadarregError, match="refused"):
        lr.views.registered(refused, case.scan, case.photo)
    assert lr.views.overlay(refused, case.scan, case.photo).shape[0] > case.photo.pixels.shape[0], (
        "the caption is below"
    )
    given = lr.given_pose(case.scan, case.photo, case.camera_from_scanner, check_images=False)
    plain = replace(accepted, camera_from_scanner=given.camera_from_scanner)
    marked = lr.views.registered(given, case.scan, case.photo)
    assert (marked != lr.views.registered(plain, case.scan, case.photo)).any(axis=2).mean() > 0.01, "no watermark"


def test_a_figure_has_the_verdict_and_the_residuals(case: SimulatedCase, accepted: lr.Registration) -> None:
    drawn = lr.views.figure(accepted, case.scan, case.photo)
    assert drawn.get_suptitle() == "Accepted: verified against the image."
    assert len(drawn.axes) == 4
    assert sum(len(one.get_offsets()) for one in drawn.axes[1].collections) == len(accepted.matches)
    refused = replace(accepted, accepted=False, evidence="none")
    assert lr.views.figure(refused, case.scan, case.photo).get_suptitle().startswith("Not accepted")


def test_without_matplotlib_it_is_named(
    case: SimulatedCase, accepted: lr.Registration, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = builtins.__import__

    def without(name: str, *rest: object, **more: object) -> object:
        if name.split(".")[0] == "matplotlib":
            raise ImportError(name)
        return real(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(lr.LadarregError, match="Matplotlib"):
        lr.views.figure(accepted, case.scan, case.photo)


def test_notebooks_show_scan_photograph_and_verdict(case: SimulatedCase, accepted: lr.Registration) -> None:
    scan, photo, result = (Parsed(one._repr_html_()) for one in (case.scan, case.photo, accepted))
    assert scan.tags.count("img") == photo.tags.count("img") == result.tags.count("svg") == 1
    assert f"{case.scan.shape[0]} x {case.scan.shape[1]} cells" in scan.text
    assert "Accepted: verified against the image." in result.text
    assert result.tags.count("line") == len(accepted.matches)
    for one in accepted.thesis_parameters.rounded(accepted.thesis_sigmas):
        assert f"{one.value} \u00b1 {one.sigma} {one.unit}" in result.text
    refused = Parsed(replace(accepted, accepted=False, evidence="none")._repr_html_())
    assert "Not accepted" in refused.text


def test_what_a_notebook_shows_is_escaped(case: SimulatedCase) -> None:
    hostile = "<script>alert(1)</script>"
    for one in (replace(case.scan, name=hostile, notes=(hostile,)), replace(case.photo, name=hostile)):
        assert "script" not in Parsed(one._repr_html_()).tags
        assert hostile in Parsed(one._repr_html_()).text


def test_a_scan_without_intensity_shows_its_shape(case: SimulatedCase) -> None:
    bare = replace(case.scan, intensity=np.zeros(case.scan.shape, np.float32), color=None)
    assert "nearness" in Parsed(bare._repr_html_()).text


def test_progress_is_shown_where_there_is_ipython(monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[str] = []

    class Handle:
        def update(self, html: object) -> None:
            shown.append(html.data)

    def display(html: object, display_id: bool) -> Handle:
        shown.append(html.data)
        return Handle()

    monkeypatch.setattr("IPython.display.display", display)
    report = lr.NotebookProgress()
    report(lr.Progress(1, 2, "reading <b>"))
    report(lr.Progress(2, 2, "reading"))
    report(lr.Step("climb", 0.25))
    assert len(shown) == 3
    assert "<b>" not in shown[0]
    assert 'max="2" value="1"' in shown[0]
    assert "climb: 0.25 s" in shown[2]
