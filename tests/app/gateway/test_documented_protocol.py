"""docs/workbench.md describes the protocol that exists: its commands, slices, settings, jobs, events and stages."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints, is_typeddict

import pytest
from ladarreg.argument_names import reading_slice
from ladarreg.decoding import types_of
from ladarreg.gateway.uploads import KINDS, STATION
from ladarreg.slices.every import OfPhoto, Slices
from ladarreg.workbench.commands.registry import EVERY_COMMAND

from ladarreg_core.acquisition.plan import PlanFields
from ladarreg_core.project.settings import Settings
from ladarreg_core.results.registration import StageId
from testing.workbench.protocol_text import DECLARATIONS, declarations, with_rows
from testing.workbench.workbench_driver import WorkbenchDriver, sample_bench

DATA_KEYED = ("by_pick", "predicted", "lines", "camera_sigmas", "absent", "in_photo", "residuals_px")
"""Fields whose keys are data: ids of picks, names of parameters."""
NEVER_HERE = {
    "audit:pID",
    "beside",
    "embedded",
    "partner",
    "corners:pID",
    "drawn_lines",
    "drawn_ties",
    "self_test:pID",
    "served",
    "smoothing",
    "stations",
    "survey",
    "ties:pID",
}
"""Slices that are null in this project, or have no more than their totals."""


@pytest.fixture(scope="module")
def document() -> str:
    return (Path(__file__).parents[3] / "docs/workbench.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[WorkbenchDriver]:
    """A workbench with a registered photograph, a drawn line, and a file that waits for others."""
    found = sample_bench(tmp_path_factory.mktemp("registered") / "project")
    assert found.job("auto").state == "done"
    found.do("add_pick", photo="p1", kind="line", scan=[[1, 0, 0], [1, 0.1, 0.02]], photo_uv=[[300, 200], [410, 220]])
    found.do("add_measurement", kind="point", places=[{"ray": [1, 0, 0]}])
    found.eventually(lambda: found.slice("judged:p1"))
    found.eventually(lambda: found.slice("measured"))
    found.eventually(lambda: "findings" in assessed(found))
    incomplete = found.workbench.upload_folder() / "descriptor.json"
    incomplete.write_text('{"kind": "depth-image", "depth": "depth.png", "intensity": "intensity.png"}')
    found.do("open_files", files=[found.workbench.take_upload(incomplete, "kinect.json", "any", None, found.client)])
    yield found
    found.workbench.close()


def assessed(bench: WorkbenchDriver) -> dict[str, Any]:
    stages = bench.slice("poses:p1")["stages"]
    return next(stage for stage in stages if stage["stage"] == "auto")


def section(document: str, title: str) -> str:
    """Return the text below a heading, up to the next one."""
    return re.split(r"^##+ ", document.split(f"# {title}\n", 1)[1], maxsplit=1, flags=re.MULTILINE)[0]


def items(text: str) -> dict[str, str]:
    """Return the texts of a list's items by the name that each begins with."""
    parts = re.split(r"^- `([A-Za-z_]+(?::pID)?)`: ", text, flags=re.MULTILINE)[1:]
    return dict(zip(parts[::2], parts[1::2], strict=True))


def names_in(text: str) -> list[str]:
    """Return the names in backquotes."""
    return re.findall(r"`([a-z][a-z_0-9]*)`", text)


def documented_keys(text: str) -> set[str]:
    """Return the keys of all objects that are written in an item, optional ones with their question mark."""
    code = " ".join(span for span in re.findall(r"`([^`]*)`", text) if "{" in span)
    code = re.sub(r'"[^"]*"', "0", code)
    found, inside, expects_key = set(), [], False
    for token in re.findall(r"[{}\[\]():,]|\w+\??", code):
        if token in "{[(":
            inside.append(token)
            expects_key = token == "{"
        elif token in "}])":
            inside.pop()
            expects_key = False
        elif token == ",":
            expects_key = bool(inside) and inside[-1] == "{"
        elif expects_key and re.fullmatch(r"[a-z]\w*\??", token):
            found.add(token)
            expects_key = False
        else:
            expects_key = False
    return found


def keys_of(value: Any) -> set[str]:
    """Return the keys of all objects within a slice."""
    if isinstance(value, list):
        return {key for part in value for key in keys_of(part)}
    if not isinstance(value, dict):
        return set()
    found = set(value)
    for name, part in value.items():
        found |= keys_of(list(part.values()) if name in DATA_KEYED and isinstance(part, dict) else part)
    return found


