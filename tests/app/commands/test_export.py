"""`ladarreg export`: of folders of results, of a project, in the page, and what it refuses."""

from __future__ import annotations

import json
import shutil
import zipfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from ladarreg.cli import main
from ladarreg.exit_codes import ExitCode

from ladarreg_core.export.targets.registry import TARGETS
from ladarreg_core.simulate.sample import sample_folder
from testing.files.rewritten import rewrite
from testing.scenes.true_matches import true_points
from testing.workbench.workbench_driver import WorkbenchDriver, open_bench

SAMPLE = sample_folder()


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[WorkbenchDriver]:
    """A workbench with two solved photographs, one of which has a name of its own, and one without a pose."""
    home = tmp_path_factory.mktemp("exported")
    pictures = [home / name for name in ("one.png", "Größe 2.png", "three.png")]
    for picture in pictures:
        shutil.copy(SAMPLE / "photo.png", picture)
    found = open_bench(home / "project", SAMPLE / "scan.npz", *pictures, camera=SAMPLE / "camera.json")
    for photo in ("p1", "p2"):
        for point in true_points(24, seed=int(photo[1])):
            found.do("add_pick", photo=photo, **point)
        assert found.job("robust", photo).state == "done"
        assert found.slice(f"poses:{photo}")["stages"][0]["accepted"]
    yield found
    found.workbench.close()


