"""The panorama of a run: from its folder or a list of scans, to files that every reader knows."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
from ladarreg.cli import main
from PIL import Image

from ladarreg_core.acquisition.composition.panorama import compose, mount_of_text, write_panorama
from ladarreg_core.acquisition.mount_fields import base_from_value, lean_covariance, mount_as_fields, mount_from_fields
from ladarreg_core.acquisition.runs.closure import Closure
from ladarreg_core.errors import ExportError, FormatError, LadarregError, OptionError
from ladarreg_core.export.pictures.images import write_provenance_png
from ladarreg_core.formats import read_scan
from ladarreg_core.formats.documents.pose_file import read_pose
from ladarreg_core.formats.scans.npz import write_npz_xyz
from ladarreg_core.foundations.palette import distinct_colors
from ladarreg_core.frames import Rigid
from ladarreg_core.scanner.grids import AzimuthElevation, SphericalGrid
from ladarreg_core.scanner.pan_tilt import pan_tilt_pose
from testing.scenes.box_room import distances, off_surface
from testing.scenes.mosaic_pieces import MOUNT, piece_scan

COARSE = AzimuthElevation(31, 41, np.radians(1.0), np.radians(1.0))
STOPS = ((-30.0, -10.0), (0.0, -10.0), (30.0, -10.0), (-30.0, 10.0), (0.0, 10.0), (30.0, 10.0))


@pytest.fixture(scope="module")
def pieces(tmp_path_factory: pytest.TempPathFactory) -> list[bytes]:
    folder = tmp_path_factory.mktemp("pieces")
    written = []
    for pan, tilt in np.radians(STOPS):
        write_npz_xyz(folder / "piece.npz", piece_scan(pan_tilt_pose(pan, tilt, unit_from_scanner=MOUNT), COARSE))
        written.append((folder / "piece.npz").read_bytes())
    return written


@pytest.fixture
def run(tmp_path: Path, pieces: list[bytes]) -> Path:
    folder = tmp_path / "run"
    (folder / "pieces").mkdir(parents=True)
    records = []
    for index, (data, at) in enumerate(zip(pieces, STOPS, strict=True)):
        name = f"pieces/{index:03}.npz"
        (folder / name).write_bytes(data)
        records.append({"index": index, "file": name, "sha256": hashlib.sha256(data).hexdigest(),
                        "asked_deg": list(at), "read_deg": list(at), "time": 0.0, "pass": 0})  # fmt: skip
    (folder / "run.jsonl").write_text("".join(json.dumps(record) + "\n" for record in records))
    plan = {"version": 1, "mode": "mosaic", "pan_deg": [-30, 30, 30], "tilt_deg": [-10, 10, 20],
            "unit": {"kind": "flir-ptu", "port": "x"}, "scanner": {"kind": "folder", "folder": "x"},
            "mount": mount_as_fields(MOUNT)}  # fmt: skip
    (folder / "plan.json").write_text(json.dumps(plan))
    return folder


def test_a_run_becomes_a_scan_that_is_read_again(run: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert main(["panorama", str(run), "-o", str(out), "--quiet"]) == 0
    scan = read_scan(out / "scan.npz")
    assert isinstance(scan.geometry, SphericalGrid)
    wrong = np.abs(scan.ranges - distances(np.zeros(3), scan.rays))[scan.valid]
    assert np.median(wrong) < 2e-4
    assert np.quantile(off_surface(scan.points[scan.valid]), 0.97) < 0.01
    fields = json.loads((out / "panorama.json").read_text())
    assert [piece["index"] for piece in fields["pieces"]] == list(range(6))
    assert fields["pieces"][2]["pan_deg"] == pytest.approx(30)
    assert fields["mount"]["from"] == "plan"
    assert sum(piece["shown"] for piece in fields["pieces"]) == scan.valid.sum() == fields["counts"]["returns"]
    with np.load(out / "scan.npz", allow_pickle=False) as archive:
        piece = archive["piece"]
    assert ((piece < 255) == scan.valid).all()


def test_pieces_of_other_angles_are_written_and_refused(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A unit that has lost its place on the way: from piece 3 on each is 12 deg from where it says."""
    records = [json.loads(line) for line in (run / "run.jsonl").read_text().splitlines()]
    for record in records[3:]:
        record["read_deg"][0] += 12
    (run / "run.jsonl").write_text("".join(json.dumps(record) + "\n" for record in records))
    out = tmp_path / "out"
    assert main(["panorama", str(run), "-o", str(out), "--quiet"]) == 3
    said = capsys.readouterr().out
    assert "pieces do not fit" in said
    assert "from piece 3 on they lie elsewhere" in said
    fields = json.loads((out / "panorama.json").read_text())
    assert not fields["accepted"]
    assert fields["fit"]["first_misfit"] == 3
    assert any("not accepted: pieces do not fit" in note for note in read_scan(out / "scan.npz").notes)
    assert main(["panorama", str(run), "-o", str(tmp_path / "again"), "--json", "--quiet"]) == 3
    assert main(["info", str(out)]) == 0
    assert "pieces do not fit" in capsys.readouterr().out


