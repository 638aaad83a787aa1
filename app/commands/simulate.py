"""`ladarreg simulate SCENE -o DIR`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from ..exit_codes import ExitCode


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """What `simulate` is told."""

    scene: tyro.conf.Positional[Literal["boxes", "desk", "office", "people"]]
    """What to build."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="DIR")]
    """Folder to write; one that exists is refused, but see --force."""
    set: Literal["standard", "hard", "wide", "rotated", "identical", "thermal", "gamma"] = "standard"
    """How hard it is to register; the last two are other instruments."""
    seed: int = 0
    """Of the scene, its noise and the camera's place."""
    k1: float = 0.0
    """Radial distortion of the real lens."""
    k1_error: float = 0.0
    """How much the k1 in camera.json is above the real one."""
    focal_error: float = 0.0
    """How much the focal length in camera.json is above the real one, relative: .05 is 5 percent."""
    force: bool = False
    """Replace DIR if it holds what a command wrote and nothing else; any other folder is left as it is."""
    debug: bool = False
    """Log, and a trace back where something fails."""


def run(arguments: Arguments) -> ExitCode:
    """Simulate and write `scan.npz`, `photo.png`, `camera.json` and `truth.json`."""
    from ladarreg_core.export.folder import check_folder, write_folder
    from ladarreg_core.simulate import simulate_case
    from ladarreg_core.simulate.case import case_files

    check_folder(arguments.out, force=arguments.force)  # before the work, not after it
    case = simulate_case(
        arguments.scene,
        set_name=arguments.set,
        seed=arguments.seed,
        k1=arguments.k1,
        k1_error=arguments.k1_error,
        focal_error=arguments.focal_error,
    )
    write_folder(arguments.out, lambda: case_files(case), force=arguments.force)
    names = sorted(path.name for path in arguments.out.iterdir())
    print(f"Wrote {', '.join(names)} in {arguments.out}")
    return ExitCode.ACCEPTED
