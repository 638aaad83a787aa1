"""An installed wheel, in a fresh environment: its own files are inside it, and its command runs."""

from __future__ import annotations

import os
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import pytest


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory, checkout: Path) -> Path:
    """The scripts folder of an environment that holds the wheel; its dependencies are this environment's."""
    folder = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(folder), str(checkout)]
    run(build, cwd=folder)
    (wheel,) = folder.glob("ladarreg-*.whl")
    home = folder / "fresh"
    venv.create(home, with_pip=False, symlinks=os.name != "nt")
    scripts = home / ("Scripts" if os.name == "nt" else "bin")
    run(
        [
            sys.executable,
            "-m",
            "pip",
            "--python",
            str(scripts / "python"),
            "install",
            "--quiet",
            "--no-deps",
            str(wheel),
        ]
    )
    site = run([str(scripts / "python"), "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"]).strip()
    # A path file adds packages without following the path files there: this checkout stays out of sight.
    (Path(site) / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return scripts


def run(command: list[str], *, cwd: Path | None = None) -> str:
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    result = subprocess.run(command, capture_output=True, text=True, cwd=cwd, env=environment, timeout=300)
    assert result.returncode == 0, result.stdout[-3000:] + result.stderr[-3000:]
    return result.stdout


@pytest.mark.slow
def test_the_wheel_holds_its_page_and_its_sample(installed: Path, checkout: Path, tmp_path: Path) -> None:
    code = (
        "from app.static_files import static_folder; from ladarreg_core.simulate import sample_folder\n"
        "print(static_folder()); print(sample_folder())"
    )
    static, sample = map(Path, run([str(installed / "python"), "-c", code], cwd=tmp_path).split("\n")[:2])
    for folder, source in ((static, checkout / "static"), (sample, checkout / "ladarreg_core/simulate/sample_files")):
        assert not folder.is_relative_to(checkout)
        names = {path.name for path in source.iterdir() if path.is_file()}
        assert names == {path.name for path in folder.iterdir() if path.is_file()}
    assert sum(path.stat().st_size for path in sample.iterdir()) <= 3_000_000


@pytest.mark.slow
def test_the_installed_command_runs(installed: Path, tmp_path: Path) -> None:
    from ladarreg_core import __version__

    command = str(installed / "ladarreg")
    assert run([command, "--version"], cwd=tmp_path).split() == ["ladarreg", __version__]
    code = "from ladarreg_core.simulate import sample_folder; print(sample_folder())"
    sample = Path(run([str(installed / "python"), "-c", code], cwd=tmp_path).strip())
    assert "1000" in run([command, "info", str(sample / "scan.npz")], cwd=tmp_path)
