"""The tokens of a port: kept between starts, private, and replaced on request."""

from __future__ import annotations

import json
import os
import stat
import sys
from pathlib import Path

import pytest
from ladarreg.gateway.tokens import kept_tokens

POSIX = pytest.mark.skipif(os.name == "nt", reason="modes of POSIX")


def files_of(folder: Path) -> list[Path]:
    return sorted(folder.iterdir())


def test_the_tokens_of_a_port_stay_until_new_ones_are_wanted(tmp_path: Path) -> None:
    folder = tmp_path / "tokens"
    first = kept_tokens(folder, 8700)
    assert first.edit != first.look
    assert min(len(first.edit), len(first.look)) >= 30
    assert kept_tokens(folder, 8700) == first
    other = kept_tokens(folder, 8701)
    assert not {first.edit, first.look} & {other.edit, other.look}, "a link to one workbench does not open another"
    renewed = kept_tokens(folder, 8700, renew=True)
    assert not {first.edit, first.look} & {renewed.edit, renewed.look}
    assert kept_tokens(folder, 8700) == renewed
    assert len(files_of(folder)) == 2, "nothing else is left"


def test_tokens_of_any_port_are_not_kept(tmp_path: Path) -> None:
    first, second = (kept_tokens(tmp_path / "tokens", None) for _ in range(2))
    assert not {first.edit, first.look} & {second.edit, second.look}
    assert not (tmp_path / "tokens").exists()


def test_a_chosen_token_is_not_kept(tmp_path: Path) -> None:
    chosen = kept_tokens(tmp_path / "tokens", 8700, chosen="the-operators-own")
    assert chosen.edit == "the-operators-own"
    assert "the-operators-own" not in files_of(tmp_path / "tokens")[0].read_text()
    assert kept_tokens(tmp_path / "tokens", 8700).look == chosen.look


@POSIX
def test_only_the_user_can_read_them(tmp_path: Path) -> None:
    before = os.umask(0)
    try:
        kept_tokens(tmp_path / "data" / "tokens", 8700)
    finally:
        os.umask(before)
    (file,) = files_of(tmp_path / "data" / "tokens")
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert stat.S_IMODE(file.parent.stat().st_mode) == 0o700


@POSIX
@pytest.mark.parametrize("mode", [0o640, 0o604, 0o666])
def test_tokens_that_others_could_read_are_replaced(tmp_path: Path, mode: int) -> None:
    first = kept_tokens(tmp_path / "tokens", 8700)
    (file,) = files_of(tmp_path / "tokens")
    file.chmod(mode)
    second = kept_tokens(tmp_path / "tokens", 8700)
    assert second.edit != first.edit
    assert stat.S_IMODE(file.stat().st_mode) == 0o600


@pytest.mark.parametrize(
    "text",
    ["", "{", "[]", '{"edit": 1, "look": 2}', '{"edit": "short", "look": "short too"}',
     json.dumps({"edit": "the same for both", "look": "the same for both"}), '{"edit": "' + "x" * 5000],
)  # fmt: skip
def test_a_damaged_file_is_replaced(tmp_path: Path, text: str) -> None:
    kept_tokens(tmp_path / "tokens", 8700)
    (file,) = files_of(tmp_path / "tokens")
    file.write_text(text)
    found = kept_tokens(tmp_path / "tokens", 8700)
    assert kept_tokens(tmp_path / "tokens", 8700) == found


@pytest.mark.skipif(sys.platform == "win32" or os.geteuid() == 0, reason="needs a folder that cannot be written")
def test_without_a_folder_the_tokens_are_of_this_start_only(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    assert kept_tokens(tmp_path / "tokens", 8700) != kept_tokens(tmp_path / "tokens", 8700)
    tmp_path.chmod(0o700)


def test_a_file_in_the_way_does_not_prevent_the_start(tmp_path: Path) -> None:
    (tmp_path / "tokens").write_text("no folder")
    assert kept_tokens(tmp_path / "tokens", 8700) != kept_tokens(tmp_path / "tokens", 8700)
