"""The printed help of every command, and what misspelt words are answered with."""

from __future__ import annotations

import importlib
import re
import shlex
import subprocess
import sys
from dataclasses import fields

import pytest
from ladarreg.arguments import parse
from ladarreg.cli import COMMANDS, main
from ladarreg.exit_codes import ExitCode
from ladarreg.help import arguments_of, examples_of

GROUPS = {
    "register": (
        "arguments:", "options:", "matches and initial pose:", "photo and camera:",
        "scan: what its file does not say itself:", "estimation:", "the thesis's method:", "running:", "examples:",
    ),
    "info": ("arguments:", "options:", "scan: what its file does not say itself:", "running:", "examples:"),
    "demo": ("options:", "running:", "examples:"),
}  # fmt: skip
THESIS = ("--t1", "--t2-px", "--culling", "--first-pose", "--residual", "--reject-depth-m", "--samples-per-line")


def shown(name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, width: int = 80) -> str:
    monkeypatch.setenv("COLUMNS", str(width))
    assert main([name, "--help"]) == 0
    return capsys.readouterr().out


@pytest.mark.parametrize("width", [80, 120])
@pytest.mark.parametrize("name", COMMANDS)
def test_help_is_plain_text_that_fits(
    name: str, width: int, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    text = shown(name, capsys, monkeypatch, width)
    assert "None" not in text
    assert "default: )" not in text
    assert "\x1b" not in text
    assert all(len(line) < width for line in text.splitlines()), max(text.splitlines(), key=len)
    assert "Arguments of" not in text  # the summary of the command, not of its class
    kind = importlib.import_module(f"ladarreg.commands.{name.replace('-', '_')}").Arguments
    for one in arguments_of(kind):
        assert one.text, one.name
        for flag in one.flags:
            assert re.search(rf"(^|[ ,]){flag}\b", text), flag
    assert {one.name for one in arguments_of(kind)} == {field.name for field in fields(kind)}


@pytest.mark.parametrize("name", COMMANDS)
def test_every_example_parses(name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    kind = importlib.import_module(f"ladarreg.commands.{name.replace('-', '_')}").Arguments
    examples = [one for one in examples_of(kind) if not one.startswith("#")]
    assert examples
    text = shown(name, capsys, monkeypatch)
    for example in examples:
        assert f"  {example}\n" in text
        words = shlex.split(example)
        assert words[:2] == ["ladarreg", name]
        parse(kind, words[2:], prog="ladarreg", description="")


@pytest.mark.parametrize("name", GROUPS)
def test_options_stand_in_groups_in_the_order_of_use(
    name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    text = shown(name, capsys, monkeypatch)
    heads = [line for line in text.splitlines() if re.match(r"[a-z].*:$", line)]
    assert tuple(heads) == GROUPS[name]
    if name == "register":
        thesis = text[text.index("the thesis's method:") : text.index("running:")]
        assert all(flag in thesis for flag in THESIS)
        assert not any(f"  {flag} " in text.replace(thesis, "") for flag in THESIS)
        assert text.index("-o, --out") < text.index("--method") < text.index("--camera") < text.index("  --force ")
        assert "usage: ladarreg register SCAN PHOTO [SCAN ...] -o OUT [OPTIONS]" in text
        assert "{auto,thesis,manual}" in text
        assert "(default: auto)" in text


def test_the_overview_fits_and_names_every_command(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    assert main(["--help"]) == 0
    text = capsys.readouterr().out
    assert all(len(line) < 80 for line in text.splitlines())
    for line in text[text.index("examples:") :].splitlines()[1:]:
        words = shlex.split(line)
        kind = importlib.import_module(f"ladarreg.commands.{words[1].replace('-', '_')}").Arguments
        parse(kind, words[2:], prog="ladarreg", description="")


def test_help_of_a_command_by_its_name(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["register", "--help"]) == 0
    wanted = capsys.readouterr().out
    assert main(["help", "register"]) == 0
    assert capsys.readouterr().out == wanted
    assert main(["help", "regster"]) == ExitCode.BAD_INPUT
    assert "did you mean register?" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "answer"),
    [
        ("register a b -o c --focal-p 3", "--focal-p is not an option; did you mean --focal-px?"),
        ("register a b -o c --inital x", "--inital is not an option; did you mean --initial?"),
        ("register a b -o c --matches=m --qiet", "--qiet is not an option; did you mean --quiet?"),
        ("register a b -o c --xyzzy", "--xyzzy is not an option (see ladarreg register --help)"),
        ("register a b -o c --method manul", "'manul' is not a choice of --method; did you mean manual"),
        ("register a b -o c --method x", "'x' is not a choice of --method; use one of auto, thesis, manual"),
        ("register a b -o c --camera-model cube", "use one of pinhole, equirectangular"),
        ("simulate ofice -o x", "did you mean office"),
        ("serve --read-only", "--read-only is not an option"),
        ("regsiter a b", "'regsiter' is not a command; did you mean register?"),
        ("xyzzy", "use one of register, "),
    ],
)
def test_a_misspelt_word_is_answered_with_a_suggestion(
    words: str, answer: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words.split()) == ExitCode.BAD_INPUT
    captured = capsys.readouterr()
    assert answer in captured.err
    assert captured.err.count("\n") == 1
    assert captured.out == ""


def test_underscores_and_values_with_hyphens_are_no_misspelling(capsys: pytest.CaptureFixture[str]) -> None:
    from ladarreg.commands import register

    words = ["a", "b", "-o", "c", "--focal_px", "3", "--origin=-1,2,3", "--topic", "/x"]
    found = parse(register.Arguments, words, prog="ladarreg register", description="")
    assert (found.focal_px, found.origin, found.topic) == (3.0, "-1,2,3", "/x")


def test_help_of_a_command_imports_nothing_that_it_does_not_need() -> None:
    code = (
        "import sys; from ladarreg.cli import main; main(['register', '--help'])\n"
        "heavy = {'numpy', 'cv2', 'rich', 'scipy', 'viser'} & set(sys.modules)\n"
        "sys.exit(f'{heavy}' if heavy else 0)"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
