"""`ladarreg simulate SCENE -o DIR`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from ..exit_codes import ExitCode

EXAMPLES = (
    "ladarreg simulate office -o case",
    "ladarreg simulate desk --set hard --seed 7 -o hard-case",
    "ladarreg simulate office --perceptron -o raw-case",
)


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Arguments of `simulate`."""

    scene: tyro.conf.Positional[Literal["boxes", "desk", "office", "people"]]
    """Scene to simulate."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="DIR")]
    """Output folder; an existing one is refused, but see --force."""
    set: Literal[
        "standard", "hard", "wide", "rotated", "identical", "thermal", "gamma", "natural", "equirectangular", "fisheye"
    ] = "standard"
    """Difficulty of the registration; thermal and gamma are other instruments, natural has textures of stone, dense
    print and foliage, equirectangular and fisheye are wide cameras beside a scan of the whole room."""
    seed: int = 0
    """Random seed of the scene, the noise and the camera pose."""
    k1: float = 0.0
    """Radial distortion of the true lens."""
    k1_error: float = 0.0
    """Error added to k1 in camera.json."""
    focal_error: float = 0.0
    """Relative error added to the focal length in camera.json; .05 is 5 percent."""
    seam: bool = False
    """Wide cameras: the back of the camera, where the seam of a panorama is, faces the subject."""
    rolled: bool = False
    """Wide cameras: the camera lies on its side."""
    perceptron: bool = False
    """Write the scan as a Perceptron P5000 does: scan.raw, 512 x 512 packed words, with its descriptor scan.json."""
    force: bool = False
    """Replace DIR if it contains results of an earlier run and nothing else; any other folder is never touched."""
    debug: bool = False
    """Print a log, and a traceback on failure."""


def run(arguments: Arguments) -> ExitCode:
    """Simulate and write `scan.npz` (or `scan.raw` and `scan.json`), `photo.png`, `camera.json` and `truth.json`."""
    from ladarreg_core.export.targets.folder import check_folder, write_folder
    from ladarreg_core.storage.manifest import visible_files

    check_folder(arguments.out, force=arguments.force)  # before the simulation, which takes time
    files = _files(arguments)
    write_folder(arguments.out, lambda: files, force=arguments.force)
    names = visible_files(arguments.out)
    print(f"Wrote {', '.join(names)} in {arguments.out}")
    return ExitCode.ACCEPTED


def _files(arguments: Arguments) -> list[tuple[str, Callable[[Path], None]]]:
    """Return the files of the simulated case, by name, each with a function that writes it."""
    from ladarreg_core.errors import OptionError

    if arguments.set in ("equirectangular", "fisheye"):
        from ladarreg_core.simulate.panorama import PanoramaOptions, panorama_files, simulate_panorama

        if arguments.k1 or arguments.k1_error or arguments.focal_error:
            raise OptionError(
                f"the set {arguments.set} takes no --k1, --k1-error or --focal-error: its lens is exact; omit them"
            )
        if arguments.perceptron:
            raise OptionError(f"the set {arguments.set} has a scan of the whole room, which no P5000 makes; omit one")
        width = 4096 if arguments.set == "equirectangular" else 2400
        wide = PanoramaOptions(lens=arguments.set, width=width, seam=arguments.seam, rolled=arguments.rolled)
        return panorama_files(simulate_panorama(arguments.scene, seed=arguments.seed, options=wide))
    from ladarreg_core.simulate import simulate_case
    from ladarreg_core.simulate.case import case_files
    from ladarreg_core.simulate.perceptron import P5000, perceptron_files

    if arguments.seam or arguments.rolled:
        raise OptionError("--seam and --rolled belong to the sets equirectangular and fisheye; omit them")
    case = simulate_case(
        arguments.scene,
        set_name=arguments.set,
        seed=arguments.seed,
        k1=arguments.k1,
        k1_error=arguments.k1_error,
        focal_error=arguments.focal_error,
        ladar=P5000 if arguments.perceptron else None,
    )
    if arguments.perceptron:
        return [*perceptron_files(case), *(file for file in case_files(case) if file[0] != "scan.npz")]
    return case_files(case)
