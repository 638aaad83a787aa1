"""The report of `benchmarks.pose`: its text, page, JSON and bars."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.pose.accuracy import backends_apart, mismatches_section
from benchmarks.pose.report import Bar, Section, as_text, table, write_json, write_page
from ladarreg_core.frames import Rigid, rotation_from_rotvec
from testing.scenes.accuracy import Answer, Answers, ask, default, measure
from testing.scenes.pose_case import Case
from testing.scenes.room import plane_case, repeated_case, room_case, room_ranges
from testing.scenes.room_lines import line_case


def section(cell: str = "1.00", value: float = 1.0, *, key: str = "some") -> Section:
    bar = Bar("a figure", value, most=2)
    return Section(key, "Some cases", "How to read it.", (("", table(("mm",), [("default", cell)])),), (bar,),
                   {"a": np.float64(value), "b": {"c": np.arange(2.0)}, "d": np.bool_(True)})  # fmt: skip


@given(st.floats(), st.none() | st.floats(-9, 9), st.none() | st.floats(-9, 9))
def test_a_bar_is_met_between_its_bounds_and_never_by_an_unknown_value(value, least, most):
    within = (least is None or value >= least) and (most is None or value <= most)
    bar = Bar("it", value, least=least, most=most)
    assert bar.met == (within and not math.isnan(value))
    assert bar.verdict == ("met" if bar.met else "MISSED")


def test_a_page_keeps_the_text_around_the_tables_and_sections_that_did_not_run(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("# Benchmarks\n\nBefore.\n", encoding="utf-8")
    write_page(page, [section("1.11"), section("2.22", key="other")], seeds=range(3, 5))
    page.write_text(page.read_text(encoding="utf-8") + "## Matching\n\nAfter.\n", encoding="utf-8")
    write_page(page, [section("3.33")], seeds=range(7))
    again = page.read_text(encoding="utf-8")
    write_page(page, [section("3.33")], seeds=range(7))
    assert page.read_text(encoding="utf-8") == again
    assert again.startswith("# Benchmarks\n\nBefore.\n")
    assert again.endswith("## Matching\n\nAfter.\n")
    assert "1.11" not in again
    assert again.index("| default | 3.33 |") < again.index("7 seeds (0 to 6)") < again.index("| default | 2.22 |")
    assert again.index("| default | 2.22 |") < again.index("2 seeds (3 to 4)")
    assert again.count("| a figure | 1.00 | <= 2 | met |") == 2


def test_json_is_strict_and_says_what_ran(tmp_path):
    write_json(tmp_path / "figures.json", [section(value=math.nan)], seeds=range(2))
    found = json.loads((tmp_path / "figures.json").read_text(encoding="utf-8"), parse_constant=pytest.fail)
    assert found["seeds"] == [0, 1]
    assert found["sections"]["some"] == {"a": None, "b": {"c": [0.0, 1.0]}, "d": True}
    assert found["bars"][0]["verdict"] == "MISSED"
    assert {"python", "numpy"} <= set(found["versions"])


def off_by(sigmas: float):
    """Return a solver with errors of this many sigmas of the bound, which reports the bound."""
    rng = np.random.default_rng(0)

    def solve(case: Case) -> Answer:
        covariance = np.linalg.inv(case.bound())
        way = rng.normal(size=6)
        step = np.linalg.cholesky(covariance) @ way * (sigmas / np.linalg.norm(way))
        rotation = rotation_from_rotvec(-step[:3]) @ case.pose.rotation
        return Rigid.from_centre(rotation, case.pose.centre - step[3:]), covariance

    return solve


def test_figures_are_those_of_a_solver_whose_errors_are_known():
    cases = [room_case(seed, count=20) for seed in range(60)]
    near, far = measure(off_by(3.0), cases), measure(off_by(6.5), cases)
    assert near.success == 1
    assert near.consistency == pytest.approx(3 / np.sqrt(6), rel=1e-3)
    assert near.efficiency == pytest.approx(6 / 3**2, abs=4 * near.efficiency_error)
    assert near.efficiency_error < 0.1
    assert far.success == 0
    assert math.isnan(far.efficiency)
    nobody = measure(lambda case: None, cases[:3])
    assert nobody.success == 0
    assert nobody.position_mm == math.inf


@pytest.mark.slow
def test_every_peer_answers_the_same_cases(tmp_path):
    found = mismatches_section(range(2))
    assert len(found.tables) >= 4
    for _, cells in found.tables[:4]:
        assert {row[0] for row in cells.rows} >= {"default", "OpenCV RANSAC + refineLM", "our RANSAC alone"}
        success = {row[0]: row[1] for row in cells.rows}
        assert success["default"] == success["default, true inliers known"] == "100.0 %"
    assert "met     room, 0 % mismatches: success" in as_text(found)
    write_json(tmp_path / "it.json", [found], seeds=range(2))


def test_answers_of_one_solver_only_are_infinitely_far_apart():
    cases = [room_case(0, count=40)]
    ours, none = ask(default, cases), Answers((None,), np.zeros(1))
    assert backends_apart(ours, ours) == [0]
    assert backends_apart(ours, none) == [np.inf]
    assert backends_apart(none, none) == [0]


@pytest.mark.parametrize("share", [0.25, 0.5])
def test_repeated_structure_fits_two_places(share):
    case = repeated_case(4, share=share)
    beside = Rigid.from_centre(case.pose.rotation, case.pose.centre + np.array([0, 0.9, 0]))
    errors = [
        np.linalg.norm(case.camera.project(p @ case.matches.points) - case.uv, axis=1) for p in (case.pose, beside)
    ]
    assert (errors[0][case.true] < 12).all()  # 1 px, and 15 mm of range noise seen from half a metre aside
    assert (errors[1][~case.true] < 25).all()
    assert np.mean(~case.true) == share
    plane = plane_case(1, extent_m=1.0, distance_m=5.0)
    assert np.linalg.svd(plane.matches.points - plane.matches.points.mean(axis=0))[1][2] < 0.02


@pytest.mark.parametrize(("seed", "baseline_m"), [(0, 0.5), (45, 0.5), (3, 0.94)])
def test_lines_lie_on_what_both_see(seed, baseline_m):
    """The camera of seed 45 hardly sees a box that is long enough."""
    case = line_case(seed, baseline_m=baseline_m)
    assert len(case.picks) == 8
    for pick in case.picks:
        points = pick.scan * room_ranges(pick.scan)[:, None]
        assert np.abs(case.camera.project(case.pose @ points) - pick.photo).max() < 5  # 1 px of noise
        assert 290 < np.linalg.norm(np.diff(pick.photo, axis=0)) < 510
