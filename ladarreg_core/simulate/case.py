"""Simulated cases: a scan, a photograph from elsewhere and the true pose, in memory and as files."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from ladarreg_core.camera import Camera
from ladarreg_core.errors import ExportError, OptionError
from ladarreg_core.formats.cameras.camera_file import write_camera
from ladarreg_core.formats.documents.pose_file import POSE_FIELD
from ladarreg_core.formats.parsing.json_file import write_json
from ladarreg_core.formats.scans.npz import write_npz_counts
from ladarreg_core.foundations.progress import Progress, Report
from ladarreg_core.foundations.temperatures import CENTIKELVIN_K, centikelvin
from ladarreg_core.foundations.validation import require_int
from ladarreg_core.frames import Rigid, ThesisParameters
from ladarreg_core.photo import Photo, thermal_photo
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import range_from_counts
from ladarreg_core.simulate.gamma import GAMMA_CAMERA, take_gamma_image
from ladarreg_core.simulate.ladar import LADAR, Ladar, scan_world
from ladarreg_core.simulate.photograph import Lighting, take_photograph
from ladarreg_core.simulate.ray_cast import RayCaster
from ladarreg_core.simulate.thermal import THERMAL_CAMERA, take_thermal_image
from ladarreg_core.simulate.worlds.scenes import SCENES, build_scene
from ladarreg_core.simulate.worlds.world import World

CAMERA = Camera.from_focal(768, 512, 974.0)
"""A 35 mm lens before a small frame."""

Instrument = Literal["colour", "thermal", "gamma"]
_CAMERAS: dict[Instrument, Camera] = {"colour": CAMERA, "thermal": THERMAL_CAMERA, "gamma": GAMMA_CAMERA}


@dataclass(frozen=True)
class CaseSet:
    """Parameters of a set of cases."""

    baseline_m: tuple[float, float] = (0.3, 1.0)
    """Lateral baseline, to either side."""
    other_axes_m: float = 0.15
    """Largest offset along the other two axes."""
    toe_in_limit_deg: float = 12.0
    tilt_deg: float = 2.0
    """Largest pitch and roll, to either side."""
    rolls_deg: tuple[float, ...] = (0.0,)
    """Rolls of the photograph, one chosen by the seed."""
    independent_inks: bool = False
    natural: bool = False
    """Whether textures have the spectrum of natural images."""
    speckle: float = 0.06
    noise: float = 1.0
    lighting: Lighting = field(default_factory=Lighting)
    instrument: Instrument = "colour"
    """Instrument that takes the photograph."""


SETS = {
    "standard": CaseSet(),
    "hard": CaseSet(
        independent_inks=True,
        speckle=0.15,
        noise=2.0,
        lighting=Lighting(ambient=0.22, strength=(1.25,), tints=((1.0, 0.93, 0.82),)),
    ),
    # At 2 m to the side, 12 degrees of toe-in would leave half of the photo without scan.
    "wide": CaseSet(baseline_m=(1.4, 2.2), toe_in_limit_deg=26.0),
    "rotated": CaseSet(rolls_deg=(30.0, 90.0, 180.0, -90.0, -30.0)),
    "identical": CaseSet(baseline_m=(0.0, 0.0), other_axes_m=0.0, toe_in_limit_deg=0.0, tilt_deg=0.0),
    "thermal": CaseSet(instrument="thermal"),
    "gamma": CaseSet(instrument="gamma"),
    "natural": CaseSet(natural=True),
}
"""The sets by name."""


@dataclass(frozen=True, eq=False)
class SimulatedCase:
    """Measurements of the instruments, with the true pose and camera."""

    scan: Scan
    photo: Photo
    """Photograph with the stated camera, which may be wrong on purpose."""
    camera_from_scanner: Rigid
    """True pose."""
    true_camera: Camera
    """True camera."""
    counts: NDArray[np.uint16]
    """(H, W) range counts as stored by the instrument."""
    intensity: NDArray[np.uint16]
    """(H, W) intensity as stored by the instrument."""
    hot_spots_m: NDArray[np.float64] | None = None
    """(K, 3) positions of the sources, scanner frame; only in the set `gamma`."""
    ladar: Ladar = LADAR
    """The scanner."""


def simulate_case(
    scene: str,
    *,
    set_name: str = "standard",
    seed: int = 0,
    k1: float = 0.0,
    k1_error: float = 0.0,
    focal_error: float = 0.0,
    ladar: Ladar | None = None,
    report: Report | None = None,
) -> SimulatedCase:
    """Simulate a scan and a photograph of a synthetic room; equal arguments give equal bytes.

    Args:
        scene: boxes, desk, office or people.
        set_name: standard, hard, wide, rotated, identical, thermal, gamma or natural.
        seed: not negative; every seed gives another room and pose.
        k1: radial distortion of the true lens.
        k1_error: excess of the stated k1 over the true one.
        focal_error: relative excess of the stated focal length over the true one.
        ladar: the scanner; None: the thesis's, with the speckle of the set.
        report: receives the progress.

    Raises:
        OptionError: if the scene or set does not exist or a number is out of range.
        DependencyError: if `embreex` is not installed.

    Source: models of the thesis's instruments (chapter 2.2); cleaner than reality.
    """
    case_set = _checked_set(scene, set_name, seed, (k1, k1_error, focal_error))
    layout, pose_rng, scan_rng, photo_rng = _streams(scene, set_name, seed)

    def stage(start: int, share: int, label: str) -> Callable[[float], None]:
        def forward(done: float) -> None:
            if report:
                report(Progress(start + round(share * done), 100, label))

        forward(0.0)
        return forward

    stage(0, 15, "building the room")
    world = _build(scene, case_set, layout)
    caster = RayCaster(world.triangles)
    camera_from_scanner = _pose(case_set, seed, world.focus_m, pose_rng)
    true_camera = replace(_CAMERAS[case_set.instrument], distortion=(k1, 0, 0, 0))
    scanner = ladar or Ladar(speckle=case_set.speckle)
    images = scan_world(world, caster, rng=scan_rng, ladar=scanner, report=stage(15, 45, "scanning"))
    name = f"{scene}-{set_name}-{seed}"
    scan = Scan(
        geometry=scanner.geometry,
        ranges=range_from_counts(images.counts, scanner.r0_m, scanner.dr_m).astype(np.float32),
        intensity=images.intensity.astype(np.float32),
        name=name,
    )
    stated = replace(
        true_camera,
        fx=true_camera.fx * (1 + focal_error),
        fy=true_camera.fy * (1 + focal_error),
        distortion=(k1 + k1_error, 0, 0, 0),
    )
    photo, hot_spots_m = _take_photo(
        world,
        caster,
        case_set,
        true_camera,
        stated,
        camera_from_scanner,
        name,
        photo_rng,
        stage(60, 40, "photographing"),
    )
    return SimulatedCase(
        scan=scan,
        photo=photo,
        camera_from_scanner=camera_from_scanner,
        true_camera=true_camera,
        counts=images.counts,
        intensity=images.intensity,
        hot_spots_m=hot_spots_m,
        ladar=scanner,
    )


def case_world(scene: str, *, set_name: str = "standard", seed: int = 0) -> World:
    """Return the room of a simulated case: its true surfaces and edges, in the scanner frame.

    Args:
        scene: boxes, desk, office or people.
        set_name: as in `simulate_case`.
        seed: not negative.

    Raises:
        OptionError: if the scene or set does not exist or the seed is out of range.
    """
    case_set = _checked_set(scene, set_name, seed, ())
    return _build(scene, case_set, _streams(scene, set_name, seed)[0])


def write_case(case: SimulatedCase, folder: Path | str) -> None:
    """Write `scan.npz` (counts form), `photo.png`, `camera.json` and `truth.json` into a folder, created if necessary.

    A thermal photo is a 16-bit gray PNG in centikelvin, as written by thermal cameras; a gamma photo is an 8-bit one of
    photon counts, and its `truth.json` also contains the sources as `hot_spots_m`.

    Args:
        case: the case.
        folder: the target folder; files of these names are replaced.

    Raises:
        ExportError: if they cannot be written there.
    """
    target = Path(folder)
    try:
        target.mkdir(parents=True, exist_ok=True)
        for name, write in case_files(case):
            write(target / name)
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise ExportError(
            f"the simulated case cannot be written to {target}: {reason}; choose a writable folder"
        ) from None


def case_files(case: SimulatedCase) -> list[tuple[str, Callable[[Path], None]]]:
    """Return the names of the files of a case, each with a function that writes it to a path."""
    truth: dict[str, Any] = {POSE_FIELD: case.camera_from_scanner.matrix.tolist(), "made_by": "simulate"}
    if case.hot_spots_m is not None:
        truth["hot_spots_m"] = case.hot_spots_m.tolist()

    def scan(path: Path) -> None:
        scanner = case.ladar
        write_npz_counts(
            path,
            counts=case.counts,
            intensity=case.intensity,
            geometry=scanner.geometry,
            r0_m=scanner.r0_m,
            dr_m=scanner.dr_m,
        )

    def photo(path: Path) -> None:
        path.write_bytes(png_of(case.photo))

    return [
        ("scan.npz", scan),
        ("photo.png", photo),
        ("camera.json", lambda path: write_camera(path, case.photo.camera)),
        ("truth.json", lambda path: write_json(path, truth)),
    ]


def _streams(scene: str, set_name: str, seed: int) -> list[np.random.Generator]:
    """Return one random stream per purpose: more noise must not move the furniture."""
    streams = np.random.SeedSequence([zlib.crc32(f"{scene}/{set_name}".encode()), seed]).spawn(4)
    return [np.random.default_rng(s) for s in streams]


def _build(scene: str, case_set: CaseSet, layout: np.random.Generator) -> World:
    heated = case_set.instrument == "thermal"
    inks = case_set.independent_inks
    return build_scene(scene, layout=layout, independent_inks=inks, heated=heated, natural=case_set.natural)


def _take_photo(
    world: World,
    caster: RayCaster,
    case_set: CaseSet,
    true_camera: Camera,
    stated: Camera,
    pose: Rigid,
    name: str,
    rng: np.random.Generator,
    report: Callable[[float], None],
) -> tuple[Photo, NDArray[np.float64] | None]:
    """Take a photo with the instrument of the set; return it with the stated camera, and the sources that it shows."""
    if case_set.instrument == "thermal":
        kelvin = take_thermal_image(world, caster, true_camera, pose, rng=rng, noise=case_set.noise, report=report)
        return thermal_photo(centikelvin(kelvin) * np.float32(CENTIKELVIN_K), stated, name=name), None
    if case_set.instrument == "gamma":
        image = take_gamma_image(world, caster, true_camera, pose, rng=rng)
        return Photo(np.repeat(image.counts[..., None], 3, axis=-1), stated, name=name), image.hot_spots_m
    pixels = take_photograph(
        world,
        caster,
        true_camera,
        pose,
        lighting=case_set.lighting,
        rng=rng,
        noise=case_set.noise,
        report=report,
    )
    return Photo(pixels=pixels, camera=stated, name=name), None


def _checked_set(scene: str, set_name: str, seed: int, lens: tuple[float, ...]) -> CaseSet:
    if scene not in SCENES:
        raise OptionError(f"there is no scene {scene!r}; the scenes are {', '.join(SCENES)}")
    if set_name not in SETS:
        raise OptionError(f"there is no set {set_name!r}; the sets are {', '.join(SETS)}")
    require_int(seed, "the seed", least=0)
    if not all(math.isfinite(v) and abs(v) <= 0.5 for v in lens):
        raise OptionError(f"k1, its error and the focal error are {lens}; each must lie within -0.5 to 0.5")
    return SETS[set_name]


def _pose(case_set: CaseSet, seed: int, focus_m: float, rng: np.random.Generator) -> Rigid:
    """Return a pose to the left or right of the scanner that looks back at the scene."""
    low, high = case_set.baseline_m
    left = float(rng.choice([-1.0, 1.0]) * rng.uniform(low, high))
    up, ahead = (float(v) for v in rng.uniform(-1, 1, 2) * case_set.other_axes_m)
    limit = case_set.toe_in_limit_deg
    aim = np.degrees(np.arctan2(left, focus_m)) + rng.uniform(-2.5, 2.5)
    pan = float(np.clip(aim, -limit, limit))
    tilt, roll = (float(v) for v in rng.uniform(-1, 1, 2) * case_set.tilt_deg)
    roll += case_set.rolls_deg[seed % len(case_set.rolls_deg)]
    a, b, c = (float(np.radians(v)) for v in (pan, tilt, roll))
    return ThesisParameters(Tx=left, Ty=up, Tz=ahead, alpha=a, beta=b, gamma=c).pose


def png_of(photo: Photo) -> bytes:
    """Return a PNG: 8-bit colour, 8-bit gray where the channels are equal, or 16-bit centikelvin."""
    pixels = photo.pixels[..., ::-1]
    picture: NDArray[Any] = pixels[..., 0] if (pixels == pixels[..., :1]).all() else pixels
    if photo.temperature_k is not None:
        picture = centikelvin(photo.temperature_k)
    _, png = cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_COMPRESSION, 9])
    return png.tobytes()
