"""Lists of jobs: what rows and folders mean, and that every fault of a list is found at once."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from ladarreg_core.batches.jobs.job import OPTIONS_OF, Job, parsed_option
from ladarreg_core.batches.jobs.job_list import JobListError, _with_paths, list_bytes, read_jobs
from ladarreg_core.errors import FormatError, LadarregError, OptionError
from ladarreg_core.export.pictures.images import write_png
from ladarreg_core.formats.scans.npz import write_npz_xyz
from testing.scenes.small_registration import sample_photo, sample_scan


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two places with a scan and photos, and one with two scans."""
    for place, scans, photos in (("a", 1, 2), ("b", 1, 1), ("c", 2, 1)):
        (tmp_path / place).mkdir()
        for k in range(scans):
            write_npz_xyz(tmp_path / place / f"scan{k}.npz", sample_scan())
        for k in range(photos):
            write_png(tmp_path / place / f"{k}.png", sample_photo().pixels)
    (tmp_path / "camera.json").write_text(json.dumps(sample_photo().camera.as_fields()))
    return tmp_path


def listed(folder: Path, text: str) -> list[Job]:
    (folder / "jobs.csv").write_text(text, encoding="utf-8")
    return read_jobs(folder / "jobs.csv")


def faults(folder: Path, text: str, name: str = "jobs.csv") -> str:
    (folder / name).write_text(text, encoding="utf-8")
    with pytest.raises(LadarregError) as error:
        read_jobs(folder / name)
    return "\n".join(getattr(error.value, "faults", (str(error.value),)))


def test_a_row_is_a_pair_with_the_options_of_register(folder: Path) -> None:
    first, second, survey = listed(
        folder,
        "scan;photo;name;camera;focal-px;origin;smooth;seed;survey;more\n"
        "a/scan0.npz;a/0.png;;camera.json;;1, 2 3;yes;7;;\n"
        "# a comment\n"
        "b/scan0.npz;b/0.png;mine;;500.5;;;;;c/scan0.npz|c/scan1.npz\n"
        ";;;;;;;3;c;\n",
    )
    assert (first.id, first.kind, first.scan, first.photos) == (
        "a-0", "pair", folder / "a/scan0.npz", (folder / "a/0.png",),
    )  # fmt: skip
    assert first.photo_options["camera"] == folder / "camera.json"
    assert first.scan_options["origin"] == (1.0, 2.0, 3.0)
    assert (first.options["smooth"], first.register_options.seed) == (True, 7)
    assert (second.id, second.photo_options["focal_px"]) == ("mine", 500.5)
    assert second.scan_options["more"] == (folder / "c/scan0.npz", folder / "c/scan1.npz")
    assert (survey.kind, survey.survey, survey.register_options.seed) == ("survey", folder / "c", 3)


def test_json_states_options_for_all_and_several_photos(folder: Path) -> None:
    fields: dict[str, Any] = {
        "version": 1, "options": {"focal-px": 500, "seed": 1},
        "jobs": [
            {"scan": "a/scan0.npz", "photos": ["a/0.png", "a/1.png"], "seed": 2},
            {"scan": "b/scan0.npz", "photo": "b/0.png", "origin": [1, 2, 3]},
        ],
    }  # fmt: skip
    (folder / "jobs.json").write_text(json.dumps(fields))
    several, pair = read_jobs(folder / "jobs.json")
    assert (several.kind, len(several.photos), several.options) == ("photos", 2, {"focal_px": 500.0, "seed": 2})
    assert (pair.options["seed"], pair.options["origin"]) == (1, (1.0, 2.0, 3.0))
    (folder / "jobs.json").write_text(json.dumps(fields["jobs"][1:]))
    assert read_jobs(folder / "jobs.json")[0].options == {"origin": (1.0, 2.0, 3.0)}


def test_a_folder_is_one_job_and_a_pattern_means_several(folder: Path) -> None:
    a, b, c = read_jobs(f"{folder}/[abc]")
    assert [one.id for one in (a, b, c)] == ["a", "b", "c"]
    assert (a.kind, len(a.photos), b.kind) == ("photos", 2, "photos"), "as register FOLDER does"
    assert (c.kind, c.survey) == ("survey", folder / "c")
    assert [one.id for one in read_jobs(folder / "a", folder / "a", folder / "b")] == ["a", "b"]


