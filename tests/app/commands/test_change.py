"""`ladarreg change`: two scans in one frame, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from ladarreg.cli import main
from ladarreg.exit_codes import ExitCode

from ladarreg_core.scanner.grids import AzimuthElevation


def write_wall(path: Path, seed: int, *, panel_m: float = 0.0) -> None:
    """Write a scan of a wall, of which the middle stands out."""
    rays = AzimuthElevation(80, 100, 0.01, 0.01).rays.astype(float)
    depth = np.full(rays.shape[:2], 3.0)
    depth[30:50, 40:60] -= panel_m
    ranges = depth / rays[..., 0] + np.random.default_rng(seed).normal(0, 0.002, depth.shape)
    np.savez(path, xyz=ranges[..., None] * rays, intensity=np.full(depth.shape, 100.0))


@pytest.mark.slow
def test_a_panel_on_a_wall_is_found_and_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_wall(tmp_path / "a.npz", 1)
    write_wall(tmp_path / "b.npz", 2, panel_m=0.05)
    out = tmp_path / "out"
    words = ["change", str(tmp_path / "a.npz"), str(tmp_path / "b.npz"), "--poses", "keep", "-o", str(out), "--quiet"]
    assert main([*words, "--json"]) == ExitCode.ACCEPTED
    fields = json.loads(capsys.readouterr().out)
    assert fields["largest_m"] == pytest.approx(0.05, abs=0.01)
    assert {path.name for path in out.iterdir()} >= {"change.json", "change.ply", "change.png"}
    assert main(words) == ExitCode.BAD_INPUT
    assert "--force" in capsys.readouterr().err
    assert main([*words, "--force"]) == ExitCode.ACCEPTED
    assert "5 % by chance" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("more", "complaint"),
    [(["--radius", "0"], "radius"), (["--spacing", "-1"], "spacing"), (["--reach", "nan"], "reach")],
)
def test_bad_lengths_are_refused_in_a_sentence(
    tmp_path: Path, more: list[str], complaint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    write_wall(tmp_path / "a.npz", 1)
    words = ["change", str(tmp_path / "a.npz"), str(tmp_path / "a.npz"), "--poses", "keep", "--quiet"]
    assert main([*words, "-o", str(tmp_path / "out"), *more]) == ExitCode.BAD_INPUT
    (line,) = capsys.readouterr().err.splitlines()
    assert complaint in line
    assert not (tmp_path / "out").exists()
