"""The structure of the code in figures: python -m benchmarks.structure [--calls] [--options].

Packages are folders with an `__init__.py`; the top level of the core counts as one of them. Counted are

- entries at the top of the core and of the app, files in their largest package, and statements without docstrings;
- names that a file imports from another package of the same side, and pairs of packages with such an import;
- option fields that no keyword of a call and no key of a dictionary sets anywhere, tests and benchmarks included;
- what a scan enters on its way from a file to a GLB, and a photograph on its way from a file to a pose: modules in the
  order in which they are first called, on all threads (`sys.setprofile`). Packages are those entered; returns are
  entries of a package that was left before. Both are counted again with the packages at the top alone.
"""

from __future__ import annotations

import argparse
import ast
import sys
import tempfile
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from types import FrameType
from typing import Any

CHECKOUT = Path(__file__).resolve().parents[1]
SIDES = {"core": "ladarreg_core", "app": "app"}
IMPORTED_AS = {"ladarreg_core": "ladarreg_core", "ladarreg": "app"}
"""The folder of each top-level package."""


@cache
def sources(side: str) -> dict[Path, ast.Module]:
    """Return the syntax trees of the files of a side or of another folder, by paths relative to the checkout."""
    files = sorted((CHECKOUT / SIDES.get(side, side)).rglob("*.py"))
    return {path.relative_to(CHECKOUT): ast.parse(path.read_text(encoding="utf-8")) for path in files}


def top_entries(side: str) -> int:
    """Return the number of packages and modules at the top of a side."""
    return len({path.parts[1] for path in sources(side)} - {"__init__.py"})


def largest_package(side: str) -> tuple[int, str]:
    """Return the number of files of the package with the most, and its path."""
    files = Counter(path.parent.as_posix() for path in sources(side) if path.name != "__init__.py")
    name, count = files.most_common(1)[0]
    return count, name


def statements(side: str) -> int:
    """Return the number of statements, without docstrings and strings below fields."""
    return sum(
        isinstance(node, ast.stmt)
        and not (
            isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
        )
        for tree in sources(side).values()
        for node in ast.walk(tree)
    )


def imported(path: Path, tree: ast.Module) -> Iterator[tuple[Path, str]]:
    """Yield the package and the name of each `from ... import` of this project's packages in a file."""
    for node in ast.walk(tree):
        if not isinstance(node, ast.ImportFrom):
            continue
        if node.level:
            base = path.parents[node.level - 1]
            module = base.joinpath(*(node.module or "").split(".")) if node.module else base
        else:
            first, *rest = (node.module or "").split(".")
            if first not in IMPORTED_AS:
                continue
            module = Path(IMPORTED_AS[first], *rest)
        package = module if (CHECKOUT / module).is_dir() else module.parent
        for name in node.names:
            inner = package / name.name if module == package else package
            yield (inner if (CHECKOUT / inner).is_dir() else package), name.name


def imports(side: str) -> tuple[int, int]:
    """Return the number of names imported across packages of a side, and of pairs of packages that import."""
    names: set[tuple[Path, Path, str]] = set()
    for path, tree in sources(side).items():
        for package, name in imported(path, tree):
            if package != path.parent and package.parts[0] == SIDES[side]:
                names.add((path, package, name))
    return len(names), len({(path.parent, package) for path, package, _ in names})


def options() -> dict[str, list[str]]:
    """Return the fields of each class of options of the core."""
    found = {}
    for tree in sources("core").values():
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef) and node.name.endswith("Options"):
                body = [each for each in node.body if isinstance(each, ast.AnnAssign)]
                found[node.name] = [each.target.id for each in body if isinstance(each.target, ast.Name)]
    return found


def unset_options() -> dict[str, list[str]]:
    """Return the option fields that no keyword of a call and no key of a dictionary sets, in the tests neither."""
    named: set[str] = set()
    for tree in (tree for folder in (*SIDES, "testing", "tests", "benchmarks") for tree in sources(folder).values()):
        for node in ast.walk(tree):
            if isinstance(node, ast.Call):
                named |= {each.arg for each in node.keywords if each.arg}
            elif isinstance(node, ast.Dict):
                named |= {
                    each.value for each in node.keys if isinstance(each, ast.Constant) and isinstance(each.value, str)
                }
    unset = {name: [each for each in fields if each not in named] for name, fields in options().items()}
    return {name: fields for name, fields in unset.items() if fields}


