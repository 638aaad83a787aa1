"""Checksums of results: the canonical form, and what is refused, trusted or noted where a file was changed."""

from __future__ import annotations

import json
import math
import shutil
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from ladarreg.cli import main
from ladarreg.exit_codes import ExitCode

from ladarreg_core.errors import DegenerateGeometryError, ExportError, FormatError
from ladarreg_core.export.json import find_inputs, hinted_file, write_result
from ladarreg_core.export.outputs.integrity import check_integrity
from ladarreg_core.export.outputs.saved_results import (
    read_saved_result,
    recorded_options,
    recorded_scans,
    registered_results,
)
from ladarreg_core.export.targets.folder import export_registration, registration_files
from ladarreg_core.export.targets.zip_file import write_zip
from ladarreg_core.formats import read_photo, read_scan
from ladarreg_core.formats.documents.own_results import edited_note
from ladarreg_core.formats.documents.pose_file import read_initial
from ladarreg_core.formats.documents.registration_file import read_registration
from ladarreg_core.frames import Rigid
from ladarreg_core.registration.carry import carry_over
from ladarreg_core.simulate.sample import sample_folder
from ladarreg_core.storage.checksums import canonical, checksum, checksum_state, sealed
from ladarreg_core.storage.manifest import MANIFEST_FILE, ListedFile, read_manifest, update_manifest, write_manifest
from testing.scenes.small_registration import sample_photo, sample_registration, sample_scan

SAVED = Path(__file__).parents[2] / "app/workbench/saved_by_0_1"
Edit = Callable[[str], str]

_TEXTS = st.text(st.characters(exclude_categories=["Cs"]), max_size=8)
_PLAIN = (
    st.none() | st.booleans() | st.integers(-(2**53), 2**53) | st.floats(allow_nan=False, allow_infinity=False) | _TEXTS
)
_VALUES = st.recursive(
    _PLAIN, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(_TEXTS, inner, max_size=4), max_leaves=8
)


# The table of appendix B of RFC 8785.
@pytest.mark.parametrize(
    ("bits", "text"),
    [
        ("0000000000000000", "0"), ("8000000000000000", "0"), ("0000000000000001", "5e-324"),
        ("8000000000000001", "-5e-324"), ("7fefffffffffffff", "1.7976931348623157e+308"),
        ("ffefffffffffffff", "-1.7976931348623157e+308"), ("4340000000000000", "9007199254740992"),
        ("c340000000000000", "-9007199254740992"), ("4430000000000000", "295147905179352830000"),
        ("44b52d02c7e14af5", "9.999999999999997e+22"), ("44b52d02c7e14af6", "1e+23"),
        ("44b52d02c7e14af7", "1.0000000000000001e+23"), ("444b1ae4d6e2ef4e", "999999999999999700000"),
        ("444b1ae4d6e2ef4f", "999999999999999900000"), ("444b1ae4d6e2ef50", "1e+21"),
        ("3eb0c6f7a0b5ed8c", "9.999999999999997e-7"), ("3eb0c6f7a0b5ed8d", "0.000001"),
        ("41b3de4355555553", "333333333.3333332"), ("41b3de4355555556", "333333333.3333334"),
        ("becbf647612f3696", "-0.0000033333333333333333"), ("43143ff3c1cb0959", "1424953923781206.2"),
    ],
)  # fmt: skip
def test_numbers_are_written_as_ecmascript_writes_them(bits: str, text: str) -> None:
    (value,) = struct.unpack(">d", bytes.fromhex(bits))
    assert canonical(value).decode() == text


def test_the_examples_of_the_standard() -> None:
    # RFC 8785, 3.2.2 to 3.2.4
    value = {
        "numbers": [333333333.33333329, 1e30, 4.50, 2e-3, 0.000000000000000000000000001],
        "string": "\u20ac$\u000f\u000aA'\u0042\u0022\u005c\\\"/",
        "literals": [None, True, False],
    }
    assert canonical(value).decode() == (
        '{"literals":[null,true,false],"numbers":[333333333.3333333,1e+30,4.5,0.002,1e-27],'
        '"string":"€$\\u000f\\nA\'B\\"\\\\\\\\\\"/"}'
    )
    names = ["\u20ac", "\r", "\ufb33", "1", "\U0001f600", "\u0080", "\u00f6"]
    ordered = ["\r", "1", "\u0080", "\u00f6", "\u20ac", "\U0001f600", "\ufb33"]
    assert list(json.loads(canonical(dict.fromkeys(names)))) == ordered


