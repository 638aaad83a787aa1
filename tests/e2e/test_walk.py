"""A walk through the states of a project: in each, every figure and verdict on the page is that of the project.

The states are reached by commands, as by another page. In each, the whole page is read and compared with the project on
the disk (testing/workbench/page_truth.py), and with what a person expects of this state.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from PIL import Image, ImageOps

from ladarreg_core.simulate.sample import sample_folder
from testing.scenes.true_matches import true_points
from testing.workbench.served import Page as Socket
from testing.workbench.walk import Walk

MIN_STATES = 40
FOCAL_PX = 974.0


SCAN = sample_folder() / "scan.npz"
PHOTO = next(sample_folder().glob("photo.*"))


def first_steps(walk: Walk) -> list[str]:
    """From nothing to matches that are solved by a button."""
    walk.state("nothing is open")
    walk.files(PHOTO)
    walk.state("a photograph alone")
    walk.files(SCAN)
    walk.page.keyboard.press("Escape")
    walk.state("both, the focal length is unknown")
    walk.do("set_settings", solve_automatically=False)
    walk.do("set_camera", photo="p1", focal_px=FOCAL_PX)
    walk.page.keyboard.press("Escape")
    walk.state("the focal length is entered")
    picks = walk.points(1)
    walk.state("one match")
    picks += [str(walk.do("add_pick", photo="p1", **point)["pick"]) for point in true_points(3)[1:]]
    walk.state("three matches")
    picks += [str(walk.do("add_pick", photo="p1", **point)["pick"]) for point in true_points(16)[3:]]
    walk.state("sixteen matches", ticks=("match",))
    walk.do("switch_picks", photo="p1", picks=picks, on=False)
    walk.state("all matches are disabled")
    walk.do("undo")
    walk.state("enabled again", ticks=("match",))
    return picks


SOLVED = ("match", "solve", "judge")


@pytest.mark.long
def test_a_short_walk(walk: Walk) -> None:
    """Nothing open, matches, solved, out of date, undone, contradicted, corrected."""
    picks = first_steps(walk)
    walk.job("simplex")
    walk.state("a single step, not compared with the images", "matches_only", ticks=SOLVED)
    walk.job("solve")
    walk.state("solved", "verified", ticks=SOLVED)
    walk.do("remove_picks", photo="p1", picks=picks[:1])
    walk.state("a match is removed since", "out_of_date", ticks=("match",))
    walk.do("undo")
    walk.state("and is back", "verified", ticks=SOLVED)
    walk.do("remove_picks", photo="p1", picks=picks)
    walk.points(16, shift_px=30)
    walk.job("solve")
    walk.state("contradicted by the images", "not_accepted", ticks=("match",))
    walk.do("use_stage", photo="p1", stage="refined")
    walk.state("the images' pose is used", "verified", ticks=SOLVED)
    walk.finish(15)


@pytest.mark.long
def test_a_walk_where_the_images_cannot_judge(walk: Walk, tmp_path: Path) -> None:
    """A photograph of fog: matches alone accept, in a colour of their own, everywhere; and never green."""
    fog = tmp_path / "fog.png"
    with Image.open(PHOTO) as image:
        Image.new("RGB", image.size, (128, 130, 132)).save(fog)
    walk.files(SCAN, fog)
    walk.page.keyboard.press("Escape")
    walk.do("set_settings", solve_automatically=False)
    walk.do("set_camera", photo="p1", focal_px=FOCAL_PX)
    walk.page.keyboard.press("Escape")
    picks = walk.points(16)
    walk.state("matches in fog", ticks=("match",))
    walk.job("solve")
    walk.state("accepted on matches only", "matches_only", ticks=SOLVED)
    walk.job("verify")
    walk.state("the images cannot judge", "matches_only", ticks=SOLVED)
    for step in ("Solve", "Judge", "Export"):
        walk.operator.step(step)
        walk.state(f"seen in the step {step}", "matches_only", ticks=SOLVED)
    walk.job("export")
    walk.state("exported", "matches_only", ticks=(*SOLVED, "export"))
    walk.do("set_pick", photo="p1", pick=picks[0], on=False)
    walk.state("a match is disabled", "out_of_date", ticks=("match",))
    walk.do("undo")
    walk.state("and enabled", "matches_only", ticks=(*SOLVED, "export"))
    walk.reopen()
    walk.state("reopened", "matches_only", ticks=(*SOLVED, "export"))
    walk.job("auto")
    walk.state("automatic registration is refused", "not_accepted", ticks=("match",))
    walk.do("use_stage", photo="p1", stage="robust")
    walk.state("the drawn pose is used again", "matches_only", ticks=(*SOLVED, "export"))
    walk.finish(12)


@pytest.mark.long
@pytest.mark.timeout(1200)
def test_a_long_walk(walk: Walk, tmp_path: Path) -> None:
    """More than forty states, among them each of those that have contradicted themselves before."""
    picks = first_steps(walk)
    walk.job("robust")
    walk.state("solved as drawn", "verified", ticks=SOLVED)
    walk.job("solve")
    walk.state("solved and refined", "verified", ticks=SOLVED)
    walk.do("use_stage", photo="p1", stage="robust")
    walk.state("the drawn pose is used", "verified", ticks=SOLVED)
    walk.job("verify")
    walk.state("verified again", "verified", ticks=SOLVED)
    walk.do("set_pick", photo="p1", pick=picks[0], photo_uv=[[100.0, 100.0]])
    walk.state("a match is moved", "out_of_date", ticks=("match",))
    walk.do("set_pick", photo="p1", pick=picks[1], weight=2)
    walk.state("another is weighted", "out_of_date", ticks=("match",))
    walk.job("robust")
    walk.state("solved with an outlier", "verified", ticks=SOLVED)
    walk.do("switch_picks", photo="p1", picks=picks[:1], on=False)
    walk.state("the outlier is disabled", "out_of_date", ticks=("match",))
    walk.job("solve")
    walk.state("and solved again", "verified", ticks=SOLVED)
    walk.job("linear")
    walk.state("linear", light_of(walk), ticks=ticks_of(walk))
    walk.job("simplex")
    walk.state("simplex", light_of(walk), ticks=ticks_of(walk))
    walk.job("reject_outliers")
    walk.state("outliers are removed", light_of(walk), ticks=ticks_of(walk))
    walk.job("compare")
    walk.state("all methods are compared", light_of(walk), ticks=ticks_of(walk))
    walk.do("reject", photo="p1", by="px", above=0.3)
    walk.state("matches are disabled by the threshold", "out_of_date", ticks=("match",))
    walk.do("undo")
    walk.state("and enabled again", light_of(walk), ticks=ticks_of(walk))
    walk.job("auto")
    walk.state("registered automatically", "verified", ticks=SOLVED)
    walk.do("remove_picks", photo="p1", picks=picks[2:5])
    walk.state("a pose from the images outlives its matches", "verified", ticks=SOLVED)
    walk.job("export")
    exported = (*SOLVED, "export")
    walk.state("exported", "verified", ticks=exported)
    other = Socket(walk.workbench.server)
    assert other.ask("call_me", name="Ada")["ok"]
    assert other.ask("use_stage", photo="p1", stage="robust")["ok"]
    walk.state("another person shows another pose", "out_of_date", ticks=("match",))
    assert other.ask("undo")["ok"]
    walk.state("and undoes it", "verified", ticks=exported)
    assert other.ask("set_pick", photo="p1", pick=picks[6], on=False)["ok"]
    walk.state("another person disables a match", "verified", ticks=exported)
    other.socket.close()

    walk.reopen()
    walk.state("reopened", "verified", ticks=exported)
    walk.do("undo")
    walk.state("undone after reopening", "verified", ticks=exported)

    mirrored = tmp_path / "mirrored.png"
    with Image.open(PHOTO) as image:
        ImageOps.mirror(image).save(mirrored)
    walk.files(mirrored)
    walk.operator.page.evaluate(
        "import('./js/net/requests.js').then(({ request }) => request('show_photo', { photo: 'p2' }))"
    )
    walk.page.keyboard.press("Escape")
    walk.state("a second photograph")
    walk.do("set_camera", photo="p2", focal_px=FOCAL_PX)
    walk.state("its focal length is entered")
    walk.job("auto", photo="p2")
    walk.state("it is of something else: refused", "not_accepted")
    walk.points(3, photo="p2")
    walk.state("a refused one with matches", "not_accepted")
    walk.points(6, shift_px=40, photo="p2")
    walk.state("a refused one with enough matches", "not_accepted", ticks=("match",))
    walk.job("solve", photo="p2")
    walk.state("wrong matches of it are solved", "not_accepted", ticks=("match",))
    walk.page.evaluate("import('./js/net/requests.js').then(({ request }) => request('show_photo', { photo: 'p1' }))")
    walk.state("the first photograph again", "verified", ticks=exported)
    walk.do("remove_photo", photo="p2")
    walk.state("the second is removed", "verified", ticks=exported)
    walk.do("undo")
    walk.state("and is back", "verified", ticks=exported)
    walk.do("set_camera", photo="p1", focal_px=900.0)
    walk.state("another focal length removes the poses", ticks=("match",))
    walk.do("undo")
    walk.state("which are back", "verified", ticks=exported)
    walk.job("find_corners")
    walk.state("corners are found", "verified", ticks=exported)
    walk.job("match")
    walk.state("corners are matched", "verified", ticks=exported)
    walk.do("undo")
    walk.state("corner matches are undone", "verified", ticks=exported)
    walk.do("rename", name="Seven of nine")
    walk.state("renamed", "verified", ticks=exported)
    walk.finish(MIN_STATES)


def light_of(walk: Walk) -> str | None:
    """What the workbench says of the first photograph, where a person would not know."""
    walk.socket.ask("list_served")
    light = walk.socket.slices["photos"][0].get("light")
    return str(light) if light else None


def ticks_of(walk: Walk) -> tuple[str, ...]:
    return SOLVED if light_of(walk) in ("verified", "matches_only") else ("match",)