def test_the_commands_are_documented(document: str) -> None:
    rows = re.findall(r"^\| (`[^|]*`) \|", section(document, "Commands"), flags=re.MULTILINE)
    found = [name for row in rows for name in names_in(row)]
    assert sorted(found) == sorted(EVERY_COMMAND)
    assert with_rows(document) == document, "python -m testing.workbench.protocol_text writes the rows anew"


def test_the_types_of_the_page_are_those_of_commands_slices_and_events() -> None:
    """Written by python -m testing.workbench.protocol_text."""
    assert DECLARATIONS.read_text(encoding="utf-8") == declarations()


def typed_keys(kind: Any) -> set[str]:
    """Return the keys of all objects within the type of a slice; a plan is described where its file is."""
    if not is_typeddict(kind):
        parts = () if get_origin(kind) is Literal else get_args(kind)
        return {key for part in parts for key in typed_keys(part)}
    hints = {} if kind is PlanFields else get_type_hints(kind)
    return {*hints, *(key for part in hints.values() for key in typed_keys(part))}


def test_the_types_of_the_slices_are_documented_with_all_their_fields(document: str) -> None:
    described = items(section(document, "Slices"))
    typed = {**get_type_hints(Slices), **{f"{name}:pID": kind for name, kind in get_type_hints(OfPhoto).items()}}
    assert set(described) == set(typed)
    described["beside"] = described["scan"]
    for name, kind in typed.items():
        documented = {key.rstrip("?") for key in documented_keys(described[name])}
        assert typed_keys(kind) == documented - (set(reading_slice()) if name == "reading" else set()), name


def test_choices_that_the_core_defines_are_those_of_the_commands() -> None:
    """The commands repeat them, since the core's modules are imported only when they are needed."""
    from ladarreg_core.export.output_frame import FrameName
    from ladarreg_core.export.targets.target import Crop
    from ladarreg_core.registration.stations.registration import PoseUse

    for command, field, choices in (
        ("export", "frame", FrameName), ("export", "crop", Crop), ("register_stations", "poses", PoseUse)
    ):  # fmt: skip
        assert get_args(types_of(EVERY_COMMAND[command])[field]) == get_args(choices)


@pytest.mark.slow
def test_the_slices_are_documented_with_all_their_fields(document: str, bench: WorkbenchDriver) -> None:
    described = items(section(document, "Slices"))
    sent = {name.replace(":p1", ":pID"): bench.slice(name) for name in bench.workbench.slices(bench.client)}
    assert set(described) == set(sent)
    for name, value in sent.items():
        documented = documented_keys(described[name])
        present = keys_of(list(value.values()) if name == "settings" else value)
        optional = {key[:-1] for key in documented if key.endswith("?")}
        required = {key for key in documented if not key.endswith("?")}
        assert present <= required | optional, name
        assert required <= present or name in NEVER_HERE, name


@pytest.mark.slow
def test_the_settings_stages_jobs_and_types_of_file_are_documented(document: str, bench: WorkbenchDriver) -> None:
    slices = items(section(document, "Slices"))
    settings = re.search(r"Names: ([^;]*);", slices["settings"])
    assert settings is not None
    assert names_in(settings[1]) == list(bench.slice("settings"))
    assert set(names_in(settings[1])) == set(Settings.__struct_fields__)
    assert names_in(slices["poses:pID"].rsplit("Stages, in this order:")[1]) == list(get_args(StageId))
    jobs = re.search(r"Names of jobs: ([^.]*)\.", section(document, "Commands"))
    assert jobs is not None
    for name in names_in(jobs[1]):
        assert "there is no job" not in bench.ask("run", photo="none", job=name)["error"]
    assert set(names_in(jobs[1])) == set(bench.workbench.jobs._kinds)
    kinds = re.findall(r'"(\w+)"', re.search(r"kind: ([^}]*)}", slices["served"])[1])  # type: ignore[index]
    assert tuple(kinds) == KINDS
    assert f"?what={'|'.join((*KINDS, STATION))}&" in document


def test_the_events_are_documented(document: str) -> None:
    sent = set()
    for path in (Path(__file__).parents[3] / "app").rglob("*.py"):
        sent |= set(re.findall(r'"event": "(\w+)"', path.read_text(encoding="utf-8")))
    assert set(items(section(document, "Events"))) == sent


def test_every_file_that_the_document_names_exists(document: str, checkout: Path) -> None:
    paths = re.findall(r"\b((?:app|static|ladarreg_core)/[\w/]+(?:\.\w+)?)", document)
    assert len(paths) > 10
    assert [path for path in paths if not (checkout / path).exists()] == []
