"""The core knows no command line: its texts name arguments, and the app says how its users give them."""

from __future__ import annotations

import ast
import re
from dataclasses import fields
from functools import cache
from pathlib import Path

import pytest
from ladarreg.argument_names import ARGUMENTS, as_fields, as_flags, reading_slice
from ladarreg.arguments import ScanArguments
from ladarreg.messages import one_line

from ladarreg_core.formats.scans.scan_request import SCAN_OPTIONS, ScanOptions

CORE = Path(__file__).resolve().parents[2] / "ladarreg_core"
_FLAG = re.compile(r"(?<![\w`-])--[a-z][a-z-]+")
_ARGUMENT = re.compile(r"`(\w+)(?:=[^`]*)?`")
_NOT_OURS = {"style.py", "ros.py", "report.py"}  # style sheets, and commands of ROS
_ONLY_IN_PYTHON = {"xyz", "ranges", "rays", "azimuth_rad", "elevation_rad", "white", "points", "to_json"}


@cache
def texts() -> dict[str, list[str]]:
    """Return the string constants of the core's files, without docstrings."""
    found = {}
    for path in sorted(CORE.rglob("*.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        documented = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
        found[path.name] = [
            node.value
            for node in ast.walk(tree)
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in documented
        ]
    return found


@pytest.mark.slow
def test_the_core_names_no_options_of_the_command_line() -> None:
    found = texts()
    assert _FLAG.search("give --origin x"), "the control"
    assert not {
        (name, flag) for name, strings in found.items() if name not in _NOT_OURS
        for text in strings for flag in _FLAG.findall(text)
    }  # fmt: skip


@pytest.mark.slow
def test_every_argument_that_is_named_has_an_option() -> None:
    named = {name for path, strings in texts().items() if path not in _NOT_OURS
             for text in strings for name in _ARGUMENT.findall(text)}  # fmt: skip
    assert len(named) > 10
    assert named - _ONLY_IN_PYTHON <= {*ARGUMENTS}, named - _ONLY_IN_PYTHON - {*ARGUMENTS}
    nameless = {name for name, one in ARGUMENTS.items() if not (one.label or one.words)}
    assert nameless == {"inputs"}, "files are uploaded to the page"


def test_each_option_of_reading_a_scan_is_given_on_the_command_line_and_in_the_form_of_the_page() -> None:
    defaults = {name: getattr(ScanOptions(), name) or None for name in SCAN_OPTIONS}
    options = {one.name: one.default or None for one in fields(ScanArguments)}
    assert options == defaults
    assert {*reading_slice()} == {*SCAN_OPTIONS, "temperature_unit", "camera_name"}
    for name in SCAN_OPTIONS:
        assert ARGUMENTS[name].flag.split()[0] in ("--scan", f"--{name.replace('_', '-')}")


@pytest.mark.parametrize(
    ("text", "flags", "labels"),
    [
        ("give it by `origin`", "give it by --origin X,Y,Z", "give it by 'Scanner stood at'"),
        ("(`scan_index=3`)", "(--scan 3)", "('Scan of the file' 3)"),
        ("by `force=True`", "by --force", "by 'replace an earlier export'"),
        ("or `intensity='luma'`", "or --intensity luma",
         "or 'Use the brightness of the colours as the intensity'"),
        ("the field `of another`, `x`", "the field `of another`, `x`", "the field `of another`, `x`"),
    ],
)  # fmt: skip
def test_arguments_are_worded_for_their_readers(text: str, flags: str, labels: str) -> None:
    assert as_flags(text) == flags == one_line(text)
    assert as_fields(text) == labels
