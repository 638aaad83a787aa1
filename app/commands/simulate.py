"""`ladarreg simulate SCENE -o DIR`."""

from __future__ import annotations

import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from app.exit_codes import ExitCode


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """What `simulate` is told."""

    scene: tyro.conf.Positional[Literal["boxes", "desk", "office", "people"]]
    """What to build."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="DIR")]
    """Folder to write; it must not exist, see --force."""
    set: Literal["standard", "hard", "wide", "rotated", "identical", "thermal"] = "standard"
    """How hard it is to register."""
    seed: int = 0
    """Of the scene, its noise and the camera's place."""
    force: bool = False
    """Replace the folder if it exists."""
    debug: bool = False
    """Log, and a trace back where something fails."""


def run(arguments: Arguments) -> ExitCode:
    """Simulate and write `scan.npz`, `photo.png`, `camera.json` and `truth.json`."""
    from ladarreg_core.export.folder import check_folder
    from ladarreg_core.simulate import simulate_case, write_case

    check_folder(arguments.out, force=arguments.force)
    case = simulate_case(arguments.scene, set_name=arguments.set, seed=arguments.seed)
    out = arguments.out.absolute()
    out.parent.mkdir(parents=True, exist_ok=True)
    # Beside the target, so that the rename that publishes it stays on one disk.
    with tempfile.TemporaryDirectory(prefix=f".{out.name}-", dir=out.parent) as aside:
        made = Path(aside) / "case"
        made.mkdir()
        write_case(case, made)
        names = sorted(path.name for path in made.iterdir())
        if out.exists():
            shutil.move(out, Path(aside) / "replaced")
        made.rename(out)
    print(f"Wrote {', '.join(names)} in {arguments.out}")
    return ExitCode.ACCEPTED