@given(_VALUES)
def test_the_canonical_form_is_the_same_value_and_its_own_canonical_form(value: Any) -> None:
    text = canonical(value)
    assert json.loads(text, parse_int=float) == value  # as doubles
    assert canonical(json.loads(text)) == text
    again = json.loads(json.dumps(value, indent=3, sort_keys=True))
    assert canonical(again) == text


@given(st.dictionaries(_TEXTS, _VALUES, max_size=4))
def test_sealed_fields_are_intact_however_they_are_formatted(fields: dict[str, Any]) -> None:
    found = json.loads(json.dumps(sealed(fields), indent=2, sort_keys=True))
    assert checksum_state(found) == "intact"
    assert checksum_state({**found, "one more": 1}) == "edited" or "one more" in fields
    assert sealed(sealed(fields)) == sealed(fields)


@pytest.mark.parametrize("value", [math.nan, math.inf, 10**400, "\ud800", {"\udfff": 1}, {1: 2}, b"x", object()])
def test_what_has_no_canonical_form_is_no_intact_document(value: Any) -> None:
    with pytest.raises((ValueError, TypeError)):
        canonical({"a": value})
    assert checksum_state({"a": value, "sha256": "0" * 64}) == "edited"


def test_hostile_checksums_are_wrong_ones() -> None:
    deep: Any = 1
    for _ in range(100_000):
        deep = [deep]
    assert checksum_state({"a": deep, "sha256": "0"}) == "edited"
    for stated in (None, 5, [], {}, "", checksum({"a": 1}).upper()):
        assert checksum_state({"a": 1, "sha256": stated}) == "edited"
    assert checksum_state({"a": 1}) == "no checksum"