@pytest.fixture(scope="module")
def project(bench: WorkbenchDriver, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same project, closed."""
    folder = tmp_path_factory.mktemp("closed") / "project"
    shutil.copytree(bench.workbench.session.folder.path, folder, ignore=shutil.ignore_patterns("lock"))
    return folder


@pytest.fixture(scope="module")
def exported(project: Path) -> Path:
    """The reports of all photographs of the project."""
    out = project.parent / "exported"
    assert main(["export", str(project), "--to", "report", "-o", str(out), "--quiet"]) == ExitCode.ACCEPTED
    return out


@pytest.fixture(scope="module")
def results(exported: Path) -> Path:
    """`registration.json` of two photographs, each in a folder."""
    folder = exported.parent / "results"
    for name in ("one", "Gr-e-2"):
        (folder / name).mkdir(parents=True)
        shutil.copy(exported / "report" / f"{name}.json", folder / name / "registration.json")
    return folder


def complaint(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    """Run the command, which must refuse in one line."""
    capsys.readouterr()
    assert main(["export", "--quiet", *words]) == ExitCode.BAD_INPUT
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("ladarreg: ")
    return line


def ids(out: Path) -> list[str]:
    return [photo["id"] for photo in json.loads((out / "export.json").read_bytes())["photos"]]


def test_the_targets_are_listed_with_what_each_is_for(capsys: pytest.CaptureFixture[str]) -> None:
    for words in (["--list"], ["--to", "list"]):
        assert main(["export", *words]) == ExitCode.ACCEPTED
        lines = capsys.readouterr().out.splitlines()
        assert [line.split()[0] for line in lines] == [target.name for target in TARGETS]
        assert all(target.purpose in line for target, line in zip(TARGETS, lines, strict=True))


@pytest.mark.slow
def test_a_project_goes_out_with_all_its_registered_photographs(
    project: Path, exported: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert ids(exported) == ["one", "Gr-e-2"]
    out = tmp_path / "out"
    words = ["export", str(project), "--to", "opencv", "-o", str(out), "--photo", "Größe 2.png"]
    assert main(words) == ExitCode.ACCEPTED
    assert "Photo    Gr-e-2: accepted, verified on the image" in capsys.readouterr().out
    assert ids(out) == ["Gr-e-2"]
    assert "Gr-e-2.yaml" in {path.name for path in (out / "opencv").iterdir()}
    said = complaint(capsys, str(project), "--to", "report", "-o", str(out), "--force", "--photo", "p3")
    assert "nothing was written: three.png: it has no pose" in said
    assert ids(out) == ["Gr-e-2"]


@pytest.mark.slow
def test_results_of_several_photographs_go_out_together(
    results: Path, exported: Path, bench: WorkbenchDriver, tmp_path: Path
) -> None:
    home = bench.workbench.session.folder.path.parent
    words = ["export", str(results / "one"), str(results / "Gr-e-2"), "--to", "report", "-o", str(tmp_path / "out")]
    files = ["--scan", str(SAMPLE / "scan.npz"), "--photo", str(home / "one.png"), "--root", str(home)]
    assert main([*words, *files, "--quiet"]) == ExitCode.ACCEPTED
    assert ids(tmp_path / "out") == ["one", "Gr-e-2"]
    for name in ("one", "Gr-e-2"):
        for kind in ("html", "json"):
            written = (tmp_path / "out" / "report" / f"{name}.{kind}").read_bytes()
            assert written == (exported / "report" / f"{name}.{kind}").read_bytes()
    recorded = json.loads((results / "one" / "registration.json").read_bytes())["inputs"]
    assert recorded[0]["read_with"] == {"scan_index": 0, "intensity": "auto"}
    assert recorded[1]["read_with"] == {"camera": "camera.json"}


@pytest.mark.slow
def test_photographs_that_are_left_out_are_listed(
    bench: WorkbenchDriver,
) -> None:
    from ladarreg.session.exported import chosen_photos

    workbench = bench.workbench
    chosen = chosen_photos(workbench.loader, workbench.session.document, None)
    assert [(one.name, one.why) for one in chosen.left_out] == [("three.png", "it has no pose; register it")]
    bench.do("switch_picks", photo="p1", picks=["1"], on=False)
    try:
        stale = chosen_photos(workbench.loader, workbench.session.document, None)
        assert [entry.id for entry in stale.entries] == ["p2"]
        assert stale.left_out[0].why.startswith("its pose is out of date: ")
        last = chosen_photos(workbench.loader, workbench.session.document, {"p1"}, last_solved=True)
        assert [entry.id for entry in last.entries] == ["p1"]
    finally:
        bench.do("undo")


@pytest.mark.slow
def test_refusals(results: Path, project: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    to = ["--to", "report", "-o", str(out)]
    one = str(results / "one")
    assert "missing --to, --out" in complaint(capsys, one)
    assert "missing RESULT" in complaint(capsys, *to)
    assert "'colmop' is not an export target" in complaint(capsys, one, "--to", "report,colmop", "-o", str(out))
    assert "has neither a registration.json nor a project.json" in complaint(capsys, str(SAMPLE), *to)
    assert "is not a folder" in complaint(capsys, str(tmp_path / "gone"), *to)
    assert "scan.npz is needed, but there is no such file; give its folder with --root" in complaint(capsys, one, *to)
    assert "a project is exported by itself" in complaint(capsys, str(project), one, *to)
    assert "a project knows its files" in complaint(capsys, str(project), "--root", str(SAMPLE), *to)
    assert "0 photos are called 'p9'; the project has p1 (one.png)" in complaint(
        capsys, str(project), "--photo", "p9", *to
    )
    assert "lies in the project" in complaint(
        capsys, str(project), "--to", "report", "-o", str(project / "exports"), "--force"
    )
    assert "--scan give the files" in complaint(capsys, one, "--scan", "0", *to)
    assert "the frame 'world' needs the scanner's pose" in complaint(capsys, str(project), "--frame", "world", *to)
    assert not out.exists()


def test_a_refused_result_is_refused_before_anything_is_read(
    results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "refused").mkdir()
    document = json.loads((results / "one" / "registration.json").read_bytes())
    document |= {"accepted": False, "evidence": "none", "reasons": ["No."], "camera_from_scanner": None}
    document["rejected_guess"] = np.eye(4).tolist()
    rewrite(tmp_path / "refused" / "registration.json", document)
    others = next(target.name for target in TARGETS if not target.shows_refused)
    said = complaint(capsys, str(tmp_path / "refused"), "--to", f"report,{others}", "-o", str(tmp_path / "out"))
    assert f"{others} cannot be written: the pose of one.png was refused" in said
    assert not (tmp_path / "out").exists()


def test_the_page_lists_the_targets_and_exports_all_photographs_together(
    bench: WorkbenchDriver, tmp_path: Path
) -> None:
    table = bench.do("export_targets")
    assert [(one["name"], one["purpose"]) for one in table["targets"]] == [(one.name, one.purpose) for one in TARGETS]
    assert [one["id"] for one in table["photos"]] == ["p1", "p2"]
    assert [(one["name"], one["is_stale"]) for one in table["left_out"]] == [("three.png", False)]
    assert {one["refusal"] for one in table["targets"] if one["name"] in ("opencv", "report", "results")} == {None}
    assert next(one["refusal"] for one in table["targets"] if one["name"] == "stations").startswith("there is one scan")
    bench.do("export", targets=["kalibr", "opencv"])
    bench.workbench.runner.wait(240)
    job = bench.workbench.runner.job
    assert job is not None
    assert job.state == "done", job.message
    assert job.message.endswith("with kalibr, opencv. Left out: three.png: it has no pose; register it.")
    (ready,) = [m for m in bench.received if m.get("event") == "export_ready"]
    assert (ready["url"], ready["targets"]) == ("export/all.zip", ["kalibr", "opencv"])
    path, name = bench.workbench.export_file("all") or (Path(), "")
    assert name.endswith("-export.zip")
    with zipfile.ZipFile(path) as file:
        names = set(file.namelist())
        assert [one["id"] for one in json.loads(file.read("export.json"))["photos"]] == ["one", "Gr-e-2"]
    assert {"opencv/one.yaml", "opencv/Gr-e-2.yaml"} <= names
    assert any(name.startswith("kalibr/") for name in names)
    folder = tmp_path / "opencv"
    bench.do("export", targets=["opencv"], photos=["p2"], folder=str(folder))
    bench.workbench.runner.wait(240)
    assert ids(folder) == ["Gr-e-2"]
    assert "contains earlier results" in bench.refused("export", targets=["opencv"], folder=str(folder))
    bench.do("export", targets=["opencv"], folder=str(folder), force=True)
    bench.workbench.runner.wait(240)
    assert ids(folder) == ["one", "Gr-e-2"]


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"targets": ["colmop"]}, "is not an export target"),
        ({"targets": []}, "there is no export target"),
        ({"targets": "opencv"}, "the targets are a list of names"),
        ({"targets": ["opencv"], "photos": ["p3"]}, "three.png: it has no pose"),
        ({"targets": ["opencv"], "frame": "world"}, "the frame 'world' needs the scanner's pose"),
        ({"targets": ["opencv"], "crop": "all"}, "crop"),
        ({"targets": ["opencv"], "folder": "here"}, "is not an absolute path"),
    ],
)
def test_the_page_refuses_at_once(bench: WorkbenchDriver, fields: dict[str, object], said: str) -> None:
    assert said.lower() in bench.refused("export", **fields).lower()


def test_targets_say_why_they_cannot_be_written(bench: WorkbenchDriver) -> None:
    table = bench.do("export_targets", photos=["p3"])
    assert table["photos"] == []
    of_photographs = [one for one in table["targets"] if one["name"] not in ("stations", "measurements")]
    assert {one["refusal"] for one in of_photographs} == {"three.png: it has no pose; register it"}


@pytest.mark.slow
def test_results_of_several_photographs_have_a_folder_each_beside_other_targets(
    bench: WorkbenchDriver, tmp_path: Path
) -> None:
    bench.do("export", targets=["opencv", "results"], folder=str(tmp_path / "both"))
    bench.workbench.runner.wait(240)
    listed = json.loads((tmp_path / "both" / "export.json").read_text())["files"]
    assert {"opencv/one.yaml", "results/one/registration.json", "results/Gr-e-2/cloud.ply"} <= {*listed}
    bench.do("export", targets=["results"], photos=["p1"], folder=str(tmp_path / "alone"))
    bench.workbench.runner.wait(240)
    assert (tmp_path / "alone" / "registration.json").is_file()
    assert not (tmp_path / "alone" / "export.json").exists()
    both = json.loads((tmp_path / "both" / "results" / "one" / "registration.json").read_text())
    alone = json.loads((tmp_path / "alone" / "registration.json").read_text())
    hints = [one.pop("path_hint", None) for one in alone["inputs"]]
    assert all(hints)
    assert [one.pop("path_hint", None) for one in both["inputs"]] == [None] * len(hints)
    assert {**both, "sha256": 0} == {**alone, "sha256": 0}


@pytest.mark.parametrize(
    ("former", "present"),
    [
        (
            {"id": 4, "do": "run", "job": "export", "photo": "p1", "frame": "world"},
            {"id": 4, "do": "export", "targets": ["results"], "photos": ["p1"], "frame": "world"},
        ),
        (
            {"do": "export_folder", "photo": "p1", "folder": "/a", "force": True, "project": "x"},
            {"do": "export", "targets": ["results"], "photos": ["p1"], "folder": "/a", "force": True, "project": "x"},
        ),
        ({"do": "hand_over", "targets": ["laz"]}, {"do": "export", "targets": ["laz"]}),
        ({"do": "export_stations"}, {"do": "export", "targets": ["stations", "e57"], "photos": []}),
        ({"do": "run", "job": "report", "photo": "p1"}, {"do": "write_report", "photo": "p1"}),
        ({"do": "run", "job": "auto", "photo": "p1"}, {"do": "run", "job": "auto", "photo": "p1"}),
    ],
)
def test_export_commands_of_earlier_versions_are_read(former: dict[str, object], present: dict[str, object]) -> None:
    from ladarreg.workbench.commands.former import present_form

    assert present_form(former) == present


def test_an_earlier_result_says_how_the_same_files_are_read(results: Path, tmp_path: Path) -> None:
    from ladarreg.commands.apply import Arguments
    from ladarreg.inputs import with_recorded_options

    scan, photo = SAMPLE / "scan.npz", SAMPLE / "photo.png"  # of which the project has a copy under another name
    file = tmp_path / "registration.json"
    document = json.loads((results / "one" / "registration.json").read_bytes())
    document["inputs"][0]["read_with"] |= {"scan_index": 2, "origin": [1.0, 2.5, 3.0], "columns": ["x", "y"]}
    document["inputs"][1]["read_with"] = {"focal_px": 900.0, "temperature_unit": "C"}
    file.write_text(json.dumps(document))
    words = Arguments(scan=scan, photo=photo, out=tmp_path / "out", pose=file)
    found = with_recorded_options(words, file, None)
    assert (found.scan_index, found.origin, found.columns) == (2, "1.0,2.5,3.0", "x,y")
    assert found.scan_options["origin"] == (1.0, 2.5, 3.0)
    assert (found.focal_px, found.temperature_unit) == (900.0, "C")
    given = with_recorded_options(replace(words, scan_index=1, camera=photo), file)
    assert (given.scan_index, given.camera, given.focal_px) == (1, photo, None)
    assert with_recorded_options(words, SAMPLE / "truth.json") == words
