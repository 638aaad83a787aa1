"""The command line as tests use it: words that register the sample, and what a refusal prints."""

from __future__ import annotations

import pytest

from ladarreg_core.simulate.sample import sample_folder


def complaint(capsys: pytest.CaptureFixture[str]) -> str:
    """Return the single line on stderr."""
    captured = capsys.readouterr()
    steps = ("Read ", "Prepare photo ", "Compute channels ")
    lines = [line for line in captured.err.splitlines() if not line.startswith(steps)]
    assert len(lines) == 1, captured.err
    assert lines[0].startswith("ladarreg: ")
    assert "Traceback" not in captured.err
    return lines[0]


def sample(*more: str) -> list[str]:
    """Return the words that register the embedded sample."""
    folder = sample_folder()
    return [
        "register",
        str(folder / "scan.npz"),
        str(folder / "photo.png"),
        "--camera",
        str(folder / "camera.json"),
        *more,
    ]
