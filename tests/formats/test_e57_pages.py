"""Damage anywhere in an E57 file: found by the checksums of its pages."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from ladarreg.cli import main
from ladarreg.exit_codes import ExitCode

from ladarreg_core.errors import FormatError
from ladarreg_core.export.outputs.integrity import check_integrity
from ladarreg_core.formats.e57.pages import _checksums, require_intact_pages
from testing.files.small_scans import e57_fields, e57_file
from testing.scenes.small_registration import sample_scan


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """An intact E57 with two scans, which are described from the header alone."""
    fields = e57_fields(sample_scan())
    return e57_file(tmp_path / "a.e57", [fields, fields])  # type: ignore[arg-type]


def test_the_checksum_is_crc_32c() -> None:
    # RFC 3720, B.4: 32 bytes of zeros, of ones, and counting up
    words = np.array([np.zeros(32, np.uint8), np.full(32, 255, np.uint8), np.arange(32, dtype=np.uint8)]).view("<u4")
    assert _checksums(words).tolist() == [0x8A9136AA, 0x62A8AB43, 0x46DD794E]


def test_an_intact_file_is_described(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert not require_intact_pages(file)
    assert main(["info", str(file)]) == ExitCode.ACCEPTED
    assert main(["check", str(file)]) == ExitCode.ACCEPTED
    assert "nothing is damaged" in capsys.readouterr().out


@pytest.mark.parametrize("part", [0.0, 0.5, 1.0])
def test_one_flipped_bit_is_said_in_one_sentence(file: Path, part: float, capsys: pytest.CaptureFixture[str]) -> None:
    data = bytearray(file.read_bytes())
    page = round(part * (len(data) // 1024 - 1))
    data[page * 1024 + 1000] ^= 1
    file.write_bytes(data)
    with pytest.raises(FormatError, match=f"the first at byte {page * 1024:,}"):
        require_intact_pages(file)
    assert main(["info", str(file)]) == ExitCode.BAD_INPUT
    (line,) = capsys.readouterr().err.splitlines()
    assert file.name in line
    assert "damaged" in line
    assert main(["check", str(file)]) == ExitCode.BAD_INPUT
    assert check_integrity(file).damaged
