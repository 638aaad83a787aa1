"""Cameras that are stated wrongly: is a pose that is accepted right within its stated uncertainty?

    python -m benchmarks.trust [--photos 200] [--first-seed 0] [--against CHECKOUT] [--rows]

Every simulated pair gives several photographs: with a focal length 1 to 5 % wrong; cut out off the middle; as a phone
saves it in 16:9, 20:9 or 1:1, with the 35 mm equivalent of its whole 4:3 sensor; and stored upside down with the
calibration of the stored pixels. The figure is the Mahalanobis distance of the pose to the truth, with 6 degrees of
freedom, by the covariance that is reported. Seeds below 10,000 served to set thresholds; figures are reported on
others. `--against` does the same with another checkout's code, photograph by photograph in turn.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

import ladarreg_core as lr
from ladarreg_core.camera import Camera
from ladarreg_core.photo import Photo
from ladarreg_core.simulate import simulate_case
from ladarreg_core.simulate.case import SimulatedCase

SCENES = ("boxes", "desk", "office", "people")
SETS = ("standard", "standard", "hard", "standard", "wide")
KINDS = ("focal", "centre", "crop", "focal", "turned")
_FAR, _TOO_FAR = 5.0, 7.0
_CONSISTENT = (0.85, 1.15)
_MAX_FAR, _MIN_ACCEPTED = 2, 0.90
_FOCAL_ERROR, _SMALL_FOCAL_ERROR = (0.01, 0.05), 0.03
_CENTRE_ERROR = 0.03
_TURNED_CENTRE = (9.0, -6.0)  # px off the middle of a calibrated camera
_FILM_DIAGONAL_MM = float(np.hypot(36, 24))
_SHAPES = {"16:9": (0.0, 9 / 16), "20:9": (0.0, 9 / 20), "1:1": (1.0, 1.0)}
_QUALITY = 97


@dataclass(frozen=True)
class Row:
    """One photograph."""

    kind: str
    seed: int
    scene: str
    focal_error: float
    """Relative error of the stated focal length."""
    centre_error: float
    """Error of the stated principal point, share of the width."""
    accepted: bool
    distance: float
    """Mahalanobis distance of the pose to the truth."""
    error_mm: float
    sigma_mm: float
    error_deg: float
    focal_ratio: float
    """Focal length of the result relative to the true one."""
    seconds: float
    reasons: tuple[str, ...]


@dataclass(frozen=True)
class Case:
    """A photograph as it is given, with what it truly is."""

    kind: str
    seed: int
    scene: str
    scan: lr.Scan
    photo: Photo
    truth: lr.Rigid
    true_camera: Camera


def cases(first_seed: int, photos: int) -> Iterator[Case]:
    """Return the photographs of `photos` / 5 simulated pairs."""
    for seed in range(first_seed, first_seed + -(-photos // len(KINDS))):
        scene, set_name = SCENES[seed % len(SCENES)], SETS[seed % len(SETS)]
        rng = np.random.default_rng([seed, 815])
        pair = simulate_case(scene, set_name=set_name, seed=seed, k1=float(rng.normal(0, 0.03)))
        for kind in KINDS:
            yield _case(kind, seed, scene, pair, rng)


def _case(kind: str, seed: int, scene: str, pair: SimulatedCase, rng: np.random.Generator) -> Case:
    true = pair.true_camera
    pixels = pair.photo.pixels
    if kind == "focal":
        focal = true.fx * (1 + float(rng.choice((-1, 1)) * rng.uniform(*_FOCAL_ERROR)))
        photo = Photo(pixels, Camera.from_focal(true.width, true.height, focal), assumed=True)
    elif kind == "centre":
        width, height = round(true.width * 0.92), round(true.height * 0.92)
        off = rng.uniform(-_CENTRE_ERROR, _CENTRE_ERROR, 2) * width
        left, top = (
            int(np.clip(round((whole - part) / 2 + by), 0, whole - part))
            for whole, part, by in zip(true.size, (width, height), off, strict=True)
        )
        pixels = np.ascontiguousarray(pixels[top : top + height, left : left + width])
        true = replace(true, width=width, height=height, cx=true.cx - left, cy=true.cy - top)
        focal = true.fx * (1 + float(rng.uniform(-_SMALL_FOCAL_ERROR, _SMALL_FOCAL_ERROR)))
        photo = Photo(pixels, Camera.from_focal(width, height, focal), assumed=True)
    elif kind == "crop":
        photo, true = _phone(pixels, true, str(rng.choice(list(_SHAPES))))
    else:
        photo, true = _turned(pixels, true)
    return Case(kind, seed, scene, pair.scan, photo, pair.camera_from_scanner, true)


def _phone(pixels: np.ndarray, true: Camera, shape: str) -> tuple[Photo, Camera]:
    """Return what a phone saves of a picture: a part of its 4:3 sensor, with the equivalent of the whole one."""
    height, width = pixels.shape[:2]
    square, aspect = _SHAPES[shape]
    sensor = (width, width * 3 / 4) if not square else (height * 4 / 3, height)
    new_width, new_height = (height, height) if square else (width, round(width * aspect))
    left, top = (width - new_width) // 2, (height - new_height) // 2
    part = pixels[top : top + new_height, left : left + new_width]
    exif = Image.Exif()
    equivalent = true.fx / np.hypot(*sensor) * _FILM_DIAGONAL_MM
    exif.get_ifd(0x8769).update({0x920A: equivalent / 6, 0xA405: round(equivalent)})
    photo = _read(part, exif, None)
    return photo, replace(true, width=new_width, height=new_height, cx=true.cx - left, cy=true.cy - top)


def _turned(pixels: np.ndarray, true: Camera) -> tuple[Photo, Camera]:
    """Return a picture stored upside down, with a calibration of the pixels as stored."""
    margin = [round(2 * abs(off)) for off in _TURNED_CENTRE]
    left, top = (m if off < 0 else 0 for m, off in zip(margin, _TURNED_CENTRE, strict=True))
    height, width = pixels.shape[0] - margin[1], pixels.shape[1] - margin[0]
    part = pixels[top : top + height, left : left + width]
    true = replace(true, width=width, height=height, cx=true.cx - left, cy=true.cy - top)
    stored = replace(true, cx=width - 1 - true.cx, cy=height - 1 - true.cy)
    exif = Image.Exif()
    exif[0x0112] = 3
    return _read(part[::-1, ::-1], exif, stored), true


def _read(pixels: np.ndarray, exif: Any, camera: Camera | None) -> Photo:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "photo.jpg"
        data = io.BytesIO()
        Image.fromarray(np.ascontiguousarray(pixels)).save(data, "JPEG", quality=_QUALITY, subsampling=0, exif=exif)
        path.write_bytes(data.getvalue())
        if camera is None:
            return lr.read_photo(path)
        described = Path(folder) / "camera.json"
        described.write_text(camera.to_json())
        return lr.read_photo(path, camera=described)


def row_of(case: Case) -> Row:
    """Register a photograph and compare the pose with the truth."""
    begun = time.perf_counter()
    result = lr.register(case.scan, case.photo)
    seconds = time.perf_counter() - begun
    from ladarreg_core.frames import rotvec_from_rotation

    found = result.camera_from_scanner
    turn = rotvec_from_rotation(case.truth.rotation @ found.rotation.T)
    off = np.concatenate([turn, case.truth.centre - found.centre])
    stated = case.photo.pinhole
    return Row(
        case.kind, case.seed, case.scene,
        stated.focal_px / case.true_camera.focal_px - 1,
        float(np.hypot(stated.cx - case.true_camera.cx, stated.cy - case.true_camera.cy)) / stated.width,
        result.accepted,
        float(np.sqrt(off @ np.linalg.solve(result.covariance, off))),
        float(1000 * np.linalg.norm(off[3:])), 1000 * result.sigma_position_m, float(np.degrees(np.linalg.norm(turn))),
        result.camera.focal_px / case.true_camera.focal_px,
        seconds, tuple(result.reasons),
    )  # fmt: skip


def report(title: str, rows: Sequence[Row]) -> None:
    """Print the figures of the photographs, of all and by kind."""
    print(f"{title}: {len(rows)} photographs")
    for kind in ("all", *dict.fromkeys(KINDS)):
        some = [row for row in rows if kind in ("all", row.kind)]
        good = [row for row in some if row.accepted]
        if not some:
            continue
        d = np.array([row.distance for row in good] or [np.nan])
        consistency = float(np.sqrt(np.mean(d**2) / 6))
        far, too_far = int((d > _FAR).sum()), int((d > _TOO_FAR).sum())
        small = [row for row in some if abs(row.focal_error) < _SMALL_FOCAL_ERROR]
        share = np.mean([row.accepted for row in small]) if small else float("nan")
        print(
            f"  {kind:7} accepted {len(good):4} of {len(some):4} ({share:4.0%} of those less than 3 % off); beyond "
            f"{_FAR:g}: {far}, {_TOO_FAR:g}: {too_far}; RMS / sqrt 6 {consistency:.2f}; median error "
            f"{np.median([r.error_mm for r in good] or [np.nan]):.1f} mm, stated "
            f"{np.median([r.sigma_mm for r in good] or [np.nan]):.1f}, worst "
            f"{max((r.error_mm for r in good), default=float('nan')):.0f}; {np.median([r.seconds for r in some]):.2f} s"
        )
    bad = sorted((row for row in rows if row.accepted and row.distance > _FAR), key=lambda row: -row.distance)
    for row in bad[:20]:
        print(
            f"    {row.kind} {row.scene} {row.seed}: {row.distance:.1f}, {row.error_mm:.0f} mm at {row.sigma_mm:.1f}, "
            f"{row.error_deg:.2f} deg; stated focal length {row.focal_error:+.1%}, found {row.focal_ratio - 1:+.2%}"
        )


def _rows_of_other(checkout: Path, first_seed: int, photos: int) -> list[Row]:
    """Return the rows of another checkout's code on the same photographs."""
    environment = os.environ | {"PYTHONPATH": str(checkout)}
    command = [sys.executable, __file__, "--rows", "--photos", str(photos), "--first-seed", str(first_seed)]
    done = subprocess.run(command, cwd=checkout, env=environment, capture_output=True, text=True, check=True)
    return [Row(**json.loads(line)) for line in done.stdout.splitlines() if line.startswith("{")]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photos", type=int, default=200)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--against", type=Path, metavar="CHECKOUT", help="another checkout, measured likewise")
    parser.add_argument("--rows", action="store_true", help="print the rows as JSON instead of the figures")
    a = parser.parse_args()
    if a.rows:
        for case in cases(a.first_seed, a.photos):
            print(json.dumps(asdict(row_of(case))), flush=True)
        return
    if a.against is not None:
        report(f"Code of {a.against.name}", _rows_of_other(a.against, a.first_seed, a.photos))
    report("This code", [row_of(case) for case in cases(a.first_seed, a.photos)])


if __name__ == "__main__":
    main()