def test_a_number_without_a_place_in_json_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(ExportError, match="too large"):
        write_result(tmp_path / "registration.json", {"seed": 10**400})
    assert not list(tmp_path.iterdir())


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A result on the embedded sample, whose inputs lie in another folder beside it."""
    home = tmp_path_factory.mktemp("home")
    (home / "data").mkdir()
    shutil.copy(sample_folder() / "photo.png", home / "data")
    shutil.copy(sample_folder() / "scan.npz", home / "data")
    from dataclasses import replace

    scan = read_scan(home / "data/scan.npz")
    photo = read_photo(home / "data/photo.png", camera=sample_folder() / "camera.json")
    found = replace(sample_registration(), camera=photo.camera)
    export_registration(home / "runs/out", found, scan, photo)
    return home


@pytest.fixture
def home(written: Path, tmp_path: Path) -> Path:
    """A copy of the result and its inputs, as it was moved."""
    shutil.copytree(written, tmp_path / "moved")
    return tmp_path / "moved"


def fields_of(file: Path) -> dict[str, Any]:
    found = json.loads(file.read_bytes())
    assert isinstance(found, dict)
    return found


def flip_digit(file: Path, *, after: str = '"camera_from_scanner": [\n  [0.0, -1.0, 0.0, -0.') -> None:
    """Change one digit of a document; by default of the translation."""
    text = file.read_text(encoding="utf-8")
    start = text.index(after) + len(after)
    at = next(k for k in range(start, len(text)) if text[k].isdigit())
    file.write_text(text[:at] + str((int(text[at]) + 1) % 10) + text[at + 1 :], encoding="utf-8")


def refused(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    """Run a command, which must refuse in one sentence with exit code 2."""
    capsys.readouterr()
    assert main([str(word) for word in words]) == ExitCode.BAD_INPUT
    (line,) = capsys.readouterr().err.splitlines()
    return str(line)


@pytest.mark.slow
def test_results_from_python_state_their_inputs_and_are_found_again(written: Path, home: Path) -> None:
    document = fields_of(home / "runs/out/registration.json")
    names = ["scan.npz", "photo.png", "camera.json"]
    assert [one["name"] for one in document["inputs"]] == names
    assert [one["path_hint"] for one in document["inputs"][:2]] == ["../../data/scan.npz", "../../data/photo.png"]
    assert document["inputs"][1]["read_with"] == {"camera": "camera.json"}
    handed = registered_results([read_saved_result(home / "runs/out")])
    assert handed.scan_file.samefile(home / "data/scan.npz")
    assert handed.photos[0].file.samefile(home / "data/photo.png")
    # the control: a file of the same name and size with other bytes is not taken
    data = bytearray((home / "data/photo.png").read_bytes())
    data[-20] ^= 1
    (home / "data/photo.png").write_bytes(data)
    with pytest.raises(ExportError, match=r"photo\.png is needed"):
        registered_results([read_saved_result(home / "runs/out")])


def test_hints_are_followed_within_given_folders_only_and_tell_nothing(home: Path) -> None:
    record = fields_of(home / "runs/out/registration.json")["inputs"][0]
    out = home / "runs/out"
    assert hinted_file(record, out) == (home / "data/scan.npz").resolve()
    assert hinted_file(record, out, within=[home / "data"]) is not None
    answers = set()
    for within, hint in (([home / "runs"], record["path_hint"]), ([home / "runs"], "../../data/missing.npz")):
        with pytest.raises(ExportError) as error:
            find_inputs([{**record, "path_hint": hint}], [home / "runs"], beside=out, within=within)
        answers.add(str(error.value))
    assert len(answers) == 1
    (home / "runs/link.npz").symlink_to(home / "data/scan.npz")
    assert hinted_file({**record, "path_hint": "../link.npz"}, out, within=[home / "runs"]) is None


@pytest.mark.parametrize(
    "hint", [5, None, [], "", "/etc/passwd", "\0", "../" * 3000, "..", ".", "/dev/zero", "../../../../dev/stdin"]
)
def test_hostile_hints_find_nothing(home: Path, hint: Any) -> None:
    record = fields_of(home / "runs/out/registration.json")["inputs"][0]
    assert hinted_file({**record, "path_hint": hint}, home / "runs/out") is None
    assert hinted_file({**record, "size": None}, home / "runs/out") is None


def test_a_zip_has_a_manifest_and_no_hints(tmp_path: Path) -> None:
    registration, scan, photo = sample_registration(), sample_scan(), sample_photo()
    source = sample_folder() / "photo.png"
    write_zip(tmp_path / "a.zip", lambda: registration_files(registration, scan, photo, [source, source])[:2])
    shutil.unpack_archive(tmp_path / "a.zip", tmp_path / "out")
    assert sorted(read_manifest(tmp_path / "out") or {}) == ["registration.json", "report.html"]
    assert not check_integrity(tmp_path / "out").damaged
    assert all("path_hint" not in one for one in fields_of(tmp_path / "out/registration.json")["inputs"])


def test_one_flipped_digit_is_refused_in_one_sentence(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    result = home / "runs/out"
    assert main(["check", str(result)]) == ExitCode.ACCEPTED
    assert "nothing is damaged" in capsys.readouterr().out
    flip_digit(result / "registration.json")
    for words in (
        ("export", result, "--to", "report", "-o", home / "e"), ("report", result), ("info", result),
        ("info", result / "registration.json"),
    ):  # fmt: skip
        line = refused(capsys, *words)
        assert "registration.json" in line
        assert "checksum" in line
        assert "--trust-edited" in line
    assert not (home / "e").exists()
    with pytest.raises(FormatError, match="checksum"):
        read_registration(result / "registration.json")
    assert main(["check", str(result)]) == ExitCode.BAD_INPUT
    assert capsys.readouterr().out.startswith("Damaged  registration.json: it does not match its own checksum")


@pytest.mark.slow
def test_trusted_results_are_given_not_verified_everywhere(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    result = home / "runs/out"
    before = read_registration(result / "registration.json")
    flip_digit(result / "registration.json")
    words = ["export", str(result), "--to", "report", "-o", str(home / "e"), "--trust-edited"]
    assert main(words) == ExitCode.ACCEPTED
    assert "given, not verified" in capsys.readouterr().out
    (photo,) = fields_of(home / "e/export.json")["photos"]
    assert (photo["accepted"], photo["evidence"], photo["mark"]) == (False, "given", "given, not verified")
    again = fields_of(home / "e/report/photo.json")
    assert (again["accepted"], again["evidence"], again["covariance"]) == (False, "given", None)
    assert checksum_state(again) == "intact"
    assert "given, not verified" in (home / "e/report/photo.html").read_text(encoding="utf-8")
    assert main(["info", str(result), "--trust-edited"]) == ExitCode.ACCEPTED
    shown = capsys.readouterr().out
    assert "wrong: the file was changed" in shown
    assert "Accepted" not in shown
    found = read_registration(result / "registration.json", trust_edited=True)
    assert before.accepted
    assert not found.accepted
    assert found.mark
    with pytest.raises(DegenerateGeometryError):
        carry_over(found, Rigid.identity(), sample_photo())


def test_a_refused_result_stays_refused_when_trusted(tmp_path: Path) -> None:
    from dataclasses import replace

    poor = replace(sample_registration(), accepted=False, evidence="none", reasons=("Too little.",))
    export_registration(tmp_path / "out", poor, sample_scan(), sample_photo())
    file = tmp_path / "out/registration.json"
    fields = {**fields_of(file), "accepted": True, "evidence": "image"}
    file.write_text(json.dumps(fields))
    with pytest.raises(FormatError, match="checksum"):
        read_registration(file)
    assert not read_registration(file, trust_edited=True).is_shown


def test_as_an_initial_pose_an_edited_file_is_noted(home: Path) -> None:
    file = home / "runs/out/registration.json"
    assert not edited_note(file)
    flip_digit(file)
    assert edited_note(file).startswith("registration.json: it does not match")
    assert isinstance(read_initial(file, None), Rigid)
    scan, photo = home / "data/scan.npz", home / "data/photo.png"
    assert recorded_options(file, scan, photo) == {}
    assert recorded_scans(file, scan) == ([], [])
    assert not edited_note(sample_folder() / "truth.json")
    assert not edited_note(home / "none.json")


def test_reformatted_documents_are_intact(home: Path) -> None:
    file = home / "runs/out/registration.json"
    file.write_text(json.dumps(fields_of(file), indent=4, sort_keys=True))
    assert read_registration(file).accepted
    assert not check_integrity(file.parent).damaged


def test_a_document_of_another_run_is_refused(home: Path) -> None:
    file = home / "runs/out/registration.json"
    file.write_text(json.dumps(sealed({**fields_of(file), "seed": 4711})))
    with pytest.raises(FormatError, match="manifest"):
        read_registration(file)
    assert check_integrity(file.parent).damaged == ("registration.json is not what was written (another SHA-256)",)


def test_other_files_are_compared_with_the_manifest(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    result = home / "runs/out"
    data = bytearray((result / "labels.png").read_bytes())
    data[-10] ^= 1
    (result / "labels.png").write_bytes(data)
    (result / "model.glb").write_bytes(b"glTF")
    (result / "cloud.ply").unlink()
    assert main(["check", str(result), "--json"]) == ExitCode.BAD_INPUT
    found = json.loads(capsys.readouterr().out)
    assert found["kind"] == "result"
    assert [line.split()[0] for line in found["damaged"]] == ["cloud.ply", "labels.png", "model.glb"]
    update_manifest(result, ["labels.png", "model.glb"])
    assert check_integrity(result).damaged == ("cloud.ply is missing",)


def test_a_report_that_is_written_again_is_listed_again(home: Path) -> None:
    result = home / "runs/out"
    assert main(["report", str(result), "--quiet"]) == ExitCode.ACCEPTED
    assert not check_integrity(result).damaged


@pytest.mark.parametrize(
    "content",
    [b"", b"{}", b"[]", b"nonsense", b'{"kind":"manifest","files":[]}', b"[" * 50_000, b'{"a":NaN}',
     json.dumps(sealed({"kind": "manifest", "files": [{"name": "../x", "size": 1, "sha256": "0"}]})).encode(),
     json.dumps(sealed({"kind": "manifest", "files": [{"name": 5, "size": "a"}]})).encode(),
     json.dumps(sealed({"kind": "manifest", "files": 5})).encode()],
)  # fmt: skip
def test_a_damaged_manifest_is_one_sentence(home: Path, content: bytes, capsys: pytest.CaptureFixture[str]) -> None:
    result = home / "runs/out"
    (result / MANIFEST_FILE).write_bytes(content)
    assert MANIFEST_FILE in refused(capsys, "info", result)
    assert any(MANIFEST_FILE in line for line in check_integrity(result).damaged)
    (result / MANIFEST_FILE).unlink()
    found = check_integrity(result)
    assert not found.damaged
    assert MANIFEST_FILE in found.notes[0]
    assert read_registration(result / "registration.json").accepted


@pytest.mark.parametrize(
    "edit",
    [
        lambda text: text.replace('"version": 1,', '"version": 1e999,'),
        lambda text: text.replace('"version": 1,', f'"version": {10**400},'),
        lambda text: text.replace('"version": 1,', '"version": NaN,'),
        lambda text: text.replace('"accepted": true', '"accepted": false, "accepted": true'),
        lambda text: text.replace('"version": 1,', f'"version": {"[" * 900}0{"]" * 900},'),
        lambda text: text.replace('"version": 1,', f'"version": {"[" * 100_000}0{"]" * 100_000},'),
        lambda text: text.replace('"version": 1,', '"version": "\\ud800",'),
        lambda text: text.replace('"sha256": "', '"sha256": "0', 1),
    ],
    ids=["infinite", "too large", "not a number", "twice", "deep", "deeper", "half a pair", "another hash"],
)
def test_hostile_documents_are_refused_in_one_sentence(
    home: Path, edit: Edit, capsys: pytest.CaptureFixture[str]
) -> None:
    file = home / "runs/out/registration.json"
    text = file.read_text(encoding="utf-8")
    assert edit(text) != text
    file.write_text(edit(text), encoding="utf-8")
    assert "registration.json" in refused(capsys, "export", file.parent, "--to", "report", "-o", home / "e")
    assert check_integrity(file.parent).damaged


@pytest.mark.parametrize("name", ["stations.json", "rig.json", "export.json"])
def test_every_kind_of_document_is_checked(tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    pose = np.eye(4).tolist()
    documents: dict[str, dict[str, Any]] = {
        "stations.json": {"version": 1, "kind": "stations", "software": {}, "loops": [], "pairs": [], "reasons": [],
                          "stations": [{"name": "a", "scan": "a.npz", "state": "fixed", "world_from_scanner": pose}]},
        "rig.json": {"version": 1, "kind": "rig", "software": {}, "camera_from_scanner": pose, "accepted": True,
                     "reasons": [], "pairs": []},
        "export.json": {"version": 1, "kind": "export", "software": {}, "targets": [], "files": ["a.npz"]},
    }  # fmt: skip
    np.savez(tmp_path / "a.npz", x=np.arange(5))
    file = tmp_path / name
    write_result(file, documents[name])
    write_manifest(tmp_path)
    assert main(["info", str(file)]) == ExitCode.ACCEPTED
    assert "checksum" in capsys.readouterr().out
    assert not check_integrity(tmp_path).damaged
    assert not check_integrity(file).damaged
    flip_digit(file, after='"version":')
    assert "does not match its own checksum" in refused(capsys, "info", file)
    if name == "stations.json":
        words = ["export", tmp_path, "--to", "e57", "-o", tmp_path / "out"]
        assert "--trust-edited" in refused(capsys, *words)
    assert check_integrity(file).damaged
    assert check_integrity(tmp_path).damaged
    # the control: without its field it is a document of an earlier version
    (tmp_path / MANIFEST_FILE).unlink()
    write_result(file, documents[name])
    old = fields_of(file)
    del old["sha256"]
    file.write_text(json.dumps(old))
    found = check_integrity(tmp_path)
    assert not found.damaged
    assert any("no checksum" in note for note in found.notes)
    (tmp_path / "a.npz").write_bytes(b"PK damaged")
    assert check_integrity(tmp_path).damaged


def test_results_of_earlier_versions_open_without_a_checksum(capsys: pytest.CaptureFixture[str]) -> None:
    for folder in (SAVED, SAVED / "project"):
        assert main(["check", str(folder)]) == ExitCode.ACCEPTED
        assert "no checksum" in capsys.readouterr().out
    assert main(["info", str(SAVED / "registration.json")]) == ExitCode.ACCEPTED
    assert "no checksum" in capsys.readouterr().out
    assert not edited_note(SAVED / "registration.json")


def test_what_is_none_of_ours_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "is no project, result, run or export" in refused(capsys, "check", tmp_path)
    (tmp_path / "a.txt").write_text("a")
    assert "a.txt" in refused(capsys, "check", tmp_path / "a.txt")
    assert "nothing" in refused(capsys, "check", tmp_path / "nothing")


def test_a_listed_file_states_its_own_checksum(tmp_path: Path) -> None:
    write_result(tmp_path / "rig.json", {"a": 1.0})
    one = ListedFile.of(tmp_path / "rig.json", "rig.json")
    assert one.document_sha256 == checksum({"a": 1})
    assert not one.fault(tmp_path)
    assert ListedFile.of(tmp_path / "rig.json", "other.json").document_sha256 is None
