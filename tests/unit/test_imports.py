"""Who may look into whom, and what an import costs: checked on the source itself."""

from __future__ import annotations

import ast
import subprocess
import sys
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).resolve().parents[2]

GROUND_FLOOR = {"errors", "arrays", "progress", "frames", "camera", "ray_table", "scanner", "scan", "photo", "matches"}
DATA = GROUND_FLOOR | {"results"}
NEVER_IN_CORE = {"app", "viser", "starlette", "uvicorn", "rich", "tyro", "websockets"}
ALGORITHMS = {"features", "matching", "pose", "register", "simulate", "texture"}
FORBIDDEN = {
    "pose": {"scan", "photo", "scanner", "matching", "features"},
    "features": {"matching", "pose", "register", "formats", "export"},
    "matching": {"register", "formats", "export"},
    "formats": ALGORITHMS | {"export"},
    "device": ALGORITHMS | {"export"},
    "export": {"features", "matching", "pose", "register", "formats", "simulate"},
    "simulate": {"features", "matching", "pose", "register", "export"},
    "register": {"formats", "export", "simulate", "inspection", "project"},
    "inspection": {"formats", "export", "simulate", "project", "register"},
    "project": {"inspection", "simulate"},
}
"""What a room may not see, beside what would close a circle."""


def imported_modules(path: Path) -> set[str]:
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
    return names


def rooms_imported(path: Path) -> set[str]:
    return {name.split(".")[1] for name in imported_modules(path) if name.startswith("ladarreg_core.")}


def core_files() -> list[Path]:
    return [path for path in sorted((CHECKOUT / "ladarreg_core").rglob("*.py")) if path.name != "conftest.py"]


def room_of(path: Path) -> str:
    return path.relative_to(CHECKOUT / "ladarreg_core").with_suffix("").parts[0]


def room_graph() -> dict[str, set[str]]:
    graph: dict[str, set[str]] = {}
    for path in core_files():
        if room_of(path) != "__init__":
            graph.setdefault(room_of(path), set()).update(rooms_imported(path) - {room_of(path)})
    return graph


def test_rooms_look_one_way_only() -> None:
    graph = room_graph()
    assert "frames" in graph["camera"] | graph["scanner"], "the graph was not read"
    try:
        tuple(TopologicalSorter({room: others & set(graph) for room, others in graph.items()}).static_order())
    except CycleError as error:
        pytest.fail(f"rooms import each other in a circle: {' -> '.join(error.args[1])}")


def test_the_ground_floor_stands_alone() -> None:
    graph = room_graph()
    assert not {room: extra for room in DATA if (extra := graph[room] - DATA)}


@pytest.mark.parametrize("room", sorted(FORBIDDEN))
def test_no_room_looks_where_it_may_not(room: str) -> None:
    assert not room_graph().get(room, set()) & FORBIDDEN[room]


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


@pytest.mark.parametrize(
    "first", ["", "from ladarreg_core.register import RegisterOptions", "import ladarreg_core.register"]
)
def test_the_facade_can_be_called_whatever_was_imported_first(first: str) -> None:
    """The function and its module share a name, and the import system gives it to the module."""
    call = "try: lr.register(None, None, method='magic')\nexcept lr.LadarregError: pass"
    code = f"{first}\nimport ladarreg_core as lr\n{call}"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=CHECKOUT)
    assert result.returncode == 0, result.stderr
