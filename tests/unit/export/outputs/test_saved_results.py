"""Results that are opened again: read as they were read before, from files recognised by their content."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from ladarreg_core.camera import Camera
from ladarreg_core.errors import ExportError, FormatError, OptionError, UnderspecifiedError
from ladarreg_core.export.outputs.placed_scans import PlacedScan
from ladarreg_core.export.outputs.saved_results import (
    SavedResult,
    read_saved_result,
    recorded_options,
    registered_results,
)
from ladarreg_core.export.targets.folder import export_registration
from ladarreg_core.export.targets.pipeline import export_to
from ladarreg_core.formats import read_photo, read_scan
from ladarreg_core.frames import Rigid
from testing.files.rewritten import rewrite
from testing.scenes.small_registration import sample_photo, sample_registration, sample_scan
from tests.formats.test_ptx import block

STATION = np.block([[np.eye(3), np.array([[4.0], [5.0], [1.5]])], [np.zeros((1, 3)), np.ones((1, 1))]])
TURNED = 3
"""EXIF orientation: upside down."""


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file with two scans, of which the second is wanted, and a photograph whose raw pixels are upside down."""
    folder = tmp_path_factory.mktemp("inputs")
    scan = sample_scan()
    low = replace(scan, ranges=scan.ranges * 2)
    (folder / "two.ptx").write_text(block(low, np.eye(4)) + block(scan, STATION))
    exif = Image.Exif()
    exif[0x0112] = TURNED
    Image.fromarray(sample_photo().pixels[::-1, ::-1]).save(folder / "Größe 1.png", exif=exif)
    Image.fromarray(sample_photo().pixels).save(folder / "b.png")
    return folder


def results(
    folder: Path, inputs: Path, photo: str = "Größe 1.png", *, index: int = 1, **options: object
) -> SavedResult:
    """Write results as `register` does, and read them."""
    scan_options = {"scan_index": index, "origin": None, "columns": ()}
    photo_options = {"camera": None, "focal_px": 100.0, **options}
    scan = read_scan(inputs / "two.ptx", scan_index=index)
    read = read_photo(inputs / photo, **photo_options)
    found = replace(sample_registration(), camera=Camera.from_focal(120, 90, 101.0))
    files = [inputs / "two.ptx", inputs / photo]
    export_registration(folder, found, scan, read, inputs=files, read_with=[scan_options, photo_options])
    return read_saved_result(folder)


def test_the_options_of_reading_are_recorded_and_used_again(inputs: Path, tmp_path: Path) -> None:
    saved = results(tmp_path / "out", inputs)
    assert saved.document["inputs"][0]["read_with"] == {"scan_index": 1}
    assert saved.document["inputs"][1]["read_with"] == {"focal_px": 100.0}
    handed = registered_results([saved], folders=[inputs])
    assert np.array_equal(handed.scan.ranges, read_scan(inputs / "two.ptx", scan_index=1).ranges, equal_nan=True)
    assert np.array_equal(handed.scan.world_from_scanner.matrix, STATION)
    (one,) = handed.photos
    assert np.array_equal(one.photo.pixels, sample_photo().pixels)  # upright
    assert one.photo.camera.fx == 101.0  # that of the result, not that of the options
    assert (one.id, one.file, handed.scan_file) == ("Gr-e-1", inputs / "Größe 1.png", inputs / "two.ptx")
    # the control: results of earlier versions do not say how, and without options another scan is read
    old = json.loads((tmp_path / "out" / "registration.json").read_bytes())
    for record in old["inputs"]:
        del record["read_with"]
    (tmp_path / "old").mkdir()
    rewrite(tmp_path / "old" / "registration.json", old)
    before = read_saved_result(tmp_path / "old")
    first = registered_results([before], folders=[inputs])
    assert not np.allclose(np.nanmax(first.scan.ranges), np.nanmax(handed.scan.ranges))
    given = registered_results([before], folders=[inputs], scan_options={"scan_index": 1, "intensity": "auto"})
    assert np.array_equal(given.scan.ranges, handed.scan.ranges, equal_nan=True)


