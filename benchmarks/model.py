"""One model from many photographs: a photograph withheld, things that moved, known exposures, time and memory.

Run it as `python -m benchmarks.model`; `--huge` measures 28 million cells, `--figure` writes docs/pictures/model.png.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from ladarreg_core.camera import Camera
from ladarreg_core.foundations.linear_light import linear_light
from ladarreg_core.foundations.palette import UNSEEN
from ladarreg_core.fusion.fused_model import FusedModel, fuse
from ladarreg_core.fusion.layers import model_layers
from ladarreg_core.photo import Photo
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation
from ladarreg_core.surface.texture.best_photo import NO_PHOTO, PosedPhoto, best_photo
from ladarreg_core.surface.texture.registered_texture import Label
from testing.scenes.photo_tour import PhotoTour, light_error, photo_tour, scan_of_tour
from testing.scenes.survey_set import simulate_survey

SEEDS = range(3)
WITHHELD = (1, 5, 9)
MOVED_SEEDS = range(4)
CELLS = ((740, 676), (1046, 956), (1480, 1352))  # half a million, one and two
PHOTO = (4000, 3000)
PHOTOS = 20
HUGE, HUGE_PHOTOS = (5000, 5600), 5
PICTURE = Path(__file__).resolve().parents[1] / "docs" / "pictures" / "model.png"
FIGURE_PHOTOS = 14


def last_writer(model: FusedModel) -> tuple[np.ndarray, np.ndarray]:
    """Return the photograph and the colour of each cell if each photograph is written over those before."""
    photo = np.full(model.scan.shape, NO_PHOTO, np.uint16)
    image = np.empty((*model.scan.shape, 3), np.uint8)
    image[:] = UNSEEN
    for k, sample in enumerate(model.samples):
        photo[sample.here][sample.colored] = k
        image[sample.here][sample.colored] = sample.color[sample.colored]
    return photo, image


def difference(image: np.ndarray, other: np.ndarray, cells: np.ndarray) -> float:
    """Return the median difference of two pictures (H, W, 3) over cells, codes, after one gain a channel."""
    return light_error(image, linear_light(other), cells)


def withheld(tour: PhotoTour, left_out: int) -> tuple[float, float, float, float]:
    """Return the error of the fused colours of the other photographs in what one shows, relative to three peers.

    They are the photograph that is nearest to it, on what both show; the best photograph of each cell; the last writer.
    """
    views = [view for k, view in enumerate(tour.views) if k != left_out]
    model = fuse(tour.scan, views)
    (alone,) = fuse(tour.scan, [tour.views[left_out]]).samples
    true = np.zeros((*tour.scan.shape, 3), np.uint8)
    true[alone.here] = alone.color
    shown = np.zeros(tour.scan.shape, np.bool_)
    shown[alone.here] = alone.labels == Label.SEEN
    errors = []
    for sample in model.samples:
        both = np.zeros(tour.scan.shape, np.bool_)
        both[sample.here] = sample.labels == Label.SEEN
        both &= shown & (model.labels == Label.SEEN)
        if both.sum() < 0.05 * shown.sum():
            continue
        own = np.zeros_like(true)
        own[sample.here] = sample.color
        errors.append((difference(own, true, both), difference(model.image, true, both)))
    single, same = min(errors)
    cells = shown & (model.labels == Label.SEEN)
    fused = difference(model.image, true, cells)
    best = difference(best_photo(tour.scan, views).image, true, cells)
    last = difference(last_writer(model)[1], true, cells)
    return fused, same / single, fused / best, fused / last


def measure_withheld() -> None:
    print("a photograph withheld, 12 photographs with exposures that differ by 20 %: error of the fused colours")
    print(
        f"{'seed':>4} {'photo':>5} {'codes':>6} {'/ best single':>14} {'/ best of each cell':>20} {'/ last writer':>14}"
    )
    ratios = []
    for seed in SEEDS:
        tour = photo_tour(seed, photos=12)
        for left_out in WITHHELD:
            found = withheld(tour, left_out)
            ratios.append(found)
            print(f"{seed:>4} {left_out + 1:>5} {found[0]:6.2f} {found[1]:14.2f} {found[2]:20.2f} {found[3]:14.2f}")
    middle = np.median(ratios, axis=0)
    print(f"{'median':>10} {middle[0]:6.2f} {middle[1]:14.2f} {middle[2]:20.2f} {middle[3]:14.2f}   (bar 1.15)\n")


def measure_moved() -> None:
    print("five things that moved, 20 photographs: cells that show one, and gains")
    print(f"{'seed':>4} {'last writer':>12} {'best photo':>11} {'fused':>6} {'/ last':>7} {'gains off, %':>13}")
    total = np.zeros(3)
    for seed in MOVED_SEEDS:
        tour = photo_tour(seed, photos=20, moved=5)
        model = fuse(tour.scan, tour.views)
        photos = last_writer(model)[0], best_photo(tour.scan, tour.views).photo, model.photo
        ghosts = np.array([int(tour.shows_moved(photo).sum()) for photo in photos])
        total += ghosts
        off = 100 * np.abs(model.gains.gains / tour.gains - 1).max()
        print(f"{seed:>4} {ghosts[0]:>12} {ghosts[1]:>11} {ghosts[2]:>6} {ghosts[2] / ghosts[0]:7.2f} {off:13.2f}")
    print(f" all {total[0]:>12.0f} {total[1]:>11.0f} {total[2]:>6.0f} {total[2] / total[0]:7.2f}   (bar .50)\n")


def measure_vignetting() -> None:
    print(
        "lenses that leave .58 and .45 of the light at the corners, 12 photographs: error of the fused colours, codes"
    )
    print(f"{'seed':>4} {'corner':>7} {'as it is':>9} {'--vignetting':>13} {'corner found':>13}")
    for seed in SEEDS:
        for powers in ((0.0, 0.0), (-0.3, -0.25), (-0.6, -0.2)):
            tour = photo_tour(seed, photos=12, vignetting=powers)
            models = [fuse(tour.scan, tour.views, vignetting=asked) for asked in (False, True)]
            cells = np.isfinite(tour.truth[..., 0])
            errors = [light_error(one.image, tour.truth, cells & (one.labels == Label.SEEN)) for one in models]
            corners = np.exp(models[1].vignetting.sum(axis=1))
            corner = np.exp(sum(powers))
            print(
                f"{seed:>4} {corner:7.3f} {errors[0]:9.2f} {errors[1]:13.2f} {corners.min():7.3f}-{corners.max():.3f}"
            )
    print()


def large_job(rows: int, columns: int, photos: int) -> None:
    """Fuse photographs of 12 megapixels on a scan, and print processor seconds and the peak of memory as JSON."""
    coarse, _ = scan_of_tour(0, cells=(740, round(740 * columns / rows)))
    ranges, intensity = (
        np.asarray(cv2.resize(np.asarray(one), (columns, rows), interpolation=cv2.INTER_NEAREST))
        for one in (coarse.ranges, coarse.intensity)
    )
    step = np.deg2rad(33) / rows
    scan = Scan(AzimuthElevation(rows, columns, step, step), ranges, intensity)
    base = photo_tour(0, photos=photos, cells=(60, 84), size=(200, 150))
    views = []
    for view in base.views:
        scale = PHOTO[0] / view.camera.width
        camera = Camera.from_focal(*PHOTO, view.camera.focal_px * scale)
        pixels = np.asarray(cv2.resize(view.photo.pixels, PHOTO, interpolation=cv2.INTER_LINEAR), np.uint8)
        views.append(PosedPhoto(Photo(pixels, camera), view.camera_from_scanner, camera, view.covariance))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    started, wall = time.process_time(), time.perf_counter()
    model = fuse(scan, views)
    took = time.process_time() - started
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    print(json.dumps({
        "cells": scan.ranges.size, "cpu_s": took, "wall_s": time.perf_counter() - wall, "peak_gb": peak / 1e6,
        "before_gb": before / 1e6, "colored": float((model.photo != NO_PHOTO).mean()),
        "views_a_cell": float(model.seen_by.mean()),
    }))  # fmt: skip


def measure_cost(sizes: Sequence[tuple[int, int]], photos: int) -> None:
    print(f"time and memory of the fusion alone, {photos} photographs of 12 Mpixel; processor seconds of all threads")
    print(
        f"{'cells':>9} {'processor, s':>13} {'wall, s':>8} {'peak, GB':>9} {'photos and scan':>16} {'views a cell':>13}"
    )
    found = []
    for cells in sizes:
        command = [sys.executable, "-m", "benchmarks.model", "--large", *map(str, (*cells, photos))]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        one = json.loads(done.stdout.splitlines()[-1])
        found.append(one)
        print(
            f"{one['cells']:>9} {one['cpu_s']:13.1f} {one['wall_s']:8.1f} {one['peak_gb']:9.2f} "
            f"{one['before_gb']:16.2f} {one['views_a_cell']:13.1f}"
        )
    if len(found) < 2:
        return
    growth = np.polyfit(np.log([one["cells"] for one in found]), np.log([one["cpu_s"] for one in found]), 1)[0]
    print(f"growth of the time with the cells: exponent {growth:.2f} (bar 1.1); bars 60 s, 3 GB\n")


def draw() -> None:
    """Write the figure of the documentation."""
    survey = simulate_survey("office", seed=3, stations=1, photos=FIGURE_PHOTOS, strangers=0, step_deg=0.25, size=0.75)
    rng = np.random.default_rng(0)
    views = []
    for one in survey.photos:
        assert one.camera_from_world is not None
        camera = survey.cameras[one.camera]
        gain = np.exp(rng.normal(0, 0.25) + rng.normal(0, 0.1, 3))
        codes = (255 * np.clip(linear_light(np.arange(256))[:, None] * gain, 0, 1) ** (1 / 2.2)).astype(np.uint8)
        pixels = np.asarray(cv2.LUT(one.pixels, codes[None]), np.uint8)
        pose = survey.in_first(one.camera_from_world)
        views.append(PosedPhoto(Photo(pixels, camera, name=one.name), pose, camera, np.diag([1e-7] * 3 + [2e-6] * 3)))
    model = fuse(survey.scans[0], views)
    layers = {one.name: one for one in model_layers([model])}
    rows = np.flatnonzero((model.photo != NO_PHOTO).any(axis=1))
    crop = slice(max(rows[0], 100), rows[-1] + 1), slice(0, int(0.46 * model.scan.shape[1]))
    pictures = [
        last_writer(model)[1], best_photo(model.scan, views).image, model.image, layers["intensity"].draw(0),
        layers["photo_id"].draw(0), layers["resolution_mm"].draw(0),
    ]  # fmt: skip
    tiles = [np.pad(one[crop], ((0, 6), (0, 6), (0, 0))) for one in pictures]
    shown = np.concatenate([np.concatenate(tiles[k : k + 2], axis=1) for k in range(0, len(tiles), 2)])
    width = 1100
    height = round(len(shown) * width / shown.shape[1])
    small = cv2.resize(shown, (width, height), interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(PICTURE), small[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])
    print(f"wrote {PICTURE}")


def main(words: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--figure", action="store_true", help="write the figure of docs/model.md, and nothing else")
    parser.add_argument("--huge", action="store_true", help="28 million cells and five photographs, and nothing else")
    parser.add_argument("--large", nargs=3, type=int, metavar=("ROWS", "COLUMNS", "PHOTOS"), help=argparse.SUPPRESS)
    arguments = parser.parse_args(words)
    if arguments.large:
        large_job(*arguments.large)
    elif arguments.huge:
        measure_cost([HUGE], HUGE_PHOTOS)
    elif arguments.figure:
        draw()
    else:
        measure_withheld()
        measure_moved()
        measure_vignetting()
        measure_cost(CELLS, PHOTOS)


if __name__ == "__main__":
    main()
