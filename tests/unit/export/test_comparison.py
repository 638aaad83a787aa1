"""The exported comparison: its numbers and table, and that only accepted stages are written as registered."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ladarreg_core.errors import Cancelled, ExportError, ShapeError
from ladarreg_core.export.comparison.folder import comparison_document, export_comparison, table_text
from ladarreg_core.export.comparison.table import comparison_table, differences, markdown_table, rms_depth_m, rms_px
from ladarreg_core.frames import Rigid, rotation_from_rotvec
from ladarreg_core.registration.comparison import Comparison
from ladarreg_core.storage.manifest import MANIFEST_FILE, visible_files
from testing.scenes.small_registration import POSE, sample_photo, sample_scan
from tests.unit.export.comparisons import NOTE, comparison_of
from tests.unit.export.test_contact_sheet import hostile


@pytest.fixture(scope="session")
def comparison() -> Comparison:
    return comparison_of(
        sample_scan(), sample_photo(), POSE, accepted=("simplex", "default"), no_pose=("constrained_linear",),
        cautions=("The camera stands | close\nby.",),
    )  # fmt: skip


def names(path):
    return visible_files(path)


def strict(text):
    return json.loads(text, parse_constant=lambda word: pytest.fail(f"{word} is not JSON"))


def test_the_folder_contains_everything_under_its_name(tmp_path, comparison, scan, photo) -> None:
    source = tmp_path / "elsewhere" / "scan.npz"
    source.parent.mkdir()
    source.write_bytes(b"123")
    out, seen = tmp_path / "a" / "out", []
    export_comparison(out, comparison, scan, photo, inputs=[source], report=seen.append)
    pictures = {
        "linear": "not_accepted_linear.png",
        "constrained_linear": None,
        "simplex": "registered_simplex.png",
        "simplex_outliers_removed": "not_accepted_simplex_outliers_removed.png",
        "default": "registered_default.png",
    }
    files = ["comparison.json", "contact_sheet.png", "table.md", *filter(None, pictures.values())]
    assert names(out) == sorted(files)
    assert [progress.done for progress in seen] == list(range(len(files) + 1))
    document = strict((out / "comparison.json").read_text(encoding="utf-8"))
    assert {column["name"]: column["picture"] for column in document["columns"]} == pictures
    assert [column["accepted"] for column in document["columns"]] == [False, False, True, False, True]
    assert document["inputs"] == [{"name": "scan.npz", "size": 3, "sha256": hashlib.sha256(b"123").hexdigest()}]
    assert (document["version"], document["seed"], document["software"]["name"]) == (1, 3, "ladarreg")
    assert str(tmp_path) not in json.dumps(document)


def test_every_column_has_its_numbers(comparison, scan) -> None:
    document = comparison_document(comparison, scan)
    for column, told in zip(comparison.columns, document["columns"], strict=True):
        result = column.stage.result
        assert (told["name"], told["note"], told["seconds"]) == (column.stage.name, column.stage.note, column.seconds)
        if result is None:
            assert told["note"] == NOTE
            assert (told["verdict"], told["evidence"], told["camera_from_scanner"]) == ("no pose", "none", None)
            assert told["matches"] is told["rms_px"] is told["from_default"] is None
            continue
        np.testing.assert_array_equal(told["camera_from_scanner"], result.camera_from_scanner.matrix)
        squares = (result.residuals_px[result.inliers] ** 2).sum(axis=1)
        assert told["rms_px"] == pytest.approx(np.sqrt(squares.mean()))
        assert (told["matches"], told["inliers"]) == (len(result.matches), result.inliers.sum())
        thesis = told["thesis_parameters"]
        assert thesis["Ty"] == result.thesis_parameters.Ty
        assert np.deg2rad(thesis["gamma_deg"]) == pytest.approx(result.thesis_parameters.gamma)
        assert told["reasons"] == list(result.reasons)


@cache
def two_alike():
    scan, photo = sample_scan(), sample_photo()
    return scan, photo, comparison_of(scan, photo, POSE, stages=("linear", "default"), off={"linear": 0, "default": 0})


@given(st.lists(st.floats(-0.2, 0.2), min_size=6, max_size=6))
def test_the_difference_from_the_default_is_the_poses(change) -> None:
    scan, photo, base = two_alike()
    moved = Rigid.from_centre(rotation_from_rotvec(change[:3]) @ POSE.rotation, POSE.centre + change[3:])
    first = base.columns[0]
    result = replace(first.stage.result, camera_from_scanner=moved)
    comparison = replace(base, columns=(replace(first, stage=replace(first.stage, result=result)), base.columns[1]))
    apart, itself = differences(comparison, scan)
    assert (itself.median_px, itself.position_m) == (0, 0)
    assert apart.position_m == pytest.approx(np.linalg.norm(change[3:]), abs=1e-9)
    assert apart.angle_rad == pytest.approx(np.linalg.norm(change[:3]), abs=1e-7)
    cells = np.argwhere(base.columns[1].texture.colored)
    points = scan.points[cells[:, 0], cells[:, 1]].astype(float)
    shift = photo.camera.project(moved @ points) - photo.camera.project(POSE @ points)
    assert apart.median_px == pytest.approx(np.median(np.hypot(*shift.T)), rel=1e-6, abs=1e-9)


def test_a_camera_that_looks_away_is_infinitely_far_in_pixels(scan, photo) -> None:
    base = comparison_of(scan, photo, POSE, stages=("linear", "default"))
    away = Rigid.from_centre(np.diag([-1, 1, -1]) @ POSE.rotation, POSE.centre)
    first = base.columns[0]
    result = replace(first.stage.result, camera_from_scanner=away)
    comparison = replace(base, columns=(replace(first, stage=replace(first.stage, result=result)), base.columns[1]))
    assert differences(comparison, scan)[0].median_px == np.inf
    told = comparison_document(comparison, scan)["columns"][0]["from_default"]
    assert told["median_px"] is None
    assert told["angle_deg"] == pytest.approx(180)
    row = {name: cells for name, *cells in comparison_table(comparison, scan).rows}
    assert row["from default, px"] == ["-", "0.00"]


def test_the_table_is_the_theses(comparison, scan) -> None:
    table = comparison_table(comparison, scan)
    rows = {name: cells for name, *cells in table.rows}
    assert list(rows)[:7] == ["Tx, m", "Ty, m", "Tz, m", "alpha, deg", "beta, deg", "gamma, deg", "points"]
    assert rows["verdict"] == ["not accepted", "no pose", "accepted", "not accepted", "accepted"]
    assert {cells[1] for name, cells in rows.items() if name != "verdict"} == {"-"}
    last = comparison.columns[-1].stage.result
    assert float(rows["Tx, m"][-1]) == pytest.approx(last.thesis_parameters.Tx, abs=5e-5)
    assert float(rows["alpha, deg"][-1]) == pytest.approx(np.degrees(last.thesis_parameters.alpha), abs=5e-5)
    assert rows["points"][-1] == "24 of 30"
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in markdown_table(table).splitlines()]
    assert [tuple(row) for row in cells] == [("", *table.heads), ("---", *["---:"] * 5), *table.rows]


def test_the_text_keeps_its_lines(comparison, scan) -> None:
    text = table_text(comparison, scan)
    assert "- Caution: The camera stands \\| close by." in text.splitlines()
    assert f"no pose. {NOTE}" in text
    wild = table_text(hostile(comparison_of(scan, sample_photo(), POSE)), scan)
    assert "<b>" not in wild
    assert sum(line.startswith("- ") for line in wild.splitlines()) == 5


def test_an_unaccepted_default_is_cautioned_about(scan, photo) -> None:
    refused = comparison_of(scan, photo, POSE, accepted=())
    assert "default itself is not accepted" in table_text(refused, scan)
    assert comparison_document(refused, scan)["cautions"]
    assert not comparison_document(comparison_of(scan, photo, POSE), scan)["cautions"]
    without = comparison_of(scan, photo, POSE, no_pose=("default",))
    assert differences(without, scan) == (None,) * 5


def test_figures_leave_out_what_is_not_a_number(comparison) -> None:
    result = comparison.columns[0].stage.result
    residuals = np.array(result.residuals_px)
    residuals[:] = (3.0, 4.0)
    residuals[1] = np.nan
    known = replace(result, residuals_px=residuals, stereo_depth_error_m=np.full(len(residuals), -0.5))
    assert (rms_px(known), rms_depth_m(known)) == (5.0, 0.5)
    nothing = replace(known, inliers=np.zeros(len(residuals), bool))
    assert np.isnan([rms_px(nothing), rms_depth_m(nothing)]).all()


def test_extreme_results_are_written(tmp_path, scan, photo) -> None:
    export_comparison(tmp_path / "out", hostile(comparison_of(scan, photo, POSE)), scan, photo)
    document = strict((tmp_path / "out" / "comparison.json").read_text(encoding="utf-8"))
    assert document["columns"][0]["rms_px"] is None
    assert document["columns"][1]["picture"] is None


@pytest.mark.parametrize("at", [0, 2, 7])
def test_stopped_anywhere_it_leaves_what_was_there(tmp_path, comparison, scan, photo, at) -> None:
    out = tmp_path / "out"
    export_comparison(out, comparison, scan, photo)
    (out / MANIFEST_FILE).unlink()
    (out / "table.md").write_text("old", encoding="utf-8")
    with pytest.raises(ExportError, match="`force=True`"):
        export_comparison(out, comparison, scan, photo)
    written = names(out)

    def report(progress):
        if progress.done == at:
            raise Cancelled

    with pytest.raises(Cancelled):
        export_comparison(out, comparison, scan, photo, force=True, report=report)
    assert names(tmp_path) == ["out"]
    assert names(out) == written
    assert (out / "table.md").read_text(encoding="utf-8") == "old"
    export_comparison(out, comparison, scan, photo, force=True)
    assert names(out) == written
    assert (out / "table.md").read_text(encoding="utf-8") != "old"
    (out / "registered_by_hand.png").write_bytes(b"mine")
    with pytest.raises(ExportError, match=r"contains registered_by_hand\.png next to comparison\.json"):
        export_comparison(out, comparison, scan, photo, force=True)


def test_a_folder_with_an_input_is_kept_and_nothing_is_left_of_nothing(tmp_path, comparison, scan, photo) -> None:
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "comparison.json").write_bytes(b"precious")
    inputs = [tmp_path / "data" / "comparison.json"]
    with pytest.raises(ExportError, match="contains the input"):
        export_comparison(tmp_path / "data", comparison, scan, photo, inputs=inputs, force=True)
    with pytest.raises(ShapeError, match="no columns"):
        export_comparison(tmp_path / "new", Comparison(columns=()), scan, photo)
    assert names(tmp_path) == ["data"]
