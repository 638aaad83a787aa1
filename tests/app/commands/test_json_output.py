"""`--json`: one document on stdout and nothing else; and what `info` says of results."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from ladarreg.cli import main
from ladarreg.exit_codes import ExitCode

from ladarreg_core.errors import LadarregError
from ladarreg_core.export.json import registration_document, write_document
from ladarreg_core.formats import describe
from ladarreg_core.simulate.sample import sample_folder
from ladarreg_core.storage.manifest import visible_files
from testing.scenes.small_registration import sample_registration

SAMPLE = sample_folder()
INPUTS = [str(SAMPLE / "scan.npz"), str(SAMPLE / "photo.png"), "--camera", str(SAMPLE / "camera.json")]


def document(capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    """Return what stdout consists of: one line of strict JSON."""
    out = capsys.readouterr().out
    assert out.count("\n") == 1
    return json.loads(out, parse_constant=pytest.fail)  # type: ignore[no-any-return]


@pytest.mark.slow
def test_register_prints_the_registration_and_where_it_is(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert main(["register", *INPUTS, "-o", str(out), "--json"]) == ExitCode.ACCEPTED
    found = document(capsys)
    output = found.pop("output")
    assert output == {"folder": str(out), "files": visible_files(out)}
    notes = found.pop("notes")
    assert isinstance(notes, list)
    assert found == json.loads((out / "registration.json").read_text())
    assert main(["info", str(out / "registration.json"), "--json"]) == 0
    info = document(capsys)
    assert (info["kind"], info["verdict"]) == ("results", "Accepted: verified against the image.")
    assert info["sigma"]["position_mm"] == pytest.approx(1000 * found["sigma"]["position_m"])
    assert [one.split(" ")[0] for one in info["inputs"]] == ["scan.npz", "photo.png", "camera.json"]
    assert info["rejected_guess"] == {}
    assert main(["info", str(out), "--json"]) == 0
    assert document(capsys) == info


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (["register", "none.npz", "none.jpg", "-o", "out", "--json"], "none.npz"),
        (["apply", *INPUTS, "-o", "out", "--json"], "--pose"),
        (["info", "none", "--json"], "none"),
        (["regster", "--json"], "did you mean register?"),
        (["register", "a", "b", "-o", "c", "--focal-p", "3", "--json"], "--focal-px"),
    ],
)
def test_an_error_is_a_document_too_and_one_line_on_stderr(
    words: list[str], part: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(words) == ExitCode.BAD_INPUT
    captured = capsys.readouterr()
    found = json.loads(captured.out)
    assert set(found) == {"error", "exit_code"}
    assert part in found["error"]
    assert found["exit_code"] == 2
    assert captured.err.endswith(f"ladarreg: {found['error']}\n")


def test_info_of_a_scan_and_a_pose_as_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", INPUTS[0], "--json"]) == 0
    scan = document(capsys)
    assert (scan["kind"], scan["returns"]) == ("scan", 683_826)
    assert main(["info", str(SAMPLE / "truth.json"), "--json"]) == 0
    assert document(capsys)["kind"] == "pose"


EXPORT = {
    "version": 1, "kind": "export", "targets": [{"name": "laz"}], "files": ["export.json", "laz/a.laz"],
    "photos": [{"id": "a", "name": "a", "evidence": "given", "mark": "given, not verified"}],
    "inputs": [{"name": "s.e57", "size": 3, "sha256": "ab"}], "software": {"name": "ladarreg", "version": "1"},
}  # fmt: skip


def test_info_of_other_results(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "export.json"
    path.write_text(json.dumps(EXPORT))
    assert main(["info", str(path)]) == 0
    shown = capsys.readouterr().out
    assert "2 files for laz" in shown
    assert "a (a): given, not verified" in shown
    for damage in ({"photos": 3}, {"photos": [3]}, {"targets": [None]}, {"inputs": [{}]}, {"inputs": {"a": 1}}):
        path.write_text(json.dumps({**EXPORT, **damage}))
        assert main(["info", str(path)]) == ExitCode.BAD_INPUT, damage
        assert "damaged" in capsys.readouterr().err


HOSTILE = (None, 0, -1e308, "a\n\u202e" * 300, [[]], [{}], {"a": [1]}, [{"name": 3}])


def test_damaged_results_end_in_a_description_or_one_sentence(tmp_path: Path) -> None:
    path = tmp_path / "registration.json"
    result = sample_registration()
    write_document(path, registration_document(result, inputs=[SAMPLE / "scan.npz"]))
    fields = json.loads(path.read_text())
    documents = [{**fields, name: value} for name in fields for value in HOSTILE]
    documents += [{**EXPORT, name: value} for name in EXPORT for value in HOSTILE]
    ended = {"described": 0, "refused": 0, "badly refused": 0}
    for document_ in documents:
        path.write_text(json.dumps(document_).replace("-1e+308", "1e400"))
        try:
            describe(path)
            ended["described"] += 1
        except LadarregError as error:
            ended["refused" if str(error).isprintable() else "badly refused"] += 1
    assert ended["badly refused"] == 0
    assert min(ended["described"], ended["refused"]) > 50
