"""Simulated cases of wide cameras: a dome scan, and an equirectangular or fisheye photograph from elsewhere."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from ladarreg_core.camera import CameraModel, EquirectangularCamera, FisheyeCamera
from ladarreg_core.errors import OptionError
from ladarreg_core.formats.documents.pose_file import POSE_FIELD
from ladarreg_core.formats.parsing.json_file import write_json
from ladarreg_core.formats.scans.npz import write_npz_xyz
from ladarreg_core.foundations.progress import Progress, Report
from ladarreg_core.foundations.validation import require_choice, require_int
from ladarreg_core.frames import Rigid, look_along, rotation_about
from ladarreg_core.photo import Photo
from ladarreg_core.scan import Scan
from ladarreg_core.simulate.case import png_of
from ladarreg_core.simulate.photograph import Lighting, take_photograph
from ladarreg_core.simulate.ray_cast import RayCaster
from ladarreg_core.simulate.terrestrial import dome_grid, scan_around
from ladarreg_core.simulate.worlds.scenes import SCENES, build_scene

WideLens = Literal["equirectangular", "fisheye"]
"""Wide cameras that are simulated."""
FISHEYE_FIELD_RAD = float(np.radians(190.0))
"""Field of view of the simulated fisheye lens."""

_BASELINE_M = (0.3, 1.0)
_OTHER_AXIS_M = 0.15
_TILT_RAD = float(np.radians(2.0))
_YAW_RAD = float(np.radians(180.0))
_LIT = Lighting()


@dataclass(frozen=True, slots=True, kw_only=True)
class PanoramaOptions:
    """What a simulated wide photograph and its scan look like."""

    lens: WideLens = "equirectangular"
    """The camera."""
    width: int = 4096
    """Width of the photograph, px; an equirectangular one is half as high, a fisheye one is square."""
    step_deg: float = 0.1
    """Angle between neighbouring rays of the scan."""
    scan_width_deg: float = 360.0
    """Extent of the scan in longitude, centred on the subject."""
    seam: bool = False
    """The camera's back, and so the seam of an equirectangular photograph, faces the subject."""
    rolled: bool = False
    """The camera lies on its side, rolled by 90 degrees."""

    def __post_init__(self) -> None:
        require_choice(self.lens, get_args(WideLens), "the lens")
        require_int(self.width, "the width of the photograph", least=64, most=16_384)
        if not (math.isfinite(self.step_deg) and 0.02 <= self.step_deg <= 2):
            raise OptionError(f"the scan's step is {self.step_deg} deg; it must lie within 0.02 to 2 deg")
        if not (math.isfinite(self.scan_width_deg) and 10 <= self.scan_width_deg <= 360):
            raise OptionError(f"the scan is {self.scan_width_deg} deg wide; it must lie within 10 to 360 deg")

    @property
    def camera(self) -> CameraModel:
        """The true camera."""
        if self.lens == "equirectangular":
            return EquirectangularCamera(self.width, self.width // 2)
        focal = (self.width - 1) / FISHEYE_FIELD_RAD
        middle = (self.width - 1) / 2
        return FisheyeCamera(self.width, self.width, focal, focal, middle, middle, (0.0, 0.0, 0.0, 0.0))


@dataclass(frozen=True, eq=False)
class PanoramaCase:
    """A dome scan and a wide photograph, with the true pose."""

    scan: Scan
    photo: Photo
    camera_from_scanner: Rigid
    """True pose."""


def simulate_panorama(
    scene: str, *, seed: int = 0, options: PanoramaOptions | None = None, report: Report | None = None
) -> PanoramaCase:
    """Simulate a dome scan of a synthetic room and a wide photograph of it; equal arguments give equal bytes.

    Args:
        scene: boxes, desk, office or people.
        seed: not negative; every seed gives another room and pose.
        options: the camera and the scan.
        report: receives the progress.

    Raises:
        OptionError: if the scene does not exist or a number is out of range.
        DependencyError: if `embreex` is not installed.
    """
    o = options or PanoramaOptions()
    require_choice(scene, tuple(SCENES), "the scene")
    require_int(seed, "the seed", least=0)
    streams = np.random.SeedSequence([zlib.crc32(f"{scene}/panorama".encode()), seed]).spawn(4)
    layout, pose_rng, scan_rng, photo_rng = (np.random.default_rng(s) for s in streams)

    def stage(start: int, share: int, label: str) -> Callable[[float], None]:
        def forward(done: float) -> None:
            if report:
                report(Progress(start + round(share * done), 100, label))

        forward(0.0)
        return forward

    stage(0, 10, "building the room")
    world = build_scene(scene, layout=layout)
    caster = RayCaster(world.triangles)
    grid = dome_grid(math.radians(o.step_deg), width_rad=math.radians(o.scan_width_deg))
    ranges, intensity = scan_around(world, caster, grid, rng=scan_rng, report=stage(10, 30, "scanning"))
    name = f"{scene}-{o.lens}-{seed}"
    pose = _pose(o, pose_rng)
    pixels = take_photograph(
        world, caster, o.camera, pose, lighting=_LIT, rng=photo_rng, report=stage(40, 60, "photographing")
    )
    return PanoramaCase(
        Scan(geometry=grid, ranges=ranges, intensity=intensity, name=name),
        Photo(pixels=pixels, camera=o.camera, name=name),
        pose,
    )


def _pose(options: PanoramaOptions, rng: np.random.Generator) -> Rigid:
    """Return a pose beside the scanner that looks anywhere, or away from the subject, tilted by up to two degrees."""
    bearing = float(rng.uniform(-math.pi, math.pi))
    away = float(rng.uniform(*_BASELINE_M))
    centre = [away * math.cos(bearing), away * math.sin(bearing), float(rng.uniform(-1, 1) * _OTHER_AXIS_M)]
    yaw = float(rng.uniform(-1, 1) * _YAW_RAD)
    if options.seam:
        yaw = math.pi + float(rng.uniform(-0.2, 0.2))
    elif options.lens == "fisheye":
        yaw *= 0.3  # a fisheye lens has a front, which is turned to the subject
    pitch, roll = (float(v) for v in rng.uniform(-1, 1, 2) * _TILT_RAD)
    roll += float(rng.choice([-1.0, 1.0])) * math.pi / 2 if options.rolled else 0.0
    ahead = [math.cos(yaw) * math.cos(pitch), math.sin(yaw) * math.cos(pitch), math.sin(pitch)]
    return Rigid.from_centre(rotation_about("z", roll) @ look_along(ahead), np.array(centre))


def panorama_files(case: PanoramaCase) -> list[tuple[str, Callable[[Path], None]]]:
    """Return the names of the files of a case, each with a function that writes it to a path."""
    truth = {POSE_FIELD: case.camera_from_scanner.matrix.tolist(), "made_by": "simulate"}

    def photo(path: Path) -> None:
        path.write_bytes(png_of(case.photo))

    return [
        ("scan.npz", lambda path: write_npz_xyz(path, case.scan)),
        ("photo.png", photo),
        ("camera.json", lambda path: write_json(path, case.photo.camera.as_fields())),
        ("truth.json", lambda path: write_json(path, truth)),
    ]
