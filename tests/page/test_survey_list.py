"""The list of all photographs of a survey: its order, what it hides, and what work on some of them asks for."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from testing.workbench.pages import two_frames

if TYPE_CHECKING:
    from playwright.sync_api import Page

CAMERA = {"short": "f 780", "said": ""}
PHOTOS = [
    {"id": "p1", "name": "one.jpg", "camera": CAMERA, "state": "accepted", "light": "verified",
     "light_words": "verified", "position": "3 mm"},
    {"id": "p2", "name": "two.jpg", "camera": CAMERA, "state": "accepted", "light": "verified",
     "light_words": "verified", "position": "9 mm", "part": "held"},
    {"id": "p3", "name": "three.jpg", "camera": CAMERA, "state": "empty"},
    {"id": "p4", "name": "four.jpg", "camera": None, "state": "empty"},
    {"id": "p5", "name": "five.jpg", "camera": CAMERA, "state": "empty", "part": "out"},
]  # fmt: skip
_OF_ALL = {
    "verdict": "",
    "ties_left_out": 2,
    "partners": [],
    "camera": "camera-1",
    "angle": None,
    "moved": None,
    "changed": False,
}
SURVEY = {
    "accepted": 2, "scans": ["scan.npz"], "chi2_per_dof": 0.9, "sigma_px": 0.25, "since": "",
    "photos": [
        {**_OF_ALL, "id": "p1", "accepted": True, "reasons": ["Good."], "ties": 40, "median_px": 0.2, "sigma_m": 0.003},
        {**_OF_ALL, "id": "p2", "accepted": True, "reasons": ["Good."], "ties": 30, "median_px": 0.7, "sigma_m": 0.009},
        {**_OF_ALL, "id": "p3", "accepted": False, "reasons": ["Nothing agrees."], "ties": 0, "median_px": None,
         "sigma_m": None},
    ],
    "cameras": [{"id": "camera-1", "focal_px": 781.25, "sigma_px": 0.4, "width": 960, "height": 640,
                 "photos": ["one.jpg", "two.jpg"], "used": 2, "held": False}],
}  # fmt: skip
SLICES = {"photos": PHOTOS, "survey": SURVEY, "scan": {"id": "s1", "views": []}, "shown": "p1", "job": None}
MOUNTED = """async (slices) => {
  const { store } = await import('/js/net/store.js');
  const { mountPhotographs } = await import('/js/panels/stations/photographs.js');
  document.body.append(mountPhotographs());
  store.take({ slices });
}"""


@pytest.fixture
def survey(page: Page, modules: str) -> Page:
    page.goto(f"{modules}/blank.html")
    for sheet in ("tokens.css", "css/base.css", "css/controls.css", "css/stations.css"):
        page.add_style_tag(url=f"{modules}/{sheet}")
    page.evaluate(MOUNTED, SLICES)
    page.locator(".survey-photo").nth(4).wait_for()
    return page


def names(page: Page) -> list[str]:
    two_frames(page)
    return page.locator(".survey-name").all_text_contents()


def test_the_worst_photographs_come_first(survey: Page) -> None:
    assert names(survey) == ["one.jpg", "two.jpg", "three.jpg", "four.jpg", "five.jpg"]
    survey.get_by_label("Order of the photographs").select_option("worst")
    assert names(survey) == ["three.jpg", "four.jpg", "five.jpg", "two.jpg", "one.jpg"]


def test_what_needs_a_hand_is_found(survey: Page) -> None:
    survey.get_by_label("Which photographs are listed").select_option("open")
    assert names(survey) == ["three.jpg", "four.jpg", "five.jpg"]
    text = survey.locator(".survey-list").inner_text()
    assert "Nothing agrees." in text
    assert "focal length unknown" in text


def test_figures_of_all_are_stated(survey: Page) -> None:
    text = survey.locator(".survey").inner_text()
    for words in ("2 of 5 accepted", "ties to 0.25 px", "781.3 px ± 0.40", "± 9 mm", "30 · 2 out"):
        assert words in text


def test_ticked_photographs_limit_the_work(survey: Page) -> None:
    survey.get_by_label("Choose two.jpg").check()
    survey.get_by_label("Choose three.jpg").check()
    assert survey.get_by_role("button", name="Adjust 2", exact=True).is_visible()
    assert survey.get_by_role("button", name="Register 2", exact=True).is_visible()
    survey.get_by_label("Choose two.jpg").uncheck()
    survey.get_by_label("Choose three.jpg").uncheck()
    assert survey.get_by_role("button", name="Register all", exact=True).is_visible()


@pytest.mark.slow
def test_how_the_chosen_photographs_take_part_is_offered(survey: Page) -> None:
    text = survey.locator(".survey-list").inner_text()
    assert "verified, held" in text
    assert "taken out" in text
    group = survey.get_by_role("group", name="The chosen photographs")
    assert not group.is_visible()
    for chosen, offered in (
        ("one.jpg", ["Hold poses", "Take out"]), ("two.jpg", ["Release", "Take out"]), ("five.jpg", ["Take back"]),
    ):  # fmt: skip
        survey.get_by_label(f"Choose {chosen}").check()
        shown = [one for one in group.get_by_role("button").all() if one.is_visible()]
        assert [one.inner_text() for one in shown] == offered
        survey.get_by_label(f"Choose {chosen}").uncheck()
    survey.get_by_label("Choose three.jpg").check()
    assert group.get_by_role("button", name="Hold poses").is_disabled()


def test_what_is_drawn_of_the_ties_is_said(survey: Page) -> None:
    said = survey.locator(".survey-ties")
    assert not said.is_visible()
    take = """async (slices) => (await import('/js/net/store.js')).store.take({ slices })"""
    survey.evaluate(take, {"ties:p1": [[10, 20, 0.1, 0.2, 1]] * 40 + [[5, 5, 3, 4, 0]] * 2})
    two_frames(survey)
    assert said.inner_text() == "In the photograph: 42 ties, needles 20 × their residuals, crosses where left out."
    survey.evaluate(take, {"ties:p1": [[10, 20, 0.1, 0.2, 1]] * 30})
    two_frames(survey)
    assert said.inner_text().startswith("In the photograph: 30 of 42 ties,")


def test_thumbnails_are_fetched_where_they_are_in_sight(page: Page, modules: str) -> None:
    page.goto(f"{modules}/blank.html")
    fetched: list[str] = []
    page.on("request", lambda request: fetched.append(request.url) if "form=small" in request.url else None)
    made = """async () => {
      const { thumbnail } = await import("./js/ui/thumbnail.js");
      const list = document.createElement("div");
      list.style = "height: 300px; overflow-y: scroll";
      for (let n = 1; n <= 80; n++) {
        const one = thumbnail({ id: `p${n}`, rev: "r" });
        one.style = "display: block; height: 40px; width: 60px";
        list.append(one);
      }
      document.body.append(list);
    }"""
    page.evaluate(made)
    page.wait_for_function("[...document.querySelectorAll('img')].slice(0, 7).every((each) => each.naturalWidth > 0)")
    assert not any("/p80?" in url for url in fetched)
    assert len(fetched) < 20
    page.evaluate("document.querySelector('img:last-child').scrollIntoView()")
    page.wait_for_function("document.querySelector('img:last-child').naturalWidth > 0")
    assert len(fetched) < 40, "those between were never in sight"
