"""What a refused `register` leaves: a picture, a guess that no reader takes for a pose, and a command that works."""

from __future__ import annotations

import contextlib
import io
import json
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from ladarreg.arguments import parse
from ladarreg.cli import main
from ladarreg.commands import register, serve
from ladarreg.commands.serve import _reading
from ladarreg.exit_codes import ExitCode
from ladarreg.inputs import read_inputs, read_start
from ladarreg.open_command import open_command
from ladarreg.progress_bar import progress_bar
from ladarreg.workbench.launch import open_workbench
from PIL import Image

from ladarreg_core.errors import ExportError
from ladarreg_core.export.pictures.rejected_overlay import rejected_overlay
from ladarreg_core.export.targets.folder import check_folder
from ladarreg_core.formats import describe, read_photo, read_scan
from ladarreg_core.formats.documents.registration_file import read_result
from ladarreg_core.simulate.sample import sample_folder
from ladarreg_core.storage.manifest import MANIFEST_FILE, visible_files

SAMPLE = sample_folder()


@pytest.fixture(scope="module")
def other_scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A photograph that shows another scene, under a name that a shell would take apart."""
    path = tmp_path_factory.mktemp("it's here") / "ph öto $1.png"
    Image.fromarray(np.array(Image.open(SAMPLE / "photo.png"))[:, ::-1]).save(path)
    return path


@pytest.fixture(scope="module")
def refused(other_scene: Path) -> Path:
    """The results of a registration that was refused."""
    out = other_scene.parent / "out"
    words = ["register", str(SAMPLE / "scan.npz"), str(other_scene), "--focal-px", "974", "-o", str(out)]
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        assert main(words) == ExitCode.NOT_ACCEPTED
    command = json.loads((out / "registration.json").read_text())["open_in_workbench"]
    assert f"Open     {command}\n" in printed.getvalue()
    return out


@pytest.mark.slow
def test_a_refused_result_has_no_pose_and_a_guess(refused: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert {*visible_files(refused)} == {"registration.json", "report.html", "rejected_overlay.png"}
    path = refused / "registration.json"
    fields = json.loads(path.read_text())
    for name in ("camera_from_scanner", "scanner_from_camera", "camera_from_world", "thesis_parameters"):
        assert fields[name] is None, name
    assert np.array(fields["rejected_guess"]).shape == (4, 4)
    assert (fields["accepted"], fields["evidence"], fields["mark"]) == (False, "none", None)
    registration, _ = read_result(path)
    assert np.allclose(registration.camera_from_scanner.matrix, fields["rejected_guess"])
    assert not registration.is_shown
    inputs = [str(SAMPLE / "scan.npz"), str(SAMPLE / "photo.png"), "--focal-px", "974"]
    for command in (["register", *inputs, "--initial"], ["apply", *inputs, "--pose"]):
        assert main([*command, str(path), "-o", str(refused.parent / "no"), "--quiet"]) == ExitCode.BAD_INPUT
        assert "rejected_guess" in capsys.readouterr().err
    assert main(["report", str(refused), "--inputs", str(SAMPLE), str(refused.parent), "--quiet"]) == ExitCode.ACCEPTED
    assert "Rejected guess" in (refused / "report.html").read_text()


@pytest.mark.slow
def test_the_overlay_says_refused_across_the_picture(refused: Path, other_scene: Path) -> None:
    shown = np.array(Image.open(refused / "rejected_overlay.png")).astype(int)
    photo = np.array(Image.open(other_scene).convert("RGB")).astype(int)
    height, width = photo.shape[:2]
    assert shown.shape[1] == width
    assert shown.shape[0] > height  # a caption
    red = (shown[:height, :, 0] - shown[:height, :, 1:].max(axis=-1) > 60) & (
        np.abs(shown[:height] - photo).max(-1) > 40
    )
    assert 0.04 < red.mean() < 0.4
    rows, columns = np.nonzero(red)
    assert np.ptp(np.percentile(columns, [1, 99])) > 0.6 * width
    assert np.ptp(np.percentile(rows, [1, 99])) > 0.3 * height


def test_a_result_without_any_candidate_still_has_a_picture(other_scene: Path) -> None:
    from ladarreg_core.matching.from_images import no_pose

    scan, photo = read_scan(SAMPLE / "scan.npz"), read_photo(other_scene, focal_px=974.0)
    result = no_pose(scan, photo)
    assert not result.has_pose
    assert rejected_overlay(scan, photo, result).shape[1] == photo.camera.width


@pytest.mark.slow
def test_the_next_try_needs_no_force_but_what_is_somebodys_work_does(
    refused: Path, other_scene: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    again = ["register", str(SAMPLE / "scan.npz"), str(other_scene), "--focal-px", "974", "-o", str(refused), "--json"]
    (refused / "notes.txt").write_text("mine")
    assert main(again) == ExitCode.BAD_INPUT
    (refused / "notes.txt").unlink()
    capsys.readouterr()
    assert main(again) == ExitCode.NOT_ACCEPTED
    printed = json.loads(capsys.readouterr().out)
    assert printed["camera_from_scanner"] is None
    assert printed["open_in_workbench"].startswith("ladarreg serve ")
    document, manifest = refused / "registration.json", refused / MANIFEST_FILE
    kept, listed = document.read_text(), manifest.read_bytes()
    manifest.unlink()  # as of another program
    document.write_text(json.dumps({**json.loads(kept), "evidence": "given"}))
    with pytest.raises(ExportError, match="earlier results"):  # a given pose is not accepted, and yet a result to keep
        check_folder(refused)
    document.write_text(kept)
    manifest.write_bytes(listed)
    check_folder(refused)


@pytest.mark.slow
def test_info_shows_a_guess_as_a_guess(refused: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", str(refused / "registration.json")]) == 0
    shown = capsys.readouterr().out
    assert "Not accepted: the evidence is insufficient." in shown
    assert "rejected guess camera" in shown
    assert "is no pose: do not use it" in shown
    assert "\npose camera" not in shown
    assert "sigma" not in shown
    # A file of an earlier version has the guess in the place of the pose.
    fields = json.loads((refused / "registration.json").read_text())
    fields["camera_from_scanner"] = fields.pop("rejected_guess")
    del fields["sha256"]
    old = tmp_path / "registration.json"
    old.write_text(json.dumps(fields))
    info = describe(old)
    assert info.pose == {}
    assert info.rejected_guess["camera"]


def parsed(words: list[str]) -> register.Arguments:
    return parse(register.Arguments, words, prog="ladarreg register", description="")


def test_the_command_is_in_the_files(refused: Path, other_scene: Path) -> None:
    command = json.loads((refused / "registration.json").read_text())["open_in_workbench"]
    assert shlex.split(command)[:4] == ["ladarreg", "serve", str(SAMPLE / "scan.npz"), str(other_scene)]
    assert "To draw matches by hand, open it in the workbench" in (refused / "report.html").read_text()


def cloud(folder: Path) -> Path:
    """A text cloud without a header whose scanner did not stand at its origin."""
    scan = read_scan(SAMPLE / "scan.npz")
    points = scan.points[::6, ::6].reshape(-1, 3)
    level = scan.intensity[::6, ::6].reshape(-1)
    known = np.isfinite(points).all(axis=1)
    path = folder / "cloud with spaces.xyz"
    rows = np.column_stack([points[known] + [-100.0, 20.0, 3.0], np.zeros(int(known.sum())), level[known]])
    np.savetxt(path, rows, fmt="%.3f")
    return path


CASES: dict[str, tuple[str, list[str]]] = {
    "a camera file and a start": (
        "npz", ["--camera", str(SAMPLE / "camera.json"), "--initial", str(SAMPLE / "truth.json")],
    ),
    "a cloud": ("xyz", ["--origin=-100,20,3", "--columns", "x,y,z,-,intensity", "--focal-px", "974.25"]),
    "a focal length in millimetres": ("npz", ["--focal-mm", "45.5", "--sensor-mm", "36", "--matches", "MATCHES"]),
    "a panorama": ("npz", ["--camera-model", "equirectangular"]),
    "a thermal image": ("npz", ["--focal-px", "974", "--temperature-unit", "C"]),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_the_command_opens_the_same_inputs(case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LADARREG_HOME", str(tmp_path / "home"))
    kind, options = CASES[case]
    (tmp_path / "m.csv").write_text("x,y,z,u,v\n1,0.01,0,310,200\n")
    options = [str(tmp_path / "m.csv") if word == "MATCHES" else word for word in options]
    scan_file = cloud(tmp_path) if kind == "xyz" else SAMPLE / "scan.npz"
    photo_file = tmp_path / "it's ä photo.png"
    pixels = np.array(Image.open(SAMPLE / "photo.png").convert("RGB"))
    Image.fromarray(pixels).save(photo_file)
    if case == "a panorama":
        Image.fromarray(pixels[:384]).save(photo_file)
    if case == "a thermal image":
        photo_file = photo_file.with_suffix(".tif")
        Image.fromarray((pixels[..., 1] / 10).astype(np.float32)).save(photo_file)
    arguments = parsed([str(scan_file), str(photo_file), *options, "-o", "x"])
    words = shlex.split(open_command(arguments))
    assert words[:2] == ["ladarreg", "serve"]
    served = parse(serve.Arguments, words[2:], prog="ladarreg serve", description="")
    with progress_bar(quiet=True) as bar:
        scan, photo = read_inputs(arguments, bar)
    picks, initial = read_start(arguments, scan)
    for _ in range(2):  # the second time the project is there, and nothing changes
        workbench = open_workbench(served.inputs, reading=_reading(served))
        try:
            document = workbench.session.document
            (entry,) = document.photos
            found, shown = workbench.loader.scan(document), workbench.loader.photo(entry)
            assert found is not None
            assert np.array_equal(found.ranges, scan.ranges, equal_nan=True)
            assert (found.intensity == scan.intensity).all()
            assert shown.camera.as_fields() == photo.camera.as_fields()
            assert (shown.pixels == photo.pixels).all()
            assert len(entry.picks) == len(picks or ())
            assert (entry.stated_pose is None) == (initial is None)
            if initial is not None:
                assert np.allclose(entry.stated_pose, initial.matrix)
            steps = len(workbench.session.history.entries)
        finally:
            workbench.close()
    assert steps <= 2 + len(options)


def test_options_without_files_are_refused(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["serve", "--focal-px", "900", "--no-browser", "--project", str(tmp_path / "p")]) == ExitCode.BAD_INPUT
    assert "give SCAN PHOTO" in capsys.readouterr().err


NASTY = {
    "scan_index": [3], "origin": ["-1.5,2,-3"], "intensity": ["luma"], "columns": ["-,x,y,z"],
    "topic": ["/a b", "it's"],
    "seconds": [0.25], "camera": [Path("a camera.json"), Path("-c.json")], "camera_name": ["ä \"b\"", "-x"],
    "focal_px": [1e-3, 2918.123456789012], "focal_mm": [35.0], "sensor_mm": [36.0], "camera_model": ["equirectangular"],
    "temperature_unit": ["none", "C"], "matches": [Path("$HOME/m;n.csv")], "initial": [Path("`p`.json")],
}  # fmt: skip


@pytest.mark.parametrize("seed", range(8))
def test_every_option_survives_the_shell(seed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(seed)
    some = {
        name: values[rng.integers(len(values))] for name, values in NASTY.items() if seed == 0 or rng.random() < 0.5
    }
    arguments = replace(parsed(["s", "p", "-o", "x"]), **some)
    words = shlex.split(open_command(arguments))
    served = parse(serve.Arguments, words[2:], prog="ladarreg serve", description="")
    assert served.inputs == (tmp_path / "s", tmp_path / "p")
    for name in NASTY:
        value = getattr(arguments, name)
        assert getattr(served, name) == (tmp_path / value if isinstance(value, Path) else value), name
