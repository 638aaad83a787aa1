"""A scan of a whole room with two photographs in opposite directions, for the page and its overview strip."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ladarreg_core.camera import Camera
from ladarreg_core.formats.scans.npz import write_npz_panorama
from ladarreg_core.frames import Rigid, look_along
from ladarreg_core.photo import Photo
from ladarreg_core.scan import Scan
from ladarreg_core.simulate.case import png_of
from ladarreg_core.simulate.photograph import Lighting, take_photograph
from ladarreg_core.simulate.ray_cast import RayCaster
from ladarreg_core.simulate.terrestrial import dome_grid, scan_around
from ladarreg_core.simulate.worlds.scenes import build_scene

AHEAD, BEHIND = ("ahead", (1.0, 0.25, 0.0), (0.1, -0.3, 0.1)), ("behind", (-1.0, 0.12, -0.05), (-0.2, 0.3, 0.05))


@dataclass(frozen=True)
class WholeRoom:
    """The scan, and its photographs with their true poses, by name."""

    scan: Scan
    photos: dict[str, Photo]
    poses: dict[str, Rigid]

    def write(self, folder: Path) -> None:
        """Write `scan.npz`, and a photograph with its camera by each name."""
        folder.mkdir(parents=True, exist_ok=True)
        write_npz_panorama(folder / "scan.npz", self.scan)
        for name, photo in self.photos.items():
            (folder / f"{name}.png").write_bytes(png_of(photo))
        focal = next(iter(self.photos.values())).camera.focal_px
        (folder / "camera.json").write_text(json.dumps({"focal_px": focal}), encoding="utf-8")


def whole_room(*, step_deg: float = 0.3, width: int = 720, seed: int = 3) -> WholeRoom:
    """Make the room; the second photograph looks across the seam behind the scanner."""
    rng = np.random.default_rng(seed)
    world = build_scene("office", layout=rng, all_around=True)
    caster, grid = RayCaster(world.triangles), dome_grid(np.radians(step_deg))
    scan = Scan(grid, *scan_around(world, caster, grid, rng=rng))
    camera = Camera.from_focal(width, width * 2 // 3, width * 0.9)
    photos, poses = {}, {}
    for name, towards, centre in (AHEAD, BEHIND):
        poses[name] = Rigid.from_centre(look_along(towards), centre)
        pixels = take_photograph(world, caster, camera, poses[name], lighting=Lighting(), rng=rng)
        photos[name] = Photo(pixels, camera)
    return WholeRoom(scan, photos, poses)