@dataclass
class Calls:
    """The modules of the core that are called, in the order of their first call; a context manager."""

    modules: dict[str, None] = field(default_factory=dict)

    def __enter__(self) -> Calls:
        core = f"{CHECKOUT / SIDES['core']}/"

        def see(frame: FrameType, event: str, _: Any) -> None:
            code = frame.f_code
            if event == "call" and code.co_name != "<module>" and code.co_filename.startswith(core):
                self.modules.setdefault(code.co_filename.removeprefix(core))

        threading.setprofile(see)
        sys.setprofile(see)
        return self

    def __exit__(self, *_: object) -> None:
        sys.setprofile(None)
        threading.setprofile(None)  # type: ignore[arg-type]

    def packages(self, *, at_top: bool = False) -> list[str]:
        """Return the packages in the order in which their modules are first called; each may come again.

        Args:
            at_top: the packages at the top alone, with all within them.
        """
        found: list[str] = []
        for module in self.modules:
            package = Path(module).parts[0] if at_top and "/" in module else str(Path(module).parent)
            if not found or found[-1] != package:
                found.append(package)
        return found


def scan_to_glb() -> None:
    """Read the embedded scan and write it as GLB with the photograph at its true pose."""
    import numpy as np

    import ladarreg_core as lr
    from ladarreg_core.export.registered_scan import RegisteredPhoto, RegisteredScan
    from ladarreg_core.formats.documents.pose_file import read_pose
    from ladarreg_core.matches import Matches
    from ladarreg_core.simulate.sample import sample_folder

    folder = sample_folder()
    none = np.zeros(0)
    photo = lr.read_photo(folder / "photo.png", camera=folder / "camera.json")
    result = lr.Registration(
        camera_from_scanner=read_pose(folder / "truth.json"), camera=photo.camera, matches=Matches.none(),
        inliers=none > 0, residuals_px=none.reshape(0, 2), residuals_m=none, stereo_depth_error_m=none,
        covariance=np.eye(6) * 1e-8, chi2_per_dof=1.0, sigma_px=1.0, sigma_range_m=0.01, accepted=True,
        evidence="given", method="given", reasons=(),
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as out:
        scan = lr.read_scan(folder / "scan.npz")
        handed = RegisteredScan(scan, (RegisteredPhoto("photo", photo, result),), folder / "scan.npz")
        lr.export_to(Path(out) / "model", handed, ["glb"])


def photo_to_pose() -> None:
    """Read the embedded photograph and register it with the scan."""
    import ladarreg_core as lr
    from ladarreg_core.matching.images.kept_channels import forget_last_view
    from ladarreg_core.simulate.sample import sample_folder

    forget_last_view()  # another photograph on the same scan would find its channels
    folder = sample_folder()
    scan = lr.read_scan(folder / "scan.npz")
    lr.register(scan, lr.read_photo(folder / "photo.png", camera=folder / "camera.json"))


WAYS: dict[str, Callable[[], None]] = {"a scan to a GLB": scan_to_glb, "a photograph to a pose": photo_to_pose}


def way_of(work: Callable[[], None]) -> Calls:
    """Return what is called by work, which is done once before: imports and caches are no part of the way."""
    work()
    with Calls() as calls:
        work()
    return calls


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--calls", action="store_true", help="also list the packages of each way, in order")
    parser.add_argument("--options", action="store_true", help="also list the options that nothing sets")
    chosen = parser.parse_args()
    print("| | core | app |\n|---|---|---|")
    print(f"| entries at the top | {top_entries('core')} | {top_entries('app')} |")
    core, app = largest_package("core"), largest_package("app")
    print(f"| files of the largest package | {core[0]} (`{core[1]}`) | {app[0]} (`{app[1]}`) |")
    print(f"| files | {len(sources('core'))} | {len(sources('app'))} |")
    print(f"| statements | {statements('core'):,} | {statements('app'):,} |")
    (core_names, core_pairs), (app_names, app_pairs) = imports("core"), imports("app")
    print(f"| names imported across packages | {core_names:,} | {app_names:,} |")
    print(f"| pairs of packages | {core_pairs} | {app_pairs} |")
    unset = unset_options()
    print(f"\noptions that nothing sets: {sum(map(len, unset.values()))} of {sum(map(len, options().values()))}")
    if chosen.options:
        for name, fields in sorted(unset.items()):
            print(f"  {name}: {', '.join(fields)}")
    for name, work in WAYS.items():
        calls = way_of(work)
        packages, rooms = calls.packages(), calls.packages(at_top=True)
        entered, of_top = set(packages), set(rooms)
        print(
            f"{name}: {len(entered)} packages, {len(packages) - len(entered)} returns; "
            f"at the top {len(of_top)}, {len(rooms) - len(of_top)}"
        )
        if chosen.calls:
            print("  " + " > ".join(packages))


if __name__ == "__main__":
    main()