def test_several_results_on_one_scan_are_one_hand_over(inputs: Path, tmp_path: Path) -> None:
    one, two = results(tmp_path / "a", inputs), results(tmp_path / "b", inputs, "b.png")
    handed = registered_results([one, two, one], folders=[inputs], frame="world")
    assert [each.id for each in handed.photos] == ["Gr-e-1", "b", "Gr-e-1-2"]
    assert handed.frame.name == "world"
    other = results(tmp_path / "c", inputs, index=0)
    with pytest.raises(OptionError, match=r"read two\.ptx with different options \(another scan of the file"):
        registered_results([one, other], folders=[inputs])
    document = dict(two.document)
    document["inputs"] = [{**document["inputs"][0], "sha256": "0" * 64}, document["inputs"][1]]
    (tmp_path / "d").mkdir()
    rewrite(tmp_path / "d" / "registration.json", document)
    with pytest.raises(OptionError, match="the results are on different scans"):
        registered_results([one, read_saved_result(tmp_path / "d")], folders=[inputs])
    with pytest.raises(OptionError, match="no result"):
        registered_results([])


def test_a_scan_of_a_survey_without_photographs_is_handed_over_too(inputs: Path, tmp_path: Path) -> None:
    saved = results(tmp_path / "a", inputs)
    moved = Rigid.from_rotvec([0.0, 0.0, 0.1], [5.0, 0.0, 1.0])
    listed = [
        PlacedScan({**saved.inputs[0], "read_with": {"scan_index": index}}, moved) for index in (1, 0)
    ]  # the first of them is that of the results
    handed = registered_results([saved], placed=listed, folders=[inputs])
    assert [(one.id, len(one.photos)) for one in handed.scans] == [("two", 1), ("two-2", 0)]
    assert np.array_equal(handed.scans[1].scan.ranges, read_scan(inputs / "two.ptx").ranges, equal_nan=True)
    assert np.array_equal(handed.scans[1].scan.world_from_scanner.matrix, moved.matrix)
    assert handed.scans[0].frame.offset_m == handed.scans[1].frame.offset_m
    export_to(tmp_path / "out", handed, ["ply", "glb"])
    assert {path.parent.name for path in (tmp_path / "out").glob("ply/*/*.ply")} == {"two", "two-2"}
    assert {path.parent.name for path in (tmp_path / "out").glob("glb/*/*.glb")} == {"two"}  # a model needs a texture
    gone = PlacedScan({**saved.inputs[0], "name": "gone.ptx", "sha256": "0" * 64, "size": 1}, moved)
    with pytest.raises(ExportError, match=r"gone\.ptx is needed, but there is no such file"):
        registered_results([saved], placed=[gone], folders=[inputs])


def test_the_unit_of_a_thermal_photograph_is_recorded(inputs: Path, tmp_path: Path) -> None:
    import tifffile

    celsius = 20 + sample_photo().pixels[..., 0].astype(np.float32) / 10
    tifffile.imwrite(tmp_path / "t.tif", celsius)
    with pytest.raises(UnderspecifiedError):
        read_photo(tmp_path / "t.tif", focal_px=100.0)
    shutil.copy(inputs / "two.ptx", tmp_path)
    saved = results(tmp_path / "out", tmp_path, "t.tif", temperature_unit="C")
    (one,) = registered_results([saved]).photos
    assert one.photo.temperature_k is not None
    assert np.allclose(one.photo.temperature_k, celsius + 273.15, atol=1e-3)


def test_inputs_are_found_in_a_folder_beside_the_results(inputs: Path, tmp_path: Path) -> None:
    saved = replace(results(tmp_path / "out", inputs), within=())  # no paths are followed
    kept = Path(shutil.copytree(inputs, tmp_path / "kept"))
    assert registered_results([saved]).scan_file == kept / "two.ptx"
    kept.rename(tmp_path / ".hidden")
    with pytest.raises(ExportError, match="there is no such file"):
        registered_results([saved])