def test_a_run_that_does_not_close_is_written_and_refused(run: Path, tmp_path: Path) -> None:
    closure = Closure(False, 0.2, (1.5, 0.0))
    (run / "closure.json").write_text(json.dumps(closure.as_fields()))
    assert main(["panorama", str(run), "-o", str(tmp_path / "out"), "--quiet"]) == 3
    fields = json.loads((tmp_path / "out" / "panorama.json").read_text())
    assert fields["fit"]["fits"]
    assert fields["reasons"] == [closure.sentence()]
    (run / "closure.json").write_text(json.dumps(Closure(True, 0.01).as_fields()))
    assert compose(run).accepted
    (run / "closure.json").write_text("{}")
    with pytest.raises(FormatError, match="does not say whether the run has closed"):
        compose(run)


def test_the_picture_of_the_pieces_says_which_one_each_cell_is_from(run: Path, tmp_path: Path) -> None:
    made = compose(run)
    write_panorama(tmp_path / "out", made)
    with Image.open(tmp_path / "out" / "provenance.png") as image:
        numbers, shown = np.asarray(image), np.asarray(image.convert("RGB"))
    np.testing.assert_array_equal(numbers, np.where(made.piece_of_cell < 0, 255, made.piece_of_cell))
    pieces = json.loads((tmp_path / "out" / "panorama.json").read_text())["pieces"]
    assert len({piece["color"] for piece in pieces}) == len(pieces)
    for place, piece in enumerate(pieces):
        assert (shown[made.piece_of_cell == place] == list(bytes.fromhex(piece["color"][1:]))).all()
        assert (made.piece_of_cell == place).sum() == piece["shown"] > 0
    assert not shown[made.piece_of_cell < 0].any()


def test_a_picture_of_more_pieces_than_a_palette_holds_shows_their_colors(tmp_path: Path) -> None:
    numbers = np.arange(-1, 3999, dtype=np.int16).reshape(40, 100)
    colors = distinct_colors(3999)
    write_provenance_png(tmp_path / "provenance.png", numbers, colors)
    with Image.open(tmp_path / "provenance.png") as image:
        shown = np.asarray(image).reshape(-1, 3)
    assert not shown[0].any()
    np.testing.assert_array_equal(shown[1:], colors)
    assert len({color.tobytes() for color in colors} | {b"\0\0\0"}) == 4000


def test_reading_gives_back_what_was_written(run: Path, tmp_path: Path) -> None:
    made = compose(run)
    write_panorama(tmp_path / "out", made)
    scan = read_scan(tmp_path / "out" / "scan.npz")
    np.testing.assert_allclose(scan.ranges, made.scan.ranges, rtol=1e-6)
    np.testing.assert_array_equal(scan.intensity, made.scan.intensity)
    assert scan.geometry == made.scan.geometry
    with pytest.raises(ExportError, match="earlier results"):
        write_panorama(tmp_path / "out", made)
    write_panorama(tmp_path / "out", made, force=True)
    with pytest.raises(ExportError):
        write_panorama(run, made, inputs=[run], force=True)


