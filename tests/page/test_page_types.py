"""Types and lint of the page's modules, by tools of Node: `npm ci` in the checkout installs them."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).parents[2]
TOOLS = CHECKOUT / "node_modules" / ".bin"
_ERROR = re.compile(r"^(static/js/[^(]+)\(\d+,\d+\): error", re.MULTILINE)


def run(tool: str, *words: str) -> subprocess.CompletedProcess[str]:
    """Run a tool of Node in the checkout."""
    if shutil.which("node") is None:
        pytest.skip("there is no Node")
    if not (TOOLS / tool).exists():
        pytest.skip(f"{tool} is not installed; run npm ci in the checkout")
    return subprocess.run(
        [str(TOOLS / tool), *words], cwd=CHECKOUT, capture_output=True, text=True, check=False, timeout=600
    )


def faults_of(folder: Path) -> tuple[set[str], str]:
    """Return the modules in which the type check finds faults, and all that it says."""
    found = run("tsc", "--project", str(folder / "tsconfig.json"))
    return set(_ERROR.findall(found.stdout)), found.stdout + found.stderr


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_types_of_the_page_fit_and_commands_and_slices_are_those_of_the_workbench() -> None:
    faulty, said = faults_of(CHECKOUT)
    assert not faulty, said


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_wrong_commands_wrong_slices_nulls_and_missing_types_are_found(tmp_path: Path) -> None:
    shutil.copy(CHECKOUT / "tsconfig.json", tmp_path)
    shutil.copytree(CHECKOUT / "static" / "js", tmp_path / "static" / "js")
    (tmp_path / "static" / "js" / "control.js").write_text(
        'import { request, requestForPhoto } from "./net/requests.js";\n'
        'request("add_pik", {});\nrequest("rename", { nam: "x" });\nrequestForPhoto("run", { job: 3 });\n'
        'request("rename", { name: "x" });\nrequestForPhoto("run", { job: "auto" });\nrequest("undo");\n'
        'document.querySelector("p").remove();\ntry { request("undo"); } catch (error) { error.stack; }\n'
        "const half = (value) => value / 2;\nhalf(3);\n"
        'import { store } from "./net/store.js";\nstore.get("photo");\nstore.get("people").count;\n'
        "store.stageOf()?.when;\nstore.picksOf(`p1`)[0].weight.toFixed();\n"
        'store.on("picks:*", (picks) => picks?.[0].numbr);\nstore.onEvent("hover", ({ pik }) => pik);\n'
        'store.get(`judged:${store.shown()}`)?.by_pick.k1.px.toFixed();\nstore.get("scan")?.rows.toFixed();\n'
    )
    _, said = faults_of(tmp_path)
    found = {int(line) for line in re.findall(r"control\.js\((\d+),", said)}
    assert found == {2, 3, 4, 8, 9, 10, 13, 14, 15, 17, 18, 19, 20}, said


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_linter_finds_nothing() -> None:
    found = run("eslint", "static/js")
    assert found.returncode == 0, found.stdout + found.stderr