def test_inputs_are_recognised_by_their_content(inputs: Path, tmp_path: Path) -> None:
    saved = replace(results(tmp_path / "out", inputs), within=())  # no paths are followed
    with pytest.raises(
        ExportError, match=r"two\.ptx is needed, but there is no such file; give its folder with --root"
    ):
        registered_results([saved], option="--root")
    renamed = shutil.copy(inputs / "two.ptx", tmp_path / "renamed.ptx")
    assert registered_results([saved], folders=[inputs], scan_file=Path(renamed)).scan_file == Path(renamed)
    with open(renamed, "ab") as file:
        file.write(b"\n")
    with pytest.raises(ExportError, match=r"renamed\.ptx differs from it \(another SHA-256\)"):
        registered_results([saved], folders=[Path(renamed), inputs / "Größe 1.png"])


def test_a_refused_result_is_shown_by_its_report_only(inputs: Path, tmp_path: Path) -> None:
    saved = results(tmp_path / "out", inputs)
    path = tmp_path / "out" / "registration.json"
    rewrite(path, {**saved.document, "accepted": False, "evidence": "none", "reasons": ["No."]})
    handed = registered_results([read_saved_result(tmp_path / "out")], folders=[inputs])
    assert (len(handed.photos), len(handed.refused)) == (0, 1)
    export_to(tmp_path / "report", handed, ["report"])
    assert "not accepted</span>" in (tmp_path / "report" / "report" / "Gr-e-1.html").read_text(encoding="utf-8")
    assert json.loads((tmp_path / "report" / "report" / "Gr-e-1.json").read_bytes())["reasons"] == ["No."]
    with pytest.raises(ExportError, match="is listed as refused"):
        replace(handed, refused=[replace(handed.refused[0], registration=sample_registration())])


@pytest.mark.parametrize(
    "broken",
    [
        {"inputs": []},
        {"inputs": [{"name": "a", "read_with": {"scan_index": "x"}}, {"name": "b"}]},
        {"inputs": [{"name": "a"}, {"name": "b", "read_with": [1]}]},
        {"inputs": [{"name": "a"}, {"name": "b", "read_with": {"temperature_unit": "F"}}]},
    ],
)
def test_damaged_records_are_refused(inputs: Path, tmp_path: Path, broken: dict[str, object]) -> None:
    saved = results(tmp_path / "out", inputs)
    rewrite(tmp_path / "out" / "registration.json", {**saved.document, **broken})
    with pytest.raises(FormatError):
        read_saved_result(tmp_path / "out")


def test_a_given_pose_that_is_missing_is_not_taken_for_a_refused_one(inputs: Path, tmp_path: Path) -> None:
    """Otherwise the identity would be exported as the pose."""
    given = {**results(tmp_path / "out", inputs).document, "accepted": False, "evidence": "given"}
    file = tmp_path / "out" / "registration.json"
    rewrite(file, given)
    assert registered_results([read_saved_result(tmp_path / "out")], folders=[inputs]).marks
    for guess in (None, given["camera_from_scanner"]):
        rewrite(file, {**given, "camera_from_scanner": None, "rejected_guess": guess})
        with pytest.raises(FormatError, match="camera_from_scanner"):
            read_saved_result(tmp_path / "out")


def test_the_options_are_those_of_the_same_files_only(inputs: Path, tmp_path: Path) -> None:
    results(tmp_path / "out", inputs)
    file, scan, photo = tmp_path / "out" / "registration.json", inputs / "two.ptx", inputs / "Größe 1.png"
    assert recorded_options(file, scan, photo) == {"scan_index": 1, "focal_px": 100.0}
    assert recorded_options(file, scan, inputs / "b.png") == {"scan_index": 1}
    assert recorded_options(file, photo, photo) == {"focal_px": 100.0}
    assert recorded_options(scan, scan, photo) == recorded_options(file, tmp_path / "gone", photo) == {}