def test_every_fault_of_a_list_is_found_at_once(folder: Path) -> None:
    said = faults(
        folder,
        "scan,photo,name,seed,t1,nonsense\n"
        "none.npz,a/0.png,one,,,\n"
        "a/scan0.npz,none.png,One,1,,\n"
        "a/scan0.npz,a/0.png,../x,1.5,,\n"
        "a/scan0.npz,,empty,,,3\n"
        "a/scan0.npz,a/1.png,thesis,1,.2,,,\n"
        "a/scan0.npz,a/1.png,t,1,.2,\n",
    )
    for one in (
        "none.npz: file not found", "none.png: file not found", "2 jobs have the name one", "'../x'",
        "seed is '1.5'; it must be a whole number", "'nonsense'", "it names a scan and no photo",
        "8 cells, more than the header", "`t1` can only be used with `method=thesis`",
    ):  # fmt: skip
        assert one in said, one
    assert said.count("\n") == 8


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "empty"),
        ("scan,photo\n", "it has no jobs"),
        ("file,picture\n1,2\n", "its header is 'file, picture'"),
        ("scan,photo,scan\n1,2,3\n", "names scan twice"),
        ('scan,photo\n"a,b\n', "damaged"),
        ("scan,photo\na\0b,c\n", "no text"),
        ("[1, {}]", "it must name a scan and a photo"),
        ('{"jobs": 3}', "no list of jobs"),
        ('{"jobs": [], "job": 1}', "unknown fields job"),
        ('{"jobs": [], "version": 2}', "another version"),
        ('{"version": 1, "scans": []}', "it is a survey"),
        ("[" * 100_000, "nested too deeply"),
        ('[{"scan": ["a/scan0.npz"], "photo": 3}]', "photo must name files"),
        ('[{"survey": "a", "photo": "a/0.png"}]', "nothing else"),
        ('[{"survey": "nowhere"}]', "nowhere: file not found"),
        ('[{"survey": "c", "focal_px": 3}]', "focal_px is no option of a survey"),
        ('[{"survey": "camera.json"}]', "camera.json"),
    ],
)
def test_a_list_that_is_none_says_what_is_wrong(folder: Path, text: str, said: str) -> None:
    assert said in faults(folder, text)


def test_folders_without_a_job_and_mixed_names_are_refused(folder: Path) -> None:
    (folder / "a/0.png").unlink()
    (folder / "a/1.png").unlink()
    with pytest.raises(JobListError) as error:
        read_jobs(folder / "a", f"{folder}/x*", folder)
    assert [said for said in error.value.faults if "no photo" in said or "no such" in said or "no scan" in said] == [
        *error.value.faults
    ]
    assert len(error.value.faults) == 3
    with pytest.raises(OptionError, match="file among"):
        read_jobs(folder / "camera.json", folder / "a")
    with pytest.raises(FormatError, match="UTF-8"):
        read_jobs(folder / "a/scan0.npz")


def test_names_are_made_once_each_and_do_not_depend_on_other_rows(folder: Path) -> None:
    shutil.copytree(folder / "a", folder / "x" / "a")
    rows = ["a/scan0.npz,a/0.png", "a/scan0.npz,a/1.png", "x/a/scan0.npz,x/a/0.png", "a/scan0.npz,a/0.png"]
    found = listed(folder, "\n".join(["scan,photo", *rows]))
    assert [one.id for one in found] == ["a-0", "a-1", "a-0-2", "a-0-3"]
    assert [one.id for one in listed(folder, f"scan,photo\n{rows[1]}\n")] == ["a-1"]


@pytest.mark.parametrize("name", OPTIONS_OF["pair"])
def test_every_option_refuses_what_it_is_not(name: str, tmp_path: Path) -> None:
    if name in ("columns", "topic", "camera_name", "camera", "matches", "initial"):
        assert parsed_option(name, "x", tmp_path) in ("x", ("x",), tmp_path / "x")
        return
    for wrong in ("x", "nan x", "", [], {}):
        with pytest.raises(OptionError, match=name):
            parsed_option(name, wrong, tmp_path)


def test_the_options_are_those_of_the_command() -> None:
    from dataclasses import fields

    from ladarreg.commands.register import Arguments
    from ladarreg.photos import PhotosArguments

    running = {"scan", "photo", "more", "out", "force", "quiet", "json", "debug", "carry", "offset", "rig", "files"}
    own = {"processes", "cache"}
    assert {*OPTIONS_OF["pair"]} == {one.name for one in fields(Arguments)} - running
    assert {*OPTIONS_OF["photos"]} == {one.name for one in fields(PhotosArguments)} - running - own


def test_a_list_that_is_written_reads_back_also_after_everything_has_moved(folder: Path, tmp_path: Path) -> None:
    found = listed(
        folder,
        "scan;photo;name;camera;focal-px;origin;smooth;columns;seed;survey;more\n"
        "a/scan0.npz;a/0.png;;camera.json;;1, 2 3;yes;;7;;\n"
        "b/scan0.npz;b/0.png;mine;;500.25;;;x|y|z;;;c/scan0.npz|c/scan1.npz\n"
        ";;;;;;;;3;c;\n",
    )
    found.append(
        Job(id="all", kind="photos", scan=folder / "a/scan0.npz", photos=(folder / "a/0.png", folder / "a/1.png"))
    )
    site = tmp_path / "site"
    (site / "out").mkdir(parents=True)
    (site / "out/jobs.json").write_bytes(list_bytes(found, site / "out"))
    again = read_jobs(site / "out/jobs.json")

    def resolved(job: Job) -> Job:
        return _with_paths(job, Path.resolve)

    assert [resolved(job) for job in again] == [resolved(job) for job in found]
