"""The step Survey: the list of all photographs, and one press that solves them together."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from PIL import Image

import ladarreg_core as lr
from ladarreg_core.inspection.pictures import inspection_views
from ladarreg_core.simulate.sample import sample_survey_folder
from ladarreg_core.survey.least_squares.problem import Matrix
from testing.scenes.shared_places import lines_on_scan, shared_lines
from testing.workbench.operator import Operator, at_work
from testing.workbench.pages import choose_photo
from testing.workbench.shared import SharedWorkbench

if TYPE_CHECKING:
    from playwright.sync_api import Browser, FloatRect, Locator

pytestmark = pytest.mark.slow


@pytest.fixture
def operator(browser: Browser, workbench: SharedWorkbench, request: pytest.FixtureRequest) -> Iterator[Operator]:
    """An operator at a project whose photograph is registered."""
    workbench.open("solved")
    with at_work(browser, workbench.server, request) as found:
        found.open()
        yield found


def test_photographs_are_adjusted_and_taken_back(operator: Operator) -> None:
    page = operator.page
    page.set_default_timeout(240_000)
    operator.step("Survey")
    part = page.get_by_role("region", name="All photographs")
    part.get_by_text("1 of 1 accepted").wait_for()
    part.get_by_role("button", name="Adjust", exact=True).click()
    part.get_by_text(re.compile("Adjusted together: 1 of 1")).wait_for()
    part.get_by_label("Choose photo.png").check()
    assert part.get_by_role("button", name="Register 1", exact=True).is_enabled()
    page.get_by_role("button", name=re.compile("Undo")).first.click()
    part.get_by_text(re.compile("^Adjust solves all photographs")).wait_for()
    part.get_by_text("1 of 1 accepted").wait_for()


SIDES = ("first", "second", "third")
PAINTED = (
    "() => [...document.querySelectorAll('.tie-side:not([hidden]) .tie-picture')].every((c) => c.width &&"
    " c.getContext('2d').getImageData(c.width / 2, c.height / 2, 1, 1).data[3] === 255)"
)
"""Whether all pictures of the dialog are there: a canvas is painted."""


def open_ties(operator: Operator) -> tuple[Locator, list[Locator]]:
    """Open the dialog in which ties are drawn; return it with its pictures."""
    operator.open()
    operator.step("Survey")
    page = operator.page
    page.get_by_role("region", name="All photographs").get_by_role("button", name="Draw ties").click()
    dialog = page.get_by_role("dialog", name="Ties and lines drawn by hand")
    pictures = [dialog.get_by_role("img", name=f"{side} photograph") for side in SIDES]
    page.wait_for_function(PAINTED)
    return dialog, pictures


def test_a_tie_is_drawn_in_two_photographs_listed_and_removed(
    browser: Browser, workbench: SharedWorkbench, request: pytest.FixtureRequest
) -> None:
    folder = sample_survey_folder()
    workbench.open_files([folder / name for name in ("station1.npz", "IMG_0001.jpg", "IMG_0003.jpg")]).socket.close()
    with at_work(browser, workbench.server, request) as operator:
        page = operator.page
        dialog, pictures = open_ties(operator)
        first, second = (picture.bounding_box() for picture in pictures[:2])
        assert first is not None
        assert second is not None
        scale = min(first["width"] / 576, first["height"] / 384)

        def at(box: FloatRect, u: float, v: float) -> tuple[float, float]:
            left, top = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
            return left + scale * (u + 0.5 - 288), top + scale * (v + 0.5 - 192)

        page.mouse.click(*at(first, 100, 80))
        dialog.get_by_text("Now click the same place in the second photograph.").wait_for()
        page.mouse.click(*at(second, 400, 300))
        row = dialog.get_by_role("listitem")
        row.wait_for()
        (tie,) = operator.slice("drawn_ties")
        assert tie["photos"] == ["p2", "p1"], "from the photograph that is shown"
        assert np.abs(np.array(tie["uv"]) - [[100, 80], [400, 300]]).max() < 1 / scale
        assert "not adjusted yet" in (row.text_content() or "")
        operator.shot("ties")

        pictures[0].focus()  # the same by keys, to the pixel
        for key in ("ArrowRight", "Shift+ArrowDown", "Enter"):
            page.keyboard.press(key)
        pictures[1].focus()
        page.keyboard.press("Enter")
        operator.wait(lambda: len(operator.slice("drawn_ties")) == 2, "the second tie")
        dialog.get_by_role("button", name="Remove tie 1").click()
        operator.wait(lambda: [one["id"] for one in operator.slice("drawn_ties")] == ["t2"], "the first one is gone")
        page.keyboard.press("Escape")
        dialog.wait_for(state="hidden")
        assert page.get_by_role("button", name="Draw ties").text_content() == "Ties 1"
        page.get_by_role("button", name=re.compile("Undo")).first.click()
        operator.wait(lambda: len(operator.slice("drawn_ties")) == 2, "what was removed is back")


def test_a_tie_is_continued_into_a_third_photograph(
    browser: Browser, workbench: SharedWorkbench, request: pytest.FixtureRequest
) -> None:
    folder = sample_survey_folder()
    names = ("IMG_0001.jpg", "IMG_0003.jpg", "IMG_0002.jpg")
    workbench.open_files([folder / "station1.npz", *(folder / name for name in names)]).socket.close()
    with at_work(browser, workbench.server, request) as operator:
        page = operator.page
        dialog, pictures = open_ties(operator)
        for picture in pictures[:2]:  # the middle of both
            picture.focus()
            page.keyboard.press("Enter")
        operator.wait(lambda: len(operator.slice("drawn_ties")) == 1, "the first tie")
        (tie,) = operator.slice("drawn_ties")
        third = next(photo["id"] for photo in operator.slice("photos") if photo["id"] not in tie["photos"])
        dialog.get_by_role("combobox", name="The second photograph").select_option(third)
        page.wait_for_function(PAINTED)
        box = pictures[0].bounding_box()
        assert box is not None
        page.mouse.click(box["x"] + box["width"] / 2 + 5, box["y"] + box["height"] / 2 - 4)  # near its mark
        dialog.get_by_text("Tie 1 is continued. Now click the same place in the second photograph.").wait_for()
        pictures[1].focus()
        page.keyboard.press("ArrowRight")
        page.keyboard.press("Enter")
        operator.wait(lambda: len(operator.slice("drawn_ties")) == 2, "the second tie")
        first, second = operator.slice("drawn_ties")
        assert second["photos"] == [first["photos"][0], third]
        assert second["uv"][0] == first["uv"][0], "to the last digit"
        assert [first["track"], second["track"]] == [first["id"], first["id"]]
        operator.shot("ties-continued")
        page.keyboard.press("Escape")
        page.get_by_role("button", name=re.compile("Undo")).first.click()
        operator.wait(lambda: [one["id"] for one in operator.slice("drawn_ties")] == ["t1"], "one step each")


def test_a_line_is_drawn_in_three_photographs(
    browser: Browser, workbench: SharedWorkbench, request: pytest.FixtureRequest
) -> None:
    shared = shared_lines()
    folder = sample_survey_folder()
    workbench.open_files([folder / "station1.npz", *(folder / f"{name}.jpg" for name in shared.names)]).socket.close()
    with at_work(browser, workbench.server, request) as operator:
        page = operator.page
        dialog, pictures = open_ties(operator)
        assert not pictures[2].is_visible(), "a tie is of two photographs"
        dialog.get_by_role("button", name="Lines", exact=True).click()
        page.wait_for_function(PAINTED)
        by_name = {photo["name"]: photo for photo in operator.slice("photos")}
        for name, side in zip(shared.names, SIDES, strict=True):
            select = dialog.get_by_role("combobox", name=f"The {side} photograph")
            select.select_option(by_name[f"{name}.jpg"]["id"])
        page.wait_for_function(PAINTED)

        def click(number: int, uv: list[float]) -> None:
            box, photo = pictures[number].bounding_box(), by_name[f"{shared.names[number]}.jpg"]
            assert box is not None
            scale = min(box["width"] / photo["width"], box["height"] / photo["height"])
            middle = ((photo["width"] - 1) / 2, (photo["height"] - 1) / 2)
            left, top = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
            page.mouse.click(left + scale * (uv[0] - middle[0]), top + scale * (uv[1] - middle[1]))

        def draw(number: int, ends: list[list[float]]) -> None:
            click(number, ends[0])
            dialog.get_by_text(f"Now click another place of the same edge in the {SIDES[number]} photograph").wait_for()
            click(number, ends[1])

        hints = (
            "Line 1 is drawn in 1 photograph: click two places of the same edge in two others, or in the scan.",
            "Line 1 is drawn in 2 photographs, which do not constrain their poses: draw it in a third, or in the scan.",
            "Line 1 is drawn in 3 photographs: draw it in a further one, or begin another",
        )
        for number, hint in enumerate(hints):
            draw(number, shared.uv[0, number].tolist())
            dialog.get_by_text(hint).wait_for()
        (line,) = operator.slice("drawn_lines")
        assert line["photos"] == [by_name[f"{name}.jpg"]["id"] for name in shared.names]
        assert np.abs(np.array(line["uv"]) - shared.uv[0]).max() < 3, "within a pixel of the screen"
        row = dialog.get_by_role("listitem").filter(has_text="Line 1")
        row.get_by_text("not adjusted yet").wait_for()
        operator.shot("lines")

        draw(0, shared.uv[1, 0].tolist())  # where line 1 is drawn already: another one
        draw(1, shared.uv[1, 1].tolist())
        operator.wait(lambda: [len(one["photos"]) for one in operator.slice("drawn_lines")] == [3, 2], "a second line")
        pair = dialog.get_by_role("listitem").filter(has_text="Line 2")
        pair.get_by_text("in two photographs, which do not constrain their poses: draw it in a third, or").wait_for()
        pair.get_by_role("button", name="Keep the ends of line 2 as ties").click()
        operator.wait(lambda: len(operator.slice("drawn_ties")) == 2, "its ends are two ties")
        operator.wait(lambda: len(operator.slice("drawn_lines")) == 1, "in place of the line")
        operator.shot("lines-ends-as-ties")
        dialog.get_by_role("button", name="Line 1", exact=False).first.click()
        dialog.get_by_role("button", name="Remove line 1").click()
        operator.wait(lambda: not operator.slice("drawn_lines"), "the line is gone")
        page.keyboard.press("Escape")
        page.get_by_role("button", name=re.compile("Undo")).first.click()
        operator.wait(lambda: len(operator.slice("drawn_lines")) == 1, "what was removed is back")
        page.get_by_role("button", name="Draw ties").get_by_text("Ties 3").wait_for()


def test_a_line_is_drawn_in_the_scan_moved_adjusted_and_erased(
    browser: Browser, workbench: SharedWorkbench, request: pytest.FixtureRequest
) -> None:
    shared, folder = lines_on_scan(), sample_survey_folder()
    (name,), ends = shared.names, shared.xyz[0]
    views = inspection_views(lr.read_scan(folder / "station1.npz"))
    named = next(
        view for view in views if view.camera.contains(view.camera.project(view.view_from_scanner @ ends)).all()
    )
    in_view = named.camera.project(named.view_from_scanner @ ends)
    workbench.open_files([folder / "station1.npz", folder / f"{name}.jpg"]).socket.close()
    with at_work(browser, workbench.server, request) as operator:
        page = operator.page
        dialog, pictures = open_ties(operator)
        dialog.get_by_role("button", name="Lines", exact=True).click()
        scan = dialog.get_by_role("img", name="scan")
        view = dialog.get_by_role("combobox", name="The scan and its view")
        view.select_option(label=f"station1.npz, {named.label}")
        page.wait_for_function(PAINTED)
        assert not pictures[1].is_visible(), "there is one photograph"

        def at(picture: Locator, size: tuple[int, int], uv: Matrix) -> tuple[float, float]:
            box = picture.bounding_box()
            assert box is not None
            scale = min(box["width"] / size[0], box["height"] / size[1])
            left, top = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
            return left + scale * (uv[0] + 0.5 - size[0] / 2), top + scale * (uv[1] + 0.5 - size[1] / 2)

        def draw(picture: Locator, size: tuple[int, int], uv: Matrix, called: str) -> None:
            page.mouse.click(*at(picture, size, uv[0]))
            dialog.get_by_text(f"Now click another place of the same edge in the {called}").wait_for()
            page.mouse.click(*at(picture, size, uv[1]))

        draw(scan, named.camera.size, in_view, "scan")
        dialog.get_by_text("Line 1 is drawn in the scan: click two places of the same edge in a photograph.").wait_for()
        draw(pictures[0], shared.cameras[0].size, shared.uv[0, 0], "first photograph")
        dialog.get_by_text("Line 1 is drawn in 1 photograph and the scan: draw it in a further one").wait_for()
        (line,) = operator.slice("drawn_lines")
        assert np.abs(np.array(line["in_scan"]["xyz"]) - ends).max() < 0.1
        row = dialog.get_by_role("listitem").filter(has_text="Line 1")
        row.get_by_text(f"station1.npz ± {line['in_scan']['sigma']}").wait_for()
        operator.shot("line-in-scan")

        page.mouse.move(*at(scan, named.camera.size, in_view[1]))  # its second end is moved halfway to the first
        page.mouse.down()
        page.mouse.move(*at(scan, named.camera.size, in_view.mean(axis=0)), steps=4)
        page.mouse.up()
        operator.wait(
            lambda: operator.slice("drawn_lines")[0]["in_scan"]["xyz"][1] != line["in_scan"]["xyz"][1], "moved"
        )
        (moved,) = operator.slice("drawn_lines")
        assert np.linalg.norm(np.subtract(*moved["in_scan"]["xyz"])) == pytest.approx(
            np.linalg.norm(ends[1] - ends[0]) / 2, rel=0.3
        )
        page.keyboard.press("Escape")
        part = page.get_by_role("region", name="All photographs")
        part.get_by_role("button", name="Adjust", exact=True).click()
        part.get_by_text(re.compile("Adjusted together: 1 of 1")).wait_for(timeout=240_000)
        part.get_by_role("button", name="Draw ties").click()
        (adjusted,) = operator.slice("drawn_lines")
        assert adjusted["agrees"], adjusted["reason"]
        row.get_by_text(f"station1.npz {adjusted['scan_residual']}").wait_for()
        row.get_by_role("button", name="Line 1:").click()
        view.select_option(label=f"station1.npz, {named.label}")
        page.wait_for_function(PAINTED)
        operator.shot("line-in-scan-adjusted")

        dialog.get_by_role("button", name="Erase in the scan").click()
        row.get_by_text("in one photograph: draw it in two more, or in the scan").wait_for()
        page.keyboard.press("Escape")
        page.get_by_role("button", name=re.compile("Undo")).first.click()
        operator.wait(lambda: operator.slice("drawn_lines")[0]["in_scan"], "what was erased is back")


def test_the_files_of_an_export_are_those_of_the_photographs_that_it_takes(operator: Operator, tmp_path: Path) -> None:
    page = operator.page
    path = tmp_path / "elsewhere.png"
    Image.fromarray(np.random.default_rng(1).integers(0, 255, (60, 80, 3), np.uint8)).save(path)
    waiting = operator.server.upload(path)
    assert operator.socket.ask("open_files", files=[waiting])["opened"]
    operator.step("Export")
    choose_photo(page, "elsewhere.png")
    page.get_by_text("Left out: elsewhere.png: it has no pose", exact=False).wait_for()
    files = page.get_by_role("region", name="Files of the results")
    files.get_by_text("Of each photograph that is exported").wait_for()
    assert files.locator("li.left-out").count() == 0
    page.get_by_label("Photographs to export").select_option("this photograph")
    files.get_by_text("(not written)").first.wait_for()
    assert files.get_by_text("Of each photograph").is_hidden()
