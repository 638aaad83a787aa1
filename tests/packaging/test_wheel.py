"""The distribution: a wheel in a fresh environment, and the editable install that the tests themselves run from."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
import tomllib
import venv
import zipfile
from pathlib import Path

import pytest

BUILT_FROM = ("app", "ladarreg_core", "static", "pyproject.toml", "README.md", "LICENSE")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory, checkout: Path) -> Path:
    """The wheel, built from a copy of the sources: the build leaves its own folders beside them."""
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    source.mkdir()
    for name in BUILT_FROM:
        if (checkout / name).is_dir():
            shutil.copytree(checkout / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(checkout / name, source / name)
    run([sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(folder), str(source)], cwd=folder)
    (built,) = folder.glob("ladarreg-*.whl")
    return built


@pytest.fixture(scope="module")
def installed(wheel: Path) -> Path:
    """The scripts folder of an environment with the wheel; its dependencies are this environment's."""
    home = wheel.parent / "fresh"
    venv.create(home, with_pip=False, symlinks=os.name != "nt")
    scripts = home / ("Scripts" if os.name == "nt" else "bin")
    python = str(scripts / "python")
    run([sys.executable, "-m", "pip", "--python", python, "install", "--quiet", "--no-deps", str(wheel)])
    site = run([python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"]).strip()
    # A path file adds packages without following the path files there: this checkout stays out of sight.
    (Path(site) / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return scripts


@pytest.fixture
def own_app(tmp_path: Path) -> Path:
    """A folder that contains another package called `app`."""
    (tmp_path / "app").mkdir()
    (tmp_path / "app" / "__init__.py").write_text("raise SystemExit('the wrong app was imported')\n")
    return tmp_path


def run(command: list[str], *, cwd: Path | None = None) -> str:
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    result = subprocess.run(command, capture_output=True, text=True, cwd=cwd, env=environment, timeout=300)
    assert result.returncode == 0, result.stdout[-3000:] + result.stderr[-3000:]
    return result.stdout


@pytest.mark.long
def test_the_wheel_holds_its_page_and_its_sample(installed: Path, checkout: Path, tmp_path: Path) -> None:
    code = (
        "from ladarreg.gateway.page.folder import static_folder; from ladarreg_core.simulate import sample_folder\n"
        "print(static_folder()); print(sample_folder())"
    )
    static, sample = map(Path, run([str(installed / "python"), "-c", code], cwd=tmp_path).split("\n")[:2])
    for folder, source in ((static, checkout / "static"), (sample, checkout / "ladarreg_core/simulate/sample_files")):
        assert not folder.is_relative_to(checkout)
        names = {path.name for path in source.iterdir() if path.is_file()}
        assert names == {path.name for path in folder.iterdir() if path.is_file()}
    assert sum(path.stat().st_size for path in sample.iterdir()) <= 3_000_000


@pytest.mark.long
def test_the_installed_command_runs(installed: Path, tmp_path: Path) -> None:
    from ladarreg_core import __version__

    command = str(installed / "ladarreg")
    assert run([command, "--version"], cwd=tmp_path).split() == ["ladarreg", __version__]
    code = "from ladarreg_core.simulate import sample_folder; print(sample_folder())"
    sample = Path(run([str(installed / "python"), "-c", code], cwd=tmp_path).strip())
    assert "1000" in run([command, "info", str(sample / "scan.npz")], cwd=tmp_path)


@pytest.mark.long
def test_the_wheel_installs_two_packages_and_no_other(wheel: Path) -> None:
    names = zipfile.ZipFile(wheel).namelist()
    top = {name.split("/")[0] for name in names}
    assert {name for name in top if not name.endswith(".dist-info")} == {"ladarreg", "ladarreg_core"}
    assert {"ladarreg/py.typed", "ladarreg_core/py.typed"} <= set(names)


@pytest.mark.long
def test_the_wheel_works_in_a_folder_with_an_app_of_its_own(installed: Path, own_app: Path) -> None:
    for command in ([str(installed / "ladarreg")], [str(installed / "python"), "-m", "ladarreg"]):
        assert run([*command, "--version"], cwd=own_app).startswith("ladarreg ")
        assert "--port" in run([*command, "serve", "--help"], cwd=own_app)


def test_the_editable_install_works_in_a_folder_with_an_app_of_its_own(own_app: Path) -> None:
    command = Path(sys.executable).with_name("ladarreg.exe" if os.name == "nt" else "ladarreg")
    if not command.is_file():
        pytest.skip("the tests do not run in an environment with the package installed")
    for words in ([str(command)], [sys.executable, "-m", "ladarreg"]):
        assert run([*words, "--version"], cwd=own_app).startswith("ladarreg ")


def test_the_package_page_states_the_authors_of_the_licence_and_the_versions_of_python(checkout: Path) -> None:
    project = tomllib.loads((checkout / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    (author,) = project["authors"]
    assert f"Copyright (c) 2026 {author['name']}\n" in (checkout / "LICENSE").read_text(encoding="utf-8")
    named = {int(name.rpartition(".")[2]) for name in project["classifiers"] if ":: Python :: 3." in name}
    assert project["requires-python"] == f">=3.{min(named)},<3.{max(named) + 1}"
    assert "Typing :: Typed" in project["classifiers"]


def test_every_folder_of_modules_is_a_package_of_the_wheel(checkout: Path) -> None:
    settings = tomllib.loads((checkout / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["setuptools"]
    folders = {"app": "ladarreg", "ladarreg_core": "ladarreg_core"}
    found = {"ladarreg.static"}
    for folder, package in folders.items():
        for init in (checkout / folder).rglob("__init__.py"):
            found.add(".".join([package, *init.parent.relative_to(checkout / folder).parts]))
    assert sorted(settings["packages"]) == sorted(found)


@pytest.mark.slow
def test_no_module_file_is_loaded_under_two_names() -> None:
    code = (
        "import importlib, pkgutil, sys, ladarreg, ladarreg_core\n"
        "for package in (ladarreg, ladarreg_core):\n"
        "    for found in pkgutil.walk_packages(package.__path__, package.__name__ + '.'):\n"
        "        if not found.name.endswith('__main__'): importlib.import_module(found.name)\n"
        "names = {}\n"
        "for name, module in list(sys.modules.items()):\n"
        "    if getattr(module, '__file__', None): names.setdefault(module.__file__, set()).add(name)\n"
        "twice = [found for file, found in names.items() if len(found) > 1 and ('ladarreg' in file or 'app' in file)]\n"
        "assert not twice, twice\n"
        "assert 'app' not in sys.modules\n"
    )
    run([sys.executable, "-c", code])
