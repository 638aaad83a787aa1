"""Import rules, and what an import costs: checked on the source itself."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

import ladarreg_core

CHECKOUT = Path(__file__).resolve().parents[2]

GROUND_FLOOR = {"errors", "foundations", "frames", "camera", "scanner", "scan", "photo", "matches"}
DATA = GROUND_FLOOR | {"results"}
NEVER_IN_CORE = {"app", "ladarreg", "viser", "starlette", "uvicorn", "rich", "tyro", "websockets"}
ALGORITHMS = {"matching", "pose", "thesis", "registration", "simulate", "surface"}
FORBIDDEN = {
    "foundations": {"storage"},
    "storage": ALGORITHMS | {"formats", "export", "project", "camera", "scan", "photo"},
    "thesis/estimators": {"pose", "scan", "photo", "scanner", "surface", "matching"},
    "pose": {"scan", "photo", "scanner", "surface", "matching"},
    "matching/features": {"pose", "registration", "formats", "export", "matching/images", "matching/search"},
    "matching": {"thesis/matching", "registration", "formats", "export"},
    "formats": ALGORITHMS | {"export", "acquisition"},
    "acquisition/devices": ALGORITHMS | {"export"},
    "acquisition/runs": ALGORITHMS | {"export"},
    "export": {"matching", "pose", "simulate"},
    "export/models": {"registration", "formats"},
    "export/pictures": {"registration", "formats"},
    "export/report": {"registration", "formats"},
    "export/targets": {"registration"},
    "simulate": {"matching", "pose", "registration", "export"},
    "registration": {"formats", "export", "simulate", "inspection", "project"},
    "batches": {"simulate", "inspection", "project", "acquisition", "thesis"},
    "batches/photos": {"survey", "batches/jobs"},
    "fusion": {
        "registration",
        "matching",
        "pose",
        "formats",
        "simulate",
        "project",
        "acquisition",
        "survey",
        "batches",
    },
    "survey": {"batches/jobs", "simulate", "inspection", "project", "acquisition", "thesis"},
    "inspection": {
        "formats/cameras",
        "formats/photos",
        "formats/recordings",
        "formats/scans",
        "simulate",
        "project",
        "registration",
    },
    "inspection/measuring": {"acquisition", "thesis", "matching"},
    "project": {"inspection", "simulate"},
}
"""What a package and its sub-packages may not import, with what is below it, beside what would close a circle."""


def modules(package: str) -> dict[str, Path]:
    """Return the files of a package by their dotted names."""
    found = {}
    for path in sorted((CHECKOUT / package).rglob("*.py")):
        parts = path.relative_to(CHECKOUT).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


@cache
def imported_modules(path: Path) -> frozenset[str]:
    """Return the dotted names that a file imports anywhere, those for type checkers included."""
    names: set[str] = set()
    package = path.relative_to(CHECKOUT).with_suffix("").parts[:-1]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = ".".join(package[: len(package) - node.level + 1]) if node.level else ""
            module = ".".join(part for part in (base, node.module or "") if part)
            names.update(f"{module}.{alias.name}" for alias in node.names)
    return frozenset(names)


def file_graph(package: str) -> dict[str, set[str]]:
    """Return which modules of a package each of its modules imports."""
    files = modules(package)
    graph = {}
    for name, path in files.items():
        imported = {found if found in files else found.rpartition(".")[0] for found in imported_modules(path)}
        graph[name] = (imported & set(files)) - {name}
    return graph


def room_of(path: Path, package: str) -> str:
    """Return the folder that a file lies in, below the package; a file of its top level is a room of its own."""
    inside = path.relative_to(CHECKOUT / package)
    return inside.parent.as_posix() if len(inside.parts) > 1 else inside.stem


def room_graph(package: str = "ladarreg_core") -> dict[str, set[str]]:
    """Return which rooms each room of a package imports; a folder inside a folder is a room of its own."""
    files = modules(package)
    graph: dict[str, set[str]] = {}
    for name, imported in file_graph(package).items():
        room = room_of(files[name], package)
        graph.setdefault(room, set()).update({room_of(files[other], package) for other in imported} - {room})
    graph.pop("__init__", None)
    return graph


def core_files() -> list[Path]:
    return list(modules("ladarreg_core").values())


def assert_no_circle(graph: dict[str, set[str]]) -> None:
    try:
        tuple(TopologicalSorter(graph).static_order())
    except CycleError as error:
        pytest.fail(f"imports in a circle: {' -> '.join(error.args[1])}")


@pytest.mark.parametrize("package", ["ladarreg_core", "app"])
def test_rooms_import_one_way_only(package: str) -> None:
    graph = room_graph(package)
    assert any(graph.values()), "the graph was not read"
    assert_no_circle(graph)


@pytest.mark.parametrize("package", ["ladarreg_core", "app"])
def test_no_files_import_each_other_in_a_circle(package: str) -> None:
    assert_no_circle(file_graph(package))


def test_a_circle_is_noticed() -> None:
    with pytest.raises(pytest.fail.Exception, match="circle"):
        assert_no_circle({"a": {"b"}, "b": {"c"}, "c": {"a"}})


def test_the_ground_floor_stands_alone() -> None:
    graph = room_graph()
    assert not {room: extra for room in DATA if (extra := graph.get(room, set()) - DATA)}


def is_below(room: str, package: str) -> bool:
    return room == package or room.startswith(f"{package}/")


@pytest.mark.parametrize("package", sorted(FORBIDDEN))
def test_no_package_imports_what_it_may_not(package: str) -> None:
    graph = room_graph()
    found = [room for room in graph if is_below(room, package)]
    assert found, f"there is no package {package}"
    wrong = {
        (room, other)
        for room in found
        for other in graph[room]
        if any(is_below(other, forbidden) for forbidden in FORBIDDEN[package])
    }
    assert not wrong


@pytest.mark.parametrize("path", core_files(), ids=lambda path: str(path.relative_to(CHECKOUT)))
def test_the_core_knows_nothing_of_its_users(path: Path) -> None:
    assert not {name.split(".")[0] for name in imported_modules(path)} & NEVER_IN_CORE


def test_the_app_holds_no_mathematics() -> None:
    for path in sorted((CHECKOUT / "app").rglob("*.py")):
        names = imported_modules(path)
        assert not {name.split(".")[0] for name in names} & {"scipy", "cv2", "poselib", "trimesh"}, path
        private = {
            name for name in names if name.startswith("ladarreg_core") and "._" in name.replace("__version__", "")
        }
        assert not private, f"{path} reaches into {private}"


@pytest.mark.slow
def test_slow_packages_are_imported_where_they_are_used() -> None:
    quick = {*sys.stdlib_module_names, "numpy", "cv2", "msgspec", "threadpoolctl", "ladarreg_core"}
    for path in sorted((CHECKOUT / "ladarreg_core").rglob("*.py")):
        if "simulated" in path.parts:  # programs of their own
            continue
        tree = ast.parse(path.read_text(encoding="utf-8"))
        at_the_top = {alias.name for node in tree.body if isinstance(node, ast.Import) for alias in node.names}
        at_the_top |= {node.module or "" for node in tree.body if isinstance(node, ast.ImportFrom)}
        slow = {name for name in at_the_top if name.split(".")[0] not in quick}
        assert not slow, f"{path}: import {', '.join(sorted(slow))} in the function that needs it"


def test_no_package_is_called_as_a_public_name() -> None:
    """Importing the package would put it in the place of the function."""
    top = {path.stem for path in (CHECKOUT / "ladarreg_core").iterdir() if path.suffix == ".py" or path.is_dir()}
    assert not top & set(ladarreg_core.__all__)


def test_importing_the_core_costs_nothing() -> None:
    code = (
        "import sys, ladarreg_core\n"
        "heavy = {'numpy', 'cv2', 'scipy', 'trimesh', 'pye57', 'viser'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
        "for name in ladarreg_core.__all__: getattr(ladarreg_core, name)\n"
        "late = {'scipy', 'trimesh', 'pye57', 'embreex', 'poselib', 'PIL'} & set(sys.modules)\n"
        "assert not late, late\n"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=CHECKOUT)
    assert result.returncode == 0, result.stderr


def test_benchmarks_and_what_they_share_with_tests_import_no_tests() -> None:
    checkout = Path(__file__).resolve().parents[2]
    statement = re.compile(r"^\s*(?:from|import) tests\b", re.MULTILINE)
    files = [*(checkout / "benchmarks").rglob("*.py"), *(checkout / "testing").rglob("*.py")]
    assert len(files) > 50
    assert not [str(file) for file in files if statement.search(file.read_text(encoding="utf-8"))]


@pytest.mark.slow
def test_no_module_but_those_of_cameras_asks_for_the_class_of_a_camera() -> None:
    """What depends on the model is asked of the camera (`as_pinhole`, `depth_of`, `turn_px`...)."""
    classes = {"Camera", "FocalCamera", "FisheyeCamera", "EquirectangularCamera"}
    found = []
    for path in [*core_files(), *modules("app").values()]:
        if path.is_relative_to(CHECKOUT / "ladarreg_core" / "camera"):
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "isinstance":
                asked = {name.id for name in ast.walk(node.args[1]) if isinstance(name, ast.Name)}
                found += [f"{path.relative_to(CHECKOUT)}:{node.lineno}"] if asked & classes else []
    assert not found