def test_a_list_of_scans_is_enough(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines = ["file, pan_deg, tilt_deg", *(f"pieces/{k:03}.npz, {pan}, {tilt}" for k, (pan, tilt) in enumerate(STOPS))]
    (run / "list.csv").write_text("\n".join(lines))
    mount = mount_as_fields(MOUNT)
    given = ",".join(map(str, (*mount["xyz_m"], *mount["rpy_deg"])))
    assert main(["panorama", str(run / "list.csv"), "-o", str(tmp_path / "out"), "--mount", given, "--json"]) == 0
    fields = json.loads(capsys.readouterr().out)
    assert fields["mount"]["from"] == "given"
    np.testing.assert_allclose(read_scan(tmp_path / "out" / "scan.npz").ranges, compose(run).scan.ranges, rtol=1e-6)


def test_an_incomplete_run_is_refused_unless_it_is_wanted(run: Path, tmp_path: Path) -> None:
    lines = (run / "run.jsonl").read_text().splitlines()
    (run / "run.jsonl").write_text("\n".join(lines[:4]) + '\n{"index": 4, "fi')  # killed while it wrote
    with pytest.raises(FormatError, match=r"2 of 6 pieces are missing \(4, 5\)"):
        compose(run)
    assert main(["panorama", str(run), "-o", str(tmp_path / "out"), "--partial", "--quiet"]) == 0
    assert json.loads((tmp_path / "out" / "panorama.json").read_text())["missing"] == [4, 5]


def test_a_piece_that_was_changed_is_refused(run: Path, pieces: list[bytes]) -> None:
    (run / "pieces" / "002.npz").write_bytes(pieces[1])
    with pytest.raises(FormatError, match=r"002\.npz: it is not the file that was recorded"):
        compose(run)


@pytest.mark.parametrize(
    ("line", "why"),
    [
        ("nonsense", "line 1 is not a JSON object"),
        ('{"index": -1}', "index"),
        ('{"index": 0, "file": "../x.npz", "read_deg": [0, 0]}', "leads out of the folder"),
        ('{"index": 0, "file": "pieces/000.npz", "read_deg": [0]}', "read_deg"),
        ('{"index": 0, "file": "pieces/000.npz", "read_deg": [1e9, 0]}', "angles in degrees"),
        ("[]", "line 1 is not a JSON object"),
    ],
)
def test_records_are_checked(run: Path, line: str, why: str) -> None:
    (run / "run.jsonl").write_text(line + "\n" + (run / "run.jsonl").read_text())
    with pytest.raises(FormatError, match=why):
        compose(run)


@pytest.mark.parametrize(
    "text", ["", "a,b\n1,2", "file,pan_deg,tilt_deg", "file,pan_deg,tilt_deg\nx.npz,left,0", "file,pan_deg,tilt_deg\nx"]
)
def test_lists_are_checked(tmp_path: Path, text: str) -> None:
    (tmp_path / "list.csv").write_text(text)
    with pytest.raises(LadarregError):
        compose(tmp_path / "list.csv")


def test_info_says_what_a_run_and_a_panorama_are(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", str(run)]) == 0
    assert "6 of 6" in capsys.readouterr().out
    write_panorama(tmp_path / "out", compose(run))
    for path in (tmp_path / "out", tmp_path / "out" / "panorama.json"):
        assert main(["info", str(path)]) == 0
        assert "6 pieces" in capsys.readouterr().out


def test_the_mount_is_read_from_numbers_and_files(run: Path) -> None:
    for _ in range(3):
        again = mount_from_fields(mount_as_fields(MOUNT))
        assert again.angle_to(MOUNT) < 1e-12
        assert again.distance_to(MOUNT) < 1e-12
    assert mount_of_text(str(run / "plan.json")).angle_to(MOUNT) < 1e-12
    for wrong in ("1,2,3", "1,2,3,4,5,x", "nowhere.json", "0,0,0,0,0,nan"):
        with pytest.raises(OptionError, match="six numbers"):
            mount_of_text(wrong)


@pytest.mark.slow
def test_the_mosaic_of_a_unit_that_hangs_is_level(run: Path, tmp_path: Path) -> None:
    plan = json.loads((run / "plan.json").read_text())
    upright = compose(run)
    plan["mount"]["base"] = [180, 0, 25]
    (run / "plan.json").write_text(json.dumps(plan))
    level = base_from_value([180, 0, 25])
    out = tmp_path / "out"
    assert main(["panorama", str(run), "-o", str(out), "--quiet"]) == 0
    scan, fields = read_scan(out / "scan.npz"), json.loads((out / "panorama.json").read_text())
    assert fields["mount"]["base"] == pytest.approx([180, 0, 25])
    assert fields["frame_is"].startswith("scan.npz is level")
    in_unit = scan.points[scan.valid] @ level.rotation
    assert np.quantile(off_surface(in_unit), 0.97) < 0.01
    assert scan.valid.sum() == pytest.approx(upright.scan.valid.sum(), rel=0.05)
    rows = scan.points[..., 2] / scan.ranges
    assert np.nanmean(rows[0]) > np.nanmean(rows[-1])  # the top row is up
    assert "base" not in upright.fields["mount"]
    assert "level_covariance" not in fields["mount"]
    plan["mount"]["base_sigma_deg"] = [0.05, 0.1]
    (run / "plan.json").write_text(json.dumps(plan))
    known = compose(run)
    np.testing.assert_allclose(known.fields["mount"]["level_covariance"], lean_covariance(level, (0.05, 0.1)))
    np.testing.assert_allclose(known.scan.ranges, scan.ranges, rtol=1e-6)  # it moves nothing
    again = [str(run), "-o", str(out), "--quiet", "--force"]
    assert main(["panorama", *again, "--base", "180,0,25", "--base-sigma", ".2"]) == 0
    assert json.loads((out / "panorama.json").read_text())["mount"]["base_sigma_deg"] == [0.2, 0.2]
    assert main(["panorama", *again, "--base", "180,0,25"]) == 0, "the plan's sigma is not that of another base"
    assert "base_sigma_deg" not in json.loads((out / "panorama.json").read_text())["mount"]
    assert main(["panorama", *again, "--base-sigma", "good"]) == 2
    # what the command line says precedes the plan
    assert main(["panorama", str(run), "-o", str(out), "--quiet", "--force", "--base", "upright"]) == 0
    np.testing.assert_allclose(read_scan(out / "scan.npz").ranges, upright.scan.ranges, rtol=1e-6)
    assert main(["panorama", str(run), "-o", str(out), "--force", "--base", "sideways"]) == 2
    plan["mount"]["base"] = "sideways"
    (run / "plan.json").write_text(json.dumps(plan))
    with pytest.raises(FormatError, match=r"plan\.json: the base is 'sideways'"):
        compose(run)


def test_photographs_of_a_camera_whose_mount_is_stated_get_their_poses(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert main(["panorama", str(run), "-o", str(out), "--calibrate-camera", "--focal-px", "500"]) == 2
    assert "has no photographs" in capsys.readouterr().err
    plan, mount = json.loads((run / "plan.json").read_text()), Rigid.from_rotvec((0.1, -1.2, 1.1), (0.1, 0, 0.05))
    plan["camera"] = {"folder": str(tmp_path), "mount": mount.matrix.tolist()}
    plan["scanner"]["folder"] = str(run)
    plan["mount"]["base"] = "hanging"
    (run / "plan.json").write_text(json.dumps(plan))
    (run / "photos").mkdir()
    records = [json.loads(line) for line in (run / "run.jsonl").read_text().splitlines()]
    for record in records[:2]:
        record["photo"] = f"photos/{record['index']:03}.jpg"
        (run / record["photo"]).write_bytes(b"a photograph")
    (run / "run.jsonl").write_text("".join(json.dumps(record) + "\n" for record in records))
    assert main(["panorama", str(run), "-o", str(out), "--quiet"]) == 0
    assert sorted(path.name for path in (out / "poses").iterdir()) == ["000.json", "001.json"]
    for name, (pan, tilt) in zip(("000", "001"), np.radians(STOPS), strict=False):
        expected = (base_from_value("hanging") @ pan_tilt_pose(pan, tilt) @ mount).inverse
        assert read_pose(out / f"poses/{name}.json").distance_to(expected) < 1e-9
    assert main(["panorama", str(run), "-o", str(out), "--quiet", "--force"]) == 0  # and are replaced
