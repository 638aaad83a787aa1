"""Cut a release: version and changelog, then source distribution and wheel, each tried in fresh environments.

Run it as `make release VERSION=0.3.0`, or as `python -m testing.release VERSION [--only-build]`. Nothing is committed,
tagged or uploaded: what is left to do is printed.
"""

from __future__ import annotations

import argparse
import hashlib
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from datetime import date
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parents[1]
VERSION_FILE = CHECKOUT / "ladarreg_core" / "foundations" / "version.py"
CHANGELOG = CHECKOUT / "docs" / "changelog.md"
PYTHONS = ("python3.11", "python3.12", "python3.13")
_UNRELEASED = "## Unreleased"
_TRIAL = "from ladarreg_core.simulate import sample_folder; print(sample_folder())"


class ReleaseError(Exception):
    """A release that cannot be cut, and why."""


def next_version(now: str, wanted: str) -> str:
    """Return the wanted version.

    Raises:
        ReleaseError: if it is not of the form 1.2.3, or not after the present one.
    """
    if not re.fullmatch(r"\d+\.\d+\.\d+", wanted):
        raise ReleaseError(f"the version is {wanted!r}; it must be three numbers, e.g. 0.3.0")
    if _numbers(wanted) <= _numbers(now):
        raise ReleaseError(f"the version {wanted} is not after {now}; choose a later one")
    return wanted


def cut_changelog(text: str, version: str, day: date) -> str:
    """Return the changelog with what is unreleased under the version, and an empty section above.

    Raises:
        ReleaseError: if there is no section of unreleased changes, or nothing in it.
    """
    before, heading, after = text.partition(f"{_UNRELEASED}\n")
    if not heading:
        raise ReleaseError(f"the changelog has no section '{_UNRELEASED}'; add one with what has changed")
    changes = re.split(r"^## ", after, maxsplit=1, flags=re.MULTILINE)[0]
    if not changes.strip():
        raise ReleaseError(f"nothing stands under '{_UNRELEASED}'; describe what has changed")
    return f"{before}{_UNRELEASED}\n\n## {version} ({day.isoformat()})\n{after}"


def build(folder: Path) -> list[Path]:
    """Return source distribution and wheel, built from the tracked files; the wheel from the source distribution."""
    with tempfile.TemporaryDirectory() as copied:
        for name in _run(["git", "ls-files", "-z"]).split("\0"):
            if name and (CHECKOUT / name).is_file():
                target = Path(copied) / name
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(CHECKOUT / name, target)
        shutil.rmtree(folder, ignore_errors=True)
        _run([sys.executable, "-m", "build", "--outdir", str(folder), copied])
    return sorted(folder.iterdir())


def try_wheel(wheel: Path, python: str, version: str) -> None:
    """Install a wheel with its dependencies in a fresh environment, and register the embedded sample there.

    Raises:
        ReleaseError: if the command is of another version or does not accept the sample.
    """
    with tempfile.TemporaryDirectory() as home:
        environment = Path(home) / "venv"
        _run([python, "-m", "venv", str(environment)])
        scripts = environment / ("Scripts" if sys.platform == "win32" else "bin")
        _run([str(scripts / "python"), "-m", "pip", "install", "--quiet", str(wheel)])
        command = str(scripts / "ladarreg")
        said = _run([command, "--version"], cwd=home).split()
        if said != ["ladarreg", version]:
            raise ReleaseError(f"the wheel says {' '.join(said)!r}; 'ladarreg {version}' is needed")
        sample = Path(_run([str(scripts / "python"), "-c", _TRIAL], cwd=home).strip())
        files = [str(sample / name) for name in ("scan.npz", "photo.png")]
        _run([command, "register", *files, "--camera", str(sample / "camera.json"), "-o", "results"], cwd=home)


def pythons() -> list[str]:
    """Return the supported interpreters that this machine has and can make environments with."""
    found = []
    for name in PYTHONS:
        if shutil.which(name) is not None:
            test = subprocess.run([name, "-c", "import venv, ensurepip"], capture_output=True)
            found += [name] if test.returncode == 0 else []
    return found


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(int(part) for part in version.split("."))


def _run(command: Sequence[str], *, cwd: str | Path = CHECKOUT) -> str:
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True)
    if done.returncode:
        raise ReleaseError(f"{' '.join(map(str, command[:4]))} ... failed:\n{(done.stdout + done.stderr)[-2000:]}")
    return done.stdout


def main() -> int:
    """Cut and try a release; return 0, or 1 with what stands in the way."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("version", help="of the release, e.g. 0.3.0")
    parser.add_argument("--only-build", action="store_true", help="build and try the present version; change no file")
    options = parser.parse_args()
    try:
        text = VERSION_FILE.read_text(encoding="utf-8")
        now = re.search(r'^VERSION = "(.+)"$', text, re.MULTILINE)
        assert now is not None, "the version is written by this program"
        version = now[1]
        if not options.only_build:
            if _run(["git", "status", "--porcelain"]).strip():
                raise ReleaseError("the checkout has changes that are not committed; commit or stash them")
            version = next_version(now[1], options.version)
            changelog = cut_changelog(CHANGELOG.read_text(encoding="utf-8"), version, date.today())
            VERSION_FILE.write_text(text.replace(now[0], f'VERSION = "{version}"'), encoding="utf-8")
            CHANGELOG.write_text(changelog, encoding="utf-8")
        files = build(CHECKOUT / "dist")
        (wheel,) = [file for file in files if file.suffix == ".whl"]
        for python in pythons():
            try_wheel(wheel, python, version)
            print(f"{python}: installed, the sample is accepted")
        for file in files:
            print(f"{hashlib.sha256(file.read_bytes()).hexdigest()}  dist/{file.name}")
    except ReleaseError as error:
        print(f"release: {error}", file=sys.stderr)
        return 1
    print(f"Left to do: git commit -am 'Release {version}'; git tag v{version}; upload dist/*.")
    return 0


if __name__ == "__main__":
    sys.exit(main())
