"""`ladarreg compare`: exit codes, the table on the terminal, the files, and one line for every mistake."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ladarreg.cli import main
from ladarreg.exit_codes import ExitCode
from ladarreg.messages import aligned
from PIL import Image

import ladarreg_core.registration.comparison
from ladarreg_core.errors import Cancelled, DegenerateGeometryError
from ladarreg_core.export.comparison.table import Table
from ladarreg_core.formats.documents.pose_file import read_pose
from ladarreg_core.registration.comparison import Comparison
from ladarreg_core.results.steps import Step
from ladarreg_core.simulate.sample import sample_folder
from ladarreg_core.storage.manifest import visible_files
from tests.unit.export.comparisons import NOTE, STAGES, comparison_of


def words(*more: str) -> list[str]:
    folder = sample_folder()
    files = [str(folder / "scan.npz"), str(folder / "photo.png"), "--camera", str(folder / "camera.json")]
    return ["compare", *files, *more]


def answers(monkeypatch: pytest.MonkeyPatch, make: Callable[..., Comparison]) -> list[dict[str, Any]]:
    """Replace the comparison by a function; return the arguments of its calls."""
    calls: list[dict[str, Any]] = []

    def compare(scan: Any, photo: Any, **given: Any) -> Comparison:
        calls.append(given)
        given["report"](Step("linear", 0.01))
        return make(scan, photo)

    monkeypatch.setattr(ladarreg_core.registration.comparison, "compare", compare)
    return calls


def by_hand(**options: Any) -> Callable[..., Comparison]:
    truth = read_pose(sample_folder() / "truth.json")
    return lambda scan, photo: comparison_of(scan, photo, truth, **options)


@pytest.mark.slow
def test_the_table_is_printed_and_the_files_are_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    calls = answers(monkeypatch, by_hand(no_pose=("simplex",), cautions=("Little baseline.",)))
    out = tmp_path / "deep" / "results"
    truth = str(sample_folder() / "truth.json")
    assert main(words("-o", str(out), "--seed", "5", "--initial", truth)) == ExitCode.ACCEPTED
    assert calls[0]["options"].seed == 5
    assert calls[0]["initial"] is not None
    assert calls[0]["picks"] is None
    shown = capsys.readouterr()
    assert "Caution  Little baseline." in shown.out
    assert "Linear pose" in shown.err
    lines = shown.out.splitlines()
    assert max(map(len, lines[:20])) <= 120
    (verdict,) = (line for line in lines if line.startswith("verdict"))
    assert verdict.split("  ")[0] == "verdict"
    assert (verdict.count("not accepted"), verdict.count("no pose"), verdict.count("accepted")) == (3, 1, 4)
    (alpha,) = (line for line in lines if line.startswith("alpha, deg"))
    assert len(alpha.split()) == 7
    assert f"  {NOTE}" in lines
    names = {*visible_files(out)}
    assert names == {
        "comparison.json", "table.md", "contact_sheet.png", "not_accepted_linear.png",
        "not_accepted_constrained_linear.png", "not_accepted_simplex_outliers_removed.png", "registered_default.png",
    }  # fmt: skip
    assert all(name in shown.out for name in names)
    inputs = json.loads((out / "comparison.json").read_text(encoding="utf-8"))["inputs"]
    assert [entry["name"] for entry in inputs] == ["scan.npz", "photo.png", "camera.json", "truth.json"]


@pytest.mark.slow
@pytest.mark.parametrize("no_pose", [(), ("default",)], ids=["not accepted", "no pose"])
def test_the_default_decides_the_exit_code(
    no_pose: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    answers(monkeypatch, by_hand(stages=("linear", "default"), accepted=("linear",), no_pose=no_pose))
    assert main(words("-o", str(tmp_path / "new"), "--quiet")) == ExitCode.NOT_ACCEPTED
    shown = capsys.readouterr()
    assert shown.err == ""
    assert len(shown.out.splitlines()) == 1
    assert shown.out.startswith("Not accepted")


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (Cancelled(), ExitCode.INTERRUPTED),
        (KeyboardInterrupt(), ExitCode.INTERRUPTED),
        (DegenerateGeometryError("the matches lie on one line; add others"), ExitCode.BAD_INPUT),
    ],
    ids=lambda value: type(value).__name__,
)
def test_a_stop_leaves_no_files(
    error: BaseException,
    code: ExitCode,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def stop(scan: Any, photo: Any) -> Comparison:
        raise error

    answers(monkeypatch, stop)
    assert main(words("-o", str(tmp_path / "new"), "--quiet")) == code
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("ladarreg: ")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("more", "named"),
    [
        (["--matches", "none.json"], "none.json"),
        (["--initial", "none.json"], "none.json"),
        (["--scan-index", "7"], "7"),
        (["--method", "auto"], "--method"),
    ],
)
def test_a_mistake_is_one_line_and_leaves_no_files(
    more: list[str],
    named: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    calls = answers(monkeypatch, by_hand())
    assert main(words("-o", str(tmp_path / "new"), "--quiet", *more)) == ExitCode.BAD_INPUT
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("ladarreg: ")
    assert named in line
    assert not calls
    assert not list(tmp_path.iterdir())


def test_an_existing_folder_is_refused_before_any_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    calls = answers(monkeypatch, by_hand())
    (tmp_path / "notes.txt").write_text("mine")
    for force in ([], ["--force"]):
        assert main(words("-o", str(tmp_path), *force)) == ExitCode.BAD_INPUT
        assert "contains notes.txt, which ladarreg did not write" in capsys.readouterr().err
    assert not calls
    assert (tmp_path / "notes.txt").read_text() == "mine"


def test_table_columns_are_aligned() -> None:
    table = Table(heads=("A head of several words", "B"), rows=(("x, m", "1.25", "-"), ("verdict", "no pose", "no")))
    assert aligned(table).splitlines() == [
        "             A head of",
        "         several words   B",
        "-" * 26,
        "x, m              1.25   -",
        "verdict        no pose  no",
    ]


@pytest.mark.long
def test_the_sample_is_compared_by_one_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "results"
    assert main(words("-o", str(out))) == ExitCode.ACCEPTED
    assert "Wrote" in capsys.readouterr().out
    document = json.loads((out / "comparison.json").read_text(encoding="utf-8"))
    assert [column["name"] for column in document["columns"]] == list(STAGES)
    default = document["columns"][-1]
    truth = read_pose(sample_folder() / "truth.json")
    np.testing.assert_allclose(default["camera_from_scanner"], truth.matrix, atol=0.02)
    assert default["accepted"]
    assert (out / "registered_default.png").is_file()
    for column in document["columns"]:
        if column["picture"] is not None:
            assert column["picture"].startswith("registered_") == column["accepted"]
            assert (out / column["picture"]).is_file()
    with Image.open(out / "contact_sheet.png") as sheet:
        assert sheet.width <= 2600
