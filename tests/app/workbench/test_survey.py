"""All photographs of a project: registered one after the other, adjusted together, and a survey that is opened."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ladarreg.jobs.runner import JobContext
from PIL import Image

from ladarreg_core.export.outputs.project_survey import survey_of_project, with_names
from ladarreg_core.foundations.progress import Progress
from ladarreg_core.simulate.sample import sample_survey_folder
from testing.scenes.shared_places import lines_on_scan, shared_lines, shared_places
from testing.workbench.workbench_driver import WorkbenchDriver, kept_bench, open_bench, registered

pytestmark = pytest.mark.slow


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[WorkbenchDriver]:
    """The sample, registered, with a blank photograph beside it."""
    bench = kept_bench("registered", tmp_path / "project", registered)
    blank = tmp_path / "blank.png"
    Image.fromarray(np.full((48, 64, 3), 120, np.uint8)).save(blank)
    bench.workbench.files.open(blank, blank.name, "photo", None, bench.client)
    yield bench
    bench.workbench.close()


def done(bench: WorkbenchDriver, command: str, **fields: object) -> str:
    bench.do(command, **fields)
    bench.workbench.runner.wait(300)
    job = bench.workbench.runner.job
    assert job is not None
    assert job.state == "done", job.message
    return job.message


def test_what_is_accepted_is_not_registered_again_and_what_cannot_be_is_named(bench: WorkbenchDriver) -> None:
    before = bench.slice("poses:p1")
    said = done(bench, "register_all")
    assert "registered already" in said
    assert "blank.png" in said
    assert bench.slice("poses:p1") == before


def test_an_adjustment_is_one_step_of_the_history(bench: WorkbenchDriver) -> None:
    before = bench.workbench.session.document.photo("p1")
    said = done(bench, "adjust")
    assert "1 of 1" in said
    assert "blank.png" in said
    survey = bench.slice("survey")
    (one,) = survey["photos"]
    assert one["accepted"]
    assert not one["changed"]
    assert one["position"]
    assert survey["scans"] == [{"name": "scan.npz", "state": "fixed", "position": None, "angle": None}]
    for camera in survey["cameras"]:
        residuals = [one["median_px"] for one in survey["photos"] if one["camera"] == camera["id"] and one["accepted"]]
        known = [px for px in residuals if px is not None]
        assert camera["median_px"] == (None if not known else float(np.median(known)))
        assert camera["worst"] is None if not known else camera["worst"]["median_px"] == max(known)
    assert "added" in survey["since"]  # the blank one
    photo = next(photo for photo in bench.slice("photos") if photo["id"] == "p1")
    assert photo["light"] == "verified"
    assert bench.slice("history")["entries"][-1]["label"].startswith("Adjust")
    bench.do("undo")
    assert bench.slice("survey") is None
    assert bench.workbench.session.document.photo("p1") == before


def test_what_is_said_of_photographs_names_their_files(bench: WorkbenchDriver, monkeypatch: pytest.MonkeyPatch) -> None:
    document = bench.workbench.session.document
    name = document.photos[1].source.name
    assert with_names("p1 and p2 on scan 1, p77, 3 px", document) == f"photo.png and {name} on scan 1, p77, 3 px"
    labels: list[str] = []
    really = JobContext.progress

    def progress(context: JobContext, told: Progress) -> None:
        labels.append(told.label)
        really(context, told)

    monkeypatch.setattr(JobContext, "progress", progress)
    done(bench, "adjust")
    assert "reading photo.png" in labels
    assert not [label for label in labels if "p1" in label]


def test_an_adjustment_is_out_of_date_once_a_photograph_has_another_pose(bench: WorkbenchDriver) -> None:
    done(bench, "adjust", photos=["p1"])
    assert bench.job("auto").state == "done"
    assert "another pose" in bench.slice("survey")["since"]
    assert bench.slice("survey")["photos"][0]["changed"]


def test_photographs_that_are_not_there_are_refused(bench: WorkbenchDriver) -> None:
    assert "photograph" in bench.refused("adjust", photos=["p99"])
    assert "photograph" in bench.refused("register_all", photos=[])


def test_a_survey_opens_as_a_project_and_again(tmp_path: Path) -> None:
    job = tmp_path / "job"
    shutil.copytree(sample_survey_folder(), job)
    for photo in sorted(job.glob("*.jpg"))[2:]:
        photo.unlink()
    (job / "camera.json").write_text(
        json.dumps({"width": 576, "height": 384, "fx": 468, "fy": 468, "cx": 288, "cy": 192})
    )
    fields = {
        "version": 1,
        "scans": [{"id": "a", "path": "station1.npz"}, {"id": "b", "path": "station2.npz"}],
        "cameras": [{"id": "given", "path": "camera.json"}, {"id": "exif"}],
        "photos": [
            {"id": "one", "path": "IMG_0001.jpg", "camera": "given"},
            {"id": "two", "path": "IMG_0002.jpg", "camera": "exif"},
        ],
        "ties": [{"id": "seen", "photos": ["two", "one"], "uv": [[1.5, 2], [3, 4]], "sigma_px": 0.5}],
        "lines": [
            {
                "id": "edge",
                "photos": ["two"],
                "uv": [[[1.5, 2], [30, 4]]],
                "scan": {"id": "b", "xyz": [[1, 2, 3], [1, 2, 4]]},
            }
        ],
    }
    survey = job / "survey.json"
    survey.write_text(json.dumps(fields))
    for _ in range(2):
        bench = open_bench(tmp_path / "project", survey)
        assert bench.slice("scan")["name"] == "station1.npz"
        assert [one["name"] for one in bench.slice("stations")["stations"]] == ["station1.npz", "station2.npz"]
        first, second = bench.slice("photos")
        (tie,) = bench.slice("drawn_ties")
        assert tie["photos"] == [second["id"], first["id"]]
        assert (tie["uv"], tie["sigma_px"], tie["agrees"]) == ([[1.5, 2], [3, 4]], 0.5, None)
        (line,) = bench.slice("drawn_lines")
        assert (line["photos"], line["uv"]) == ([second["id"]], [[[1.5, 2], [30, 4]]])
        assert (line["in_scan"]["name"], line["in_scan"]["station"]) == ("station2.npz", "s1")
        assert (line["agrees"], line["residuals_px"]) == (None, {})
        project = bench.workbench.session
        (kept,) = survey_of_project(project.document, project.folder).lines
        assert kept.in_scan.scan == "station2"
        assert kept.in_scan.xyz == ((1.0, 2.0, 3.0), (1.0, 2.0, 4.0))
        assert first["camera"]["calibrated"]
        assert first["camera"]["fx"] == 468
        assert not second["camera"]["calibrated"]
        entry = bench.workbench.session.document.photos[1]
        read_before = bench.workbench.loader.known("photo", (entry.source, entry.camera)) is not None
        bench.workbench.close()
    assert not read_before, "what is kept of a photograph needs none of its pixels"


def test_a_pose_that_is_held_stays_and_one_that_was_taken_out_takes_no_part(bench: WorkbenchDriver) -> None:
    pose = bench.workbench.session.document.photo("p1").pose
    assert bench.refused("set_part", photos=["p2"], part="held").startswith("blank.png has no accepted pose")
    bench.do("set_part", photos=["p1"], part="held")
    done(bench, "adjust")
    photo = bench.workbench.session.document.photo("p1")
    assert photo.pose == pose
    (one,) = bench.slice("survey")["photos"]
    assert one["accepted"]
    assert not one["changed"]
    assert one["moved"] is None
    bench.do("set_part", photos=["p1"], part="out")
    assert next(one for one in bench.slice("photos") if one["id"] == "p1")["part"] == "out"
    assert bench.slice("survey")["since"] == ("1 photograph was added, 1 photograph was taken out since: adjust again.")
    bench.do("adjust")
    bench.workbench.runner.wait(300)
    assert "Taken out by hand: photo.png" in bench.workbench.runner.job.message
    bench.do("undo")
    assert bench.workbench.session.document.photo("p1").part == "held"


def test_a_camera_that_is_held_keeps_its_focal_length(bench: WorkbenchDriver) -> None:
    assert "adjust again" in bench.refused("hold_camera", camera="camera-1", held=True)
    bench.do("set_camera", photo="p1", focal_35mm=27)
    bench.job("auto")
    done(bench, "adjust", photos=["p1"])
    (before,) = bench.slice("survey")["cameras"]
    assert before["sigma_px"]
    bench.do("hold_camera", camera=before["id"], held=True)
    assert bench.slice("survey")["cameras"][0]["held"]
    done(bench, "adjust", photos=["p1"])
    (after,) = bench.slice("survey")["cameras"]
    assert after["focal_px"] == before["focal_px"]
    assert after["sigma_px"] is None
    bench.do("hold_camera", camera=after["id"], held=False)
    assert not bench.slice("survey")["cameras"][0]["held"]


def test_ties_are_shown_where_the_photographs_show_them_and_kept(tmp_path: Path) -> None:
    job = tmp_path / "job"
    job.mkdir()
    for name in ("station1.npz", "IMG_0001.jpg", "IMG_0004.jpg", "IMG_0005.jpg"):
        shutil.copy(sample_survey_folder() / name, job / name)
    bench = open_bench(tmp_path / "project", job)
    assert bench.slice("ties:p1") is None
    done(bench, "adjust")
    rows = {one["id"]: one for one in bench.slice("survey")["photos"]}
    tied = [name for name, one in rows.items() if one["ties"]]
    assert tied, "none of them show the same"
    for name in tied:
        u, v, du, dv, agrees = np.array(bench.slice(f"ties:{name}")).T
        photo = next(one for one in bench.slice("photos") if one["id"] == name)
        assert (np.column_stack([u, v]) >= -0.5).all()
        assert (np.column_stack([u, v]) <= [photo["width"], photo["height"]]).all()
        if len(agrees) < 400:
            assert agrees.sum() == rows[name]["ties"]
            assert (agrees == 0).sum() == rows[name]["ties_left_out"]
        assert np.median(np.hypot(du, dv)[agrees == 1]) == pytest.approx(rows[name]["median_px"], abs=0.02)
    shown = bench.slice(f"ties:{tied[0]}")
    bench.workbench.close()
    again = open_bench(tmp_path / "project")
    assert again.slice(f"ties:{tied[0]}") == shown
    again.do("undo")
    assert again.slice(f"ties:{tied[0]}") is None
    again.workbench.close()


def test_ties_are_drawn_and_taken_back_adjusted_and_a_wrong_one_is_named(tmp_path: Path) -> None:
    job, pair = tmp_path / "job", shared_places()
    job.mkdir()
    for name in ("station1.npz", *(f"{one}.jpg" for one in pair.names)):
        shutil.copy(sample_survey_folder() / name, job / name)
    bench = open_bench(tmp_path / "project", job)
    ids = {Path(photo["name"]).stem: photo["id"] for photo in bench.slice("photos")}
    photos = [ids[name] for name in pair.names]
    assert "same photograph" in bench.refused("add_tie", photos=photos[:1] * 2, uv=[[1, 2], [3, 4]])
    for uv in pair.uv[:: len(pair.uv) // 6].tolist():
        bench.do("add_tie", photos=photos, uv=uv, sigma_px=0.5)
    right = [one["id"] for one in bench.slice("drawn_ties")]
    (u, v), (s, t) = pair.uv[0].tolist()
    wrong = bench.do("add_tie", photos=photos, uv=[[u, v], [s + 18, t - 14]], sigma_px=0.5)["tie"]
    assert bench.slice("history")["entries"][-1]["label"] == "Draw a tie"
    bench.do("undo")
    assert [one["id"] for one in bench.slice("drawn_ties")] == right
    bench.do("redo")
    assert "2 of 2" in done(bench, "adjust")
    said = {one["id"]: one for one in bench.slice("drawn_ties")}
    assert [name for name, one in said.items() if one["agrees"]] == right
    assert said[wrong]["reason"].startswith("Left out: it lies")
    assert bench.slice("survey")["since"] == ""
    bench.do("remove_ties", ties=[wrong])
    assert bench.slice("survey")["since"] == "1 tie was drawn or removed since: adjust again."
    survey = survey_of_project(bench.workbench.session.document, bench.workbench.session.folder)
    assert [one.id for one in survey.ties] == right
    bench.do("remove_photo", photo=photos[0])
    assert bench.slice("drawn_ties") == []
    bench.workbench.close()


def test_a_line_is_drawn_in_the_scan_and_one_photograph_adjusted_moved_and_erased(tmp_path: Path) -> None:
    job, shared = tmp_path / "job", lines_on_scan()
    job.mkdir()
    for name in ("station1.npz", f"{shared.names[0]}.jpg"):
        shutil.copy(sample_survey_folder() / name, job / name)
    bench = open_bench(tmp_path / "project", job)
    ends = shared.xyz.tolist()
    assert "two ends" in bench.refused("draw_line_in_scan", scan=ends[0][:1])
    assert "no longer in the project" in bench.refused("draw_line_in_scan", scan=ends[0], line="l7")
    assert "station" in bench.refused("draw_line_in_scan", scan=ends[0], station="s7")
    assert "no length in the scan" in bench.refused("draw_line_in_scan", scan=[ends[0][0]] * 2)
    made = bench.do("draw_line_in_scan", scan=ends[0], sigma_px=0.5)
    assert made["notes"] == []
    assert bench.slice("history")["entries"][-1]["label"] == "Draw a line in a scan"
    bench.do("draw_line", line=made["line"], photo="p1", uv=shared.uv[0, 0].tolist())
    far = [[x, y, z + 0.3] for x, y, z in ends[1]]
    wrong = bench.do("draw_line", photo="p1", uv=shared.uv[1, 0].tolist(), sigma_px=0.5)["line"]
    bench.do("draw_line_in_scan", scan=far, line=wrong, sigma_rad=0.001)
    right, other = bench.slice("drawn_lines")
    assert (right["id"], right["photos"], right["in_scan"]["station"]) == (made["line"], ["p1"], "")
    assert np.abs(np.array(right["in_scan"]["xyz"]) - shared.xyz[0]).max() < 0.03
    assert right["in_scan"]["sigma"].endswith("mm")
    assert (right["agrees"], right["scan_residual"]) == (None, None)
    assert "1 of 1" in done(bench, "adjust")
    right, other = bench.slice("drawn_lines")
    assert right["agrees"], right["reason"]
    assert right["scan_residual"].endswith("mm")
    assert right["residuals_px"]["p1"] < 2
    assert not other["agrees"], other["reason"]
    bench.do("draw_line_in_scan", scan=ends[1], line=wrong, sigma_rad=0.001)
    assert bench.slice("drawn_lines")[1]["agrees"] is None, "what was said of it is of another line"
    assert bench.slice("survey")["since"] == "1 line was drawn or removed since: adjust again."
    bench.do("undo")
    bench.do("erase_line", line=wrong)
    assert bench.slice("drawn_lines")[1]["in_scan"] is None
    bench.do("erase_line", line=wrong, photo="p1")
    assert [one["id"] for one in bench.slice("drawn_lines")] == [made["line"]], "no picture shows it any more"
    assert "not drawn in that photograph" in bench.refused("erase_line", line=made["line"], photo="p9")
    assert bench.do("scan_of")["scan"] == bench.slice("scan")
    bench.workbench.close()
    again = open_bench(tmp_path / "project")
    (kept,) = again.slice("drawn_lines")
    assert kept["in_scan"] == right["in_scan"]
    again.workbench.close()


def test_lines_are_drawn_in_three_photographs_adjusted_and_a_wrong_one_is_named(tmp_path: Path) -> None:
    job, shared = tmp_path / "job", shared_lines()
    job.mkdir()
    for name in ("station1.npz", *(f"{one}.jpg" for one in shared.names)):
        shutil.copy(sample_survey_folder() / name, job / name)
    bench = open_bench(tmp_path / "project", job)
    ids = {Path(photo["name"]).stem: photo["id"] for photo in bench.slice("photos")}
    photos = [ids[name] for name in shared.names]

    def draw(uv: list[Any]) -> str:
        made = None
        for photo, ends in zip(photos, uv, strict=False):
            made = bench.do("draw_line", line=made, photo=photo, uv=ends, sigma_px=0.5)["line"]
        assert made is not None
        return made

    right = [draw(uv) for uv in shared.uv[:4].tolist()]
    first, second, ((u, v), (s, t)) = shared.uv[4].tolist()
    wrong = draw([first, second, [[u + 15, v + 15], [s + 25, t + 25]]])
    pair = draw(shared.uv[5].tolist()[:2])
    assert [len(one["photos"]) for one in bench.slice("drawn_lines")] == [3, 3, 3, 3, 3, 2]
    assert bench.slice("history")["entries"][-1]["label"] == f"Draw line {pair[1:]} further"
    bench.do("undo")
    assert bench.slice("drawn_lines")[-1]["photos"] == photos[:1]
    bench.do("redo")
    assert "3 of 3" in done(bench, "adjust")
    said = {one["id"]: one for one in bench.slice("drawn_lines")}
    assert [name for name, one in said.items() if one["agrees"]] == right
    assert all(set(said[name]["residuals_px"]) == set(photos) for name in right)
    assert all(max(said[name]["residuals_px"].values()) < 2 for name in right)
    assert said[wrong]["reason"].startswith("Left out: one of ")
    assert said[pair]["reason"].startswith("Left out: only two of its photographs are part")
    assert bench.slice("survey")["since"] == ""
    bench.do("draw_line", line=pair, photo=photos[2], uv=shared.uv[5, 2].tolist())
    assert bench.slice("drawn_lines")[-1]["agrees"] is None, "what was said of it is of another line"
    assert bench.slice("survey")["since"] == "1 line was drawn or removed since: adjust again."
    assert "exactly two" in bench.refused("line_ends_as_ties", line=pair)
    bench.do("undo")
    bench.do("line_ends_as_ties", line=pair)
    assert [one["id"] for one in bench.slice("drawn_lines")] == [*right, wrong]
    assert [one["photos"] for one in bench.slice("drawn_ties")] == [photos[:2]] * 2
    bench.do("remove_lines", lines=[wrong])
    assert [one["id"] for one in bench.slice("drawn_lines")] == right
    bench.do("remove_photo", photo=photos[0])
    assert [one["photos"] for one in bench.slice("drawn_lines")] == [photos[1:]] * 4
    bench.workbench.close()
