"""Several photographs that one camera took around one scan of a furnished room, and one of another room."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from ladarreg_core.camera import Camera
from ladarreg_core.formats.scans.npz import write_npz_counts
from ladarreg_core.foundations.arrays import ByteArray
from ladarreg_core.frames import Rigid, ThesisParameters
from ladarreg_core.scanner.grids import AzimuthElevation
from ladarreg_core.simulate.case import CAMERA, case_world
from ladarreg_core.simulate.ladar import Ladar, LadarImages, scan_world
from ladarreg_core.simulate.photograph import Lighting, take_photograph
from ladarreg_core.simulate.ray_cast import RayCaster
from ladarreg_core.simulate.worlds.world import World
from testing.scenes.kept import kept

_QUALITY = 95
_EXIF_IFD, _MAKE, _MODEL, _FOCAL_35MM, _LENS = 0x8769, 0x010F, 0x0110, 0xA405, 0xA434
_FILM_DIAGONAL_MM = float(np.hypot(36, 24))


@dataclass(frozen=True)
class PhotoSet:
    """What one scanner and one camera measured in a room."""

    images: LadarImages
    ladar: Ladar
    pixels: list[ByteArray]
    """(H, W, 3) uint8 each."""
    poses: list[Rigid]
    """The true `camera_from_scanner` of each."""
    camera: Camera
    """The true camera."""


def simulate_photo_set(
    scene: str = "office", *, seed: int = 0, photos: int = 6, camera: Camera = CAMERA, ladar: Ladar | None = None
) -> PhotoSet:
    """Simulate a scan and photographs from all around the scanner; equal arguments give equal pixels.

    Args:
        scene: a scene of `simulate_case`.
        seed: of the room, the poses and the noise.
        photos: number of photographs.
        camera: the true camera.
        ladar: the scanner; None: that of the thesis.
    """
    world = case_world(scene, seed=seed)
    caster, rng = RayCaster(world.triangles), np.random.default_rng([seed, 407])
    scanner = ladar or Ladar()
    images = scan_world(world, caster, rng=rng, ladar=scanner)
    poses = [_pose(world, rng) for _ in range(photos)]
    lighting = Lighting()
    pixels = [take_photograph(world, caster, camera, pose, lighting=lighting, rng=rng) for pose in poses]
    return PhotoSet(images, scanner, pixels, poses, camera)


@kept
def small_photo_set(scene: str, *, seed: int, photos: int) -> PhotoSet:
    """Return a set that is registered in a second a photograph."""
    step = float(np.radians(0.11))
    ladar = Ladar(geometry=AzimuthElevation(rows=350, columns=500, d_azimuth_rad=step, d_elevation_rad=step))
    camera = Camera(480, 320, 609.0, 609.0, 241.0, 157.0, (-0.02, 0.0, 0.0, 0.0))
    return simulate_photo_set(scene, seed=seed, photos=photos, camera=camera, ladar=ladar)


def write_photo_set(folder: Path, found: PhotoSet, *, focal_error: float = 0.0, model: str = "P1") -> list[Path]:
    """Write `scan.npz` and the photographs as a phone would, JPEG with EXIF, and return the photographs' paths.

    Args:
        folder: an existing folder.
        found: the measurements.
        focal_error: relative error of the focal length in EXIF.
        model: of the camera in EXIF.
    """
    write_npz_counts(
        folder / "scan.npz", counts=found.images.counts, intensity=found.images.intensity,
        geometry=found.ladar.geometry, r0_m=found.ladar.r0_m, dr_m=found.ladar.dr_m,
    )  # fmt: skip
    paths = [folder / f"IMG_{number:04}.jpg" for number in range(1, len(found.pixels) + 1)]
    for path, pixels in zip(paths, found.pixels, strict=True):
        write_phone_photo(path, pixels, found.camera, focal_error=focal_error, model=model)
    return paths


def write_phone_photo(
    path: Path, pixels: ByteArray, camera: Camera, *, focal_error: float = 0.0, model: str = "P1"
) -> None:
    """Write a JPEG whose EXIF states body, lens and the 35 mm equivalent of a focal length with an error."""
    focal_px = camera.focal_px * (1 + focal_error)
    exif = Image.Exif()
    exif[_MAKE], exif[_MODEL] = "Simulated", model
    exif.get_ifd(_EXIF_IFD).update(
        {_FOCAL_35MM: round(focal_px * _FILM_DIAGONAL_MM / float(np.hypot(*camera.size)), 4), _LENS: "main"}
    )
    Image.fromarray(pixels).save(path, quality=_QUALITY, subsampling=0, exif=exif)


def _pose(world: World, rng: np.random.Generator) -> Rigid:
    """Return a pose beside the scanner that looks at the scene, as a hand holds a camera."""
    left = float(rng.choice([-1.0, 1.0]) * rng.uniform(0.1, 0.9))
    up, ahead = float(rng.uniform(-0.3, 0.3)), float(rng.uniform(-0.2, 0.5))
    pan = np.degrees(np.arctan2(left, world.focus_m)) + rng.uniform(-4, 4)
    alpha, beta, gamma = np.radians([float(np.clip(pan, -14, 14)), *rng.uniform(-3, 3, 2)])
    return ThesisParameters(Tx=left, Ty=up, Tz=ahead, alpha=alpha, beta=beta, gamma=gamma).pose
