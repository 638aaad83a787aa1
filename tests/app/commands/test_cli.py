"""The command line: help, arguments, and complete runs."""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from ladarreg.cli import COMMANDS, main
from ladarreg.exit_codes import ExitCode
from PIL import Image

from ladarreg_core.simulate.sample import sample_folder
from ladarreg_core.storage.manifest import visible_files
from testing.command_line import complaint, sample

REGISTER_OPTIONS = (
    "--method", "--matches", "--initial", "--camera", "--focal-px", "--focal-mm", "--sensor-mm", "--scan-index",
    "--seed", "--force", "--quiet", "--debug", "-o", "--t1", "--t2-px", "--culling", "--first-pose", "--residual",
    "--reject-depth-m", "--samples-per-line", "--smooth",
)  # fmt: skip


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (("--t1", ".1"), "--t1 can only be used with --method thesis"),
        (("--method", "thesis", "--t1", "3"), "from 0 to 2"),
        (("--method", "thesis", "--t2-px", "-4"), "number of pixels from"),
        (("--method", "thesis", "--reject-depth-m", "nan"), "reject_depth_m"),
        (("--method", "thesis", "--samples-per-line", "1"), "whole number from 2 to 1000"),
    ],
)
def test_unused_and_invalid_thresholds_are_refused(
    flags: tuple[str, ...], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(sample("-o", str(tmp_path / "out"), *flags)) == ExitCode.BAD_INPUT
    assert words in complaint(capsys)
    assert not (tmp_path / "out").exists()


def test_thresholds_reach_the_chain_of_the_thesis(tmp_path: Path) -> None:
    out = tmp_path / "out"
    flags = ("--method", "thesis", "--t1", ".15", "--culling", "one-sided", "--first-pose", "robust", "--quiet")
    assert main(sample("-o", str(out), *flags)) in (ExitCode.ACCEPTED, ExitCode.NOT_ACCEPTED)
    options = json.loads((out / "registration.json").read_text())["options"]["thesis"]
    assert options["matching"]["t1"] == 0.15
    assert options["matching"]["culling"] == "one_sided"
    assert options["first_pose"] == "robust"


def test_help_names_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--help"]) == 0
    shown = capsys.readouterr().out
    for name, summary in COMMANDS.items():
        assert name in shown
        assert summary in shown
        command = importlib.import_module(f"ladarreg.commands.{name.replace('-', '_')}")
        assert callable(command.run)
        assert command.Arguments.__doc__


def test_help_imports_no_slow_modules() -> None:
    code = (
        "import sys; from ladarreg.cli import main; main(['--help'])\n"
        "heavy = {'tyro', 'numpy', 'rich', 'logging', 'ladarreg_core.frames', 'viser'} & set(sys.modules)\n"
        "sys.exit(f'{heavy}' if heavy else 0)"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr


@pytest.mark.slow
def test_a_registration_imports_what_it_uses_alone(tmp_path: Path) -> None:
    """Packages of other formats, of exports, of the server and of devices cost up to a second of start-up."""
    others = {
        "typeguard",
        "asyncio",
        "unittest",
        "scipy",
        "trimesh",
        "pye57",
        "laspy",
        "mcap",
        "av",
        "serial",
        "viser",
        "starlette",
        "uvicorn",
        "rich",
    }
    rooms = {
        "acquisition",
        "project",
        "registration.stations",
        "registration.rig",
        "registration.self_test",
        "simulate",
    }
    files = {"registration.comparison", "export.comparison", "quality.smoothing", "outputs"}
    unused = others | {f"ladarreg_core.{name}" for name in rooms | files}
    code = (
        f"import sys; from ladarreg.cli import main; code = main({sample('-o', str(tmp_path / 'out'), '--quiet')!r})\n"
        f"found = {unused!r} & set(sys.modules)\n"
        "sys.exit(f'{sorted(found)}' if found else code)"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.returncode == ExitCode.ACCEPTED, result.stderr
    assert (tmp_path / "out" / "report.html").stat().st_size


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_help(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([name, "--help"]) == 0
    shown = capsys.readouterr().out
    assert f"ladarreg {name}" in shown
    wanted = {"register": REGISTER_OPTIONS, "simulate": ("-o", "--set", "--seed"), "demo": ("--port", "--no-browser")}
    for option in wanted.get(name, ()):
        assert option in shown


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    from ladarreg_core import __version__

    assert main(["--version"]) == 0
    assert capsys.readouterr().out.split() == ["ladarreg", __version__]
    assert main(["--version", "--verbose"]) == 0
    first, *means = capsys.readouterr().out.splitlines()
    assert first == f"ladarreg {__version__}"
    assert [line.partition(": ")[0] for line in means] == [
        "confinement of reader processes, Landlock", "confinement of reader processes, seccomp",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["regsiter", "a", "b"], "regsiter"),
        (["register"], "SCAN"),
        (["register", "a", "b"], "--out"),
        (["register", "a", "b", "-o"], "--out"),
        (["register", "a", "b", "-o", "c", "--method", "magic"], "magic"),
        (["register", "a", "b", "-o", "c", "--seed", "x"], "--seed"),
        (["register", "a", "b", "-o", "c", "--bogus"], "--bogus"),
        (["register", "a", "b", "c", "-o", "d"], "c"),
        (["register", "a", "b", "-o", "c", "--focal-px", "long"], "--focal-px"),
        (["simulate", "moon", "-o", "c"], "moon"),
        (["simulate", "office", "-o", "c", "--set", "easy"], "easy"),
        (["info"], "FILE"),
        (["demo", "--port", "http"], "--port"),
    ],
)
def test_a_mistyped_command_is_one_line(words: list[str], named: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(words) == ExitCode.BAD_INPUT
    assert named in complaint(capsys)


def test_no_command_shows_the_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == ExitCode.BAD_INPUT
    assert "register" in capsys.readouterr().out


def npz(**arrays: object) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        np.savez(folder / "scan.npz", **arrays)  # type: ignore[arg-type]
        return folder / "scan.npz"

    return write


@pytest.mark.long
def test_the_sample_is_registered_by_one_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from ladarreg_core.formats.documents.pose_file import read_pose

    out = tmp_path / "deep" / "results"
    assert main(sample("-o", str(out))) == ExitCode.ACCEPTED
    shown = capsys.readouterr()
    assert "Accepted" in shown.out
    assert "sigma" in shown.out
    names = {
        "registration.json", "report.html", "registered.png", "labels.png", "visibility.png", "uncertainty.png",
        "model.glb", "cloud.ply",
    }  # fmt: skip
    assert {*visible_files(out)} == names
    for name in names:
        assert name in shown.out
    assert "Image verification" in shown.err
    pose, truth = read_pose(out / "registration.json"), read_pose(sample_folder() / "truth.json")
    assert np.degrees(pose.angle_to(truth)) < 0.12
    assert pose.distance_to(truth) < 0.015

    assert main(sample("-o", str(out), "--force", "--quiet")) == ExitCode.ACCEPTED
    shown = capsys.readouterr()
    assert shown.err == ""
    assert len(shown.out.splitlines()) == 1


def drawn(path: Path, *, count: int, seed: int, spread: float = 1.0) -> Path:
    """Write matches of the sample with the noise of careful manual drawing, within a part of the photo."""
    import ladarreg_core as lr
    from ladarreg_core.formats.documents.pose_file import read_pose

    folder = sample_folder()
    scan = lr.read_scan(folder / "scan.npz")
    camera = lr.read_photo(folder / "photo.png", camera=folder / "camera.json").camera
    rng = np.random.default_rng(seed)
    cells = np.argwhere(scan.valid)[rng.permutation(np.count_nonzero(scan.valid))[: 60 * count]]
    uv = camera.project(read_pose(folder / "truth.json") @ scan.points[cells[:, 0], cells[:, 1]].astype(float))
    uv = uv + rng.normal(size=uv.shape) * 0.7
    with np.errstate(invalid="ignore"):
        inside = ((uv > 5) & (uv < np.array(camera.size) * spread - 5)).all(axis=1)
    rows = np.column_stack([cells, uv])[inside][:count]
    np.savetxt(path, rows, delimiter=",", header="row,column,u,v", comments="")
    return path


@pytest.mark.slow
@pytest.mark.parametrize(
    ("count", "spread"),
    [(8, 1.0), *(pytest.param(*case, marks=pytest.mark.long) for case in ((40, 1.0), (18, 0.45)))],
)
def test_manual_matches_get_a_few_lines_of_advice(
    count: int, spread: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    matches = drawn(tmp_path / "m.csv", count=count, seed=count, spread=spread)
    code = main(sample("--matches", str(matches), "-o", str(tmp_path / "out"), "--smooth"))
    lines = capsys.readouterr().out.splitlines()
    heads = [line[:9].strip() for line in lines]
    block = [head for head in heads if head in ("Image", "Poor", "Fair", "Check", "Next", "Smooth")]
    assert len(block) <= 8
    assert heads.count("Next") == heads.count("Smooth") == 1
    assert code == ExitCode.ACCEPTED
    assert "Image" in block
    document = json.loads((tmp_path / "out" / "registration.json").read_text())
    worse = [finding for finding in document["findings"] if finding["level"] != "good"]
    if spread < 1:
        assert "spread" in {finding["name"] for finding in worse}
        assert any(head in ("Poor", "Fair") and "cover" in line for head, line in zip(heads, lines, strict=True))
    assert document["advice"][0]["sentence"] in "\n".join(lines)
    assert (document["smoothing"] is None) == (code != ExitCode.ACCEPTED)
    assert all(match["influence"]["cook"] >= 0 for match in document["matches"])


def test_a_uniform_gray_photo_is_not_accepted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    photo = tmp_path / "gray.png"
    Image.fromarray(np.full((512, 768, 3), 128, np.uint8)).save(photo)
    out = tmp_path / "results"
    words = sample("-o", str(out))
    words[2] = str(photo)
    assert main(words) == ExitCode.NOT_ACCEPTED
    assert "Not accepted" in capsys.readouterr().out
    assert {*visible_files(out)} == {"registration.json", "report.html", "rejected_overlay.png"}
    assert json.loads((out / "registration.json").read_text())["accepted"] is False


@pytest.mark.long
def test_simulate_writes_what_info_reads(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("embreex")
    out = tmp_path / "case"
    assert main(["simulate", "boxes", "-o", str(out), "--seed", "3"]) == 0
    assert {*visible_files(out)} == {"scan.npz", "photo.png", "camera.json", "truth.json"}
    assert [path.name for path in tmp_path.iterdir()] == ["case"]
    capsys.readouterr()
    assert main(["info", str(out / "scan.npz")]) == 0
    shown = capsys.readouterr().out
    assert "1000" in shown
    assert "700" in shown
    assert main(["simulate", "boxes", "-o", str(out)]) == ExitCode.BAD_INPUT
    assert "--force" in complaint(capsys)
    scan = (out / "scan.npz").read_bytes()
    assert main(["simulate", "boxes", "-o", str(out), "--seed", "4", "--force"]) == 0
    assert (out / "scan.npz").read_bytes() != scan
    (out / "truth.json").write_text(json.dumps({"camera_from_scanner": np.eye(4).tolist()}))  # measured, not simulated
    capsys.readouterr()
    assert main(["simulate", "boxes", "-o", str(out), "--force"]) == ExitCode.BAD_INPUT
    assert "truth.json, changed since ladarreg wrote it" in complaint(capsys)


def test_an_unknown_set_is_refused_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("embreex")
    from ladarreg_core.simulate import SETS

    if "thermal" not in SETS:
        assert main(["simulate", "boxes", "-o", str(tmp_path / "x"), "--set", "thermal"]) == ExitCode.BAD_INPUT
        complaint(capsys)
        assert not list(tmp_path.iterdir())


def test_a_closed_output_pipe_is_not_an_error(checkout: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "ladarreg", "--help"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=checkout
    )
    assert process.stdout is not None
    process.stdout.close()
    assert process.wait(timeout=30) == 0
    assert process.stderr is not None
    assert process.stderr.read() == b""


def test_it_runs_from_anywhere(tmp_path: Path, checkout: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": str(checkout)}
    result = subprocess.run(
        [sys.executable, "-m", "ladarreg", "--version"], capture_output=True, text=True, cwd=tmp_path, env=environment
    )
    assert result.returncode == 0
    assert result.stdout.startswith("ladarreg ")
