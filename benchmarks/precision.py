"""How accurate are poses on coarse and uneven grids? python -m benchmarks.precision [--against CHECKOUT].

Pictures rendered from the coloured points of a terrestrial scan (steps of .25 by .07 degrees) from .3 to .8 m away,
turned by up to 4 degrees, with exact truth; simulated scans of rows and columns of different steps, in rooms with
textures of a natural spectrum; real captures from rough guesses; and the dense rooms of the standard and hard sets.
With --focal-error, their cameras are only assumed. Each case is made once and registered by each version in turn, in
processes that stay; times are the processor's.

The file also runs by its path with another checkout on PYTHONPATH; that is how the other version registers.
"""

from __future__ import annotations

import argparse
import json
import os
import pickle
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_WORK = "--work"
# Focal length (px), size and background of the cameras of the rendered pictures: one pixel per row of the scan is 848.
_PUMP_CAMERAS = ((700.0, 900, 1000, 128), (1000.0, 1200, 1400, 15), (850.0, 1000, 1200, 235))
_PUMP_PICTURES, _PUMP_NEAR_M, _PUMP_FAR_M, _PUMP_TURN_DEG = 12, 0.3, 0.8, 4.0
_BLUR_PX, _NOISE = 0.6, 3.0
# Azimuth and elevation steps, deg.
_STEPS_DEG = ((0.2, 0.05), (0.05, 0.2), (0.3, 0.075), (0.4, 0.1), (0.1, 0.4))
_FIELD_DEG = (55.0, 38.5)
_GUESSES = 6


@dataclass(frozen=True)
class Case:
    """A pair with its truth, as it is sent to each version."""

    set_name: str
    name: str
    scan: str | tuple[Any, NDArray[np.float32], NDArray[np.float32]]
    """A file, or geometry, ranges and intensity."""
    pixels: NDArray[np.uint8]
    camera: dict[str, Any]
    rotation: Floats
    translation: Floats
    initial: tuple[Floats, Floats] | None = None
    focal_error: float | None = None
    """Relative error of the focal length of a camera that is only assumed; None: the camera is stated as it is."""


@dataclass(frozen=True)
class Outcome:
    """What a version makes of a case."""

    accepted: bool
    degrees: float
    mm: float
    sigma_degrees: float
    sigma_mm: float
    sigmas: float
    """RMS error of the six parameters in the pose's own standard deviations."""
    pixels: float
    """Median displacement of what the photograph sees."""
    seconds: float


def register(case: Case, scans: dict[str, Any]) -> Outcome:
    """Register a case by whatever version of the code is imported."""
    import cv2

    import ladarreg_core as lr
    from ladarreg_core.camera import Camera

    if isinstance(case.scan, str):
        scan = scans.setdefault(case.scan, None) or lr.read_scan(case.scan)
        scans[case.scan] = scan
    else:
        geometry, ranges, intensity = case.scan
        scan = lr.Scan(geometry=geometry, ranges=ranges, intensity=intensity, name=case.name)
    camera, truth = Camera(**case.camera), lr.Rigid(case.rotation, case.translation)
    initial = None if case.initial is None else lr.Rigid(*case.initial)
    photo = lr.Photo(case.pixels, camera)
    if case.focal_error is not None:
        assumed = Camera.from_focal(camera.width, camera.height, camera.fx * (1 + case.focal_error))
        photo = lr.Photo(case.pixels, assumed, assumed=True)
    begin = time.process_time()
    result = lr.register(scan, photo, initial=initial)
    seconds = time.process_time() - begin
    pose = result.camera_from_scanner
    turn = cv2.Rodrigues(truth.rotation @ pose.rotation.T)[0][:, 0]
    apart = np.concatenate([turn, truth.centre - pose.centre])
    covariance = np.asarray(result.covariance, np.float64)
    known = bool(np.isfinite(covariance).all())
    points = scan.points[scan.valid].astype(float)
    points = points[:: max(1, len(points) // 5000)]
    true = camera.project(truth @ points)
    seen = camera.contains(true)
    off = np.linalg.norm(true[seen] - result.camera.project(pose @ points[seen]), axis=1)
    off[~np.isfinite(off)] = np.inf
    return Outcome(
        bool(result.accepted), float(np.degrees(pose.angle_to(truth))), 1e3 * float(pose.distance_to(truth)),
        float(np.degrees(np.sqrt(np.trace(covariance[:3, :3])))), 1e3 * float(np.sqrt(np.trace(covariance[3:, 3:]))),
        float(np.sqrt(apart @ np.linalg.solve(covariance, apart) / 6)) if known else float("nan"),
        float(np.median(off)), seconds,
    )  # fmt: skip


def work(source: BinaryIO, sink: BinaryIO) -> None:
    """Register the cases that arrive, until there are no more."""
    scans: dict[str, Any] = {}
    while True:
        try:
            case = pickle.load(source)
        except EOFError:
            return
        pickle.dump(tuple(getattr(register(case, scans), name) for name in Outcome.__dataclass_fields__), sink)
        sink.flush()


class Version:
    """A process that registers by one version of the code."""

    def __init__(self, checkout: Path) -> None:
        here = Path(__file__).resolve()
        environment = {**os.environ, "PYTHONPATH": str(checkout), "OMP_NUM_THREADS": "1"}
        command = [sys.executable, "-P", str(here), _WORK]
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment, cwd=checkout
        )

    def register(self, case: Case) -> Outcome:
        """Return the outcome of a case."""
        sink, source = self._process.stdin, self._process.stdout
        assert sink is not None, "it is a pipe"
        assert source is not None, "it is a pipe"
        pickle.dump(case, sink)
        sink.flush()
        return Outcome(*pickle.load(source))

    def close(self) -> None:
        """End the process."""
        assert self._process.stdin is not None, "it is a pipe"
        self._process.stdin.close()
        self._process.wait()


def _data() -> Path:
    return Path(os.environ.get("LADARREG_DATA") or Path(__file__).resolve().parents[2] / "shared" / "data")


def pump_cases(count: int) -> Iterator[Case]:
    """Pictures of the pump's own colours from elsewhere, blurred and with noise."""
    import cv2

    import ladarreg_core as lr
    from ladarreg_core.frames import look_along, rotation_from_rotvec
    from ladarreg_core.surface.visibility.render import render_scan_colors

    path = _data() / "pump" / "pumpAVisualReferenceImage.e57"
    if not path.is_file():
        print("  pump: not there, skipped")
        return
    scan = lr.read_scan(path)
    middle = np.median(scan.points[scan.valid], axis=0)
    for seed in range(count):
        focal, width, height, gray = _PUMP_CAMERAS[seed % len(_PUMP_CAMERAS)]
        camera = lr.Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
        rng = np.random.default_rng([seed, 11])
        way = rng.normal(size=3)
        centre = way / np.linalg.norm(way) * rng.uniform(_PUMP_NEAR_M, _PUMP_FAR_M)
        turn = rotation_from_rotvec(np.radians(rng.uniform(-_PUMP_TURN_DEG, _PUMP_TURN_DEG, 3)))
        truth = lr.Rigid.from_centre(turn @ look_along(middle - centre), centre)
        drawn, _ = render_scan_colors(scan, camera, truth, background=(gray, gray, gray))
        noisy = cv2.GaussianBlur(drawn, (0, 0), _BLUR_PX) + rng.normal(0, _NOISE, drawn.shape)
        pixels = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
        yield Case("pump", f"{seed}", str(path), pixels, _fields(camera), truth.rotation, truth.translation)


def uneven_cases(count: int) -> Iterator[Case]:
    """Simulated rooms with natural textures, scanned with steps four times as wide in one direction."""
    from ladarreg_core.scanner.grids import AzimuthElevation
    from ladarreg_core.simulate import SCENES, simulate_case
    from ladarreg_core.simulate.ladar import Ladar

    for number in range(count):
        azimuth, elevation = _STEPS_DEG[number % len(_STEPS_DEG)]
        rows, columns = round(_FIELD_DEG[1] / elevation), round(_FIELD_DEG[0] / azimuth)
        grid = AzimuthElevation(rows, columns, float(np.radians(azimuth)), float(np.radians(elevation)))
        scene, seed = tuple(SCENES)[number % len(SCENES)], 3000 + number
        case = simulate_case(scene, set_name="natural", seed=seed, ladar=Ladar(geometry=grid))
        yield _simulated(f"uneven {max(azimuth, elevation):g}", f"{scene} {azimuth:g} x {elevation:g}", case)


def dense_cases(count: int) -> Iterator[Case]:
    """The rooms of the standard and hard sets."""
    from ladarreg_core.simulate import SCENES, simulate_case

    for number in range(count):
        scene, set_name = tuple(SCENES)[number // 2 % len(SCENES)], ("standard", "hard")[number % 2]
        yield _simulated(set_name, scene, simulate_case(scene, set_name=set_name, seed=3100 + number))


def real_cases(count: int) -> Iterator[Case]:
    """Real captures, from guesses that are 5 degrees and .3 m off; of the Kinect, from none."""
    import ladarreg_core as lr
    from benchmarks.matching.sparse_sets import off_by

    captures = (
        ("kinect", "scan.json", "color_1.jpg"),
        ("garage", "scan.npz", "frame9.png"),
        ("street", "scan.pcd", "photo.png"),
    )
    for name, scan, picture in captures:
        folder = _data() / name
        if not folder.is_dir():
            print(f"  {name}: not there, skipped")
            continue
        photo = lr.read_photo(folder / picture, camera=folder / "camera.json")
        truth = lr.Rigid.from_matrix(json.loads((folder / "truth.json").read_text())["camera_from_scanner"])
        for seed in range(1 if name == "kinect" else count):
            guess = None if name == "kinect" else off_by(truth, seed)
            initial = None if guess is None else (guess.rotation, guess.translation)
            yield Case(
                name, f"{seed}", str(folder / scan), photo.pixels, _fields(photo.camera), truth.rotation,
                truth.translation, initial,
            )  # fmt: skip


def _simulated(set_name: str, name: str, case: Any) -> Case:
    scan, truth = case.scan, case.camera_from_scanner
    return Case(
        set_name, name, (scan.geometry, scan.ranges, scan.intensity), case.photo.pixels, _fields(case.photo.camera),
        truth.rotation, truth.translation,
    )  # fmt: skip


def _fields(camera: Any) -> dict[str, Any]:
    return {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy", "distortion")}


SETS: dict[str, tuple[Callable[[int], Iterator[Case]], int]] = {
    "pump": (pump_cases, _PUMP_PICTURES),
    "uneven": (uneven_cases, 20),
    "dense": (dense_cases, 16),
    "real": (real_cases, _GUESSES),
}
"""Sets by name, with the number of their cases."""


def _line(name: str, rows: list[Outcome]) -> str:
    medians = np.median([[r.degrees, r.mm, r.sigma_degrees, r.sigma_mm, r.pixels, r.seconds] for r in rows], axis=0)
    sigmas = np.sqrt(np.nanmean([r.sigmas**2 for r in rows]))
    accepted = sum(r.accepted for r in rows)
    deg, mm, sigma_deg, sigma_mm, px, seconds = medians
    return (
        f"| {name} | {len(rows)} | {accepted} | {deg:.4f} | {mm:.2f} | {px:.3f} | {sigma_deg:.3f} | {sigma_mm:.1f} "
        f"| {sigmas:.2f} | {seconds:.2f} |"
    )


def main() -> None:
    """Measure, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--against", type=Path, action="append", default=[], help="another checkout; may be repeated")
    parser.add_argument("--sets", default=",".join(SETS))
    parser.add_argument("--cases", type=int, default=None, help="cases of each set")
    parser.add_argument("--each", action="store_true", help="print every case")
    parser.add_argument(
        "--focal-error",
        type=float,
        default=None,
        metavar="SHARE",
        help="cameras are only assumed: this share too long or too short in turn, with a centred, undistorted image",
    )
    arguments = parser.parse_args()
    own = Path(__file__).resolve().parents[1]
    versions = {path.resolve().name: Version(path.resolve()) for path in (*arguments.against, own)}
    found: dict[tuple[str, str], list[Outcome]] = {}
    for set_name in arguments.sets.split(","):
        make, count = SETS[set_name]
        for number, case in enumerate(make(arguments.cases or count)):
            if arguments.focal_error is not None:
                case = replace(case, focal_error=arguments.focal_error * (-1) ** number)
            for name, version in versions.items():
                outcome = version.register(case)
                found.setdefault((case.set_name, name), []).append(outcome)
                if arguments.each:
                    print(_line(f"{case.set_name} {case.name}, {name}", [outcome]), flush=True)
    for version in versions.values():
        version.close()
    print("\n| set, version | cases | accepted | deg | mm | px | sigma deg | sigma mm | error / sigma | s |")
    print("|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|")
    for (set_name, name), rows in found.items():
        print(_line(f"{set_name}, {name}", rows))
    for name in list(versions)[:-1]:
        print(f"\n{own.name} over {name}: medians of deg, mm; median of the ratios of time")
        for set_name in dict.fromkeys(key[0] for key in found):
            before, after = found[set_name, name], found[set_name, own.name]
            deg, mm = (
                np.median([getattr(r, kind) for r in after]) / np.median([getattr(r, kind) for r in before])
                for kind in ("degrees", "mm")
            )
            ratio = np.median([b.seconds / a.seconds for a, b in zip(before, after, strict=True)])
            print(f"  {set_name}: {deg:.2f}, {mm:.2f}; {ratio:.2f}")


if __name__ == "__main__":
    if sys.argv[1:] == [_WORK]:
        sys.modules["benchmarks.precision"] = sys.modules["__main__"]  # where the cases are from
        work(sys.stdin.buffer, sys.stdout.buffer)
    else:
        from benchmarks import precision  # so that the cases are of the module's classes

        precision.main()
